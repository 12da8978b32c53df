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

The seam of a fillet is an edge, that of a groove the middle of a dark band (``groove``), found in each row in
the edge's place. All else is the same, but that a groove's plane never climbs.
"""

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import require
from seal_gym.core.frames import Array
from seal_gym.core.jit import kernel
from seal_gym.core.parallel import split
from seal_gym.vision.edges import EdgeDetector, EdgeTables, edge_image
from seal_gym.vision.features import SeamLines, ViewGeometry
from seal_gym.vision.fresh_bead import colour_weights, hide_sealant
from seal_gym.vision.groove import SECTION, GrooveCfg, section_of
from seal_gym.vision.seam_line import (
    LineNumbers,
    dilated,
    follow,
    groove_line,
    local_line,
    ransac_line,
    row_edge,
    strips,
)
from seal_gym.vision.strip_geometry import nearest_point, plate_axes, project_tangent, triangulate
from seal_gym.vision.track_state import (
    OWN_EDGES,
    EdgeMaps,
    PerceptionCfg,
    Scratch,
    TrackNumbers,
    TrackState,
    forget,
)
from seal_gym.vision.track_views import learn_levels, track_front, track_side

__all__ = ["GrooveCfg", "Perception", "PerceptionCfg"]

Bytes = NDArray[np.uint8]
Bools = NDArray[np.bool_]

_FILLET_PLATE = np.array([-np.sqrt(0.5), 0.0, np.sqrt(0.5)])
_HOVER = 9.5e-3  # that the gun starts further away by, about [m]
_FINE_PX, _COARSE_PX = 0.3, 1.5  # how sure an edge of the first line is
_START_SLOPE = 0.07  # of the side view's line as the gun is put before the seam
_HEIGHT_START, _PITCH_START = 0.2e-3, 0.03  # of its first tangent [m], [rad]
# A plate seen from above: on a bend the side view's line says little of its height and pitch.
_GROOVE_HEIGHT_START, _GROOVE_PITCH_START = 1e-3, 0.1


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
def _edges_of(
    i: int, image: Bytes, view: int, mask: Bools, e: EdgeTables, maps: EdgeMaps, s: Scratch
) -> None:
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
def _taught_section(view: int, g: ViewGeometry, par: TrackNumbers, section: Array) -> bool:
    """The groove as a gun sees it that is held as taught, not as close yet as it will be."""
    p, d, n, m = np.zeros(3), np.zeros(3), np.empty(3), np.empty(3)
    d[1] = 1.0
    plate_axes(d, par.plate, n, m)
    p[2] = -g.stand_off[0] - _HOVER
    return bool(section_of(p, d, n, m, view, g, par.groove, section))


@kernel
def _search(
    view: int,
    mask: Bools,
    ref: Array,
    g: ViewGeometry,
    lp: LineNumbers,
    par: TrackNumbers,
    s: Scratch,
    line: Array,
) -> float:
    """A line (p, q) without knowing where to look; returns how sure a row's edge is [px], 0 without a line.

    Where the seam only grazes the ROI, RANSAC's line has to do: the view widens as the gun comes closer.
    """
    raw, section = np.empty(2), np.empty(SECTION)
    if not _taught_section(view, g, par, section):
        return 0.0
    if section[0] > 0.0:
        if not groove_line(s.grey, mask, s.edge, ref[0], section, lp, s.profile, raw):
            return 0.0
    elif not ransac_line(s.edge, mask, s.intensity, s.ex, s.ey, ref[0], lp, raw):
        return 0.0
    n = follow(
        s.grey,
        mask,
        s.edge,
        ref[0],
        raw[0],
        raw[1],
        lp.window_px,
        lp.window_px,
        section,
        lp,
        s.profile,
        s.points,
    )
    if local_line(s.points, n, ref[0], ref[1], raw[0], lp, s.columns, line) > 0.0:
        return _FINE_PX
    line[0], line[1] = raw[0], raw[1]
    return _COARSE_PX


@kernel
def _support(mask: Bools, t_ref: float, line: Array, lp: LineNumbers, s: Scratch, out: Array) -> None:
    """Rows with an edge on the line: mean t, count, sum of squares about it, mean step in grey levels."""
    height, width = s.edge.shape
    n = s1 = s2 = step = 0.0
    for row in range(height):
        t = row + 0.5 - t_ref
        o = line[0] + line[1] * t
        for x in range(max(int(o - lp.inlier_px), 0), min(int(o + lp.inlier_px) + 1, width)):
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
    out[3] = lp.bright_side * step / (3.0 * max(n, 1.0))


@kernel
def _groove_support(
    mask: Bools, t_ref: float, line: Array, section: Array, lp: LineNumbers, s: Scratch, out: Array
) -> None:
    """``_support`` of a groove: rows with one on the line."""
    found = np.empty(2)
    n = s1 = s2 = step = 0.0
    for row in range(s.edge.shape[0]):
        t = row + 0.5 - t_ref
        o = line[0] + line[1] * t
        if row_edge(s.grey, mask, s.edge, row, o, line[1], lp.inlier_px, section, lp, s.profile, found):
            n += 1.0
            s1 += t
            s2 += t * t
            step += found[1]
    out[0], out[1] = s1 / max(n, 1.0), n
    out[2], out[3] = s2 - s1 * out[0], step / max(n, 1.0)


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
    maps: EdgeMaps,
    lp: LineNumbers,
    par: TrackNumbers,
    state: TrackState,
    s: Scratch,
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
    nearest_point(p, d)
    curve = np.zeros(3)
    _edges_of(i, front, 0, mask_front, e, maps, s)
    if track_front(i, tip, mask_front, ref[0], g, lp, par, state, s, p, d, curve):
        state.missed[i, 0] = 0
        learn_levels(i, 0, par, state)
    else:
        state.missed[i, 0] += 1
    _edges_of(i, side, 1, mask_side, e, maps, s)
    if track_side(i, mask_side, g, lp, par, state, s, p, d, curve[2]):
        state.missed[i, 1] = 0
        learn_levels(i, 1, par, state)
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
    maps: EdgeMaps,
    lp: LineNumbers,
    par: TrackNumbers,
    state: TrackState,
    s: Scratch,
    p: Array,
    d: Array,
) -> bool:
    """Looks for a seam that is not tracked; False if the views show none, and all stays as it was."""
    line, lines, support, section = np.empty(3), np.empty((2, 3)), np.empty(4), np.empty(SECTION)
    _edges_of(i, front, 0, mask_front, e, maps, s)
    if _search(0, mask_front, ref[0], g, lp, par, s, line) <= 0.0:
        return False
    lines[0] = line
    _edges_of(i, side, 1, mask_side, e, maps, s)
    sigma = _search(1, mask_side, ref[1], g, lp, par, s, line)
    if sigma <= 0.0:
        return False
    if not _taught_section(1, g, par, section):
        return False
    if section[0] > 0.0:
        _groove_support(mask_side, ref[1, 0], line, section, lp, s, support)
    else:
        _support(mask_side, ref[1, 0], line, lp, s, support)
    if support[1] < lp.min_points or support[3] < lp.min_contrast:
        return False
    # A short line's slope says little: the gun is known to start nearly as taught.
    q_noise = 3.0 * sigma * sigma / support[2]
    share = _START_SLOPE**2 / (_START_SLOPE**2 + q_noise)
    lines[1, 1] = share * line[1]
    lines[1, 0] = line[0] + (line[1] - lines[1, 1]) * support[0]
    if not triangulate(lines, ref, g, p, d):
        return False
    nearest_point(p, d)
    forget(i, state)
    state.tracking[i] = True
    state.variance[i, 0] = (_HEIGHT_START * sigma / _FINE_PX) ** 2
    state.variance[i, 1] = _PITCH_START**2
    if section[0] > 0.0:
        state.variance[i, 0], state.variance[i, 1] = _GROOVE_HEIGHT_START**2, _GROOVE_PITCH_START**2
    return True


@kernel
def _perceive(
    front: Bytes,
    side: Bytes,
    masks_front: Bools,
    masks_side: Bools,
    tips: Array,
    rows: Bools,
    ref: Array,
    g: ViewGeometry,
    e: EdgeTables,
    maps: EdgeMaps,
    lp: LineNumbers,
    par: TrackNumbers,
    state: TrackState,
    s: Scratch,
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
        # One mask for all, or one each.
        mask_front, mask_side = masks_front[i % len(masks_front)], masks_side[i % len(masks_side)]
        found = False
        if state.tracking[i]:
            found = _track(
                i, front[i], side[i], mask_front, mask_side, tip, ref, g, e, maps, lp, par, state, s, p, d
            )
        if not found:
            found = _start(
                i,
                front[i],
                side[i],
                mask_front,
                mask_side,
                ref,
                g,
                e,
                maps,
                lp,
                par,
                state,
                s,
                fresh_p,
                fresh_d,
            )
            if found:
                p[:], d[:] = fresh_p, fresh_d
        if not state.tracking[i]:
            valid[i, 0] = valid[i, 1] = False
            continue
        for a in range(3):
            state.tip[i, a] = state.point[i, a] = tip[a, 3]
            state.direction[i, a] = 0.0
            for b in range(3):
                state.point[i, a] += tip[a, b] * p[b]
                state.direction[i, a] += tip[a, b] * d[b]
        for v in range(2):
            project_tangent(i, v, p, d, g, point, direction, valid)
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
        groove: The seam's section, if the seam is the middle of a groove and not the foot of a wall.
        sealant_rgb: Colour of the sealant that the gun lays, which the tracker is not to follow, 3 numbers in
            0..1; None if it lays none.
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
        groove: GrooveCfg | None = None,
        sealant_rgb: tuple[float, float, float] | None = None,
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
        self._weights = None if sealant_rgb is None else colour_weights(sealant_rgb)
        ref = views.reference
        self._reference = np.array([[views.size[0, 1] - ref[0, 1], ref[0, 0]], ref[1]])
        self._edges, self._line = EdgeTables.of(cfg.edges), cfg.line.numbers
        plate = _FILLET_PLATE if plate is None else plate
        self._par = TrackNumbers.of(cfg, frame_s, plate, groove, sealant_rgb is not None)
        # With the wall on the right the seam's dark and bright sides change places in both views. A
        # groove is dark whichever way the gun leans.
        self._negative = bool(plate[0] > 1e-6) and groove is None
        rays = (int(self._par.memory) + 1) * (int(cfg.ahead_px) + 1)
        self._state = TrackState(
            point=np.zeros((n, 3)),
            direction=np.zeros((n, 3)),
            variance=np.zeros((n, 2)),
            tip=np.zeros((n, 3)),
            gone=np.zeros(n),
            carried=np.zeros((n, 3)),
            tracking=np.zeros(n, np.bool_),
            missed=np.zeros((n, 2), np.int64),
            clock=np.zeros(n, np.int64),
            level=np.full((n, 2, 2), -1.0),
            last=np.full((n, 2, 2), -1.0),
            steady=np.zeros((n, 2), np.int64),
            velocity=np.zeros((n, 3)),
            eye=np.zeros((n, rays, 3)),
            ray=np.zeros((n, rays, 3)),
            weight=np.zeros((n, rays)),
            stamp=np.full((n, rays), -1, np.int64),
            head=np.zeros(n, np.int64),
            page=np.zeros(n, np.int64),
        )
        # One work space for each thread that ever drew on it.
        self._rooms = [Scratch.of(length, width, self._edges.pad, rays)]
        self._lines = SeamLines(np.zeros((n, 2, 2)), np.zeros((n, 2, 2)), np.zeros((n, 2), np.bool_))

    def reset(self, i: int) -> None:
        """Forgets what one simulation has seen.

        Args:
            i: Which simulation.
        """
        for values in self._state:
            values[i] = 0
        self._state.stamp[i] = -1
        self._state.level[i] = self._state.last[i] = -1.0
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
        masks = self._hidden(front, side)
        if self._negative:
            front, side = 255 - front, 255 - side
        images = np.ascontiguousarray(front), np.ascontiguousarray(side)
        tips = np.ascontiguousarray(tip_pose, dtype=np.float64)
        fresh = np.ones(self._n, np.bool_) if rows is None else np.ascontiguousarray(rows, np.bool_)
        maps = self._detected(*images)

        def look(first: int, last: int) -> None:
            room = self._take_room()
            _perceive(
                *images,
                *masks,
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

    def _hidden(self, front: Bytes, side: Bytes) -> tuple[Bools, Bools]:
        """What the tracker must not look at, shape (1 or N, length, width) each."""
        if self._weights is None:
            return self._masks[0][None], self._masks[1][None]
        out = []
        for view, (raw, nozzle) in enumerate(zip((front, side), self._masks, strict=True)):
            masks = np.empty((self._n, *nozzle.shape), np.bool_)
            hide_sealant(np.ascontiguousarray(raw), self._weights, view, nozzle, masks)
            out.append(masks)
        return out[0], out[1]

    def _detected(self, front: Bytes, side: Bytes) -> EdgeMaps:
        if self._detector is None:
            return OWN_EDGES
        found = [self._detector(s, m) for s, m in zip(strips(front, side), self._masks, strict=True)]
        return EdgeMaps(
            edge=(found[0].edge, found[1].edge),
            intensity=(found[0].intensity, found[1].intensity),
            vector=(found[0].vector, found[1].vector),
        )

    def _take_room(self) -> Scratch:
        try:
            return self._rooms.pop()  # atomic, unlike asking for the length first
        except IndexError:
            length, width = self._masks[0].shape
            return Scratch.of(length, width, self._edges.pad, self._state.stamp.shape[1])
