"""The memory: edges of the front view as rays in the world, and the curve through them near the tip."""

import numpy as np

from seal_gym.core.frames import Array
from seal_gym.core.jit import kernel
from seal_gym.vision.features import ViewGeometry
from seal_gym.vision.seam_line import fit_curve
from seal_gym.vision.strip_geometry import strip_ray
from seal_gym.vision.track_state import MIN_ROWS, Scratch, TrackNumbers, TrackState

_ONSET_M = 0.5e-3  # more than a part gathers in a frame
_STRETCHES = 20  # of the memory around the tip, in which new and old edges are compared


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
    # The tangent moves little in a frame, which matters where the edges seen lie off the tip.
    prior = (
        1.0 / par.step_m**2,
        1.0 / (par.step_rad * sigma) ** 2,
        1.0 / (par.bend * sigma * sigma) ** 2,
    )
    count = _gather(i, tip, p, d, n, m, sigma, oldest, state, fit)
    if count < MIN_ROWS or fit_curve(fit[0], fit[1], fit[2], count, prior, clip, curve) <= 0.0:
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
        state.velocity[i, a] += par.velocity_gain * max(min(off, _ONSET_M), -_ONSET_M) * across
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
