"""How a bead creeps under its own weight: thin-film flow of a Herschel-Bulkley fluid over the surface."""

import numpy as np

from seal_gym.core.frames import Array
from seal_gym.core.jit import kernel
from seal_gym.sealant.deposition import column_height
from seal_gym.sealant.strip import Strip

GRAVITY_M_S2 = 9.81
# A cell gives at most this share of its volume through one side in a step, and no more than levels the pair:
# so the explicit step is stable whatever its length, and slower than the fluid where it would not be.
_DONOR_SHARE = 0.2
_PAIR_SHARE = 0.2


@kernel
def _flux(
    thick: float, slope: float, weight: float, yield_stress: float, consistency: float, m: float
) -> float:
    """Flow per width of a layer on a slope, m^2/s; m = 1 / n.

    With the sheared part Y = max(0, h - tau_y / (rho g S)) and the flow index n:
    ``q = (rho g S / K)^(1/n) n / ((n + 1)(2 n + 1)) Y^(1 + 1/n) ((2 n + 1) h - n Y)``, the integral of the
    velocity over the layer.
    """
    stress = weight * slope
    if stress * thick <= yield_stress:
        return 0.0
    sheared = thick - yield_stress / stress
    n = 1.0 / m
    shape = n / ((n + 1.0) * (2.0 * n + 1.0)) * ((2.0 * n + 1.0) * thick - n * sheared)
    return float((stress / consistency) ** m * shape * sheared ** (1.0 + m))


@kernel
def _head(strip: Strip, height: Array, k: int, j: int) -> float:
    """Elevation of a column's top."""
    out = 0.0
    for a in range(3):
        out += strip.up[a] * (strip.base[k, j, a] + height[k, j] * strip.column[k, a])
    return out


@kernel
def _slope_across(strip: Strip, head: Array, k: int, j: int, row: int) -> float:
    """Rise of the surface to the right, by central differences where there are two neighbours."""
    left, right = j - 1 if j > 0 else j, j + 1 if j + 1 < head.shape[1] else j
    if strip.area[k, left] <= 0.0:
        left = j
    if strip.area[k, right] <= 0.0:
        right = j
    span = 0.0
    for i in range(left, right):
        span += strip.gap_across[k, i]
    return float((head[row, right] - head[row, left]) / span) if span > 0.0 else 0.0


@kernel
def _slope_along(strip: Strip, head: Array, first: int, k: int, j: int) -> float:
    """Rise of the surface along the seam."""
    before, after = k - 1 if k > first else k, k + 1 if k - first + 1 < head.shape[0] else k
    if strip.area[before, j] <= 0.0:
        before = k
    if strip.area[after, j] <= 0.0:
        after = k
    span = 0.0
    for i in range(before, after):
        span += strip.gap_along[i, j]
    return float((head[after - first, j] - head[before - first, j]) / span) if span > 0.0 else 0.0


@kernel
def level(  # noqa: PLR0912  # one pass over pairs of neighbours
    strip: Strip,
    volume: Array,
    height: Array,
    dt_s: float,
    density: float,
    yield_stress: float,
    consistency: float,
    m: float,
    first: int,
    last: int,
) -> None:
    """Lets the sealant in some rows flow for one step; volume goes from column to column, none is lost.

    Args:
        strip: The columns.
        volume: Sealant in each column, changed in place, shape (S, U), m^3.
        height: Of each column, changed in place, shape (S, U), m.
        dt_s: Length of the step [s].
        density: Of the sealant [kg/m^3].
        yield_stress: tau_y [Pa].
        consistency: K [Pa s^n].
        m: 1 / n.
        first: First row.
        last: Last row + 1.
    """
    columns = strip.area.shape[1]
    weight = density * GRAVITY_M_S2
    thickest = 0.0
    for k in range(first, last):
        for j in range(columns):
            thickest = max(thickest, height[k, j])
    # Slopes count as 1 at most: a layer this thin stays wherever it is.
    if thickest * weight <= yield_stress:
        return
    head, change = np.empty((last - first, columns)), np.zeros((last - first, columns))
    for k in range(first, last):
        for j in range(columns):
            head[k - first, j] = _head(strip, height, k, j)
    pitch = strip.across[1] - strip.across[0]
    for k in range(first, last):
        for j in range(columns):
            for direction in range(2):
                r, c = (k, j + 1) if direction == 0 else (k + 1, j)
                if r >= last or c >= columns or strip.area[k, j] <= 0.0 or strip.area[r, c] <= 0.0:
                    continue
                if volume[k, j] <= 0.0 and volume[r, c] <= 0.0:
                    continue
                fall = head[k - first, j] - head[r - first, c]
                gk, gj, sign = (k, j, 1.0) if fall > 0.0 else (r, c, -1.0)
                if volume[gk, gj] <= 0.0:
                    continue
                if direction == 0:
                    gap = strip.gap_across[k, j]
                    other = 0.5 * (
                        _slope_along(strip, head, first, k, j) + _slope_along(strip, head, first, r, c)
                    )
                    side = strip.area[gk, gj] / pitch
                else:
                    gap = strip.gap_along[k, j]
                    other = _slope_across(strip, head, k, j, k - first)
                    other = 0.5 * (other + _slope_across(strip, head, r, c, r - first))
                    side = strip.gap_across[gk, gj] if gj + 1 < columns else strip.gap_across[gk, gj - 1]
                own = fall / gap
                slope = np.sqrt(own * own + other * other)
                if slope <= 0.0:
                    continue
                # Where the free surface is steeper than the slope of a film can be, gravity pulls no harder.
                steep = min(slope, 1.0)
                thick = strip.slant[gk, gj] * height[gk, gj]
                q = _flux(thick, steep, weight, yield_stress, consistency, m) * abs(own) / slope
                moved = min(q * side * dt_s, _DONOR_SHARE * volume[gk, gj])
                rise = strip.column[k, 0] * strip.up[0] + strip.column[k, 1] * strip.up[1]
                rise += strip.column[k, 2] * strip.up[2]
                smaller = min(strip.area[k, j], strip.area[r, c])
                moved = min(moved, _PAIR_SHARE * abs(fall) * smaller / max(rise, 0.2))
                change[k - first, j] -= sign * moved
                change[r - first, c] += sign * moved
    for k in range(first, last):
        for j in range(columns):
            if change[k - first, j] != 0.0:
                volume[k, j] += change[k - first, j]
                height[k, j] = column_height(strip.area[k, j], strip.spread[k, j], volume[k, j])
