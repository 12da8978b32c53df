"""Tau-Jerk motion: the paper's Figs. 2-3, and time and jerk beside other motions under the same limits.

    python -m experiments.tau_jerk --out experiments/results

After Carvajal and Martinez-Garcia, Figs. 2 and 3. Writes tau_jerk.json, .csv, .md and three figures.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np

from experiments import command, point_to_point, results, six_axis, tau_jerk_figures
from experiments.point_to_point import Limits, Profile
from experiments.tau_jerk_figures import KS, PAPER_K
from seal_gym.core.cell import load_cell
from seal_gym.core.kinematics import JOINT_SPEED
from seal_gym.core.provenance import version
from seal_gym.planning import newton, tau_jerk
from seal_gym.planning.tau_jerk import DEFAULT_K, TauJerk

NAME = "tau_jerk"
WAYS_RAD = (0.1, 0.5, 1.0, 3.0)
SHOWN_RAD = 1.0  # of the figure
_ACCELERATION = load_cell().limits.joint_rad_s2
# The UR5's slowest joints and the cell's limit of an action. The makers give no jerk: full acceleration after
# 0.1 s.
LIMITS = Limits(float(JOINT_SPEED.min()), _ACCELERATION, _ACCELERATION / 0.1)
FIG2_GAP_M, FIG2_S = 2.0, 2.0
FIG3_S = 5.0
# The paper gives no postures.
FIG3_START = np.radians([10.0, 20.0, 5.0, 30.0, 10.0, 15.0])
FIG3_TARGET = six_axis.pose(np.radians([70.0, -25.0, 40.0, 75.0, 30.0, 35.0]))
_AXES = 6

Row = dict[str, Any]


def compared(way: float, profiles: list[Profile]) -> list[Row]:
    """Rows of the table.

    Args:
        way: Of all [rad].
        profiles: What is compared.

    Returns:
        One a profile; None where the jerk is unbounded.
    """

    def bounded(value: float) -> float | None:
        return value if np.isfinite(value) else None

    best = profiles[-1].duration_s
    return [
        {
            "way_rad": way,
            "motion": p.name,
            "duration_s": p.duration_s,
            "duration_over_ruckig": p.duration_s / best,
            "peak_speed_rad_s": p.peaks[0],
            "peak_acceleration_rad_s2": p.peaks[1],
            "peak_jerk_rad_s3": bounded(p.peaks[2]),
            "start_jerk_rad_s3": bounded(p.end_jerk[0]),
            "end_jerk_rad_s3": bounded(p.end_jerk[1]),
        }
        for p in profiles
    ]


def sweep() -> list[Row]:
    """Peaks of a gap of 1 that closes in 1 s, at several k, beside the quintic's.

    Returns:
        One row a k; None where unbounded.
    """
    rows: list[Row] = []
    for k in KS:
        found = [float(p) for p in tau_jerk.peaks(k)]
        end = tau_jerk.unit_gap(np.ones(1), k)
        values = [*found, 6.0 / k, abs(float(end.jerk[0]))]
        rows.append({"motion": f"tau-Jerk, k = {k:.3g}", **_unit(values)})
    rows.append({"motion": "quintic", **_unit([15 / 8, 10 / np.sqrt(3), 60.0, 60.0, 60.0])})
    return rows


def _unit(values: list[float]) -> Row:
    names = ("peak_speed", "peak_acceleration", "peak_jerk", "start_jerk", "end_jerk")
    return {n: float(v) if np.isfinite(v) else None for n, v in zip(names, values, strict=True)}


def several_axes(moves: int, seed: int) -> list[Row]:
    """Durations of motions of six joints that end together, over Ruckig's.

    Args:
        moves: How many.
        seed: Of the ways, uniform in half a turn either way.

    Returns:
        Mean and range of each motion's.
    """
    ways = np.random.default_rng(seed).uniform(-np.pi, np.pi, (moves, _AXES))
    best = np.array([point_to_point.fastest_s(way, LIMITS) for way in ways])
    rows = []
    for make in (point_to_point.tau_jerk_profile, point_to_point.quintic, point_to_point.trapezoidal):
        # Under the same limits the joint with the longest way decides.
        longest = np.abs(ways).max(axis=1)
        profiles = [make(float(way), LIMITS) for way in longest]
        ratio = np.array([p.duration_s for p in profiles]) / best
        rows.append(
            {
                "motion": profiles[0].name,
                "moves": moves,
                "duration_over_ruckig_mean": float(ratio.mean()),
                "duration_over_ruckig_min": float(ratio.min()),
                "duration_over_ruckig_max": float(ratio.max()),
            }
        )
    return rows


def arm_motions() -> dict[float, TauJerk]:
    """Fig. 3: joint motions of the six-axis arm to a pose whose posture Newton's steps find.

    Returns:
        By k, the paper's first.
    """
    limit = np.full(_AXES, np.pi)
    goal = newton.solve(
        FIG3_TARGET[None],
        FIG3_START,
        np.random.default_rng(0),
        model=six_axis.linearised,
        lower=-limit,
        upper=limit,
    ).q[0]
    return {
        k: TauJerk(start=FIG3_START, goal=goal, duration_s=np.array(FIG3_S), k=np.full(_AXES, k))
        for k in (PAPER_K, DEFAULT_K)
    }


def _cell(value: Any, digits: int) -> str:
    return "unbounded" if value is None else f"{value:.{digits}f}"


def markdown(rows: list[Row], units: list[Row], axes: list[Row]) -> str:
    """The page.

    Args:
        rows: From ``compared``.
        units: From ``sweep``.
        axes: From ``several_axes``.

    Returns:
        Markdown.
    """
    head = ["way [rad]", "motion", "time [s]", "over Ruckig", "peak speed [rad/s]"]
    head += ["peak acceleration [rad/s²]", "peak jerk [rad/s³]", "jerk at start", "jerk at end"]
    keys = [("duration_s", 3), ("duration_over_ruckig", 2), ("peak_speed_rad_s", 2)]
    keys += [("peak_acceleration_rad_s2", 2), ("peak_jerk_rad_s3", 1)]
    keys += [("start_jerk_rad_s3", 1), ("end_jerk_rad_s3", 1)]
    one = results.grid(
        head, [[f"{r['way_rad']:g}", r["motion"], *(_cell(r[k], d) for k, d in keys)] for r in rows]
    )
    names = ["peak_speed", "peak_acceleration", "peak_jerk", "start_jerk", "end_jerk"]
    unit = results.grid(
        ["motion", *(n.replace("_", " ") for n in names)],
        [[r["motion"], *(_cell(r[n], 2) for n in names)] for r in units],
    )
    several = results.grid(
        ["motion", "time over Ruckig's: mean", "least", "most"],
        [
            [r["motion"], *(f"{r[f'duration_over_ruckig_{k}']:.3f}" for k in ("mean", "min", "max"))]
            for r in axes
        ],
    )
    return (
        f"One axis from rest to rest under the same limits: {LIMITS.speed:g} rad/s, "
        f"{LIMITS.acceleration:g} rad/s², {LIMITS.jerk:g} rad/s³ (the trapezoid knows no jerk).\n\n{one}\n\n"
        "In the same time: magnitudes for a way of 1 in 1 s.\n\n"
        f"{unit}\n\n"
        f"Six joints that end together, {axes[0]['moves']} random ways up to half a turn, the same "
        f"limits.\n\n{several}\n\n"
        "![tau-Jerk gaps at several k](tau_jerk_fig2.png)\n\n"
        "![the six-axis arm by joint gaps](tau_jerk_fig3.png)\n\n"
        "![beside other motions](tau_jerk_comparison.png)"
    )


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Reads the command line.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        The options.
    """
    parser = argparse.ArgumentParser(
        prog="python -m experiments.tau_jerk", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--moves", type=int, default=1000, help="of six joints (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=500_000, help="of those moves (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out") / NAME, help="folder (default: %(default)s)")
    return command.checked(parser, arguments, moves=1, seed=0)


def main(arguments: list[str] | None = None) -> int:
    """Makes figures and tables.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status: 0 if it ran to the end.
    """
    options = parse(arguments)

    def work() -> str:
        profiles = {way: point_to_point.all_profiles(way, LIMITS) for way in WAYS_RAD}
        rows = [row for way, found in profiles.items() for row in compared(way, found)]
        units, axes = sweep(), several_axes(options.moves, options.seed)
        text = markdown(rows, units, axes)
        results.write(
            options.out,
            NAME,
            rows,
            [],
            renderer="none",
            regime="kinematics alone",
            text=text,
            more={
                "ruckig": version("ruckig"),
                "limits": LIMITS._asdict(),
                "seed0": options.seed,
                "same_time": units,
                "several_axes": axes,
            },
        )
        tau_jerk_figures.gaps(options.out / "tau_jerk_fig2.png", FIG2_GAP_M, FIG2_S)
        tau_jerk_figures.arm(options.out / "tau_jerk_fig3.png", arm_motions())
        tau_jerk_figures.comparison(
            options.out / "tau_jerk_comparison.png", profiles[SHOWN_RAD], SHOWN_RAD, LIMITS
        )
        return text

    return command.run(work, options.out)


if __name__ == "__main__":
    sys.exit(main())
