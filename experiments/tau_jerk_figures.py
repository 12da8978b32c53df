"""Figures of tau-Jerk motion."""

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

from experiments import six_axis
from experiments.point_to_point import Limits, Profile
from seal_gym.core.frames import Array
from seal_gym.planning.tau_jerk import DEFAULT_K, TauJerk

mpl.use("Agg")  # no screen needed
import matplotlib.pyplot as plt  # the backend has to be chosen first

KS = (0.1, 0.2, DEFAULT_K, 1 / 3, 0.4, 0.6, 0.8)
PAPER_K = 0.4
_NAMES = ("position", "speed", "acceleration", "jerk")
_COLOURS = {"tau-Jerk": "#1f5fa8", "quintic": "#2a8f3c", "trapezoidal": "#8a8f98", "Ruckig": "#d1382c"}
_AXES = ("#d1382c", "#2a8f3c", "#1f5fa8")
_POINTS = 4001


def _finish(axes: Any) -> None:
    axes.grid(color="#dddddd", lw=0.6)
    axes.margins(x=0.01)


def gaps(path: Path, gap_m: float, duration_s: float) -> None:
    """Fig. 2: a gap and its derivatives at several k.

    Args:
        path: The PNG file.
        gap_m: At first [m].
        duration_s: T [s].
    """
    time = np.linspace(0.0, duration_s, _POINTS)
    figure, grid = plt.subplots(2, 2, figsize=(10.5, 7.4), constrained_layout=True)
    colours = mpl.colormaps["viridis"](np.linspace(0.0, 0.92, len(KS)))
    for k, colour in zip(KS, colours, strict=True):
        motion = TauJerk(
            start=np.array([gap_m]),
            goal=np.zeros(1),
            duration_s=np.array(duration_s),
            k=np.array([k]),
        ).sample(time)
        label = {1 / 3: "k = 1/3", DEFAULT_K: f"k = {DEFAULT_K:g} (default)", PAPER_K: "k = 0.4 (paper)"}
        for axes, values in zip(grid.flat, motion, strict=True):
            axes.plot(
                time,
                values[:, 0],
                color=colour,
                lw=2.4 if k in (DEFAULT_K, PAPER_K) else 1.2,
                label=label.get(k, f"k = {k:g}"),
            )
    units = ("gap [m]", "speed [m/s]", "acceleration [m/s²]", "jerk [m/s³]")
    for axes, unit in zip(grid.flat, units, strict=True):
        axes.set(xlabel="time [s]", ylabel=unit)
        _finish(axes)
    grid[0, 0].set_title(f"gap of {gap_m:g} m that closes in {duration_s:g} s")
    grid[0, 1].set_title("speed rests at the end for k < 1")
    grid[1, 0].set_title("acceleration rests at the end for k < 1/2")
    grid[1, 1].set_title("jerk rests at the end for k < 1/3, unbounded above 1/3")
    grid[0, 1].set_ylim(-2.9, 0.15)
    grid[1, 0].set_ylim(-6.0, 9.0)
    grid[1, 1].set_ylim(-26.0, 20.0)
    grid[0, 0].legend(fontsize=9)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def arm(path: Path, motions: dict[float, TauJerk]) -> None:
    """Fig. 3: position of the six-axis arm whose joints close their gaps by tau-Jerk.

    Args:
        path: The PNG file.
        motions: Of the joints, by k; the paper's first.
    """
    figure, (end, joints, jerk) = plt.subplots(
        3, 1, figsize=(8.2, 9.6), height_ratios=(1.3, 1.2, 1), constrained_layout=True
    )
    for (k, motion), style in zip(motions.items(), ("-", "--"), strict=True):
        time = np.linspace(0.0, float(motion.duration_s), _POINTS)
        sampled = motion.sample(time)
        position = six_axis.pose(sampled.position)[:, :3]
        for values, name, colour in zip(position.T, "xyz", _AXES, strict=True):
            end.plot(time, values, style, color=colour, lw=1.6, label=f"{name}, k = {k:g}")
        for j in range(6):
            label = f"joint {j}" if style == "-" else None
            joints.plot(time, np.rad2deg(sampled.position[:, j]), style, color=f"C{j}", lw=1.4, label=label)
        largest = int(np.argmax(np.abs(motion.goal - motion.start)))
        jerk.plot(
            time,
            sampled.jerk[:, largest],
            style,
            color="#333333",
            lw=1.4,
            label=f"joint {largest}, k = {k:g}",
        )
    end.set(
        ylabel="position of the end [m]", title="Six-axis arm: position by joint gaps that close together"
    )
    joints.set(ylabel="joint angle [deg]", title="joints: solid k = 0.4 (paper), dashed the default")
    jerk.set(
        ylabel="jerk [rad/s³]", xlabel="time [s]", title="the paper's k leaves the jerk unbounded at the end"
    )
    jerk.set_ylim(-0.8, 1.0)
    end.legend(fontsize=9, ncol=2)
    joints.legend(fontsize=9, ncol=3)
    jerk.legend(fontsize=9, loc="lower left")
    for axes in (end, joints, jerk):
        _finish(axes)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def comparison(path: Path, profiles: list[Profile], way: float, limits: Limits) -> None:
    """Position and derivatives of the compared motions over time.

    Args:
        path: The PNG file.
        profiles: Over the same way.
        way: Their way [rad].
        limits: Drawn as lines.
    """
    figure, rows = plt.subplots(4, 1, figsize=(8.6, 11.5), sharex=True, constrained_layout=True)
    units = ("position [rad]", "speed [rad/s]", "acceleration [rad/s²]", "jerk [rad/s³]")
    for profile in profiles:
        colour = _COLOURS[profile.name.split(",")[0]]
        time = np.linspace(0.0, profile.duration_s, _POINTS)
        for axes, values in zip(rows, profile.sample(time), strict=True):
            label = f"{profile.name}: {profile.duration_s:.3f} s"
            axes.plot(*_with_rest(time, values, axes is rows[0]), color=colour, lw=1.7, label=label)
        if np.isinf(profile.peaks[2]):
            _impulses(rows[3], time, profile.sample(time).acceleration, colour, limits.jerk)
    for axes, unit, limit in zip(rows, units, (None, *limits), strict=True):
        axes.set_ylabel(unit)
        for sign in (1, -1) if limit else ():
            if sign > 0 or axes is not rows[1]:
                axes.axhline(sign * (limit or 0.0), color="#333333", lw=0.8, ls=":")
        _finish(axes)
    rows[0].legend(fontsize=9, loc="lower right")
    rows[0].set_title(
        f"{way:g} rad from rest to rest; dotted: limits {limits.speed:g} rad/s, "
        f"{limits.acceleration:g} rad/s², {limits.jerk:g} rad/s³",
        fontsize=10,
    )
    rows[3].set_ylim(-1.6 * limits.jerk, 1.6 * limits.jerk)
    rows[3].set_xlabel("time [s]; arrows: the trapezoid's acceleration jumps, its jerk is unbounded")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _with_rest(time: Array, values: Array, position: bool) -> tuple[Array, Array]:
    """A curve with the rest before and after, so that steps at the ends show."""
    before, after = (values[0], values[-1]) if position else (0.0, 0.0)
    pad = 0.03
    return (
        np.concatenate(([-pad, 0.0], time, [time[-1], time[-1] + pad])),
        np.concatenate(([before, before], values, [after, after])),
    )


def _impulses(axes: Any, time: Array, acceleration: Array, colour: str, jerk: float) -> None:
    """Arrows where the acceleration jumps."""
    steps = np.diff(np.concatenate(([0.0], acceleration, [0.0])))
    for i in np.flatnonzero(np.abs(steps) > 0):
        at = float(time[min(int(i), len(time) - 1)])
        tip = np.sign(steps[i]) * 1.5 * jerk
        axes.annotate(
            "", xy=(at, tip), xytext=(at, 0.0), arrowprops={"arrowstyle": "->", "color": colour, "lw": 1.6}
        )
