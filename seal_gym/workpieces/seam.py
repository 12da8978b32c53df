"""Seams: space curves by arc length with a tangent and an approach direction."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from seal_gym.core.errors import SeamError, require
from seal_gym.core.frames import Array, cross, normalise
from seal_gym.core.jit import kernel

# A vertex that turns more than this is a corner and gets the corner radius; a smaller turn is a sample
# of a smooth curve and gets the largest arc that fits between its neighbours.
CORNER_TURN_RAD = np.deg2rad(12.0)
_SMOOTH_TURN_RAD = 1e-9
_ARC_STEP_RAD = np.deg2rad(0.5)
# The chord of an arc departs from it by R (1 - cos(step / 2)): 0.7 um at 70 mm.
MIN_SPACING_M = 1e-4
# Below this inner radius the mouth (radius 1.5 mm, 2.1 mm beside the seam) would turn on the spot.
MIN_CORNER_RADIUS_M = 4e-3
# The four ROI features cannot see the lean (rotation about y): a controller can only hold it.
MAX_LEAN_RATE_RAD_M = np.deg2rad(300.0)
MAX_LEAN_CHANGE_RAD = np.deg2rad(10.0)
# Under 30 deg the nozzle's mouth is within 0.2 mm of the wall, beyond 60 deg of the plate.
FILLET_LEAN_RAD = (np.deg2rad(30.0), np.deg2rad(60.0))
# The seam runs on past both ends of the sealed stretch, or the ROIs would see its end.
RUN_ON_M = 0.03
_UP = np.array([0.0, 0.0, 1.0])


class SeamPoint(NamedTuple):
    """Points of a seam.

    Attributes:
        position: Shape (..., 3), m, in the part's frame.
        tangent: Unit direction of travel, shape (..., 3).
        approach: Unit direction from the seam back along the nozzle, shape (..., 3).
    """

    position: Array
    tangent: Array
    approach: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Seam:
    """A curve of straight lines and arcs, sampled so finely that segments stand for it.

    Attributes:
        position: Samples in order of travel in the part's frame, shape (m, 3), m.
        tangent: Unit tangents at the samples, shape (m, 3).
        approach: Unit approach directions at the samples, orthogonal to the tangents, shape (m, 3).
        length: Length of the sealed stretch [m]; the samples reach beyond both its ends.
        run_in: Arc length before the sealed stretch [m].
        corners: Arc-length intervals of the rounded corners, shape (k, 2), m.
    """

    position: Array
    tangent: Array
    approach: Array
    length: float
    run_in: float
    corners: Array
    arc: Array = field(init=False)

    def __post_init__(self) -> None:
        """Adds the arc length of each sample, zero where the sealed stretch begins."""
        steps = np.linalg.norm(np.diff(self.position, axis=0), axis=1)
        arc = np.concatenate(([0.0], np.cumsum(steps))) - self.run_in
        object.__setattr__(self, "arc", arc)

    def at(self, s: ArrayLike) -> SeamPoint:
        """The seam at an arc length.

        Args:
            s: Arc length from the start of the sealed stretch, shape (...), m; clipped to the curve.

        Returns:
            Position, tangent and approach there.
        """
        s = np.clip(np.asarray(s, dtype=np.float64), self.arc[0], self.arc[-1])
        i = np.clip(np.searchsorted(self.arc, s, side="right") - 1, 0, len(self.arc) - 2)
        w = ((s - self.arc[i]) / (self.arc[i + 1] - self.arc[i]))[..., None]

        def mix(values: Array) -> Array:
            return values[i] * (1.0 - w) + values[i + 1] * w

        return SeamPoint(mix(self.position), normalise(mix(self.tangent)), normalise(mix(self.approach)))

    def tip_path(self, stand_off_m: float) -> Array:
        """The desired path of the tip.

        Args:
            stand_off_m: Distance from the seam along the approach direction [m].

        Returns:
            One point a sample, shape (m, 3), m.
        """
        return self.position + stand_off_m * self.approach


@kernel
def nearest_on_path(  # noqa: D103  # documented where it is used; numba kernels take bare arrays
    path: Array, arc: Array, point: Array, first: float, last: float
) -> tuple[float, float]:
    best, best_s = np.inf, 0.0
    for i in range(path.shape[0] - 1):
        if arc[i + 1] < first or arc[i] > last:
            continue
        dd = pd = 0.0
        for r in range(3):
            d = path[i + 1, r] - path[i, r]
            dd += d * d
            pd += (point[r] - path[i, r]) * d
        step = arc[i + 1] - arc[i]
        # Stay inside the window: its ends may cut a segment.
        lower = max(0.0, (first - arc[i]) / step)
        upper = min(1.0, (last - arc[i]) / step)
        w = min(max(pd / dd, lower), upper)
        distance = 0.0
        for r in range(3):
            e = point[r] - path[i, r] - w * (path[i + 1, r] - path[i, r])
            distance += e * e
        if distance < best:
            best, best_s = distance, arc[i] + w * step
    return np.sqrt(best), best_s


def _check_points(points: ArrayLike, approach: ArrayLike) -> tuple[Array, Array]:
    p, a = np.array(points, dtype=np.float64), np.array(approach, dtype=np.float64)
    require(
        p.ndim == 2 and p.shape[1:] == (3,) and len(p) >= 2,
        f"points has shape {p.shape}: must be (n, 3) with n >= 2, in m, in order of travel",
        SeamError,
    )
    if a.shape == (3,):
        a = np.broadcast_to(a, p.shape).copy()
    require(
        a.shape == p.shape,
        f"approach has shape {a.shape}: must be {p.shape}, one direction a point, or (3,)",
        SeamError,
    )
    for name, values in (("points", p), ("approach", a)):
        bad = np.flatnonzero(~np.all(np.isfinite(values), axis=1))
        require(
            not len(bad), f"{name}[{bad[:1]}] is not finite: give numbers in m, no NaN or inf", SeamError
        )
    size = np.linalg.norm(a, axis=1)
    bad = np.flatnonzero(np.abs(size - 1.0) > 1e-3)
    require(
        not len(bad),
        f"approach[{bad[:1]}] has length {size[bad[:1]]}: must be a unit vector",
        SeamError,
    )
    gap = np.linalg.norm(np.diff(p, axis=0), axis=1)
    bad = np.flatnonzero(gap < MIN_SPACING_M)
    require(
        not len(bad),
        f"points {bad[:1]} and {bad[:1] + 1} are {gap[bad[:1]] * 1e3} mm apart: two points alike; keep "
        f"neighbours at least {MIN_SPACING_M * 1e3} mm apart",
        SeamError,
    )
    return p, a / size[:, None]


def _segments_cross(p: Array, clearance_m: float) -> tuple[int, int] | None:
    """First pair of non-neighbouring segments that come closer than the clearance in the plate's plane."""
    a, d = p[:-1, :2], np.diff(p[:, :2], axis=0)
    n = len(a)
    arc = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))))
    for i in range(n - 2):
        j = np.arange(i + 2, n)
        r = a[j] - a[i]
        det = d[i, 0] * d[j, 1] - d[i, 1] * d[j, 0]
        safe = np.where(np.abs(det) < 1e-15, 1.0, det)
        u = (r[:, 0] * d[j, 1] - r[:, 1] * d[j, 0]) / safe
        v = (r[:, 0] * d[i, 1] - r[:, 1] * d[i, 0]) / safe
        hit = (np.abs(det) >= 1e-15) & (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
        # Vertices against segment i, and segment i's start against the others: parallel overlaps too.
        w = np.clip(np.sum(-r * d[j], axis=1) / np.maximum(np.sum(d[j] ** 2, axis=1), 1e-18), 0.0, 1.0)
        near = np.linalg.norm(r + w[:, None] * d[j], axis=1) < clearance_m
        far = arc[j] - arc[i] > np.pi * clearance_m
        bad = np.flatnonzero(hit | (near & far))
        if len(bad):
            return i, int(j[bad[0]])
    return None


def _round_vertex(before: Array, vertex: Array, after: Array, radius: float | None) -> tuple[Array, float]:
    """Arc that replaces a vertex: samples (k, 3) and its radius; the largest that fits if None."""
    u, v = normalise(vertex - before), normalise(after - vertex)
    turn = float(np.arctan2(np.linalg.norm(cross(u, v)), u @ v))
    half = 0.5 * min(float(np.linalg.norm(vertex - before)), float(np.linalg.norm(after - vertex)))
    r = radius if radius is not None else half / np.tan(turn / 2)
    cut = r * np.tan(turn / 2)
    normal = normalise(v - u * (u @ v))
    steps = max(2, int(np.ceil(turn / _ARC_STEP_RAD)))
    angle = np.linspace(0.0, turn, steps + 1)[:, None]
    return vertex - cut * u + r * (np.sin(angle) * u + (1.0 - np.cos(angle)) * normal), r


class _Piece(NamedTuple):
    points: Array
    corner: bool


def _round(p: Array, corner_radius: float) -> tuple[list[_Piece], float]:
    """Replaces every turning vertex by an arc; returns the pieces in order and the smallest radius."""
    d = np.diff(p, axis=0)
    length = np.linalg.norm(d, axis=1)
    u = d / length[:, None]
    turn = np.arctan2(np.linalg.norm(cross(u[:-1], u[1:]), axis=1), np.sum(u[:-1] * u[1:], axis=1))
    pieces = [_Piece(p[:1], False)]
    smallest = np.inf
    for k, angle in enumerate(turn, start=1):
        if angle < _SMOOTH_TURN_RAD:
            pieces.append(_Piece(p[k : k + 1], False))
            continue
        corner = bool(angle > CORNER_TURN_RAD)
        if corner:
            room = 0.5 * min(length[k - 1], length[k]) / np.tan(min(angle, np.pi - 1e-6) / 2)
            require(
                corner_radius >= MIN_CORNER_RADIUS_M,
                f"corner_radius = {corner_radius * 1e3:g} mm at point {k}, which turns "
                f"{np.rad2deg(angle):.1f} deg: tighter than the nozzle allows; use at least "
                f"{MIN_CORNER_RADIUS_M * 1e3:g} mm",
                SeamError,
            )
            require(
                corner_radius <= room + 1e-12,
                f"corner_radius = {corner_radius * 1e3:g} mm does not fit at point {k}, which turns "
                f"{np.rad2deg(angle):.1f} deg between sides of {length[k - 1] * 1e3:.1f} and "
                f"{length[k] * 1e3:.1f} mm: at most {room * 1e3:.2f} mm there; lengthen the sides, reduce "
                "the radius, or give more points along the curve",
                SeamError,
            )
        arc, r = _round_vertex(p[k - 1], p[k], p[k + 1], corner_radius if corner else None)
        require(
            r >= MIN_CORNER_RADIUS_M - 1e-12,
            f"the curve at point {k} has a radius of {r * 1e3:.2f} mm: tighter than the nozzle allows; keep "
            f"it at {MIN_CORNER_RADIUS_M * 1e3:g} mm or more",
            SeamError,
        )
        smallest = min(smallest, r)
        pieces.append(_Piece(arc, corner))
    pieces.append(_Piece(p[-1:], False))
    return pieces, smallest


def _lean(p: Array, a: Array) -> tuple[Array, float]:
    """Lean of each approach direction from the plate's normal [rad] and the side it leans to.

    The side is +1 for right of travel, -1 for left.
    """
    d = np.diff(p, axis=0)
    u = normalise(d)
    tangent = np.concatenate((u[:1], u[:-1] + u[1:], u[-1:]))
    right = cross(tangent, _UP)
    across = np.sum(a * right, axis=1) / np.maximum(np.linalg.norm(right, axis=1), 1e-12)
    lean = np.arccos(np.clip(a[:, 2], -1.0, 1.0))
    sides = np.sign(across[lean > 1e-3])
    require(
        not len(sides) or bool(np.all(sides == sides[0])),
        f"approach leans to the right of travel at some points and to the left at others (points "
        f"{np.flatnonzero(np.sign(across) != (sides[0] if len(sides) else 1))[:3]}): the wall would change sides; "
        "keep it on one side",
        SeamError,
    )
    return lean, float(sides[0]) if len(sides) and sides[0] != 0 else 1.0


def build_seam(
    points: ArrayLike, approach: ArrayLike, *, corner_radius: float = 5e-3, run_on_m: float = RUN_ON_M
) -> Seam:
    """Builds a seam from a polyline.

    Corners (turns above 12 deg) become arcs of ``corner_radius``; smaller turns are samples of a smooth
    curve and become the largest arcs that fit. The result has a continuous tangent. The lean of the
    approach direction (its angle to the plate's normal) runs linearly in arc length between the points,
    on the side the points name.

    Args:
        points: In order of travel, in the part's frame, shape (n, 3), m.
        approach: Unit directions from the seam back along the nozzle (the tip's z), shape (n, 3) or (3,).
        corner_radius: Radius of the rounded corners [m].
        run_on_m: How far the seam runs on, straight, past both ends [m]; a closed polyline (last point
            equal to the first) runs on along itself.

    Returns:
        The seam.

    Raises:
        SeamError: If the polyline has a wrong shape, a value that is not finite, two points alike, a
            crossing, a corner tighter than the nozzle allows, a vertical run, an approach direction
            that changes sides or turns about y faster than the ROI features can show.
    """
    p, a = _check_points(points, approach)
    require(
        bool(np.isfinite(corner_radius)) and corner_radius > 0,
        f"corner_radius = {corner_radius!r}: must be a length in m > 0",
        SeamError,
    )
    slope = np.abs(np.diff(p[:, 2])) / np.linalg.norm(np.diff(p, axis=0), axis=1)
    require(
        bool(np.all(slope < np.sin(np.deg2rad(45.0)))),
        f"the polyline rises at {np.rad2deg(np.arcsin(np.max(slope))):.0f} deg: at most 45 deg to the plate",
        SeamError,
    )
    lean, side = _lean(p, a)
    closed = len(p) > 3 and bool(np.linalg.norm(p[0] - p[-1]) < MIN_SPACING_M)
    if closed:
        head, tail = _along(p[::-1], run_on_m)[::-1], _along(p, run_on_m)
        crossed = _segments_cross(p[:-1], 2e-3)
    else:
        head = (p[0] - run_on_m * normalise(p[1] - p[0]))[None]
        tail = (p[-1] + run_on_m * normalise(p[-1] - p[-2]))[None]
        crossed = _segments_cross(p, 2e-3)
    require(
        crossed is None,
        f"segments {crossed} of the polyline cross or come within 2 mm of each other: a seam must not "
        "cross itself",
        SeamError,
    )
    n_head = len(head)
    extended = np.concatenate((head, p, tail))
    extended_lean = np.concatenate((np.full(n_head, lean[0]), lean, np.full(len(tail), lean[-1])))
    pieces, _ = _round(extended, corner_radius)
    position = np.concatenate([piece.points for piece in pieces])
    which = np.repeat(np.arange(len(pieces)), [len(piece.points) for piece in pieces])
    keep = np.concatenate(([True], np.linalg.norm(np.diff(position, axis=0), axis=1) > 1e-9))
    position, which = position[keep], which[keep]
    arc = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(position, axis=0), axis=1))))
    # Where each vertex of the polyline ended up: the middle of its piece.
    middle = np.array([arc[which == k].mean() if np.any(which == k) else np.nan for k in range(len(pieces))])
    middle = np.where(np.isnan(middle), np.interp(np.arange(len(pieces)), which, arc), middle)
    sample_lean = np.interp(arc, middle, extended_lean)
    start, end = middle[n_head], middle[n_head + len(p) - 1]
    _check_lean(arc, sample_lean)
    corners = np.array(
        [(arc[which == k][0], arc[which == k][-1]) for k, piece in enumerate(pieces) if piece.corner]
    ).reshape(-1, 2)
    tangent = _tangents(position, pieces, which)
    right = normalise(cross(tangent, _UP))
    up = cross(right, tangent)
    direction = np.cos(sample_lean)[:, None] * up + np.sin(sample_lean)[:, None] * side * right
    return Seam(
        position=position,
        tangent=tangent,
        approach=direction,
        length=float(end - start),
        run_in=float(start),
        corners=corners - start,
    )


def _along(p: Array, distance: float) -> Array:
    """Vertices of a closed polyline after its first, up to a distance, the last one cut to it."""
    out, left = [], distance
    for a, b in zip(p[:-1], p[1:], strict=True):
        step = float(np.linalg.norm(b - a))
        if step >= left:
            out.append(a + (b - a) * left / step)
            break
        out.append(b)
        left -= step
    return np.array(out)


def _tangents(position: Array, pieces: list[_Piece], which: Array) -> Array:
    """Tangents at the samples: exact on lines, and on arcs the bisector of a circle's two chords."""
    u = normalise(np.diff(position, axis=0))
    tangent = np.concatenate((u[:1], normalise(u[:-1] + u[1:]), u[-1:]))
    for k, piece in enumerate(pieces):
        index = np.flatnonzero(which == k)
        if len(piece.points) < 3 or len(index) < 3:
            continue
        # At an arc's ends the neighbour is a line: reflect the first chord instead.
        first, last = index[0], index[-1]
        inner, outer = tangent[first + 1], u[first]
        tangent[first] = normalise(2.0 * (inner @ outer) * outer - inner)
        inner, outer = tangent[last - 1], u[last - 1]
        tangent[last] = normalise(2.0 * (inner @ outer) * outer - inner)
    return tangent


def _check_lean(arc: Array, lean: Array) -> None:
    rate = np.abs(np.diff(lean)) / np.diff(arc)
    worst = int(np.argmax(rate))
    require(
        bool(rate[worst] <= MAX_LEAN_RATE_RAD_M) and bool(np.ptp(lean) <= MAX_LEAN_CHANGE_RAD + 1e-9),
        f"the approach direction turns about y (its lean changes) by {np.rad2deg(np.ptp(lean)):.1f} deg in all "
        f"and by up to {np.rad2deg(rate[worst]) * 1e-3:.2f} deg/mm: the four ROI features cannot show it; at "
        f"most {np.rad2deg(MAX_LEAN_CHANGE_RAD):.0f} deg and {np.rad2deg(MAX_LEAN_RATE_RAD_M) * 1e-3:.1f} deg/mm",
        SeamError,
    )
