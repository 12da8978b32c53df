"""A frame's two views: the front one moves the tangent in the plate, the side one moves the plate."""

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.frames import Array
from seal_gym.core.jit import kernel
from seal_gym.vision.features import ViewGeometry
from seal_gym.vision.groove import CUTS, SECTION, cuts_at, section_of
from seal_gym.vision.seam_line import NARROW_PX, LineNumbers, follow, row_edge
from seal_gym.vision.seam_memory import fit_memory, remember, travel, turn_page
from seal_gym.vision.strip_geometry import normalise, plate_axes, strip_slope, to_strip
from seal_gym.vision.track_state import MIN_ROWS, Scratch, TrackNumbers, TrackState

Bools = NDArray[np.bool_]

_MM, _DEG = 1e-3, float(np.deg2rad(1.0))
_SETTLED = 6  # frames without a jump after which new grey levels are the usual ones
_BESIDE = 8  # pixels on either side of the line whose brightness is watched
_BEND_GAIN, _TURNED = 0.06, 0.2  # how slopes follow the edge, and what change of slope is a bend
# From above a plate the side view answers to a bend four times as much as in a fillet: its far rows are the
# less sure, as the root, because a bend's error grows with the square of the way. And the bend is known to
# about this share, which this far from the tip looks like a change of the plane's height and pitch.
_GROOVE_REACH = 0.5
_BEND_SHARE, _BEND_M = 0.3, 2.5 * _MM
_HIDDEN = 3.0  # an edge this close to the ROI's border has no flank to compare with [px]
_HEIGHT_FLOOR, _PITCH_FLOOR = 0.02 * _MM, 0.1 * _DEG  # a measurement is no better than this
_BENT, _BENT_SHARE = (
    40.0,
    1.0 / 3.0,
)  # quadratic coefficient of a bend [1/m], and the share of the pitch's drift in it


@kernel
def _half_width(section: Array, q: float) -> float:
    """Of a groove in a row [px]; 0 of an edge."""
    if section[0] <= 0.0:
        return 0.0
    cut = np.empty(CUTS)
    cuts_at(section, q, cut)
    return float(cut[2])


@kernel
def _usual(
    i: int,
    view: int,
    mask: Bools,
    line: Array,
    followed: int,
    section: Array,
    par: TrackNumbers,
    state: TrackState,
    s: Scratch,
) -> bool:
    """Whether plate and wall beside the followed edge, or else the expected line, are as bright as usual.

    A hand or a shadow that comes in changes them from one frame to the next; the wall beyond a corner changes
    them slowly. After a jump they have to be nearer to the usual ones; what stays for longer than the
    coasting time is the new usual.
    """
    height, width = s.grey.shape
    usual = steady = True
    trust = 1.0 if state.steady[i, view] >= _SETTLED else 0.7
    fresh = np.empty(2)
    half = _half_width(section, line[2])
    # In the side view the wall changes too much at corners; the height's gate guards it.
    for side in range(view, 2):
        total, count = 0.0, 0
        o, slope, next_point = line[1] + line[2] * (int(line[0]) + 0.5 - line[0]), line[2], 0
        for row in range(max(int(line[0]), 0), min(int(line[0] + par.ahead_px), height)):
            if next_point < followed and int(line[0] + s.points[next_point, 0]) == row:
                error = s.points[next_point, 1] - o
                o, slope = o + error, slope + _BEND_GAIN * error
                next_point += 1
            elif next_point >= followed and abs(slope - line[2]) > _TURNED:
                break  # beyond a corner the plate is on both sides
            first = int(o + half) + 2 if side == 1 else int(o - half) - 1 - _BESIDE
            for x in range(max(first, 0), min(first + _BESIDE, width)):
                if not mask[row, x]:
                    total += s.grey[row, x]
                    count += 1
            o += slope
        level, last = state.level[i, view, side], state.last[i, view, side]
        fresh[side] = total / (3.0 * count) if count >= _BESIDE else last
        if level >= 0.0:
            usual = usual and abs(fresh[side] - level) <= trust * par.level_change[side]
        if last >= 0.0:
            steady = steady and abs(fresh[side] - last) <= par.level_step[side]
    state.steady[i, view] = state.steady[i, view] + 1 if steady else 0
    usual = usual and steady
    settled = state.missed[i, view] > par.coast and state.steady[i, view] > _SETTLED
    for side in range(view, 2):
        state.last[i, view, side] = fresh[side]
    return usual or settled


@kernel
def learn_levels(i: int, view: int, par: TrackNumbers, state: TrackState) -> None:
    """Takes the grey levels of a frame that showed the seam into the usual ones."""
    for side in range(2):
        if state.last[i, view, side] < 0.0:
            continue
        change = state.last[i, view, side] - state.level[i, view, side]
        known = state.level[i, view, side] >= 0.0 and abs(change) <= par.level_change[side]
        state.level[i, view, side] += (par.level_gain if known else 1.0) * change


@kernel
def track_front(
    i: int,
    tip: Array,
    mask: Bools,
    ref: Array,
    g: ViewGeometry,
    lp: LineNumbers,
    par: TrackNumbers,
    state: TrackState,
    s: Scratch,
    p: Array,
    d: Array,
    curve: Array,
) -> bool:
    """Steps 1 and 2: moves the tangent (tip frame) to where front view and memory have it.

    Returns whether the front view showed the seam; without, the memory carries on.
    """
    line, n, m, section = np.empty(3), np.empty(3), np.empty(3), np.empty(SECTION)
    travel(i, tip, d, state)
    plate_axes(d, par.plate, n, m)
    seen = strip_slope(p, d, 0, g, line) and abs(line[2]) <= 2.0
    seen = seen and section_of(p, d, n, m, 0, g, par.groove, section)
    if seen:
        o = line[1] + line[2] * (ref[0] - line[0])
        count = follow(
            s.grey,
            mask,
            s.edge,
            ref[0],
            o,
            line[2],
            par.ahead_px,
            par.ahead_px,
            section,
            lp,
            s.profile,
            s.points,
        )
        line[0] = ref[0]
        line[1] = o
        enough = count >= MIN_ROWS
        ahead = 0
        while ahead < count and s.points[ahead, 0] > 0.0:
            ahead += 1
        seen = _usual(i, 0, mask, line, ahead if enough else 0, section, par, state, s) and enough
        if seen:
            turn_page(i, state)
            remember(i, tip, count, ref, g, par, state, s)
    oldest = max(state.clock[i] - int(par.memory), 0)
    fitted = fit_memory(i, tip, p, d, n, m, oldest, par, state, s.fit, curve)
    if seen and not fitted:
        seen = False
        fitted = fit_memory(i, tip, p, d, n, m, oldest, par, state, s.fit, curve)
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
    normalise(d)
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
    if down > -1e-3 or not (strip_slope(p, d, 1, g, line) and to_strip(p, 1, g, a)):
        return False
    for k in range(3):
        lift[k] = (p[k] - g.position[0, k]) / down
        x[k] = p[k] + 1e-3 * d[k]
    if not to_strip(x, 1, g, b):
        return False
    per_m[0] = (b[0] - a[0]) * 1e3
    for k in range(3):
        x[k] = p[k] + 1e-4 * lift[k]
    if not to_strip(x, 1, g, b):
        return False
    per_m[1] = ((b[1] - a[1]) - line[2] * (b[0] - a[0])) * 1e4
    return bool(abs(per_m[1]) > 1e3)


@kernel
def _reach(section: Array, q: float, par: TrackNumbers) -> float:
    """How far from the tip the side view's rows count fully, twice [px]."""
    if section[0] <= 0.0:
        return par.side_px
    # A narrow groove needs far rows: those near the tip are under the nozzle, and all cut the same pixels.
    return par.side_px * (_GROOVE_REACH if 2.0 * _half_width(section, q) >= NARROW_PX else 1.0)


@kernel
def _past_sealant(mask: Bools, line: Array, skip: float, most: float) -> float:
    """The first row from ``skip`` on in which the expected line is not under the paste before the nozzle."""
    height, width = mask.shape
    for step in range(int(most)):
        row = int(line[0] + skip) + step
        column = int(line[1] + line[2] * (row + 0.5 - line[0]))
        if not (0 <= row < height and 0 <= column < width and mask[row, column]):
            return float(skip + step)
    return skip


@kernel
def _side_residual(
    mask: Bools,
    g: ViewGeometry,
    lp: LineNumbers,
    par: TrackNumbers,
    s: Scratch,
    p: Array,
    d: Array,
    m: Array,
    section: Array,
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
    if par.lays:
        skip = _past_sealant(mask, line, skip, par.side_px)
    reach = _reach(section, line[2], par)
    first = int(line[0] + skip - par.side_px)
    for row in range(first, int(line[0] + skip + par.side_px) + 1):
        t = row + 0.5 - line[0]
        y = t / scale
        for _ in range(2):
            for k in range(3):
                x[k] = p[k] + y * d[k] + bend * y * y * m[k]
            if not to_strip(x, 1, g, b):
                return False
            y += (row + 0.5 - b[0]) / scale
        slope = line[2]
        if abs(t) > 1e-9:
            # Chord of a parabola: its end's slope is twice the chord's less the start's.
            slope = min(max(2.0 * (b[1] - line[1]) / t - line[2], -2.0), 2.0)
        if not row_edge(s.grey, mask, s.edge, row, b[1], slope, lp.search_px, section, lp, s.profile, found):
            continue
        error = found[0] - b[1]
        # Far rows hang on the curve's bend, which is less sure.
        w = found[1] * found[1] / (1.0 + (2.0 * (t - skip) / reach) ** 4)
        s0 += w
        s1 += w * t
        s2 += w * t * t
        b0 += w * error
        b1 += w * error * t
        count += 1
    det = s0 * s2 - s1 * s1
    if count < MIN_ROWS or det <= 1e-6 * s0 * s2:
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
def track_side(  # noqa: PLR0911  # each return is a reason not to have seen the seam
    i: int,
    mask: Bools,
    g: ViewGeometry,
    lp: LineNumbers,
    par: TrackNumbers,
    state: TrackState,
    s: Scratch,
    p: Array,
    d: Array,
    bend: float,
) -> bool:
    """Step 3: corrects height and pitch of the plane through the tangent (tip frame)."""
    line, n, m, lift = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    per_m, out, section = np.empty(2), np.empty(5), np.empty(SECTION)
    plate_axes(d, par.plate, n, m)
    if not _side_frame(p, d, n, g, lift, line, per_m):
        return False
    if not section_of(p, d, n, m, 1, g, par.groove, section):
        return False
    if not _usual(i, 1, mask, line, 0, section, par, state, s):
        return False
    # Under its own paste the gun sees rows further ahead only, which a bend turns away: until it is over, the
    # plate's plane in the world has to do.
    if par.lays and abs(bend) >= _BENT:
        return True
    if not _side_residual(mask, g, lp, par, s, p, d, m, section, bend, line, per_m[0], out):
        return par.lays
    # Neighbouring rows share pixels: five times the variance of independent ones.
    noise = 5.0 * par.row_sigma_m**2
    r_height = noise * out[2] + _HEIGHT_FLOOR**2
    r_pitch = noise * out[3] * per_m[0] ** 2 + _PITCH_FLOOR**2
    if section[0] > 0.0:
        r_height += (_BEND_SHARE * bend * _BEND_M * _BEND_M) ** 2
        r_pitch += (2.0 * _BEND_SHARE * bend * _BEND_M) ** 2
    variance = state.variance[i]
    height = _kalman(variance, 0, par.height_q_m, out[0] / per_m[1], r_height, par.gate)
    if height == 0.0:
        return False
    # Where the seam bends the side view mixes bend and pitch, and plates bend seldom where seams do.
    drift = par.pitch_q_rad if abs(bend) < _BENT and not par.lays else _BENT_SHARE * par.pitch_q_rad
    pitch = _kalman(variance, 1, drift, out[1] / per_m[1] * per_m[0], r_pitch, par.gate)
    height -= pitch * out[4] / per_m[0]
    for k in range(3):
        p[k] += height * lift[k]
        d[k] += pitch * lift[k]
    normalise(d)
    return True
