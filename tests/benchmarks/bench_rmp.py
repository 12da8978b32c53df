"""Cost of a resolve, against a 6x6 ``numpy.linalg.solve`` in the same run.

Run with ``python -m tests.benchmarks.bench_rmp`` from the checkout. Ratios travel between machines,
microseconds do not.
"""

import timeit
from collections.abc import Callable

import numpy as np

from seal_gym.rmp import (
    ResolveCfg,
    SeamErrors,
    fixed_policies,
    gather,
    joint_limits,
    on_tip,
    reference_twist,
    resolve,
    seam_policies,
)


def cases(batch: int) -> dict[str, Callable[[], object]]:
    """What is timed, for ``batch`` simulations."""
    rng = np.random.default_rng(0)
    jacobian, drift = rng.normal(size=(batch, 6, 6)), rng.normal(size=(batch, 6))
    matrix, vector = jacobian[0] @ jacobian[0].T, drift[0]
    errors = SeamErrors(*0.01 * rng.normal(size=(5, batch)))
    twist, cfg = 0.01 * rng.normal(size=(batch, 6)), ResolveCfg()
    reference = reference_twist(0.01, np.zeros((batch, 6)))
    q = np.zeros((batch, 6))

    def policies() -> list[object]:
        return [
            *seam_policies(errors, twist, reference),
            *fixed_policies(errors, twist, reference, twist),
        ]

    leaves = [on_tip(*policy, jacobian, drift) for policy in policies()]
    limits = joint_limits(q, q, -np.ones(6), np.ones(6))
    root = gather(leaves)
    return {
        "numpy 6x6 solve": lambda: np.linalg.solve(matrix, vector),
        "resolve, six tip leaves": lambda: resolve(leaves[:6], jacobian, cfg),
        "resolve, eight tip leaves and joint limits": lambda: resolve([*leaves, limits], jacobian, cfg),
        "resolve of a summed RMP": lambda: resolve(root, jacobian, cfg),
        "the eight tip policies": policies,
        "joint limits": lambda: joint_limits(q, q, -np.ones(6), np.ones(6)),
    }


def microseconds(functions: dict[str, Callable[[], object]], rounds: int = 30) -> dict[str, float]:
    """Best time of each, the rounds interleaved so that all see the same clock."""
    best = dict.fromkeys(functions, float("inf"))
    for _ in range(rounds):
        for name, function in functions.items():
            best[name] = min(best[name], timeit.timeit(function, number=200) / 200 * 1e6)
    return best


def main() -> None:
    """Prints the table."""
    for batch in (1, 16, 256):
        times = microseconds(cases(batch), rounds=30 if batch < 100 else 5)
        base = times["numpy 6x6 solve"]
        print(f"N = {batch}")
        for name, value in times.items():
            print(f"  {name:<44}{value:9.1f} us  {value / base:7.1f} x solve  {value / batch:7.2f} us each")


if __name__ == "__main__":
    main()
