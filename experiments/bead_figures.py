"""Figures of bead paths: the nozzle over the edges in space, and the parameters the thesis plots."""

from functools import partial
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

from seal_gym.core.frames import Array
from seal_gym.planning.bead_cases import BeadCase
from seal_gym.planning.bead_config import BeadCfg
from seal_gym.planning.bead_curves import Edges
from seal_gym.planning.bead_geometry import BeadPath
from seal_gym.planning.bead_path import BeadQuantities
from seal_gym.planning.bead_projection import Footprint
from seal_gym.planning.robot_path import RobotPath

mpl.use("Agg")
import matplotlib.pyplot as plt  # the backend has to be chosen first
from matplotlib.ticker import MaxNLocator

_LEFT, _RIGHT, _NOZZLE, _NAIVE = "#0072b2", "#d55e00", "#222222", "#999999"
_FANS = 60
_MOST_SPREAD = 10.0  # where a border of the fan all but stands still, the number itself means nothing
_CLIP = 4.0  # heights above so many times the median leave the picture


def _fan(ax: Any, path: BeadPath, foot: Footprint) -> None:
    """The nozzle's path, and its fan and axis at places equally far apart."""
    p = 1e3 * path.position_m
    along = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))))
    chosen = np.searchsorted(along, np.linspace(0.0, along[-1], _FANS))
    for k in np.unique(np.minimum(chosen, len(p) - 1)):
        for hit, colour in ((foot.left_m, _LEFT), (foot.right_m, _RIGHT)):
            ax.plot(*np.stack((p[k], 1e3 * hit[k]), axis=1), color=colour, lw=0.5, alpha=0.5)
        back = p[k] + 12.0 * path.rotation[k, :, 2]
        ax.plot(*np.stack((p[k], back), axis=1), color=_NOZZLE, lw=0.9)
    ax.plot(*p.T, color=_NOZZLE, lw=1.6, label="nozzle's mouth; strokes: its axis")


def _named(name: str, value: float, _: object) -> str:
    return f"{name} {value:.0f} mm"


def _space(ax: Any, edges: Edges, title: str) -> None:
    share = np.linspace(0.0, 1.0, 600)
    for edge, colour, name in ((edges.left, _LEFT, "left edge"), (edges.right, _RIGHT, "right edge")):
        ax.plot(*(1e3 * edge(share * edge.length_m)).T, color=colour, lw=2.2, label=name)
    ax.set_title(title, fontsize=11, y=0.96)
    spans = [np.ptp(limits) for limits in (ax.get_xlim(), ax.get_ylim(), ax.get_zlim())]
    for axis, span, name, end in zip((ax.xaxis, ax.yaxis, ax.zaxis), spans, "xyz", (1, 0, 1), strict=True):
        axis.set_tick_params(labelsize=8, pad=1)
        if span < 0.35 * max(spans):  # true to scale there is room for one tick
            axis.set_ticks([round(float(axis.get_view_interval()[end]))])
            axis.set_major_formatter(partial(_named, name))
            continue
        axis.set_major_locator(MaxNLocator(max(2, round(6 * span / max(spans))), steps=[1, 2, 5, 10]))
        axis.set_label_text(f"{name} [mm]", fontsize=9)
    ax.set_box_aspect(spans, zoom=1.1)


def draw_paths(
    file: Path,
    case: BeadCase,
    edges: Edges,
    naive: BeadPath,
    naive_print: Footprint,
    path: BeadPath | None,
    foot: Footprint | None,
) -> None:
    """Draws the nozzle over the edges, optimal beside naive.

    Args:
        file: To write.
        case: For the title.
        edges: The edges.
        naive: The naive path.
        naive_print: Where its fan meets the surface.
        path: The optimal path, if there is one.
        foot: Where its fan meets the surface.
    """
    shown = [("naive: constant offset and speed", naive, naive_print)]
    if path is not None and foot is not None:
        shown.insert(0, ("optimal", path, foot))
    figure = plt.figure(figsize=(7.0 * len(shown), 5.6), layout="constrained")
    for k, (name, one, hits) in enumerate(shown):
        ax = figure.add_subplot(1, len(shown), k + 1, projection="3d", elev=32, azim=-62)
        _fan(ax, one, hits)
        _space(ax, edges, f"{name}: height spread {percent(hits.spread)}")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    word = "" if path is not None else ", no path within the limits"
    figure.suptitle(f"Bead path: {case.title}{word}", fontsize=13)
    figure.savefig(file, dpi=90)
    plt.close(figure)


def percent(spread: float) -> str:
    """A spread for people.

    Args:
        spread: As a ratio.

    Returns:
        In percent.
    """
    if spread > _MOST_SPREAD:
        return f"over {100 * _MOST_SPREAD:.0f} %"
    return f"{100 * spread:.2f} %" if spread < 0.1 else f"{100 * spread:.0f} %"


def draw_parameters(
    file: Path,
    case: BeadCase,
    q: BeadQuantities,
    cfg: BeadCfg,
    naive: BeadPath,
    naive_print: Footprint,
    robot: RobotPath,
    robot_print: Footprint,
) -> None:
    """Draws what the thesis plots of a path, over the planned time, and the robot's rate.

    Source: Berg Figs. 4.2, 4.4, 4.6, 4.8.

    Args:
        file: To write.
        case: For the title.
        q: The optimal path on a fine grid.
        cfg: For the limits.
        naive: The naive path.
        naive_print: What it lays.
        robot: The path as executed.
        robot_print: What that lays.
    """
    t = q.nodes.time_s
    figure, axes = plt.subplots(4, 3, figsize=(15.0, 13.0), sharex=True, layout="constrained")

    def pair(ax: Any, title: str, unit: str, *curves: tuple[Array, str, str]) -> None:
        for values, colour, label in curves:
            ax.plot(t, values, color=colour, label=label, lw=1.6)
        ax.set_title(title, fontsize=11)
        ax.set_ylabel(unit)
        ax.grid(alpha=0.3)
        ax.legend(fontsize=9)
        _open_up(ax)

    def limits(ax: Any, *values: float) -> None:
        for value in values:
            ax.axhline(value, color="#aa0000", lw=1.0, ls="--")

    deg = np.rad2deg
    pair(axes[0, 0], "speeds along the edges", "m/s", (q.nodes.u_dot, _LEFT, "left, u'"),
         (q.nodes.w_dot, _RIGHT, "right, w'"))  # fmt: skip
    pair(axes[0, 1], "arc lengths", "mm", (1e3 * q.nodes.u_m, _LEFT, "left, u"),
         (1e3 * q.nodes.w_m, _RIGHT, "right, w"))  # fmt: skip
    pair(axes[0, 2], "nozzle to edges", "mm", (1e3 * q.c_m, _LEFT, "left, c"),
         (1e3 * q.b_m, _RIGHT, "right, b"))  # fmt: skip
    pair(axes[1, 0], "width of the bead", "mm", (1e3 * q.across.width_m, _NOZZLE, "a"))
    pair(axes[1, 2], "tilt", "deg", (deg(q.tilt_rad), _NOZZLE, "rho"))
    limits(axes[1, 2], -float(deg(cfg.tilt_rad)), float(deg(cfg.tilt_rad)))
    pair(axes[2, 0], "spin: line across against the edges", "deg", (deg(q.eta_rad), _LEFT, "left, eta"),
         (deg(q.zeta_rad), _RIGHT, "right, zeta"))  # fmt: skip
    pair(axes[2, 1], "entry angles of the fan", "deg", (deg(q.beta_rad), _LEFT, "left, beta"),
         (deg(q.gamma_rad), _RIGHT, "right, gamma"))  # fmt: skip
    pair(axes[2, 2], "drag", "deg", (deg(q.nodes.drag_rad), _NOZZLE, "kappa"))
    limits(axes[2, 2], -float(deg(cfg.drag_rad)), float(deg(cfg.drag_rad)))

    ax = axes[1, 1]
    mean = 1e3 * float(np.mean((q.g_m, q.h_m)))
    for values, colour, name in (
        (naive_print.left_height_m, _LEFT, "left, naive"),
        (naive_print.right_height_m, _RIGHT, "right, naive"),
    ):
        ax.plot(naive.time_s, 1e3 * values, color=colour, lw=1.0, ls=":", label=name)
    ax.plot(t, 1e3 * q.g_m, color=_LEFT, lw=2.6, label="left, g")
    ax.plot(t, 1e3 * q.h_m, color=_RIGHT, lw=1.2, label="right, h")
    ax.set_ylim(0.0, min(_CLIP * mean, max(1.6 * mean, ax.get_ylim()[1])))
    ax.set_title("heights", fontsize=11)
    ax.set_ylabel("mm")
    ax.grid(alpha=0.3)
    ax.legend(fontsize=9, ncols=2)

    _draw_robot(axes[3], robot, robot_print, mean)
    figure.suptitle(f"Bead path: {case.title} (red dashes: limits)", fontsize=14)
    figure.savefig(file, dpi=75)
    plt.close(figure)


def _draw_robot(axes: Any, robot: RobotPath, robot_print: Footprint, mean: float) -> None:
    """The last row: rate, joint speeds and heights of the path as executed."""
    tau = robot.planned_s
    ax = axes[0]
    ax.plot(tau, robot.rate, color=_NOZZLE, lw=1.6)
    ax.set_ylim(0.0, 1.05)
    ax.set_title(f"UR5: slowed by {robot.slow_down:.2f}", fontsize=11)
    ax.set_ylabel("speed and flow over planned")
    ax = axes[1]
    for joint, speeds in enumerate(robot.qd.T):
        ax.plot(tau, speeds, lw=1.2, label=f"joint {joint + 1}")
    ax.set_title("UR5: joint speeds", fontsize=11)
    ax.set_ylabel("rad/s")
    ax.legend(fontsize=8, ncols=3)
    ax = axes[2]
    ax.plot(tau, 1e3 * robot_print.left_height_m, color=_LEFT, lw=2.6, label="left")
    ax.plot(tau, 1e3 * robot_print.right_height_m, color=_RIGHT, lw=1.2, label="right")
    ax.set_title(f"UR5: heights as executed, spread {percent(robot_print.spread)}", fontsize=11)
    ax.set_ylabel("mm")
    ax.legend(fontsize=9)
    ax.set_ylim(0.97 * mean, 1.03 * mean)
    for ax in axes:
        ax.set_xlabel("planned time [s]")
        ax.grid(alpha=0.3)


def _open_up(ax: Any) -> None:
    """Keeps a constant from looking like noise."""
    low, high = ax.get_ylim()
    middle, least = (
        (low + high) / 2,
        max(0.02 * abs(low + high) / 2, 0.1 if ax.get_ylabel() == "deg" else 0.0),
    )
    if high - low < 2 * least:
        ax.set_ylim(middle - least, middle + least)
