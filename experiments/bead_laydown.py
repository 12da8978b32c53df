"""Beads of fan-nozzle paths in the fast tier: the eight cases' surfaces, and the heights at both edges."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from seal_gym.core.frames import Array, cross, normalise
from seal_gym.planning.bead_cases import BeadCase
from seal_gym.planning.bead_curves import Curve, Edges
from seal_gym.planning.bead_geometry import BeadPath
from seal_gym.sealant.fan import FanCfg, Laid, lay_path, settled
from seal_gym.sealant.pneumatics import get_sealant
from seal_gym.sealant.strip import Strip

PATHS = ("naive", "ipopt", "robot")
SPACING_M = 0.5e-3
MARGIN_M = 8e-3
# The border of a bead on columns is a column wide to either side; its height at an edge is the mean over a
# disc this far inside.
INSET_M = 2e-3
PATCH_M = 1e-3
_ENDS_M = 6e-3  # what begins and ends with the bead
_PLACE_STEP_M = 1e-3
# Corners are where the centre line turns at least half as sharply as it does anywhere; a line that nowhere
# turns by a hundredth of a radian over the bead's width has none.
_CORNER_SHARE = 0.5
_STRAIGHT = 0.01
# A mean difference this small is the grid's; no factor is worth naming.
EQUAL_MM = 0.02


def centre_line(edges: Edges) -> Curve:
    """The curve half way between the edges, at equal shares of their lengths.

    Args:
        edges: The edges.

    Returns:
        The curve.
    """
    share = np.linspace(0.0, 1.0, 2001)
    return Curve.through(
        (edges.left(share * edges.left.length_m) + edges.right(share * edges.right.length_m)) / 2
    )


def _even(low: float, high: float, spacing_m: float) -> Array:
    """Evenly spaced values that reach a margin beyond both ends."""
    count = int(np.ceil((high - low + 2 * MARGIN_M) / spacing_m))
    middle = (low + high) / 2
    return np.asarray(middle + spacing_m * (np.arange(count + 1) - count / 2))


def _plane(case: BeadCase, edges: Edges, spacing_m: float) -> Strip:
    """The whole plane round the bead, rows along y.

    Rows across the centre line would cross each other where its bends are tighter than half the bead's width.
    """
    points = np.concatenate((case.left, case.right))
    x, y = _even(*_ends(points[:, 0]), spacing_m), _even(*_ends(-points[:, 1]), spacing_m)
    zero, one = np.zeros_like(x), np.ones_like(x)
    line = (
        np.column_stack((x, zero, zero)),
        np.column_stack((one, zero, zero)),
        np.column_stack((zero, zero, one)),
    )
    height = np.zeros((len(x), len(y)))
    if case.gap_m > 0.0:
        middle = centre_line(edges)
        vertices = middle(np.linspace(0.0, middle.length_m, round(middle.length_m / (0.1 * spacing_m))))
        feet = np.stack(np.meshgrid(x, -y, indexing="ij"), axis=-1)
        height[cKDTree(vertices[:, :2]).query(feet)[0] < case.gap_m / 2] = np.nan
    return Strip.of(x - x[0], y, line, height, np.broadcast_to([0.0, 0.0, 1.0], (*height.shape, 3)))


def _ends(values: Array) -> tuple[float, float]:
    return float(values.min()), float(values.max())


def _profile(_case: BeadCase, edges: Edges, spacing_m: float) -> Strip:
    """A band of even width over an upright profile, which goes straight on at both ends."""
    curve = centre_line(edges)
    half = float(np.linalg.norm(edges.chord(np.zeros(1)))) / 2
    s, across = _even(0.0, curve.length_m, spacing_m), _even(-half, half, spacing_m)
    on = np.clip(s, 0.0, curve.length_m)
    tangent = curve.tangent(on)
    side = np.array([0.0, -1.0, 0.0])
    column = cross(side[None], tangent)
    line = (curve(on) + (s - on)[:, None] * tangent, tangent, column)
    flat = np.zeros((len(s), len(across)))
    return Strip.of(s - s[0], across, line, flat, np.broadcast_to(column[:, None], (*flat.shape, 3)))


def _fillet(_case: BeadCase, edges: Edges, spacing_m: float) -> Strip:
    """The wall y = 0 and the floor z = 0, with columns that halve the right angle between them."""
    length = edges.left.length_m
    half = float(np.linalg.norm(edges.chord(np.zeros(1)))) / 2
    s, across = _even(0.0, length, spacing_m), _even(-half, half, spacing_m)
    tangent, column = np.array([1.0, 0.0, 0.0]), np.array([0.0, -1.0, 1.0]) / np.sqrt(2)
    point = s[:, None] * tangent
    rows = (len(s), 3)
    wall, floor = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    normal = np.where((across < 0)[:, None], wall, floor)
    height = np.tile(np.abs(across), (len(s), 1))
    line = (point, np.broadcast_to(tangent, rows), np.broadcast_to(column, rows))
    return Strip.of(s - s[0], across, line, height, np.broadcast_to(normal, (*height.shape, 3)))


# Of the cases that do not lie in a plane.
SURFACES = {"corner_seam": _fillet, "over_corner": _profile, "stairs": _profile}


def strip_of(case: BeadCase, edges: Edges, spacing_m: float = SPACING_M) -> Strip:
    """The surface under a case's bead as columns.

    Planar cases: the plane, with no columns in the half circle's gap. Over a corner and stairs: the profile
    between the edges, straight across. Seam in a corner: its wall and floor.

    Args:
        case: The case.
        edges: Its edges.
        spacing_m: Of the columns [m].

    Returns:
        The strip, from ``MARGIN_M`` before the bead to as far behind and beside it.
    """
    return SURFACES.get(case.name, _plane)(case, edges, spacing_m)


@dataclass(frozen=True, kw_only=True)
class Settling:
    """What happens to a bead after it is laid.

    Attributes:
        sealant: Its name.
        duration_s: For which it creeps under its weight [s]; 0 for stiff sealants, which stay.
    """

    sealant: str = "neutral_silicone"
    duration_s: float = 0.0


def lay(strip: Strip, path: BeadPath, fan_angle_rad: float, settling: Settling | None = None) -> Laid:
    """Lays a path's bead.

    Args:
        strip: Of the case.
        path: In the case's frame.
        fan_angle_rad: theta [rad].
        settling: Of the bead; none by default.

    Returns:
        The bead.
    """
    cfg = FanCfg(angle_rad=fan_angle_rad)
    laid = lay_path(strip, path.time_s, path.position_m, path.rotation, path.flow_m3_per_s, cfg)
    if settling is None or settling.duration_s == 0.0:
        return laid
    return settled(strip, laid, get_sealant(settling.sealant), settling.duration_s)


def on_strip(strip: Strip, points: Array) -> Array:
    """Where points near a strip are.

    Args:
        strip: The columns.
        points: Shape (n, 3), m.

    Returns:
        Arc length and offset, shape (n, 2), m.
    """
    middle = len(strip.across) // 2
    off = points[:, None] - strip.base[None, :, middle]
    along, side = (np.sum(off * axis, axis=-1) for axis in (strip.along, cross(strip.along, strip.column)))
    k = np.argmin(np.sum(off**2, axis=-1) - side**2, axis=1)
    n = np.arange(len(points))
    return np.column_stack((strip.arc[k] + along[n, k], strip.across[middle] + side[n, k]))


@dataclass(frozen=True, kw_only=True, eq=False)
class Places:
    """Pairs of places at both edges of a bead, at equal shares of the edges' lengths.

    Attributes:
        along_m: Arc length of the centre line, shape (n,), m.
        left: Places inside the left edge on the strip, shape (n, 2), m.
        right: Places inside the right edge, shape (n, 2), m.
        corner: Where the centre line has a corner, shape (n,).
    """

    along_m: Array
    left: Array
    right: Array
    corner: NDArray[np.bool_]


def places(edges: Edges, strip: Strip) -> Places:
    """Where heights are measured.

    Args:
        edges: The edges.
        strip: Under the bead.

    Returns:
        A pair about every millimetre, without the bead's beginning and end.
    """
    length = centre_line(edges).length_m
    share = np.linspace(_ENDS_M / length, 1.0 - _ENDS_M / length, round(length / _PLACE_STEP_M))
    u, w = share * edges.left.length_m, share * edges.right.length_m
    first, second = (
        (edges.left(u, n) * edges.left.length_m**n + edges.right(w, n) * edges.right.length_m**n) / 2.0
        for n in (1, 2)
    )
    speed = np.linalg.norm(first, axis=1)
    turn = np.linalg.norm(cross(first, second), axis=1) / speed**3
    width = np.linalg.norm(edges.chord(share), axis=1)
    bent = turn > max(_CORNER_SHARE * float(turn.max()), _STRAIGHT / float(width.mean()))
    left, right = on_strip(strip, edges.left(u)), on_strip(strip, edges.right(w))
    inward = INSET_M * normalise(right - left)
    return Places(along_m=share * length, left=left + inward, right=right - inward, corner=bent)


def heights_at(strip: Strip, laid: Laid, at: Array) -> Array:
    """Mean height of the columns within ``PATCH_M`` of places.

    Args:
        strip: The columns.
        laid: The bead.
        at: Arc lengths and offsets, shape (n, 2), m.

    Returns:
        Shape (n,), m; NaN where there are no columns.
    """
    there = strip.there
    grid = np.stack(np.meshgrid(strip.arc, strip.across, indexing="ij"), axis=-1)[there]
    height = laid.height[there]
    near = cKDTree(grid).query_ball_point(at, PATCH_M)
    return np.array([height[k].mean() if k else np.nan for k in near])


@dataclass(frozen=True, kw_only=True, eq=False)
class EdgeHeights:
    """Heights of a bead at both edges.

    Attributes:
        places: Where.
        left_m: Shape (n,), m.
        right_m: Shape (n,), m.
        missed: Share of the sealant that fell beside the surface.
    """

    places: Places
    left_m: Array
    right_m: Array
    missed: float

    @property
    def difference_m(self) -> Array:
        """Between both edges, shape (n,), m."""
        return np.asarray(np.abs(self.left_m - self.right_m))

    def row(self) -> dict[str, float | None]:
        """In numbers.

        Returns:
            ``laid_left_mm`` and ``laid_right_mm``, means along the path; ``laid_min_mm`` and ``laid_max_mm``
            over both edges; ``laid_difference_mm``, the largest between the edges; ``laid_corner_mm`` and
            ``laid_corner_worst_mm``, mean and largest difference at the corners, None without corners;
            ``missed_pct`` of the sealant.
        """
        both, corner = np.concatenate((self.left_m, self.right_m)), self.difference_m[self.places.corner]
        return {
            "laid_left_mm": 1e3 * float(np.mean(self.left_m)),
            "laid_right_mm": 1e3 * float(np.mean(self.right_m)),
            "laid_min_mm": 1e3 * float(both.min()),
            "laid_max_mm": 1e3 * float(both.max()),
            "laid_difference_mm": 1e3 * float(self.difference_m.max()),
            "laid_corner_mm": 1e3 * float(corner.mean()) if len(corner) else None,
            "laid_corner_worst_mm": 1e3 * float(corner.max()) if len(corner) else None,
            "missed_pct": 100.0 * self.missed,
        }


def edge_heights(strip: Strip, laid: Laid, at: Places) -> EdgeHeights:
    """Measures a bead at both edges.

    Args:
        strip: The columns.
        laid: The bead.
        at: Where.

    Returns:
        Heights along the columns.
    """
    return EdgeHeights(
        places=at,
        left_m=heights_at(strip, laid, at.left),
        right_m=heights_at(strip, laid, at.right),
        missed=laid.missed_m3 / laid.sprayed_m3,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Comparison:
    """The beads of one case's paths.

    Attributes:
        strip: The surface.
        laid: Each path's bead, by the path's name.
        heights: Their heights at both edges.
    """

    strip: Strip
    laid: dict[str, Laid]
    heights: dict[str, EdgeHeights]

    def row(self) -> dict[str, Any]:
        """The comparison in numbers.

        Returns:
            What ``EdgeHeights.row`` says of each of ``PATHS``, with its name before it, None for one that is
            not there; ``ipopt_reduction`` and
            ``robot_reduction``, by which factor the difference at the corners is smaller than the naive
            path's; and ``reduction_word``, why there is none.
        """
        rows = {who: heights.row() for who, heights in self.heights.items()}
        out: dict[str, Any] = {
            f"{who}_{key}": rows[who][key] if who in rows else None for who in PATHS for key in rows["naive"]
        }
        naive, anywhere = out["naive_laid_corner_mm"], out["naive_laid_difference_mm"]
        word = ""
        if (anywhere if naive is None else naive) < EQUAL_MM:
            word = "naive equal already"
        elif naive is None:
            word = "no corner"
        elif "ipopt" not in rows:
            word = "no path"
        for who in PATHS[1:]:
            mine = out[f"{who}_laid_corner_mm"]
            out[f"{who}_reduction"] = None if word or mine is None else naive / mine
        return out | {"reduction_word": word}


def compare(
    case: BeadCase, edges: Edges, paths: dict[str, BeadPath], fan_angle_rad: float, settling: Settling
) -> Comparison:
    """Lays the beads of several paths and measures them.

    Args:
        case: The case.
        edges: Its edges.
        paths: By name, of ``PATHS``; ``naive`` among them.
        fan_angle_rad: theta [rad].
        settling: Of the beads.

    Returns:
        The beads.
    """
    strip = strip_of(case, edges)
    at = places(edges, strip)
    laid = {who: lay(strip, path, fan_angle_rad, settling) for who, path in paths.items()}
    return Comparison(
        strip=strip, laid=laid, heights={who: edge_heights(strip, bead, at) for who, bead in laid.items()}
    )
