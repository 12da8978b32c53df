"""The seam's tangent at the tip from the two ROI images, frame after frame.

RANSAC in both views starts a track: their lines' planes meet in the seam's tangent, kept in the world, where
a seam at rest does not jump. Each frame then

1. follows the front view's edge ahead from where the tangent is expected, and remembers its pixels as rays in
   the world: the nozzle hides the seam behind the tip, but the memory holds it, which corners need;
2. meets the rays with the plate's plane through the tangent and fits a quadratic to what lies within a few
   millimetres of the tip; its tangent at the point nearest the tip is the new one; where new edges lie beside
   remembered ones the part has moved, and an alpha-beta filter moves the memory with it;
3. looks for that curve in the side view, whose offset and slope correct the plane's height and pitch by a
   Kalman filter each, with gating.

The front view fixes the seam in the plane, the side view fixes the plane. A view without the seam coasts on
the tangent in the world for a while, then is invalid, and RANSAC looks for a new start.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import require
from seal_gym.core.frames import Array
from seal_gym.core.jit import kernel
from seal_gym.core.parallel import split
from seal_gym.vision.edges import EdgeCfg, EdgeDetector, EdgeTables, edge_image
from seal_gym.vision.features import MIN_SEEN_PX, SeamLines, ViewGeometry, _length_inside
from seal_gym.vision.seam_line import (
    LineCfg,
    dilated,
    fit_curve,
    follow,
    local_line,
    ransac_line,
    row_edge,
    strips,
)

Bytes = NDArray[np.uint8]
Bools = NDArray[np.bool_]

_MM, _DEG = 1e-3, float(np.deg2rad(1.0))
_FILLET_PLATE = np.array([-np.sqrt(0.5), 0.0, np.sqrt(0.5)])
_STRETCHES = 20  # of the memory around the tip, in which new and old edges are compared
_SETTLED = 6  # frames without a jump after which new grey levels are the usual ones
_BESIDE = 8  # pixels on either side of the line whose brightness is watched
_HIDDEN = 3.0  # an edge this close to the ROI's border has no flank to compare with [px]
_MIN_ROWS = 8  # with an edge, for a view to count as seen
_FINE_PX, _COARSE_PX = 0.3, 1.5  # how sure an edge of the first line is
_START_SLOPE = 0.07  # of the side view's line as the gun is put before the seam
_HEIGHT_START, _PITCH_START = 0.2 * _MM, 0.03
_HEIGHT_FLOOR, _PITCH_FLOOR = 0.02 * _MM, 0.1 * _DEG  # a measurement is no better than this


@dataclass(frozen=True, kw_only=True)
class PerceptionCfg:
    """Parameters of the tracker.

    Attributes:
        edges: The edge stage.
        line: The line stage.
        coast_s: A lost view is believed for this long [s].
        search_s: After this long the seam is looked for anew [s].
        level_change: A view whose grey levels beside the line are this far from the usual is not believed.
        level_step: Nor is one where they change by more from one frame to the next.
        level_gain: Share of a frame in the usual levels.
        memory_s: Age at which a remembered edge is dropped [s].
        ahead_px: How far ahead the front view's edge is remembered [px].
        sigma_m: Width of the fit around the tip [m].
        bend: Standard deviation of the curve's quadratic coefficient [1/m].
        step_m: Standard deviation of the seam's place against the frame before [m].
        step_rad: Of its heading [rad].
        clip_m: Residuals beyond this weigh less [m].
        jump_m: New edges this far beside the memory's are not the seam's [m].
        row_sigma_m: Standard deviation of a row's edge at a step of one grey level [m].
        side_px: How far ahead and behind the side view is looked at [px].
        height_q_m: Drift of the plane's height from frame to frame [m].
        pitch_q_rad: Drift of its pitch [rad].
        gate: Measurements this many standard deviations off are not believed.
        follow_gain: Share of the new edges' drift against the memory by which the memory follows.
        velocity_gain: Share of that drift added to the part's velocity a frame.
    """

    edges: EdgeCfg = field(default_factory=EdgeCfg)
    line: LineCfg = field(default_factory=LineCfg)
    coast_s: float = 0.3
    search_s: float = 1.0
    level_change: float = 35.0
    level_step: float = 9.0
    level_gain: float = 0.2
    memory_s: float = 0.7
    ahead_px: float = 26.0
    sigma_m: float = 2.0 * _MM
    bend: float = 80.0
    step_m: float = 0.3 * _MM
    step_rad: float = 5.0 * _DEG
    clip_m: float = 0.15 * _MM
    jump_m: float = 0.8 * _MM
    row_sigma_m: float = 3.0 * _MM
    side_px: float = 18.0
    height_q_m: float = 0.01 * _MM
    pitch_q_rad: float = 0.1 * _DEG
    gate: float = 5.0
    follow_gain: float = 0.4
    velocity_gain: float = 0.1

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for name in ("coast_s", "search_s", "level_change", "level_step", "level_gain",
                     "memory_s", "ahead_px", "sigma_m", "bend", "step_m", "step_rad", "clip_m",
                     "jump_m", "row_sigma_m", "side_px", "height_q_m", "pitch_q_rad", "gate", "follow_gain",
                     "velocity_gain"):  # fmt: skip
            value = getattr(self, name)
            require(0.0 < value < np.inf, f"PerceptionCfg.{name} = {value!r}: must be finite and > 0")


class _Par(NamedTuple):
    """``PerceptionCfg``'s numbers as the kernels take them, times in frames, and the plate's normal."""

    memory: float
    ahead_px: float
    sigma_m: float
    bend: float
    step_m: float
    step_rad: float
    clip_m: float
    jump_m: float
    row_sigma_m: float
    side_px: float
    height_q_m: float
    pitch_q_rad: float
    gate: float
    coast: float
    search: float
    level_change: float
    level_step: float
    level_gain: float
    follow_gain: float
    velocity_gain: float
    plate_x: float
    plate_y: float
    plate_z: float

    @classmethod
    def of(cls, cfg: PerceptionCfg, frame_s: float, plate: Array) -> "_Par":
        same = {name: float(getattr(cfg, name)) for name in cls._fields if hasattr(cfg, name)}
        x, y, z = (float(v) for v in plate)
        return cls(
            **same,
            memory=float(max(round(cfg.memory_s / frame_s), 1)),
            coast=cfg.coast_s / frame_s + 1e-9,
            search=cfg.search_s / frame_s + 1e-9,
            plate_x=x,
            plate_y=y,
            plate_z=z,
        )


class _State(NamedTuple):
    """What is remembered of N simulations."""

    point: Array  # the tangent's point nearest the tip, world, (N, 3), m
    direction: Array  # its direction of travel, world, (N, 3)
    variance: Array  # of the plane's height and pitch, (N, 2)
    tracking: Bools  # (N,)
    missed: NDArray[np.int64]  # frames without the seam, (N, 2)
    clock: NDArray[np.int64]  # frames in which the front view showed the seam, (N,)
    level: Array  # usual grey levels beside the line, views by sides, -1 before the first, (N, 2, 2)
    last: Array  # those of the frame before
    steady: NDArray[np.int64]  # frames since they jumped, (N, 2)
    velocity: Array  # of the part across the seam, world, (N, 3), m a frame
    eye: Array  # remembered rays: optical centre, world, (N, K, 3), m
    ray: Array  # direction, (N, K, 3)
    weight: Array  # (N, K)
    stamp: NDArray[np.int64]  # frame of each, -1 for none, (N, K)
    head: NDArray[np.int64]  # where the next ray goes, (N,)


class _Maps(NamedTuple):
    """What another edge method found in N simulations' strips; without one, arrays of no rows."""

    edge: tuple[Bools, Bools]  # (N, length, width) of each view
    intensity: tuple[Array, Array]
    vector: tuple[Array, Array]  # across and along the strip, (N, length, width, 2)


_OWN = _Maps(
    edge=(np.zeros((0, 1, 1), np.bool_),) * 2,
    intensity=(np.zeros((0, 1, 1)),) * 2,
    vector=(np.zeros((0, 1, 1, 2)),) * 2,
)


class _Scratch(NamedTuple):
    """Work space of one frame."""

    grey: NDArray[np.int64]
    padded: Array
    work: Array
    bins: NDArray[np.int64]
    ex: Array
    ey: Array
    magnitude: Array
    orientation: Array
    intensity: Array
    edge: Bools
    profile: Array
    points: Array
    columns: Array
    fit: Array

    @classmethod
    def of(cls, length: int, width: int, pad: int, rays: int) -> "_Scratch":
        shape = (length, width)
        return cls(
            grey=np.empty(shape, np.int64),
            padded=np.empty((length + 2 * pad, width + 2 * pad)),
            work=np.empty(shape),
            bins=np.empty(512, np.int64),
            ex=np.empty(shape),
            ey=np.empty(shape),
            magnitude=np.empty(shape),
            orientation=np.empty(shape),
            intensity=np.empty(shape),
            edge=np.empty(shape, np.bool_),
            profile=np.empty(64),
            points=np.empty((2 * length, 3)),
            columns=np.empty((3, 2 * length)),
            fit=np.empty((4, rays)),
        )


@kernel
def _grey_strip(image: Bytes, view: int, grey: NDArray[np.int64]) -> None:
    """Sum of the channels, as a strip: the front view upside down, the side view transposed."""
    height, width = image.shape[0], image.shape[1]
    for i in range(height):
        for j in range(width):
            total = np.int64(image[i, j, 0]) + np.int64(image[i, j, 1]) + np.int64(image[i, j, 2])
            if view == 0:
                grey[height - 1 - i, j] = total
            else:
                grey[j, i] = total


@kernel
def _to_strip(p: Array, view: int, g: ViewGeometry, out: Array) -> bool:
    """Image of a point of the tip frame as t, o of the strip; False if it is behind the camera."""
    x = y = z = 0.0
    for k in range(3):
        d = p[k] - g.position[view, k]
        x += g.rotation[view, k, 0] * d
        y += g.rotation[view, k, 1] * d
        z += g.rotation[view, k, 2] * d
    if z < 1e-3:
        return False
    u, v = g.centre[view, 0] + g.focal[view] * x / z, g.centre[view, 1] + g.focal[view] * y / z
    if view == 0:
        out[0], out[1] = g.size[0, 1] - v, u
    else:
        out[0], out[1] = u, v
    return True


@kernel
def _strip_ray(t: float, o: float, view: int, g: ViewGeometry, out: Array) -> None:
    """Ray of a strip's point in the tip frame."""
    u, v = (o, g.size[0, 1] - t) if view == 0 else (t, o)
    x, y = (u - g.centre[view, 0]) / g.focal[view], (v - g.centre[view, 1]) / g.focal[view]
    for k in range(3):
        out[k] = g.rotation[view, k, 0] * x + g.rotation[view, k, 1] * y + g.rotation[view, k, 2]


@kernel
def _strip_slope(p: Array, d: Array, view: int, g: ViewGeometry, line: Array) -> bool:
    """The t and o of a point and do/dt of a direction there (line: t, o, q)."""
    a, b = np.empty(2), np.empty(2)
    ahead = np.empty(3)
    for k in range(3):
        ahead[k] = p[k] + 1e-6 * d[k]
    if not (_to_strip(p, view, g, a) and _to_strip(ahead, view, g, b)):
        return False
    if b[0] - a[0] < 1e-5:  # less than 0.01 px a mm of travel
        return False
    line[0], line[1], line[2] = a[0], a[1], (b[1] - a[1]) / (b[0] - a[0])
    return True


@kernel
def _emit(
    i: int, v: int, p: Array, d: Array, g: ViewGeometry, point: Array, direction: Array, valid: Bools
) -> None:
    """Projects the tangent (tip frame) into a view."""
    pc, dc = np.zeros(3), np.zeros(3)
    for r in range(3):
        for k in range(3):
            pc[r] += g.rotation[v, k, r] * (p[k] - g.position[v, k])
            dc[r] += g.rotation[v, k, r] * d[k]
    if pc[2] < 1e-3:
        valid[i, v] = False
        return
    x, y = pc[0] / pc[2], pc[1] / pc[2]
    point[i, v, 0], point[i, v, 1] = g.centre[v, 0] + g.focal[v] * x, g.centre[v, 1] + g.focal[v] * y
    direction[i, v, 0], direction[i, v, 1] = dc[0] - x * dc[2], dc[1] - y * dc[2]
    valid[i, v] = _length_inside(point[i, v], direction[i, v], g.size[v]) >= MIN_SEEN_PX


@kernel
def _edges_of(i: int, image: Bytes, view: int, mask: Bools, e: EdgeTables, maps: _Maps, s: _Scratch) -> None:
    _grey_strip(image, view, s.grey)
    if i < len(maps.edge[view]):
        s.edge[:] = maps.edge[view][i]
        s.intensity[:] = maps.intensity[view][i]
        s.ex[:] = maps.vector[view][i, :, :, 0]
        s.ey[:] = maps.vector[view][i, :, :, 1]
        return
    edge_image(
        s.grey,
        mask,
        e.tap,
        e.pad,
        e.par,
        e.g_log_g,
        s.padded,
        s.work,
        s.bins,
        s.ex,
        s.ey,
        s.magnitude,
        s.orientation,
        s.intensity,
        s.edge,
    )


@kernel
def _search(view: int, mask: Bools, ref: Array, lp: Array, s: _Scratch, line: Array) -> float:
    """A line (p, q) without knowing where to look; returns how sure a row's edge is [px], 0 without a line.

    Where the seam only grazes the ROI, RANSAC's line has to do: the view widens as the gun comes closer.
    """
    raw = np.empty(2)
    if not ransac_line(s.edge, mask, s.intensity, s.ex, s.ey, ref[0], lp, raw):
        return 0.0
    n = follow(s.grey, mask, s.edge, ref[0], raw[0], raw[1], lp[8], lp[8], lp, s.profile, s.points)
    if local_line(s.points, n, ref[0], ref[1], raw[0], lp, s.columns, line) > 0.0:
        return _FINE_PX
    line[0], line[1] = raw[0], raw[1]
    return _COARSE_PX


@kernel
def _support(mask: Bools, t_ref: float, line: Array, lp: Array, s: _Scratch, out: Array) -> None:
    """Rows with an edge on the line: mean t, count, sum of squares about it, mean step in grey levels."""
    height, width = s.edge.shape
    n = s1 = s2 = step = 0.0
    for row in range(height):
        t = row + 0.5 - t_ref
        o = line[0] + line[1] * t
        for x in range(max(int(o - lp[2]), 0), min(int(o + lp[2]) + 1, width)):
            if s.edge[row, x] and not mask[row, x]:
                n += 1.0
                s1 += t
                s2 += t * t
                step += (
                    s.grey[row, min(int(o) + 2, width - 1)] - s.grey[row, min(max(int(o) - 2, 0), width - 1)]
                )
                break
    out[0] = s1 / max(n, 1.0)
    out[1] = n
    out[2] = s2 - s1 * out[0]
    out[3] = lp[0] * step / (3.0 * max(n, 1.0))


@kernel
def _normalise(v: Array) -> None:
    size = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    for k in range(3):
        v[k] /= size


@kernel
def _plate(d: Array, par: _Par, n: Array, m: Array) -> None:
    """Normal n of the plate's plane through a tangent d, and its m across, both in the tip frame."""
    n[0], n[1], n[2] = par.plate_x, par.plate_y, par.plate_z
    along = n[0] * d[0] + n[1] * d[1] + n[2] * d[2]
    for k in range(3):
        n[k] -= along * d[k]
    _normalise(n)
    m[0] = d[1] * n[2] - d[2] * n[1]
    m[1] = d[2] * n[0] - d[0] * n[2]
    m[2] = d[0] * n[1] - d[1] * n[0]


@kernel
def _triangulate(lines: Array, ref: Array, g: ViewGeometry, p: Array, d: Array) -> bool:
    """The tangent (tip frame) whose images the two views' lines are."""
    normal, offset = np.empty((2, 3)), np.zeros(2)
    a, b = np.empty(3), np.empty(3)
    for v in range(2):
        # Two rays span the plane.
        _strip_ray(ref[v, 0], lines[v, 0], v, g, a)
        _strip_ray(ref[v, 0] + 10.0, lines[v, 0] + 10.0 * lines[v, 1], v, g, b)
        normal[v, 0] = a[1] * b[2] - a[2] * b[1]
        normal[v, 1] = a[2] * b[0] - a[0] * b[2]
        normal[v, 2] = a[0] * b[1] - a[1] * b[0]
        for k in range(3):
            offset[v] += normal[v, k] * g.position[v, k]
    d[0] = normal[0, 1] * normal[1, 2] - normal[0, 2] * normal[1, 1]
    d[1] = normal[0, 2] * normal[1, 0] - normal[0, 0] * normal[1, 2]
    d[2] = normal[0, 0] * normal[1, 1] - normal[0, 1] * normal[1, 0]
    size = np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    if abs(d[1]) < 0.3 * size:
        return False
    p[0] = (normal[0, 2] * offset[1] - normal[1, 2] * offset[0]) / d[1]
    p[1] = 0.0
    p[2] = (normal[1, 0] * offset[0] - normal[0, 0] * offset[1]) / d[1]
    way = 1.0 if d[1] > 0.0 else -1.0
    for k in range(3):
        d[k] *= way / size
    return bool(abs(p[0]) < 0.03 and abs(p[2]) < 0.04)


@kernel
def _gather(
    i: int,
    tip: Array,
    p: Array,
    d: Array,
    n: Array,
    m: Array,
    sigma: float,
    oldest: int,
    state: _State,
    fit: Array,
) -> int:
    """Where the remembered rays meet the plate near the tip: along (in sigma), across, weight, newness."""
    count = 0
    c, r = np.empty(3), np.empty(3)
    for k in range(state.stamp.shape[1]):
        if state.stamp[i, k] < oldest:
            continue
        for a in range(3):
            c[a] = r[a] = 0.0
            for b in range(3):
                c[a] += tip[b, a] * (state.eye[i, k, b] - tip[b, 3])
                r[a] += tip[b, a] * state.ray[i, k, b]
        down = n[0] * r[0] + n[1] * r[1] + n[2] * r[2]
        if down > -1e-3:
            continue
        gap = n[0] * (p[0] - c[0]) + n[1] * (p[1] - c[1]) + n[2] * (p[2] - c[2])
        along = across = 0.0
        for a in range(3):
            x = c[a] + r[a] * gap / down - p[a]
            along += x * d[a]
            across += x * m[a]
        if abs(along) > 2.5 * sigma:
            continue
        fit[0, count], fit[1, count] = along / sigma, across
        fit[2, count] = state.weight[i, k] * np.exp(-0.5 * (along / sigma) ** 2)
        fit[3, count] = 1.0 if state.stamp[i, k] == state.clock[i] else 0.0
        count += 1
    return count


@kernel
def _drift(fit: Array, count: int, curve: Array) -> float:
    """How far the new edges lie beside the remembered ones, stretch by stretch about a common curve [m]."""
    old, new = np.zeros((2, _STRETCHES)), np.zeros((2, _STRETCHES))
    for k in range(count):
        y, w = fit[0, k], fit[2, k]
        stretch = min(int((y + 2.5) * (_STRETCHES / 5.0)), _STRETCHES - 1)
        off = fit[1, k] - curve[0] - (curve[1] + curve[2] * y) * y
        if fit[3, k] > 0.0:
            new[0, stretch] += w
            new[1, stretch] += w * off
        else:
            old[0, stretch] += w
            old[1, stretch] += w * off
    total = weight = 0.0
    for k in range(_STRETCHES):
        if old[0, k] > 0.0 and new[0, k] > 0.0:
            w = old[0, k] * new[0, k] / (old[0, k] + new[0, k])
            total += w * (new[1, k] / new[0, k] - old[1, k] / old[0, k])
            weight += w
    return float(total / weight) if weight > 0.0 else 0.0


@kernel
def _fit_memory(
    i: int,
    tip: Array,
    p: Array,
    d: Array,
    n: Array,
    m: Array,
    oldest: int,
    par: _Par,
    state: _State,
    fit: Array,
    curve: Array,
) -> bool:
    """Fits what is remembered near the tip in the plate's plane, and learns how the part moves across."""
    sigma, clip = par.sigma_m, par.clip_m
    # The tangent moves little in a frame, which matters where the edges seen lie off the tip.
    prior = (
        1.0 / par.step_m**2,
        1.0 / (par.step_rad * sigma) ** 2,
        1.0 / (par.bend * sigma * sigma) ** 2,
    )
    count = _gather(i, tip, p, d, n, m, sigma, oldest, state, fit)
    if count < _MIN_ROWS or fit_curve(fit[0], fit[1], fit[2], count, prior, clip, curve) <= 0.0:
        return False
    off = _drift(fit, count, curve)
    if abs(off) > par.jump_m:
        # No part moves like this: something else passes the camera or, if it stays, the part was shoved.
        shoved = state.missed[i, 0] > par.coast
        for k in range(state.stamp.shape[1]):
            if (state.stamp[i, k] == state.clock[i]) != shoved:
                state.stamp[i, k] = -1
        return False
    for a in range(3):
        across = tip[a, 0] * m[0] + tip[a, 1] * m[1] + tip[a, 2] * m[2]
        state.velocity[i, a] += par.velocity_gain * off * across
        for k in range(state.stamp.shape[1]):
            if state.stamp[i, k] != state.clock[i]:
                state.eye[i, k, a] += par.follow_gain * off * across
    for k in range(count):
        fit[1, k] += par.follow_gain * off * (1.0 - fit[3, k])
    if fit_curve(fit[0], fit[1], fit[2], count, prior, clip, curve) <= 0.0:
        return False
    curve[1] /= sigma
    curve[2] /= sigma * sigma
    return True


@kernel
def _remember(
    i: int, tip: Array, count: int, ref: Array, g: ViewGeometry, par: _Par, state: _State, s: _Scratch
) -> None:
    """Keeps every second of the points followed in the front view as rays in the world."""
    ray = np.empty(3)
    for k in range(0, count, 2):
        _strip_ray(ref[0] + s.points[k, 0], s.points[k, 1], 0, g, ray)
        h = state.head[i]
        for a in range(3):
            state.eye[i, h, a] = tip[a, 3]
            state.ray[i, h, a] = 0.0
            for b in range(3):
                state.eye[i, h, a] += tip[a, b] * g.position[0, b]
                state.ray[i, h, a] += tip[a, b] * ray[b]
        state.weight[i, h] = (s.points[k, 2] / par.row_sigma_m) ** 2
        state.stamp[i, h] = state.clock[i]
        state.head[i] = (h + 1) % state.stamp.shape[1]


@kernel
def _usual(i: int, view: int, mask: Bools, line: Array, par: _Par, state: _State, s: _Scratch) -> bool:
    """Whether plate and wall beside the expected line are as bright as they usually are.

    A hand or a shadow that comes in changes them from one frame to the next; the wall beyond a corner changes
    them slowly. What stays for longer than the coasting time is the new usual.
    """
    height, width = s.grey.shape
    usual = steady = True
    fresh = np.empty(2)
    for side in range(2):
        total, count = 0.0, 0
        for row in range(max(int(line[0]), 0), min(int(line[0] + par.ahead_px), height)):
            o = line[1] + line[2] * (row + 0.5 - line[0])
            first = int(o) + 2 if side == 1 else int(o) - 1 - _BESIDE
            for x in range(max(first, 0), min(first + _BESIDE, width)):
                if not mask[row, x]:
                    total += s.grey[row, x]
                    count += 1
        level, last = state.level[i, view, side], state.last[i, view, side]
        fresh[side] = total / (3.0 * count) if count >= _BESIDE else last
        if level >= 0.0:
            usual = usual and abs(fresh[side] - level) <= par.level_change
            steady = steady and abs(fresh[side] - last) <= par.level_step
    state.steady[i, view] = state.steady[i, view] + 1 if steady else 0
    usual = usual and steady
    settled = state.missed[i, view] > par.coast and state.steady[i, view] > _SETTLED
    for side in range(2):
        state.last[i, view, side] = fresh[side]
    return usual or settled


@kernel
def _learn(i: int, view: int, par: _Par, state: _State) -> None:
    """Takes the grey levels of a frame that showed the seam into the usual ones."""
    for side in range(2):
        change = state.last[i, view, side] - state.level[i, view, side]
        known = state.level[i, view, side] >= 0.0 and abs(change) <= par.level_change
        state.level[i, view, side] += (par.level_gain if known else 1.0) * change


@kernel
def _track_front(
    i: int,
    tip: Array,
    mask: Bools,
    ref: Array,
    g: ViewGeometry,
    lp: Array,
    par: _Par,
    state: _State,
    s: _Scratch,
    p: Array,
    d: Array,
    curve: Array,
) -> bool:
    """Steps 1 and 2: moves the tangent (tip frame) to where front view and memory have it.

    Returns whether the front view showed the seam; without, the memory carries on.
    """
    line, n, m = np.empty(3), np.empty(3), np.empty(3)
    seen = _strip_slope(p, d, 0, g, line) and abs(line[2]) <= 2.0 and _usual(i, 0, mask, line, par, state, s)
    if seen:
        o = line[1] + line[2] * (ref[0] - line[0])
        count = follow(
            s.grey, mask, s.edge, ref[0], o, line[2], par.ahead_px, par.ahead_px, lp, s.profile, s.points
        )
        seen = count >= _MIN_ROWS
        if seen:
            state.clock[i] += 1
            _remember(i, tip, count, ref, g, par, state, s)
    _plate(d, par, n, m)
    oldest = max(state.clock[i] - int(par.memory), 0)
    fitted = _fit_memory(i, tip, p, d, n, m, oldest, par, state, s.fit, curve)
    if seen and not fitted:
        seen = False
        fitted = _fit_memory(i, tip, p, d, n, m, oldest, par, state, s.fit, curve)
    if not fitted:
        curve[2] = 0.0
        return False
    # The curve's point nearest the tip, the origin: |p + y d + x(y) m| is least.
    pd = p[0] * d[0] + p[1] * d[1] + p[2] * d[2]
    pm = p[0] * m[0] + p[1] * m[1] + p[2] * m[2]
    y = 0.0
    for _ in range(6):
        x, slope = curve[0] + (curve[1] + curve[2] * y) * y, curve[1] + 2.0 * curve[2] * y
        y -= (pd + y + (pm + x) * slope) / max(0.3, 1.0 + slope * slope + 2.0 * curve[2] * (pm + x))
        y = min(max(y, -0.004), 0.004)
    x, slope = curve[0] + (curve[1] + curve[2] * y) * y, curve[1] + 2.0 * curve[2] * y
    for k in range(3):
        p[k] += y * d[k] + x * m[k]
        d[k] += slope * m[k]
    _normalise(d)
    return bool(seen)


@kernel
def _side_frame(
    p: Array, d: Array, n: Array, g: ViewGeometry, lift: Array, line: Array, per_m: Array
) -> bool:
    """How the side view answers to height: a lift's direction, the line, px a metre of travel and of height.

    Height moves the seam along the front view's ray, which keeps its image there.
    """
    a, b, x = np.empty(2), np.empty(2), np.empty(3)
    down = 0.0
    for k in range(3):
        down += n[k] * (p[k] - g.position[0, k])
    if down > -1e-3 or not (_strip_slope(p, d, 1, g, line) and _to_strip(p, 1, g, a)):
        return False
    for k in range(3):
        lift[k] = (p[k] - g.position[0, k]) / down
        x[k] = p[k] + 1e-3 * d[k]
    if not _to_strip(x, 1, g, b):
        return False
    per_m[0] = (b[0] - a[0]) * 1e3
    for k in range(3):
        x[k] = p[k] + 1e-4 * lift[k]
    if not _to_strip(x, 1, g, b):
        return False
    per_m[1] = ((b[1] - a[1]) - line[2] * (b[0] - a[0])) * 1e4
    return bool(abs(per_m[1]) > 1e3)


@kernel
def _side_residual(
    mask: Bools,
    g: ViewGeometry,
    lp: Array,
    par: _Par,
    s: _Scratch,
    p: Array,
    d: Array,
    m: Array,
    bend: float,
    line: Array,
    scale: float,
    out: Array,
) -> bool:
    """The side view's edge against the curve: offset, slope, their variances at a step of 1, pivot (t).

    The offset is measured at the pivot, the rows' mean, where it does not depend on the slope.
    """
    b, x, found = np.empty(2), np.empty(3), np.empty(2)
    count = 0
    s0 = s1 = s2 = b0 = b1 = 0.0
    # Above the plate the seam may come into the ROI only ahead of the tip.
    below = line[1] - (mask.shape[1] - _HIDDEN)
    skip = min(-below / line[2], float(mask.shape[0])) if below > 0.0 and line[2] < -1e-3 else 0.0
    first = int(line[0] + skip - par.side_px)
    for row in range(first, int(line[0] + skip + par.side_px) + 1):
        t = row + 0.5 - line[0]
        y = t / scale
        for _ in range(2):
            for k in range(3):
                x[k] = p[k] + y * d[k] + bend * y * y * m[k]
            if not _to_strip(x, 1, g, b):
                return False
            y += (row + 0.5 - b[0]) / scale
        slope = line[2]
        if abs(t) > 1e-9:
            # Chord of a parabola: its end's slope is twice the chord's less the start's.
            slope = min(max(2.0 * (b[1] - line[1]) / t - line[2], -2.0), 2.0)
        if not row_edge(s.grey, mask, s.edge, row, b[1], slope, lp[7], lp, s.profile, found):
            continue
        error = found[0] - b[1]
        # Far rows hang on the curve's bend, which is less sure.
        w = found[1] * found[1] / (1.0 + (2.0 * (t - skip) / par.side_px) ** 4)
        s0 += w
        s1 += w * t
        s2 += w * t * t
        b0 += w * error
        b1 += w * error * t
        count += 1
    det = s0 * s2 - s1 * s1
    if count < _MIN_ROWS or det <= 1e-6 * s0 * s2:
        return False
    out[0], out[1] = b0 / s0, (b1 * s0 - b0 * s1) / det
    out[2], out[3], out[4] = 1.0 / s0, s0 / det, s1 / s0
    return True


@kernel
def _kalman(variance: Array, k: int, drift: float, error: float, noise: float, gate: float) -> float:
    """One scalar Kalman step (Joseph's form): the correction, 0 if the measurement is not believed."""
    ahead = variance[k] + drift * drift
    variance[k] = ahead
    if error * error > gate * gate * (ahead + noise):
        return 0.0
    gain = ahead / (ahead + noise)
    variance[k] = (1.0 - gain) ** 2 * ahead + gain * gain * noise
    return float(gain * error)


@kernel
def _track_side(
    i: int,
    mask: Bools,
    g: ViewGeometry,
    lp: Array,
    par: _Par,
    state: _State,
    s: _Scratch,
    p: Array,
    d: Array,
    bend: float,
) -> bool:
    """Step 3: corrects height and pitch of the plane through the tangent (tip frame)."""
    line, n, m, lift = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    per_m, out = np.empty(2), np.empty(5)
    _plate(d, par, n, m)
    if not _side_frame(p, d, n, g, lift, line, per_m):
        return False
    if not _usual(i, 1, mask, line, par, state, s):
        return False
    if not _side_residual(mask, g, lp, par, s, p, d, m, bend, line, per_m[0], out):
        return False
    # Neighbouring rows share pixels: five times the variance of independent ones.
    noise = 5.0 * par.row_sigma_m**2
    r_height = noise * out[2] + _HEIGHT_FLOOR**2
    r_pitch = noise * out[3] * per_m[0] ** 2 + _PITCH_FLOOR**2
    variance = state.variance[i]
    height = _kalman(variance, 0, par.height_q_m, out[0] / per_m[1], r_height, par.gate)
    if height == 0.0:
        return False
    pitch = _kalman(variance, 1, par.pitch_q_rad, out[1] / per_m[1] * per_m[0], r_pitch, par.gate)
    height -= pitch * out[4] / per_m[0]
    for k in range(3):
        p[k] += height * lift[k]
        d[k] += pitch * lift[k]
    _normalise(d)
    return True


@kernel
def _forget(i: int, state: _State) -> None:
    state.tracking[i] = False
    state.missed[i, 0] = state.missed[i, 1] = 0
    for a in range(3):
        state.velocity[i, a] = 0.0
    for k in range(state.stamp.shape[1]):
        state.stamp[i, k] = -1
    for v in range(2):
        for k in range(2):
            state.level[i, v, k] = -1.0


@kernel
def _nearest(p: Array, d: Array) -> None:
    """Moves a tangent's point to the one nearest the tip, the origin."""
    along = p[0] * d[0] + p[1] * d[1] + p[2] * d[2]
    for k in range(3):
        p[k] -= along * d[k]


@kernel
def _track(
    i: int,
    front: Bytes,
    side: Bytes,
    mask_front: Bools,
    mask_side: Bools,
    tip: Array,
    ref: Array,
    g: ViewGeometry,
    e: EdgeTables,
    maps: _Maps,
    lp: Array,
    par: _Par,
    state: _State,
    s: _Scratch,
    p: Array,
    d: Array,
) -> bool:
    """Carries a track on by a frame; False when both views have to be searched anew."""
    if state.missed[i, 0] > par.coast:
        for a in range(3):
            state.velocity[i, a] = 0.0
    for a in range(3):
        state.point[i, a] += state.velocity[i, a]
        for k in range(state.stamp.shape[1]):
            state.eye[i, k, a] += state.velocity[i, a]
    for a in range(3):
        p[a] = d[a] = 0.0
        for b in range(3):
            p[a] += tip[b, a] * (state.point[i, b] - tip[b, 3])
            d[a] += tip[b, a] * state.direction[i, b]
    _nearest(p, d)
    curve = np.zeros(3)
    _edges_of(i, front, 0, mask_front, e, maps, s)
    if _track_front(i, tip, mask_front, ref[0], g, lp, par, state, s, p, d, curve):
        state.missed[i, 0] = 0
        _learn(i, 0, par, state)
    else:
        state.missed[i, 0] += 1
    _edges_of(i, side, 1, mask_side, e, maps, s)
    if _track_side(i, mask_side, g, lp, par, state, s, p, d, curve[2]):
        state.missed[i, 1] = 0
        _learn(i, 1, par, state)
    else:
        state.missed[i, 1] += 1
    return bool(max(state.missed[i, 0], state.missed[i, 1]) <= par.search)


@kernel
def _start(
    i: int,
    front: Bytes,
    side: Bytes,
    mask_front: Bools,
    mask_side: Bools,
    ref: Array,
    g: ViewGeometry,
    e: EdgeTables,
    maps: _Maps,
    lp: Array,
    state: _State,
    s: _Scratch,
    p: Array,
    d: Array,
) -> bool:
    """Looks for a seam that is not tracked; False if the views show none, and all stays as it was."""
    line, lines, support = np.empty(3), np.empty((2, 3)), np.empty(4)
    _edges_of(i, front, 0, mask_front, e, maps, s)
    if _search(0, mask_front, ref[0], lp, s, line) <= 0.0:
        return False
    lines[0] = line
    _edges_of(i, side, 1, mask_side, e, maps, s)
    sigma = _search(1, mask_side, ref[1], lp, s, line)
    if sigma <= 0.0:
        return False
    _support(mask_side, ref[1, 0], line, lp, s, support)
    if support[1] < lp[6] or support[3] < lp[5]:
        return False
    # A short line's slope says little: the gun is known to start nearly as taught.
    q_noise = 3.0 * sigma * sigma / support[2]
    share = _START_SLOPE**2 / (_START_SLOPE**2 + q_noise)
    lines[1, 1] = share * line[1]
    lines[1, 0] = line[0] + (line[1] - lines[1, 1]) * support[0]
    if not _triangulate(lines, ref, g, p, d):
        return False
    _nearest(p, d)
    _forget(i, state)
    state.tracking[i] = True
    state.variance[i, 0] = (_HEIGHT_START * sigma / _FINE_PX) ** 2
    state.variance[i, 1] = _PITCH_START**2
    return True


@kernel
def _perceive(
    front: Bytes,
    side: Bytes,
    mask_front: Bools,
    mask_side: Bools,
    tips: Array,
    rows: Bools,
    ref: Array,
    g: ViewGeometry,
    e: EdgeTables,
    maps: _Maps,
    lp: Array,
    par: _Par,
    state: _State,
    s: _Scratch,
    point: Array,
    direction: Array,
    valid: Bools,
    first: int,
    last: int,
) -> None:
    p, d, fresh_p, fresh_d = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(first, last):
        if not rows[i]:
            continue
        tip = tips[i]
        found = False
        if state.tracking[i]:
            found = _track(
                i, front[i], side[i], mask_front, mask_side, tip, ref, g, e, maps, lp, par, state, s, p, d
            )
        if not found:
            found = _start(
                i, front[i], side[i], mask_front, mask_side, ref, g, e, maps, lp, state, s, fresh_p, fresh_d
            )
            if found:
                p[:], d[:] = fresh_p, fresh_d
        if not state.tracking[i]:
            valid[i, 0] = valid[i, 1] = False
            continue
        for a in range(3):
            state.point[i, a], state.direction[i, a] = tip[a, 3], 0.0
            for b in range(3):
                state.point[i, a] += tip[a, b] * p[b]
                state.direction[i, a] += tip[a, b] * d[b]
        for v in range(2):
            _emit(i, v, p, d, g, point, direction, valid)
            valid[i, v] = valid[i, v] and state.missed[i, v] <= par.coast


class Perception:
    """Estimates the seam's line in both views of N simulations; rows never mix.

    Args:
        n: Number of simulations.
        views: The calibrated cameras.
        nozzle: The nozzle's coverage of each pixel, front and side, shape (height, width).
        frame_s: Duration of a frame [s].
        cfg: Parameters.
        plate: Normal of the plate in the tip frame of a gun held as taught, shape (3,); by default a nozzle
            that halves the right angle between the plate and a wall on the left.
        detector: Finds the edges in place of the fractional-order stage.
        threads: Splits the batch; the lines are the same for any number.
    """

    def __init__(
        self,
        n: int,
        views: ViewGeometry,
        nozzle: tuple[Array, Array],
        frame_s: float,
        cfg: PerceptionCfg | None = None,
        *,
        plate: Array | None = None,
        detector: EdgeDetector | None = None,
        threads: int = 1,
    ) -> None:
        cfg = cfg or PerceptionCfg()
        length, width = int(views.size[0, 1]), int(views.size[0, 0])
        require(
            (length, width) == (int(views.size[1, 0]), int(views.size[1, 1])),
            f"ROIs of {views.size.tolist()} px: the side view's has to be the front view's on its side",
        )
        self._n, self._threads, self._detector = n, threads, detector
        self._views = ViewGeometry(*(np.ascontiguousarray(x, np.float64) for x in views))
        self._masks = dilated(nozzle)
        ref = views.reference
        self._reference = np.array([[views.size[0, 1] - ref[0, 1], ref[0, 0]], ref[1]])
        self._edges, self._line = EdgeTables.of(cfg.edges), cfg.line.table
        self._par = _Par.of(cfg, frame_s, _FILLET_PLATE if plate is None else plate)
        rays = (int(self._par.memory) + 1) * (int(cfg.ahead_px) + 1)
        self._state = _State(
            point=np.zeros((n, 3)),
            direction=np.zeros((n, 3)),
            variance=np.zeros((n, 2)),
            tracking=np.zeros(n, np.bool_),
            missed=np.zeros((n, 2), np.int64),
            clock=np.zeros(n, np.int64),
            level=np.full((n, 2, 2), -1.0),
            last=np.zeros((n, 2, 2)),
            steady=np.zeros((n, 2), np.int64),
            velocity=np.zeros((n, 3)),
            eye=np.zeros((n, rays, 3)),
            ray=np.zeros((n, rays, 3)),
            weight=np.zeros((n, rays)),
            stamp=np.full((n, rays), -1, np.int64),
            head=np.zeros(n, np.int64),
        )
        # One work space for each thread that ever drew on it.
        self._rooms = [_Scratch.of(length, width, self._edges.pad, rays)]
        self._lines = SeamLines(np.zeros((n, 2, 2)), np.zeros((n, 2, 2)), np.zeros((n, 2), np.bool_))

    def reset(self, i: int) -> None:
        """Forgets what one simulation has seen.

        Args:
            i: Which simulation.
        """
        for values in self._state:
            values[i] = 0
        self._state.stamp[i] = -1
        self._state.level[i] = -1.0
        for values in self._lines:
            values[i] = 0

    def update(
        self, front: Bytes, side: Bytes, tip_pose: Array, rows: NDArray[np.bool_] | None = None
    ) -> SeamLines:
        """Takes the images of a new frame.

        Args:
            front: Shape (N, height, width, 3).
            side: Shape (N, height, width, 3).
            tip_pose: ``T_world_tip`` when they were taken, shape (N, 4, 4), m.
            rows: Simulations that have a new frame, shape (N,), all by default; the others keep their lines.

        Returns:
            The seam's lines; arrays of the caller's own. A view that has not shown the seam for the
            coasting time is invalid.
        """
        images = np.ascontiguousarray(front), np.ascontiguousarray(side)
        tips = np.ascontiguousarray(tip_pose, dtype=np.float64)
        fresh = np.ones(self._n, np.bool_) if rows is None else np.ascontiguousarray(rows, np.bool_)
        maps = self._detected(*images)

        def look(first: int, last: int) -> None:
            room = self._take_room()
            _perceive(
                *images,
                *self._masks,
                tips,
                fresh,
                self._reference,
                self._views,
                self._edges,
                maps,
                self._line,
                self._par,
                self._state,
                room,
                *self._lines,
                first,
                last,
            )
            self._rooms.append(room)

        split(look, self._n, self._threads)
        point, direction, valid = self._lines
        return SeamLines(point.copy(), direction.copy(), valid.copy())

    def _detected(self, front: Bytes, side: Bytes) -> _Maps:
        if self._detector is None:
            return _OWN
        found = [self._detector(s, m) for s, m in zip(strips(front, side), self._masks, strict=True)]
        return _Maps(
            edge=(found[0].edge, found[1].edge),
            intensity=(found[0].intensity, found[1].intensity),
            vector=(found[0].vector, found[1].vector),
        )

    def _take_room(self) -> _Scratch:
        try:
            return self._rooms.pop()  # atomic, unlike asking for the length first
        except IndexError:
            length, width = self._masks[0].shape
            return _Scratch.of(length, width, self._edges.pad, self._state.stamp.shape[1])
