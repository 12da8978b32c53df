"""Figures of laid beads: height maps of naive and optimal path, and the heights along both edges."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

from experiments.bead_laydown import SURFACES, Comparison, EdgeHeights, on_strip
from seal_gym.core.frames import Array
from seal_gym.planning.bead_cases import BeadCase
from seal_gym.planning.bead_curves import Edges

mpl.use("Agg")
import matplotlib.pyplot as plt  # the backend has to be chosen first

_LEFT, _RIGHT, _CORNER, _GAP = "#0072b2", "#d55e00", "#eeeeee", "#bbbbbb"
_DRY_M = 0.05e-3
_TOP = 1.6  # colours end, and heights leave the picture, above so many times the mean
_LONG = 1.6  # maps that are wider than this are drawn one above the other
_NAMES = {"naive": "naive", "ipopt": "optimal"}


@dataclass(frozen=True, kw_only=True, eq=False)
class Beside:
    """Heights that are drawn dotted beside a bead's own.

    Attributes:
        heights: By the path they go with.
        label: What they are.
    """

    heights: dict[str, EdgeHeights]
    label: str


def _axes(found: Comparison, case: BeadCase) -> tuple[Array, Array, str, str]:
    """Coordinates of the columns in the map and their names: left of travel is up where travel is right."""
    strip = found.strip
    if case.name in SURFACES:
        return 1e3 * strip.arc, -1e3 * strip.across, "along the surface [mm]", "across [mm]"
    return 1e3 * strip.base[:, 0, 0], 1e3 * strip.base[0, :, 1], "x [mm]", "y [mm]"


def _map(ax: Any, found: Comparison, case: BeadCase, edges: Edges, who: str, top_mm: float) -> Any:
    strip, (x, y, along, across) = found.strip, _axes(found, case)
    height = 1e3 * np.where(found.laid[who].height > _DRY_M, found.laid[who].height, np.nan)
    half = 500.0 * float(strip.arc[1] - strip.arc[0])
    extent = (x[0] - half, x[-1] + half, y[-1] - half, y[0] + half)
    image = ax.imshow(height.T, extent=extent, vmin=0.0, vmax=top_mm, cmap="viridis")
    if not strip.there.all():
        missing = np.where(strip.there, np.nan, 1.0)
        ax.imshow(missing.T, extent=extent, vmin=0.0, vmax=1.0, cmap=mpl.colors.ListedColormap([_GAP]))
    for edge, colour in ((edges.left, _LEFT), (edges.right, _RIGHT)):
        place = 1e3 * on_strip(strip, edge(np.linspace(0.0, edge.length_m, 400)))
        ax.plot(x[0] + place[:, 0], -place[:, 1], color=colour, lw=1.2)
    ax.set_title(_NAMES[who], fontsize=11)
    ax.set_xlabel(along)
    ax.set_ylabel(across)
    return image


def _spans(ax: Any, heights: EdgeHeights) -> None:
    """Shades the corners."""
    s, corner = 1e3 * heights.places.along_m, heights.places.corner
    ends = np.flatnonzero(np.diff(np.concatenate(([0], corner.astype(int), [0]))))
    for k, (first, last) in enumerate(ends.reshape(-1, 2)):
        ax.axvspan(s[first], s[last - 1], color=_CORNER, lw=0, label=None if k else "corner")


def _heights(ax: Any, found: Comparison, who: str, top_mm: float, beside: Beside) -> None:
    heights = found.heights[who]
    s = 1e3 * heights.places.along_m
    _spans(ax, heights)
    ax.plot(s, 1e3 * heights.left_m, color=_LEFT, lw=2.6, label="left edge")
    ax.plot(s, 1e3 * heights.right_m, color=_RIGHT, lw=1.4, label="right edge")
    if who in beside.heights:
        other = beside.heights[who]
        ax.plot(s, 1e3 * other.left_m, color="k", lw=1.0, ls=":", label=beside.label)
        ax.plot(s, 1e3 * other.right_m, color="k", lw=1.0, ls=":")
    ax.set_ylim(0.0, top_mm)
    ax.set_title(f"{_NAMES[who]}: height inside the edges", fontsize=11)
    ax.set_xlabel("along the centre line [mm]")
    ax.set_ylabel("mm")
    ax.grid(alpha=0.3)


def draw(
    file: Path,
    case: BeadCase,
    edges: Edges,
    found: Comparison,
    *,
    title: str = "Bead in the fast tier",
    beside: Beside | None = None,
) -> None:
    """Draws the beads of the naive and the optimal path.

    Args:
        file: To write.
        case: For the title.
        edges: The edges.
        found: The beads.
        title: What laid them.
        beside: Dotted; by default the heights by the UR5, if they are there.
    """
    shown = [who for who in _NAMES if who in found.laid]
    if beside is None:
        robot = {"ipopt": found.heights["robot"]} if "robot" in found.heights else {}
        beside = Beside(heights=robot, label="by the UR5")
    strip, last = found.strip, found.heights[shown[-1]]
    top = 1e3 * _TOP * float(np.mean((last.left_m, last.right_m)))
    ratio = float(np.ptp(strip.arc) / np.ptp(strip.across))
    if ratio > _LONG:
        map_height = 11.0 / ratio + 0.8
        figure = plt.figure(figsize=(12.0, 3.4 + len(shown) * map_height), layout="constrained")
        heights = (len(shown) * map_height, 3.4)
        grid = (len(shown), 1)
    else:
        figure = plt.figure(figsize=(6.0 * len(shown) + 0.5, 3.4 + 5.2 / ratio), layout="constrained")
        heights = (5.2 / ratio, 3.4)
        grid = (1, len(shown))
    parts: Any = figure.subfigures(2, 1, height_ratios=heights)
    upper, lower = parts
    maps = upper.subplots(*grid, squeeze=False).ravel()
    for ax, who in zip(maps, shown, strict=True):
        image = _map(ax, found, case, edges, who, top)
    upper.colorbar(image, ax=maps, label="height [mm]", extend="max", shrink=0.9)
    for ax, who in zip(lower.subplots(1, len(shown), squeeze=False).ravel(), shown, strict=True):
        _heights(ax, found, who, top, beside)
    handles, labels = ax.get_legend_handles_labels()
    lower.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    word = "" if "ipopt" in found.laid else ", no path within the limits"
    figure.suptitle(f"{title}: {case.title}{word}", fontsize=12)
    figure.savefig(file, dpi=80)
    plt.close(figure)
