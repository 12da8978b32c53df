"""Inverse kinematics of the UR5: how often, how exactly and how fast each method finds a posture.

    python -m experiments.inverse_kinematics --poses 10000 --seed 500000 --out experiments/results

Postures are drawn over the joints' whole range and their poses taken from pinocchio, which also judges what
the methods find: reached is within 1e-6 m and 1e-6 rad and within the joints' limits. Times are of the
machine that ran it. Writes inverse_kinematics.json, .csv and .md.
"""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from experiments import command, results
from experiments.reference_arm import ReferenceArm
from seal_gym.core.frames import Array
from seal_gym.core.kinematics import JOINT_LOWER, JOINT_UPPER
from seal_gym.core.provenance import version
from seal_gym.planning import ik, ik_kernel, newton
from seal_gym.planning.newton import Linearised, NewtonCfg

NAME = "inverse_kinematics"
HOME = np.radians([-4.0, -117.8, -94.7, -102.4, 87.2, -92.8])  # at the start of a seam
POSITION_M, ROTATION_RAD = 1e-6, 1e-6
_ALONE = 20  # poses that are timed one by one

Row = dict[str, Any]


class Found(NamedTuple):
    """What a method found.

    Attributes:
        q: Shape (N, 6), rad; NaN where nothing.
        iterations: Shape (N,); None for a closed form.
        restarts: Shape (N,); None for a closed form.
    """

    q: Array
    iterations: NDArray[np.int64] | None = None
    restarts: NDArray[np.int64] | None = None


Method = Callable[[Array], Found]


def _newton(cfg: NewtonCfg, model: newton.Model = newton.ur5_tip) -> Method:
    def solve(poses: Array) -> Found:
        return Found(*newton.solve(poses, HOME, np.random.default_rng(1), model=model, cfg=cfg))

    return solve


def _without_target(q: Array, target: Array) -> Linearised:
    """Eqs. 36-37 as printed: zeta lacks the target, so that every pose is driven to zero."""
    return newton.ur5_tip(q, np.broadcast_to(np.eye(4), target.shape))


def _loop(arm: ReferenceArm) -> Method:
    def solve(poses: Array) -> Found:
        many = tqdm(poses, desc="pinocchio", leave=False, disable=len(poses) == 1)
        loops = [arm.loop(pose, HOME, POSITION_M / 10) for pose in many]
        q = ik.within(np.stack([found.q for found in loops]), JOINT_LOWER, JOINT_UPPER)
        iterations = np.array([found.iterations for found in loops])
        return Found(q, iterations, np.zeros_like(iterations))

    return solve


def methods(arm: ReferenceArm) -> dict[str, Method]:
    """What is compared.

    Args:
        arm: The reference.

    Returns:
        By name.
    """
    once = NewtonCfg(restarts=0)
    bare = NewtonCfg(restarts=0, iterations=50, damping=1e-12, step_rad=1e6)
    return {
        "closed form, numpy": lambda poses: Found(ik.nearest_within(ik.solve(poses), HOME)),
        "closed form, compiled": lambda poses: Found(ik.nearest_within(ik_kernel.solve(poses), HOME)),
        "Newton": _newton(NewtonCfg()),
        "Newton without restarts": _newton(once),
        "Newton, neither damped nor restarted": _newton(bare),
        "Newton as printed, without the target": _newton(once, _without_target),
        "pinocchio's CLIK example": _loop(arm),
    }


def judge(arm: ReferenceArm, q: Array, poses: Array) -> tuple[NDArray[np.bool_], Array, Array]:
    """Which postures reach their poses, by the reference.

    Args:
        arm: The reference.
        q: Shape (N, 6), rad; NaN where nothing was found.
        poses: Shape (N, 4, 4), m.

    Returns:
        Whether each is reached within limits, and distance [m] and angle [rad] of each that was found.
    """
    found = np.isfinite(q).all(axis=1)
    reached = arm.tip(q[found])
    apart = np.linalg.norm(reached[:, :3, 3] - poses[found, :3, 3], axis=1)
    # Of a small angle the chord of the matrices is sqrt(2) times it.
    angle = np.linalg.norm(reached[:, :3, :3] - poses[found, :3, :3], axis=(1, 2)) / np.sqrt(2)
    good = np.zeros(len(q), dtype=np.bool_)
    good[found] = (apart <= POSITION_M) & (angle <= ROTATION_RAD)
    good &= ((q >= JOINT_LOWER) & (q <= JOINT_UPPER)).all(axis=1)
    return good, apart, angle


def _alone_us(method: Method, poses: Array) -> float:
    """Median over some poses of the least time for one alone [us]."""
    least = []
    for pose in poses[:_ALONE]:
        times = []
        for _ in range(5):
            start = time.perf_counter()
            method(pose[None])
            times.append(time.perf_counter() - start)
        least.append(min(times))
    return 1e6 * float(np.median(least))


def measure(name: str, method: Method, arm: ReferenceArm, poses: Array) -> Row:
    """A row of the table.

    Args:
        name: Of the method.
        method: It.
        arm: The reference.
        poses: Shape (N, 4, 4), m.

    Returns:
        Success, errors of what was found, iterations and times.
    """
    method(poses[:1])  # compiles
    start = time.perf_counter()
    found = method(poses)
    batch_us = 1e6 * (time.perf_counter() - start) / len(poses)
    good, apart, angle = judge(arm, found.q, poses)
    count = int(good.sum())
    iterations = found.iterations
    return {
        "method": name,
        "poses": len(poses),
        "reached_pct": 100.0 * count / len(poses),
        "reached_ci": results.wilson(count, len(poses)),
        "largest_m": float(apart[good[np.isfinite(found.q).all(axis=1)]].max()) if count else None,
        "largest_rad": float(angle[good[np.isfinite(found.q).all(axis=1)]].max()) if count else None,
        "iterations_median": None if iterations is None else float(np.median(iterations)),
        "iterations_p95": None if iterations is None else float(np.percentile(iterations, 95)),
        "restarts_mean": None if found.restarts is None else float(found.restarts.mean()),
        "batch_us": batch_us,
        "alone_us": _alone_us(method, poses),
    }


def markdown(rows: list[Row]) -> str:
    """The table.

    Args:
        rows: From ``measure``.

    Returns:
        Markdown.
    """
    head = ["method", "reached %", "largest error [m]", "[rad]", "iterations: median", "95 %", "restarts"]
    head += ["us a pose in a batch", "us one alone"]
    body = [
        [
            r["method"],
            results.with_interval(r, "reached_pct", 2),
            *("-" if r[k] is None else f"{r[k]:.0e}" for k in ("largest_m", "largest_rad")),
            results.number(r["iterations_median"], 0),
            results.number(r["iterations_p95"], 0),
            results.number(r["restarts_mean"], 2),
            f"{r['batch_us']:.1f}",
            f"{r['alone_us']:.0f}",
        ]
        for r in rows
    ]
    return (
        f"{rows[0]['poses']} reachable poses; reached: within 1e-6 m and 1e-6 rad by pinocchio, and within "
        "the joints' limits; errors are of those. All begin from one posture, and of the closed form's "
        "branches the one next to it is taken, which its times include.\n\n"
        f"{results.grid(head, body)}"
    )


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Reads the command line.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        The options.
    """
    parser = argparse.ArgumentParser(
        prog="python -m experiments.inverse_kinematics", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--poses", type=int, default=10_000, help="(default: %(default)s)")
    parser.add_argument("--seed", type=int, default=500_000, help="of the poses (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out") / NAME, help="folder (default: %(default)s)")
    return command.checked(parser, arguments, poses=1, seed=0)


def main(arguments: list[str] | None = None) -> int:
    """Makes the table.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status: 0 if it ran to the end.
    """
    options = parse(arguments)

    def work() -> str:
        arm = ReferenceArm()
        rng = np.random.default_rng(options.seed)
        poses = arm.tip(rng.uniform(JOINT_LOWER, JOINT_UPPER, (options.poses, 6)))
        rows = [measure(name, method, arm, poses) for name, method in tqdm(methods(arm).items(), "methods")]
        text = markdown(rows)
        results.write(
            options.out,
            NAME,
            rows,
            [],
            renderer="none",
            regime="kinematics alone",
            text=text,
            more={"pin": version("pin"), "seed0": options.seed},
        )
        return text

    return command.run(work, options.out)


if __name__ == "__main__":
    sys.exit(main())
