"""Seams: space curves by arc length with a tangent and an approach direction."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from seal_gym.core.errors import SeamError, is_number, require
from seal_gym.core.frames import Array, cross, normalise
from seal_gym.core.jit import kernel

# A vertex that turns more than this is a corner and gets the corner radius; a smaller turn is a sample
# of a smooth curve and gets the largest arc that fits between its neighbours.
CORNER_TURN_RAD = np.deg2rad(12.0)
_SMOOTH_TURN_RAD = 1e-9
_MIN_SAMPLE_M = 1e-5
# The tip has to pitch with the floor: a bend up or down as tight as a corner would need 10 deg within 1 mm.
_MIN_PITCH_RADIUS_M = 20e-3
_LEVEL_RAD = np.deg2rad(1.0)
# Coming down from the hover takes up to 20 mm of travel, which must not be most of the seam.
MIN_LENGTH_M = 0.04
_ARC_STEP_RAD = np.deg2rad(0.5)
# The chord of an arc departs from it by R (1 - cos(step / 2)): 0.7 um at 70 mm.
MIN_SPACING_M = 1e-4
# Twice the arm's reach: beyond it a coordinate is no doubt in millimetres.
MAX_COORDINATE_M = 2.0
# Below this inner radius the mouth (radius 1.5 mm, 2.1 mm beside the seam) would turn on the spot.
MIN_CORNER_RADIUS_M = 4e-3
# The four ROI features cannot see the lean (rotation about y): a controller can only hold it.
MAX_LEAN_RATE_RAD_M = np.deg2rad(300.0)
MAX_LEAN_CHANGE_RAD = np.deg2rad(10.0)
# What is nearer to the direction of travel leaves the lean undefined.
MIN_CROSSING_RAD = np.deg2rad(30.0)
# Under 35 deg the nozzle's mouth is within 0.5 mm of the wall, beyond 55 deg of the plate.
FILLET_LEAN_RAD = (np.deg2rad(35.0), np.deg2rad(55.0))
# The seam runs on past both ends of the sealed stretch, or the ROIs would see its end.
RUN_ON_M = 0.03
_SELF_CLEARANCE_M = 2e-3
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

    @property
    def closed(self) -> bool:
        """Whether the sealed stretch ends where it begins."""
        ends = self.at([0.0, self.length]).position
        return bool(np.linalg.norm(ends[1] - ends[0]) < MIN_SPACING_M)

    @property
    def up(self) -> Array:
        """Unit normals of the floor at the samples: across the seam, in its vertical plane, shape (m, 3)."""
        return cross(normalise(cross(self.tangent, _UP)), self.tangent)

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


@kernel
def _seam_in_world(
    s: Array, arc: Array, position: Array, tangent: Array, part: Array, point: Array, direction: Array
) -> None:
    last = arc.shape[0] - 2
    for i in range(s.shape[0]):
        at = min(max(s[i], arc[0]), arc[-1])
        k = min(max(np.searchsorted(arc, at, side="right") - 1, 0), last)
        w = (at - arc[k]) / (arc[k + 1] - arc[k])
        for r in range(3):
            point[i, r], direction[i, r] = part[i, r, 3], 0.0
            for m in range(3):
                point[i, r] += part[i, r, m] * ((1.0 - w) * position[k, m] + w * position[k + 1, m])
                direction[i, r] += part[i, r, m] * ((1.0 - w) * tangent[k, m] + w * tangent[k + 1, m])


def seam_in_world(seam: Seam, s: Array, part_pose: Array) -> tuple[Array, Array]:
    """Points of a seam on N displaced parts: what ``Seam.at`` gives, fast and in the world frame.

    Args:
        seam: The seam.
        s: Arc lengths, shape (N,), m; clipped to the curve.
        part_pose: ``T_world_part``, shape (N, 4, 4), m.

    Returns:
        Positions [m] and directions of travel (of about unit length), shape (N, 3) each.
    """
    point, direction = np.empty((len(s), 3)), np.empty((len(s), 3))
    _seam_in_world(s, seam.arc, seam.position, seam.tangent, part_pose, point, direction)
    return point, direction


def _first(bad: NDArray[np.bool_]) -> int | None:
    """Index of the first true element."""
    return int(np.argmax(bad)) if bad.any() else None


def _check_points(points: ArrayLike, approach: ArrayLike) -> tuple[Array, Array]:
    try:
        p, a = np.array(points, dtype=np.float64), np.array(approach, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise SeamError(f"points and approach must be numbers, (n, 3) each: {error}") from error
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
        k = _first(~np.all(np.isfinite(values), axis=1))
        require(
            k is None,
            f"{name}[{k}] = {values[k].tolist() if k is not None else ''} is not finite: every number "
            "must be, no NaN or inf",
            SeamError,
        )
    k = _first(np.abs(p).max(axis=1) > MAX_COORDINATE_M)
    require(
        k is None,
        f"points[{k}] = {p[k or 0].tolist()}: no coordinate may be beyond {MAX_COORDINATE_M:g} m; divide "
        "millimetres by 1000",
        SeamError,
    )
    size = np.linalg.norm(a, axis=1)
    k = _first(np.abs(size - 1.0) > 1e-3)
    require(
        k is None,
        f"approach[{k}] = {a[k or 0].tolist()} has length {size[k or 0]:.4g}: must be a unit vector; divide "
        "it by its length",
        SeamError,
    )
    gap = np.linalg.norm(np.diff(p, axis=0), axis=1)
    k = _first(gap < MIN_SPACING_M)
    require(
        k is None,
        f"points {k} and {(k or 0) + 1} are {gap[k or 0] * 1e3:.3g} mm apart: two points alike; keep "
        f"neighbours at least {MIN_SPACING_M * 1e3:g} mm apart, drop one of them",
        SeamError,
    )
    return p, a / size[:, None]


def _segments_cross(p: Array, clearance_m: float, closed: bool) -> tuple[int, int] | None:
    """First pair of segments, not neighbours, that cross or come too close in the plate's plane."""
    start, d = p[:-1, :2], np.diff(p[:, :2], axis=0)
    end, n = p[1:, :2], len(p) - 1
    arc = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))))

    def to_segment(points: Array, k: NDArray[np.intp] | int) -> Array:
        r, along = points - start[k], d[k]
        square = np.maximum(np.sum(along**2, axis=-1), 1e-18)
        w = np.clip(np.sum(r * along, axis=-1) / square, 0.0, 1.0)
        return np.asarray(np.linalg.norm(r - w[..., None] * along, axis=-1))

    for i in range(n - 2):
        j: NDArray[np.intp] = np.arange(i + 2, n - 1 if closed and i == 0 else n)
        r = start[j] - start[i]
        det = d[i, 0] * d[j, 1] - d[i, 1] * d[j, 0]
        safe = np.where(np.abs(det) < 1e-15, 1.0, det)
        u = (r[:, 0] * d[j, 1] - r[:, 1] * d[j, 0]) / safe
        v = (r[:, 0] * d[i, 1] - r[:, 1] * d[i, 0]) / safe
        hit = (np.abs(det) >= 1e-15) & (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
        # Where two segments do not cross, they are nearest at an end of one of them.
        ends = (
            to_segment(start[i], j),
            to_segment(end[i], j),
            to_segment(start[j], i),
            to_segment(end[j], i),
        )
        near = np.min(ends, axis=0) < clearance_m
        # Along a bend neighbours come close as well: only what lies more than half a turn away counts.
        apart = arc[j] - arc[i + 1]
        if closed:
            apart = np.minimum(apart, arc[-1] - arc[j + 1] + arc[i])
        bad = np.flatnonzero(hit | (near & (apart > np.pi * clearance_m)))
        if len(bad):
            return i, int(j[bad[0]])
    return None


def _round_vertex(
    before: Array, vertex: Array, after: Array, radius: float | None
) -> tuple[Array, Array, float]:
    """Samples, tangents (k, 3) and radius of the arc for a vertex; the largest that fits if None."""
    u, v = normalise(vertex - before), normalise(after - vertex)
    turn = float(np.arctan2(np.linalg.norm(cross(u, v)), u @ v))
    half = 0.5 * min(float(np.linalg.norm(vertex - before)), float(np.linalg.norm(after - vertex)))
    r = radius if radius is not None else half / np.tan(turn / 2)
    cut = r * np.tan(turn / 2)
    normal = normalise(v - u * (u @ v))
    steps = max(2, int(np.ceil(turn / _ARC_STEP_RAD)))
    angle = np.linspace(0.0, turn, steps + 1)[:, None]
    points = vertex - cut * u + r * (np.sin(angle) * u + (1.0 - np.cos(angle)) * normal)
    return points, np.cos(angle) * u + np.sin(angle) * normal, r


class _Piece(NamedTuple):
    points: Array
    tangents: Array
    corner: bool


def _round(p: Array, corner_radius: float, n_head: int) -> list[_Piece]:
    """Replaces every turning vertex by an arc; ``n_head`` vertices stand before the user's first point."""
    d = np.diff(p, axis=0)
    length = np.linalg.norm(d, axis=1)
    u = d / length[:, None]
    turn = np.arctan2(np.linalg.norm(cross(u[:-1], u[1:]), axis=1), np.sum(u[:-1] * u[1:], axis=1))
    pieces = [_Piece(p[:1], u[:1], False)]
    for k, angle in enumerate(turn, start=1):
        if angle < _SMOOTH_TURN_RAD:
            pieces.append(_Piece(p[k : k + 1], u[k : k + 1], False))
            continue
        corner = bool(angle > CORNER_TURN_RAD)
        if corner:
            room = 0.5 * min(length[k - 1], length[k]) / np.tan(min(angle, np.pi - 1e-6) / 2)
            require(
                corner_radius >= MIN_CORNER_RADIUS_M,
                f"corner_radius = {corner_radius * 1e3:g} mm at point {k - n_head}, which turns "
                f"{np.rad2deg(angle):.1f} deg: tighter than the nozzle allows; use at least "
                f"{MIN_CORNER_RADIUS_M * 1e3:g} mm",
                SeamError,
            )
            require(
                corner_radius <= room + 1e-12,
                f"corner_radius = {corner_radius * 1e3:g} mm does not fit at point {k - n_head}, which turns "
                f"{np.rad2deg(angle):.1f} deg between sides of {length[k - 1] * 1e3:.1f} and "
                f"{length[k] * 1e3:.1f} mm: at most {room * 1e3:.2f} mm there; lengthen the sides, reduce "
                "the radius, or give more points along the curve",
                SeamError,
            )
        points, tangents, r = _round_vertex(p[k - 1], p[k], p[k + 1], corner_radius if corner else None)
        require(
            r >= MIN_CORNER_RADIUS_M - 1e-12,
            f"the curve at point {k - n_head} has a radius of {r * 1e3:.2f} mm: tighter than the nozzle "
            f"allows; keep it at {MIN_CORNER_RADIUS_M * 1e3:g} mm or more",
            SeamError,
        )
        pitch = abs(float(np.arcsin(u[k, 2]) - np.arcsin(u[k - 1, 2])))
        require(
            pitch < _LEVEL_RAD or r >= _MIN_PITCH_RADIUS_M,
            f"the seam pitches by {np.rad2deg(pitch):.1f} deg at point {k - n_head} with a radius of "
            f"{r * 1e3:.1f} mm: the gun needs {_MIN_PITCH_RADIUS_M * 1e3:g} mm or more; enlarge "
            "corner_radius or give more points along the bend",
            SeamError,
        )
        pieces.append(_Piece(points, tangents, corner))
    pieces.append(_Piece(p[-1:], u[-1:], False))
    return pieces


def _lean(p: Array, a: Array) -> tuple[Array, float]:
    """Lean of each approach direction from the plate's normal [rad] and the side it leans to.

    The side is +1 for right of travel, -1 for left.
    """
    u = normalise(np.diff(p, axis=0))
    middle = u[:-1] + u[1:]
    k = _first(np.linalg.norm(middle, axis=1) < 1e-3)
    require(
        k is None, f"the polyline turns back on itself at point {(k or 0) + 1}: a seam must go on", SeamError
    )
    tangent = normalise(np.concatenate((u[:1], middle, u[-1:])))
    right = normalise(cross(tangent, _UP))
    k = _first(np.abs(np.sum(a * tangent, axis=1)) > np.cos(MIN_CROSSING_RAD))
    require(
        k is None,
        f"approach[{k}] = {a[k or 0].tolist()} is parallel to the seam, or within "
        f"{np.rad2deg(MIN_CROSSING_RAD):.0f} deg of it: it must point away from the surface, across the seam",
        SeamError,
    )
    # From the floor's normal, which a rising seam tilts back.
    lean = np.arccos(np.clip(np.sum(a * cross(right, tangent), axis=1), -1.0, 1.0))
    sides = np.where(lean > 1e-3, np.sign(np.sum(a * right, axis=1)), 0.0)
    given = sides[sides != 0]
    side = float(given[0]) if len(given) else 1.0
    k = _first(sides == -side)
    require(
        k is None,
        f"approach leans to the {'right' if side > 0 else 'left'} of travel at first and to the other side "
        f"at point {k}: the wall would change sides; keep it on one side",
        SeamError,
    )
    return lean, side


def _stretches(pair: tuple[int, int] | None, points: int) -> str:
    """Names of two segments, counted from the polyline's first."""
    names = {-1: "the run-on before the first point", points - 1: "the run-on past the last point"}
    return " and ".join(names.get(k, f"segment {k}") for k in pair or ())


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
        is_number(corner_radius) and corner_radius > 0,
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
        crossed = _segments_cross(p, _SELF_CLEARANCE_M, closed)
    else:
        head = (p[0] - run_on_m * normalise(p[1] - p[0]))[None]
        tail = (p[-1] + run_on_m * normalise(p[-1] - p[-2]))[None]
        crossed = _segments_cross(np.concatenate((head, p, tail)), _SELF_CLEARANCE_M, closed)
        crossed = crossed and (crossed[0] - 1, crossed[1] - 1)
    require(
        crossed is None,
        f"{_stretches(crossed, len(p))} of the polyline cross or come within "
        f"{_SELF_CLEARANCE_M * 1e3:g} mm of each other: a seam must not cross itself; it runs on "
        f"straight for {run_on_m * 1e3:g} mm past both ends, so that the cameras do not see its end",
        SeamError,
    )
    n_head = len(head)
    extended = np.concatenate((head, p, tail))
    extended_lean = np.concatenate((np.full(n_head, lean[0]), lean, np.full(len(tail), lean[-1])))
    pieces = _round(extended, corner_radius, n_head)
    position = np.concatenate([piece.points for piece in pieces])
    which = np.repeat(np.arange(len(pieces)), [len(piece.points) for piece in pieces])
    # Arcs of neighbouring vertices may all but touch: a curvature is no longer one between such samples.
    keep = np.concatenate(([True], np.linalg.norm(np.diff(position, axis=0), axis=1) > _MIN_SAMPLE_M))
    tangent = np.concatenate([piece.tangents for piece in pieces])[keep]
    position, which = position[keep], which[keep]
    arc = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(position, axis=0), axis=1))))
    # Where each vertex of the polyline ended up: the middle of its piece.
    middle = np.array([arc[which == k].mean() if np.any(which == k) else np.nan for k in range(len(pieces))])
    middle = np.where(np.isnan(middle), np.interp(np.arange(len(pieces)), which, arc), middle)
    sample_lean = np.interp(arc, middle, extended_lean)
    start, end = middle[n_head], middle[n_head + len(p) - 1]
    _check_lean(arc, sample_lean)
    require(
        bool(end - start >= MIN_LENGTH_M - 1e-9),
        f"the seam is {(end - start) * 1e3:.1f} mm long: at least {MIN_LENGTH_M * 1e3:g} mm, or the gun "
        "has not come down from its hover before the end",
        SeamError,
    )
    corners = np.array(
        [(arc[which == k][0], arc[which == k][-1]) for k, piece in enumerate(pieces) if piece.corner]
    ).reshape(-1, 2)
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
    """Vertices of a closed polyline after its first, up to the first that lies beyond a distance."""
    arc = np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))
    return p[1 : 2 + min(int(np.searchsorted(arc, distance)), len(arc) - 1)]


def _check_lean(arc: Array, lean: Array) -> None:
    rate = np.abs(np.diff(lean)) / np.diff(arc)
    worst = int(np.argmax(rate))
    require(
        bool(rate[worst] <= MAX_LEAN_RATE_RAD_M) and bool(np.ptp(lean) <= MAX_LEAN_CHANGE_RAD + 1e-9),
        f"the approach direction turns about y (its lean changes) by {np.rad2deg(np.ptp(lean)):.1f} deg in "
        f"all and by up to {np.rad2deg(rate[worst]) * 1e-3:.2f} deg/mm, which the ROI features cannot show: "
        f"at most {np.rad2deg(MAX_LEAN_CHANGE_RAD):.0f} deg and "
        f"{np.rad2deg(MAX_LEAN_RATE_RAD_M) * 1e-3:.1f} deg/mm",
        SeamError,
    )
