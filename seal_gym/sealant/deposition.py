"""What leaves a round nozzle settles under its mouth: a dome that grows until it holds the volume.

The fast tier of the laydown: one frame costs tens of microseconds. A yield-stress paste does not run, so the
nozzle shapes the bead. Below the mouth's plane the paste makes a steep dome on the surface; once the dome
reaches the mouth it becomes a plateau of the mouth's height that widens, as an obround bead does whose width
is w = A / H + H (1 - pi / 4) for a section A pressed at a gap H.
"""

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.frames import Array
from seal_gym.core.jit import kernel
from seal_gym.sealant.strip import Strip

# Curvature of the dome's sides against the surface: over a plate they fall by a gap of 3 mm within 1.5 mm, as
# a half round of that gap does.
_SIDE_M = 0.4e-3
REACH_M = 5e-3
_WIDEST_M = 4e-3
_SEARCHES = 40
_EXACT = 1e-9
# A nozzle that has no surface this near to its axis shoots beside the part.
_BESIDE_M = 2e-3


@kernel
def column_height(area: float, spread: float, volume: float) -> float:
    """Height of a column of some volume.

    Args:
        area: As ``Strip.area`` [m^2], > 0.
        spread: As ``Strip.spread`` [m].
        volume: Of sealant in it [m^3].

    Returns:
        Metres.
    """
    root = np.sqrt(max(area * area + 4.0 * spread * volume, 0.0))
    out: float = 2.0 * volume / (area + root)
    return out


@kernel
def _room(size: float, count: int, cells: Array, gain: Array) -> float:
    """Volume between the surface and a dome; ``gain`` gets each cell's.

    ``size`` is the dome's height over the mouth's plane, or if positive the radius of its plateau there.
    """
    total = 0.0
    plateau, top = max(size, 0.0), min(size, 0.0)
    for m in range(count):
        fall = max(cells[m, 0] - plateau, 0.0)
        rise = (top - fall * fall / (2.0 * _SIDE_M) - cells[m, 1]) / cells[m, 2]
        gain[m] = 0.0
        if rise > 0.0:
            gain[m] = rise * (cells[m, 3] + cells[m, 4] * (2.0 * cells[m, 5] + rise))
            total += gain[m]
    return total


@kernel
def _gather(
    strip: Strip,
    height: Array,
    first: int,
    last: int,
    tip: Array,
    turn: Array,
    cells: Array,
    at: NDArray[np.int64],
) -> tuple[int, float, float]:
    """Columns near the nozzle's axis: distance, height over the mouth, slope, area, spread, height."""
    count, nearest, lowest = 0, np.inf, 0.0
    middle, columns = strip.area.shape[1] // 2, strip.area.shape[1]
    for k in range(first, last):
        ahead, lift = 0.0, 0.0
        for a in range(3):
            ahead += (strip.base[k, middle, a] - tip[a]) * strip.along[k, a]
            lift += turn[a, 2] * strip.column[k, a]
        # Rows far ahead or behind; and where the nozzle points along the surface or away from it.
        if abs(ahead) > 1.5 * REACH_M or lift < 0.2:
            continue
        for j in range(columns):
            if strip.area[k, j] <= 0.0:
                continue
            x, y, z = 0.0, 0.0, 0.0
            for a in range(3):
                off = strip.base[k, j, a] + height[k, j] * strip.column[k, a] - tip[a]
                x, y, z = x + turn[a, 0] * off, y + turn[a, 1] * off, z + turn[a, 2] * off
            square = x * x + y * y
            if square > REACH_M * REACH_M or count >= len(cells):
                continue
            nearest, lowest = min(nearest, np.sqrt(square)), min(lowest, z)
            # Across, the dome's sides are as steep against the surface, which slants in a fillet.
            x *= strip.slant[k, j]
            cells[count, 0], cells[count, 1], cells[count, 2] = np.sqrt(x * x + y * y), z, lift
            cells[count, 3], cells[count, 4] = strip.area[k, j], strip.spread[k, j]
            cells[count, 5] = height[k, j]
            at[count, 0], at[count, 1] = k, j
            count += 1
    return count, nearest, lowest


@kernel
def _dome(amount: float, lowest: float, count: int, cells: Array, gain: Array) -> float:
    """Finds the dome that holds an amount, by false position within a bracket; returns what it holds."""
    low, high = lowest, _WIDEST_M
    under, over = -amount, float(_room(high, count, cells, gain) - amount)
    if over <= 0.0:
        return over + amount
    total: float = over + amount
    for step in range(_SEARCHES):
        # Every third step halves, so that a strongly bent function cannot stall the search.
        middle = 0.5 * (low + high) if step % 3 == 2 else (low * over - high * under) / (over - under)
        total = _room(middle, count, cells, gain)
        if abs(total - amount) <= _EXACT * amount:
            break
        if total < amount:
            low, under = middle, total - amount
        else:
            high, over = middle, total - amount
    return total


@kernel
def lay(
    strip: Strip,
    volume: Array,
    height: Array,
    amount: float,
    tip: Array,
    turn: Array,
    first: int,
    last: int,
    cells: Array,
    at: NDArray[np.int64],
    gain: Array,
) -> float:
    """Lays an amount of sealant under a round nozzle.

    Args:
        strip: The columns.
        volume: Sealant in each column, changed in place, shape (S, U), m^3.
        height: Of each column, changed in place, shape (S, U), m.
        amount: What leaves the mouth [m^3].
        tip: Position of the mouth in the part's frame, shape (3,), m.
        turn: ``R_part_tip``, shape (3, 3).
        first: First row that may be near the nozzle.
        last: Last row that may be, + 1.
        cells: Scratch, shape (M, 6).
        at: Scratch, shape (M, 2).
        gain: Scratch, shape (M,).

    Returns:
        What fell beside the columns [m^3]: all or nothing.
    """
    count, nearest, lowest = _gather(strip, height, first, last, tip, turn, cells, at)
    if count == 0 or nearest > _BESIDE_M:
        return amount
    total = _dome(amount, lowest, count, cells, gain)
    if total <= 0.0:
        # The mouth is drowned: what still comes out lifts the bead round it.
        for m in range(count):
            gain[m] = cells[m, 3] * max(1.0 - cells[m, 0] / REACH_M, 0.0)
            total += gain[m]
    share = amount / total
    for m in range(count):
        if gain[m] > 0.0:
            k, j = at[m, 0], at[m, 1]
            volume[k, j] += share * gain[m]
            height[k, j] = column_height(strip.area[k, j], strip.spread[k, j], volume[k, j])
    return 0.0
