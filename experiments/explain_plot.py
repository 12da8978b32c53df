"""The picture of ``experiments.explain``: accelerations and metrics along the seam."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from seal_gym.core.frames import Array

mpl.use("Agg")  # no screen needed
import matplotlib.pyplot as plt  # the backend has to be chosen first
from matplotlib.colors import LogNorm
from matplotlib.patches import Ellipse

AXES = ("x", "y", "z", "about x", "about y", "about z")
_COLOURS = ("#d6332a", "#2f9e44", "#2f6fd6")  # x, y, z, and the turns about them
_GREY, _BLACK, _CORNER = "#8a8f98", "#222222", "#f2d9a0"
_FIRST_MM = 10.0  # where protocol.md begins to count errors
_STATIONS = 8
_LEAST = (0.01, 1.0)  # smallest range shown of accelerations [m/s^2, rad/s^2]: below, all is rest
_LEAST_FEATURES = (0.05, 0.5)  # of features [mm, deg]
_ARROW_MM = 16.0  # length of the longest arrow in the view from above
_ARROW, _SMALLEST_ARROW = "#c2255c", 0.05
_GLYPHS = (
    "stations: ellipses are metrics, long where a leaf insists "
    "(half axis: root of the eigenvalue; dotted: 1)\n"
    "yellow: the policy's A; grey: all fixed leaves; arrow: f, to the dotted circle for {:g} m/s$^2$, {:g} "
    "rad/s$^2$ and more"
)


class _Pair(NamedTuple):
    """Two axes of the tip frame that the stations' ellipses are drawn in."""

    axes: tuple[int, int]
    names: tuple[str, str]
    unit: str
    full: float  # an arrow that ends on the unit circle


_PAIRS = (
    _Pair((0, 2), ("x (across)", "z (stand-off)"), "m/s$^2$", 0.05),
    _Pair((3, 5), ("about x", "about z"), "rad/s$^2$", 10.0),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Story:
    """What a policy asked for in each of T frames. Accelerations and metrics are in the tip frame.

    Attributes:
        arc_mm: Arc length of the seam's point nearest the tip, shape (T,), mm.
        tip_pose: ``T_part_tip``, shape (T, 4, 4), m.
        desired_mm: The desired path of the tip in the part's frame, shape (n, 3), mm.
        tip_error_mm: Distance from the tip to that path, shape (T,), mm.
        accel: The policy's f, shape (T, 6), m/s^2 and rad/s^2.
        resolved: Tip acceleration after all leaves, shape (T, 6), m/s^2 and rad/s^2.
        metric: The policy's A, shape (T, 6, 6); zero if it has none.
        fixed_metric: Sum of the fixed leaves' metrics, shape (T, 6, 6).
        share: The policy's share against the fixed leaves on each axis, shape (T, 6).
        has_metric: Whether the policy has a metric.
        d_mm: Attraction distances, front and side, shape (T, 2), mm.
        theta_deg: Seam angles, front and side, shape (T, 2), deg.
        valid: Whether the view showed the seam, shape (T, 2).
        corners_mm: Arc-length intervals of the seam's corners, shape (k, 2), mm.
    """

    arc_mm: Array
    tip_pose: Array
    desired_mm: Array
    tip_error_mm: Array
    accel: Array
    resolved: Array
    metric: Array
    fixed_metric: Array
    share: Array
    has_metric: bool
    d_mm: Array
    theta_deg: Array
    valid: NDArray[np.bool_]
    corners_mm: Array

    @property
    def sealing(self) -> NDArray[np.bool_]:
        """Frames from 10 mm of travel on, shape (T,)."""
        return np.asarray(self.arc_mm >= _FIRST_MM)

    @property
    def in_corner(self) -> NDArray[np.bool_]:
        """Frames in a corner, shape (T,)."""
        inside = np.zeros(len(self.arc_mm), np.bool_)
        for first, last in self.corners_mm:
            inside |= (self.arc_mm >= first) & (self.arc_mm <= last)
        return inside


def stations(found: Story, count: int = _STATIONS) -> list[int]:
    """Frames to look at: the first, in each corner that of the hardest turn, others evenly along the seam.

    Args:
        found: The run's numbers.
        count: How many along the seam.

    Returns:
        Numbers of frames, ascending.
    """
    arc, last = found.arc_mm, float(found.arc_mm.max())
    turn = np.linalg.norm(found.accel[:, 3:], axis=1)
    chosen = {0}
    for first, end in found.corners_mm[:4]:
        inside = (arc >= first) & (arc <= end)
        if inside.any():
            chosen.add(int(np.argmax(np.where(inside, turn, -1.0))))
    apart = 0.5 * last / (count + 1)
    taken = [float(arc[i]) for i in chosen]
    for s in np.linspace(0.0, last, count + 2)[1:-1]:
        if all(abs(s - t) > apart for t in taken):
            chosen.add(int(np.argmin(np.abs(arc - s))))
    return sorted(chosen)


def plot_story(path: Path, title: str, found: Story) -> None:
    """Draws the run.

    Args:
        path: The PNG file.
        title: Above the plots.
        found: The run's numbers.
    """
    at = stations(found)
    pairs = _PAIRS if found.has_metric else ()
    curves = _curves(found)
    heights = [3.0, *([1.5] * len(pairs)), *([1.2] * len(curves)), 1.0]
    figure = plt.figure(figsize=(14.0, 1.7 * sum(heights) + 0.6), constrained_layout=True)
    figure.suptitle(f"{title}\nwhat the policy asked for: where it insists and where it yields", fontsize=13)
    rows = figure.add_gridspec(len(heights), 2, height_ratios=heights)
    _from_above(figure.add_subplot(rows[0, :]), found, at)
    for r, pair in enumerate(pairs, start=1):
        _glyphs(figure, rows[r, :], found, at, pair)
    for r, row in enumerate(curves, start=1 + len(pairs)):
        for half in (0, 1):
            _curve(figure.add_subplot(rows[r, half]), found, row, half)
    error = figure.add_subplot(rows[-1, :])
    error.semilogy(found.arc_mm, np.maximum(found.tip_error_mm, 1e-4), color=_BLACK, lw=1.0)
    error.set(ylabel="tip error [mm]", title="tip error")
    error.set_xlabel(
        "along the seam [mm]; shaded: corners; accelerations of the approach, up to 10 mm, are cut off"
    )
    _along(error, found)
    for k, i in enumerate(at):
        error.annotate(
            str(k + 1),
            (found.arc_mm[i], 1.0),
            xycoords=("data", "axes fraction"),
            ha="center",
            va="bottom",
            fontsize=8,
            color=_GREY,
        )
    figure.savefig(path, dpi=90)
    plt.close(figure)


def _from_above(axes: Any, found: Story, at: list[int]) -> None:
    """The tip's path coloured by its error, with f as arrows and the stations' numbers."""
    tip = 1e3 * found.tip_pose[:, :2, 3]
    axes.plot(*found.desired_mm[:, :2].T, color=_GREY, lw=7, alpha=0.25, label="desired path")
    for k, (first, last) in enumerate(found.corners_mm):
        inside = (found.arc_mm >= first) & (found.arc_mm <= last)
        axes.plot(*tip[inside].T, color=_CORNER, lw=12, zorder=0, label="corner" if k == 0 else None)
    dots = axes.scatter(
        *tip.T,
        c=np.maximum(found.tip_error_mm, 1e-3),
        s=6,
        cmap="viridis",
        norm=LogNorm(1e-3, 10.0),
        zorder=3,
    )
    bar = axes.inset_axes((0.02, 0.12, 0.2, 0.03))
    axes.figure.colorbar(dots, cax=bar, orientation="horizontal", label="tip error [mm]")
    step = max(len(tip) // 60, 1)
    f = (found.tip_pose[:, :3, :3] @ found.accel[:, :3, None])[::step, :2, 0]
    going = found.sealing[::step]
    size = np.linalg.norm(f, axis=1)
    full = float(np.quantile(size[going], 0.98)) if going.any() else float(size.max())
    full = max(full, _LEAST[0])
    arrows = _ARROW_MM / full * f * np.minimum(1.0, full / np.maximum(size, 1e-12))[:, None]
    axes.quiver(
        *tip[::step].T,
        *arrows.T,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        width=1.6e-3,
        color=_ARROW,
        zorder=4,
        label=f"f of the policy, {_ARROW_MM:.0f} mm for {full:.2g} m/s$^2$ and more",
    )
    for k, i in enumerate(at):
        away = found.tip_pose[i, :2, 0]  # right of travel: the free side
        away = away / max(float(np.linalg.norm(away)), 1e-9)
        axes.annotate(
            str(k + 1),
            tip[i],
            tip[i] + 14.0 * away,
            ha="center",
            va="center",
            fontsize=10,
            arrowprops={"arrowstyle": "-", "color": _GREY, "lw": 0.6},
            bbox={"boxstyle": "circle,pad=0.2", "fc": "white", "ec": _GREY},
        )
    glyphs = "\n\n" + _GLYPHS.format(*(pair.full for pair in _PAIRS)) if found.has_metric else ""
    axes.set(xlabel=f"x of the part [mm]{glyphs}", ylabel="y of the part [mm]", title="from above")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.14)
    axes.grid(color="#dddddd", lw=0.6)
    axes.legend(loc="best", fontsize=9)


def _glyphs(figure: Any, row: Any, found: Story, at: list[int], pair: _Pair) -> None:
    """At each station the policy's metric beside the fixed leaves', and f, in a plane of the tip frame."""
    block, cells = np.ix_(pair.axes, pair.axes), row.subgridspec(1, len(at))
    for k, i in enumerate(at):
        axes = figure.add_subplot(cells[k])
        axes.add_patch(Ellipse((0, 0), 2, 2, fill=False, ec=_GREY, ls=":", lw=0.8))
        axes.add_patch(_ellipse(found.fixed_metric[i][block], fc="#cfd4da", ec=_GREY, alpha=0.9))
        axes.add_patch(_ellipse(found.metric[i][block], fc="#f3d36b", ec="#b8860b", alpha=0.55, lw=1.5))
        f = found.accel[i][list(pair.axes)] / pair.full
        size = float(np.linalg.norm(f))
        if size > _SMALLEST_ARROW:
            tip = tuple(f * min(1.0, 1.0 / size))
            style = {"arrowstyle": "-|>", "color": _ARROW, "lw": 1.6, "shrinkA": 0, "shrinkB": 0}
            axes.annotate("", tip, (0, 0), arrowprops=style)
        axes.set_title(f"{k + 1}: {found.arc_mm[i]:.0f} mm", fontsize=9)
        axes.set_xlabel(f"{pair.names[0]}\n|f| = {pair.full * size:.3f} {pair.unit}", fontsize=8)
        axes.set(xlim=(-1.3, 1.3), ylim=(-1.3, 1.3), xticks=[], yticks=[])
        axes.set_aspect("equal")
        if k == 0:
            axes.set_ylabel(pair.names[1], fontsize=9)


def _ellipse(block: Array, **style: Any) -> Ellipse:
    """A metric's ellipse, long where it insists: half axes are the roots of its eigenvalues."""
    values, axes = np.linalg.eigh(block)
    half = np.sqrt(np.maximum(values, 0.0))
    angle = float(np.rad2deg(np.arctan2(axes[1, 0], axes[0, 0])))
    return Ellipse((0, 0), 2 * half[0], 2 * half[1], angle=angle, **style)


Curves = list[tuple[str, Array, Any]]


def _curves(found: Story) -> list[tuple[str, tuple[Curves, Curves], bool]]:
    """Rows of plots: a label, the curves left and right, whether the approach is cut off."""
    diagonal = np.diagonal(found.metric, axis1=1, axis2=2)

    def three(values: Array, part: int, **style: Any) -> Curves:
        return [
            (AXES[part + k], values[:, part + k], {"color": _COLOURS[k], "lw": 1.0, **style})
            for k in range(3)
        ]

    def wanted(part: int) -> Curves:
        pale = [
            ("f (pale)" if name == AXES[part] else "_", v, {**style, "alpha": 0.35, "lw": 2.4})
            for name, v, style in three(found.accel, part)
        ]
        return [*pale, *((f"resolved, {name}", v, style) for name, v, style in three(found.resolved, part))]

    def weights(part: int) -> Curves:
        eigen: Any = np.linalg.eigvalsh(found.metric[:, part : part + 3, part : part + 3])
        broad: Any = {"color": _GREY, "lw": 2.5, "alpha": 0.35}
        pale: Curves = [("eigenvalues" if k == 0 else "_", eigen[:, k], broad) for k in range(3)]
        return pale + three(diagonal, part)

    rows = [("f and resolved", (wanted(0), wanted(3)), True)]
    if found.has_metric:
        rows.append(("A, diagonal", (weights(0), weights(3)), False))
        rows.append(("share of the policy", (three(found.share, 0), three(found.share, 3)), False))
    seen = np.where(found.valid, 1.0, np.nan)
    views = (("front", _COLOURS[0]), ("side", _COLOURS[2]))
    features = tuple(
        [
            (view, (values * seen)[:, v], {"color": colour, "lw": 1.0})
            for v, (view, colour) in enumerate(views)
        ]
        for values in (found.d_mm, found.theta_deg)
    )
    rows.append(("features", (features[0], features[1]), True))
    return rows


_TITLES = {
    "f and resolved": ("acceleration of the tip [m/s$^2$]", "angular acceleration of the tip [rad/s$^2$]"),
    "A, diagonal": ("metric A, translation", "metric A, rotation"),
    "share of the policy": ("share of the policy, translation", "share of the policy, rotation"),
    "features": ("attraction distance d [mm]", "seam angle theta [deg]"),
}


def _curve(axes: Any, found: Story, row: tuple[str, tuple[Curves, Curves], bool], half: int) -> None:
    """One plot over the arc length."""
    label, both, limit = row
    curves = both[half]
    for name, values, style in curves:
        axes.plot(found.arc_mm, values, label=name, **style)
    axes.set_title(_TITLES[label][half], fontsize=10)
    counted = np.concatenate([v[found.sealing] for _, v, _ in curves])
    counted = counted[np.isfinite(counted)]
    if limit and len(counted):
        least = (_LEAST_FEATURES if label == "features" else _LEAST)[half]
        reach = max(1.4 * float(np.abs(counted).max()), least)
        axes.set_ylim(-reach, reach)
    else:
        axes.set_ylim(-0.05, max(1.35, 1.35 * float(np.max(counted, initial=0.0))))
    _along(axes, found)
    axes.legend(loc="upper center", fontsize=7, ncols=6)


def _along(axes: Any, found: Story) -> None:
    """The common axis: arc length, the corners shaded."""
    for first, last in found.corners_mm:
        axes.axvspan(first, last, color=_CORNER, alpha=0.7, lw=0)
    end = float(found.arc_mm.max())
    axes.set_xlim(min(0.0, end - 1.0), end)
    axes.grid(color="#dddddd", lw=0.6)
