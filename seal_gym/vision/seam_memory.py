"""The memory: edges of the front view as rays in the world, and the curve through them near the tip."""

import numpy as np

from seal_gym.core.frames import Array
from seal_gym.core.jit import kernel
from seal_gym.vision.features import ViewGeometry
from seal_gym.vision.seam_line import fit_curve
from seal_gym.vision.strip_geometry import strip_ray
from seal_gym.vision.track_state import MIN_ROWS, Scratch, TrackNumbers, TrackState

_ONSET_M = 0.5e-3  # more than a part gathers in a frame
_REACH = 4.5  # how far along motion is looked for, in widths of the fit
_SLOPE_OVER = 3  # neighbours on either side from which an edge's slope is taken
_GAP_M = 2.0e-3  # farther apart new edges have nothing between them
_ALONG = 0.06  # mean square of slopes about their mean with which a shift along the seam is half believed
_STEP_M = 0.25e-3  # travel after which a frame's edges are kept beside the last ones
_CARRIED_M = 0.1e-3  # motion of the part after which they are
_FADE = 0.03  # share of a velocity along the seam that is forgotten in a frame that does not show it


@kernel
def _on_plate(
    i: int, k: int, tip: Array, p: Array, d: Array, n: Array, m: Array, state: TrackState, out: Array
) -> bool:
    """Where a remembered ray meets the plate: along and across the tangent, from its point (tip frame)."""
    down = gap = 0.0
    c, r = out[2:5], out[5:8]
    for a in range(3):
        c[a] = r[a] = 0.0
        for b in range(3):
            c[a] += tip[b, a] * (state.eye[i, k, b] - tip[b, 3])
            r[a] += tip[b, a] * state.ray[i, k, b]
        down += n[a] * r[a]
        gap += n[a] * (p[a] - c[a])
    if down > -1e-3:
        return False
    out[0] = out[1] = 0.0
    for a in range(3):
        x = c[a] + r[a] * gap / down - p[a]
        out[0] += x * d[a]
        out[1] += x * m[a]
    return True


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
    state: TrackState,
    fit: Array,
) -> int:
    """Where the remembered rays meet the plate near the tip: along (in sigma), across, weight, newness.

    Those too far off to count in the fit come with a weight of 0.
    """
    count = 0
    at = np.empty(8)
    for k in range(state.stamp.shape[1]):
        if state.stamp[i, k] < oldest or not _on_plate(i, k, tip, p, d, n, m, state, at):
            continue
        y = at[0] / sigma
        if abs(y) > _REACH:
            continue
        fit[0, count], fit[1, count] = y, at[1]
        fit[2, count] = state.weight[i, k] * np.exp(-0.5 * y * y) if abs(y) <= 2.5 else 0.0
        fit[3, count] = 1.0 if state.stamp[i, k] == state.clock[i] else 0.0
        count += 1
    return count


@kernel
def _newest(fit: Array, count: int, found: Array) -> int:
    """The frame's own edges in order of travel: along, across, slope about each; how many."""
    new = 0
    for k in range(count):
        if fit[3, k] <= 0.0 or new == found.shape[1]:
            continue
        j = new
        while j > 0 and found[0, j - 1] > fit[0, k]:
            found[0, j], found[1, j] = found[0, j - 1], found[1, j - 1]
            j -= 1
        found[0, j], found[1, j] = fit[0, k], fit[1, k]
        new += 1
    for j in range(new):
        first, last = max(j - _SLOPE_OVER, 0), min(j + _SLOPE_OVER, new - 1) + 1
        my = mx = s2 = sx = 0.0
        for k in range(first, last):
            my += found[0, k] / (last - first)
            mx += found[1, k] / (last - first)
        for k in range(first, last):
            s2 += (found[0, k] - my) ** 2
            sx += (found[0, k] - my) * (found[1, k] - mx)
        found[2, j] = sx / s2 if s2 > 0.0 else 0.0
    return new


@kernel
def seam_motion(fit: Array, count: int, sigma: float, clip: float, out: Array) -> None:
    """How far the remembered edges have to go across and along to lie on the new ones [m].

    Across is seen anywhere, along only where the seam bends: each remembered edge is compared with the new
    ones beside it, and a least-squares shift explains the differences. What is not seen stays 0; ``out[2]``
    is the share of the shift along that is.
    """
    found = np.empty((3, 64))
    new = _newest(fit, count, found)
    out[0] = out[1] = out[2] = 0.0
    s0 = s1 = s2 = b0 = b1 = 0.0
    for k in range(count):
        y = fit[0, k]
        if fit[3, k] > 0.0 or new < 2 or y < found[0, 0] or y >= found[0, new - 1]:
            continue
        j = 0
        while found[0, j + 1] <= y:
            j += 1
        wide = found[0, j + 1] - found[0, j]
        if wide > _GAP_M / sigma or wide <= 0.0:
            continue
        share = (y - found[0, j]) / wide
        error = found[1, j] + share * (found[1, j + 1] - found[1, j]) - fit[1, k]
        slope = (found[2, j] + share * (found[2, j + 1] - found[2, j])) / sigma
        off = abs(error) / np.sqrt(1.0 + slope * slope)
        w = (1.0 if off <= clip else (clip / off) ** 2) / (1.0 + slope * slope)
        s0 += w
        s1 += w * slope
        s2 += w * slope * slope
        b0 += w * error
        b1 += w * error * slope
    if s0 <= 0.0:
        return
    # About the mean slope the two do not mix. The edges of a frame share its noise, so that their number
    # says little; and in a slight bend chords inside the arc pass for motion: squares leave that out.
    mean, seen = s1 / s0, s2 / s0 - (s1 / s0) ** 2
    out[2] = seen * seen / (seen * seen + _ALONG * _ALONG)
    if seen > 0.0:
        out[1] = -(b1 - mean * b0) / (seen * s0) * out[2]
    out[0] = b0 / s0 + mean * out[1]


@kernel
def fit_memory(
    i: int,
    tip: Array,
    p: Array,
    d: Array,
    n: Array,
    m: Array,
    oldest: int,
    par: TrackNumbers,
    state: TrackState,
    fit: Array,
    curve: Array,
) -> bool:
    """Fits what is remembered near the tip in the plate's plane, and learns how the part moves across."""
    sigma, clip = par.sigma_m, par.clip_m
    # The tangent moves little in a frame, which matters where the edges seen lie off the tip. As long as no
    # edges behind the tip are remembered, heading and bend are hard to tell apart: seams seldom begin in one.
    bend = par.bend * min(max(state.clock[i], 1) / par.memory, 1.0)
    prior = (1.0 / par.step_m**2, 1.0 / (par.step_rad * sigma) ** 2, 1.0 / (bend * sigma * sigma) ** 2)
    count = _gather(i, tip, p, d, n, m, sigma, oldest, state, fit)
    if count < MIN_ROWS or fit_curve(fit[0], fit[1], fit[2], count, prior, clip, curve) <= 0.0:
        return False
    shift = np.empty(3)
    # A part that sets off moves its oldest edges the most: what is robust must not be deaf.
    seam_motion(fit, count, sigma, 0.5 * par.jump_m, shift)
    off = shift[0]
    if abs(off) > par.jump_m:
        # No part moves like this: something else passes the camera or, if it stays, the part was shoved.
        shoved = state.missed[i, 0] > par.coast
        for k in range(state.stamp.shape[1]):
            if (state.stamp[i, k] == state.clock[i]) != shoved:
                state.stamp[i, k] = -1
        return False
    along = par.along_gain * max(min(shift[1], _ONSET_M), -_ONSET_M)
    across = max(min(shift[0], _ONSET_M), -_ONSET_M)
    unseen = 0.0
    for a in range(3):
        unseen += state.velocity[i, a] * (tip[a, 0] * d[0] + tip[a, 1] * d[1] + tip[a, 2] * d[2])
    unseen *= _FADE * (1.0 - shift[2])
    for a in range(3):
        x = tip[a, 0] * m[0] + tip[a, 1] * m[1] + tip[a, 2] * m[2]
        y = tip[a, 0] * d[0] + tip[a, 1] * d[1] + tip[a, 2] * d[2]
        state.velocity[i, a] += par.velocity_gain * (across * x + along * y) - unseen * y
        for k in range(state.stamp.shape[1]):
            if state.stamp[i, k] != state.clock[i]:
                state.eye[i, k, a] += par.follow_gain * (off * x + along * y)
    for k in range(count):
        fit[0, k] += par.follow_gain * along / sigma * (1.0 - fit[3, k])
        fit[1, k] += par.follow_gain * off * (1.0 - fit[3, k])
    if fit_curve(fit[0], fit[1], fit[2], count, prior, clip, curve) <= 0.0:
        return False
    curve[1] /= sigma
    curve[2] /= sigma * sigma
    return True


@kernel
def travel(i: int, tip: Array, d: Array, state: TrackState) -> None:
    """Adds up how far tip and part have gone since the last page: the one over the other, and the part."""
    for a in range(3):
        state.carried[i, a] += state.velocity[i, a]
        along = tip[a, 0] * d[0] + tip[a, 1] * d[1] + tip[a, 2] * d[2]
        state.gone[i] += (tip[a, 3] - state.tip[i, a] - state.velocity[i, a]) * along


@kernel
def turn_page(i: int, state: TrackState) -> None:
    """Makes room for the frame's edges: beside the last ones if something moved, else in their place.

    So a gun that waits keeps the edges behind the tip, which it does not see; with those ahead alone heading
    and bend could trade places, and the gun would sway. On a part that moves edges have to be young.
    """
    moved = state.carried[i, 0] ** 2 + state.carried[i, 1] ** 2 + state.carried[i, 2] ** 2
    if abs(state.gone[i]) >= _STEP_M or moved >= _CARRIED_M * _CARRIED_M:
        state.gone[i] = state.carried[i, 0] = state.carried[i, 1] = state.carried[i, 2] = 0.0
        state.clock[i] += 1
        state.page[i] = state.head[i]
        return
    for k in range(state.stamp.shape[1]):
        if state.stamp[i, k] == state.clock[i]:
            state.stamp[i, k] = -1
    state.head[i] = state.page[i]


@kernel
def remember(
    i: int,
    tip: Array,
    count: int,
    ref: Array,
    g: ViewGeometry,
    par: TrackNumbers,
    state: TrackState,
    s: Scratch,
) -> None:
    """Keeps every second of the points followed in the front view as rays in the world."""
    ray = np.empty(3)
    for k in range(0, count, 2):
        strip_ray(ref[0] + s.points[k, 0], s.points[k, 1], 0, g, ray)
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
