"""Inverse kinematics of the UR5, one pose alone and in batches (target: closed form 50 us for one pose).

Run with ``python -m tests.benchmarks.bench_ik`` from the checkout.
"""

import timeit
from collections.abc import Callable

import numpy as np

from seal_gym.core.kinematics import tip_kinematics
from seal_gym.planning import ik, ik_kernel, newton

_HOME = np.radians([-4.0, -117.8, -94.7, -102.4, 87.2, -92.8])


def cases(batch: int) -> dict[str, Callable[[], object]]:
    """What is timed, for ``batch`` poses."""
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (batch, 6))
    poses = tip_kinematics(q, np.zeros_like(q)).pose
    return {
        "closed form, numpy": lambda: ik.solve(poses),
        "closed form, compiled": lambda: ik_kernel.solve(poses),
        "Newton from a home posture": lambda: newton.solve(poses, _HOME, np.random.default_rng(1)),
    }


def microseconds(
    functions: dict[str, Callable[[], object]], number: int, rounds: int = 20
) -> dict[str, float]:
    """Best time of each, the rounds interleaved so that all see the same clock."""
    best = dict.fromkeys(functions, float("inf"))
    for _ in range(rounds):
        for name, function in functions.items():
            best[name] = min(best[name], timeit.timeit(function, number=number) / number * 1e6)
    return best


def main() -> None:
    """Prints the table."""
    for batch in (1, 100, 10_000):
        print(f"N = {batch}")
        for name, value in microseconds(cases(batch), max(1, 100 // batch)).items():
            print(f"  {name:<28}{value:11.1f} us  {value / batch:8.2f} us a pose")


if __name__ == "__main__":
    main()
