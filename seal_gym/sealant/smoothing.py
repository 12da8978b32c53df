"""Smoothing: a round tool drawn along a fresh bead takes off what stands proud and fills what is low."""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import is_number, require
from seal_gym.core.frames import Array
from seal_gym.core.jit import kernel
from seal_gym.sealant.bead import Bead
from seal_gym.sealant.deposition import column_height
from seal_gym.sealant.strip import Strip


@dataclass(frozen=True, kw_only=True)
class SmoothingCfg:
    """A soft ball that touches plate and wall and is drawn along the seam.

    Attributes:
        radius_m: Of the ball [m]: a fillet of that radius is left, of section (1 - pi / 4) radius^2.
        speed_m_s: Along the tool path [m/s].
        blend_m: Length over which the executed sealing path is averaged for the tool path [m].
    """

    radius_m: float = 5.5e-3
    speed_m_s: float = 20e-3
    blend_m: float = 4e-3

    def __post_init__(self) -> None:
        """Checks the ranges."""
        highest = {"radius_m": 0.02, "speed_m_s": 0.2, "blend_m": 0.05}
        for f in fields(self):
            value = getattr(self, f.name)
            require(
                is_number(value) and 0.0 < value <= highest[f.name],
                f"SmoothingCfg.{f.name} = {value!r}: must be above 0 and at most {highest[f.name]:g}; "
                "check the unit",
            )

    @property
    def lift_m(self) -> float:
        """Distance of the ball's centre from the seam of a right angle it touches on both sides [m]."""
        return float(np.sqrt(2.0) * self.radius_m)


def tool_path(tip: Array, stand_off_m: float, step_m: float, cfg: SmoothingCfg) -> Array:
    """The way of a smoothing tool from the way the gun has taken: averaged, evenly spaced, moved along its z.

    Source: Zhou et al., section 4.2: smoothing paths are the sealing paths times a transform.

    Args:
        tip: ``T_part_tip`` of the executed sealing path in order, shape (n, 4, 4), m; n >= 2.
        stand_off_m: Of the gun from the seam [m].
        step_m: Between the poses of the tool path [m].
        cfg: The tool.

    Returns:
        ``T_part_tool``, origin in the ball's centre, shape (m, 4, 4), m.
    """
    way = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(tip[:, :3, 3], axis=0), axis=1))))
    keep = np.concatenate(([True], np.diff(way) > 1e-9))
    even = np.linspace(0.0, way[-1], max(round(way[-1] / step_m), 1) + 1)
    flat = tip[keep].reshape(-1, 16)
    flat = np.column_stack([np.interp(even, way[keep], column) for column in flat.T])
    width = max(round(cfg.blend_m / step_m) // 2 * 2 + 1, 1)
    if width > 1 and len(flat) > width:
        # Near the ends over as much as there is to both sides, so that they stay where they are.
        sums = np.concatenate((np.zeros((1, 16)), np.cumsum(flat, axis=0)))
        i = np.arange(len(flat))
        half = np.minimum(np.minimum(i, len(flat) - 1 - i), width // 2)
        flat = (sums[i + half + 1] - sums[i - half]) / (2 * half + 1)[:, None]
    out = flat.reshape(-1, 4, 4)
    # Averages of rotations are none: the nearest one is.
    left, _, right = np.linalg.svd(out[:, :3, :3])
    out[:, :3, :3] = left @ right
    out[:, :3, 3] += (cfg.lift_m - stand_off_m) * out[:, :3, 2]
    return np.asarray(out)


@kernel
def _under(strip: Strip, k: int, j: int, centre: Array, radius: float) -> float:
    """Height of the ball's underside in a column, 0 where the surface presses it in; -1 beside the ball."""
    if strip.area[k, j] <= 0.0:
        return -1.0
    along_column, square = 0.0, 0.0
    for a in range(3):
        d = centre[a] - strip.base[k, j, a]
        along_column += d * strip.column[k, a]
        square += d * d
    inside = radius * radius - (square - along_column * along_column)
    if inside <= 0.0:
        return -1.0
    lowest: float = max(along_column - np.sqrt(inside), 0.0)
    return lowest


@kernel
def _fill(strip: Strip, volume: Array, height: Array, k: int, surface: Array, pool: float) -> float:
    """Fills the space under the ball between where it touches left and right; returns what is left over."""
    columns, middle = len(surface), len(surface) // 2
    gap = 0.0
    for step in (-1, 1):
        before, j = np.inf, middle if step > 0 else middle - 1
        # From the seam outwards the underside comes down until the ball touches.
        while 0 <= j < columns and 0.0 <= surface[j] <= before:
            room = (strip.area[k, j] + strip.spread[k, j] * surface[j]) * surface[j] - volume[k, j]
            gap += max(room, 0.0)
            before, j = surface[j], j + step
        while 0 <= j < columns:
            surface[j] = -1.0
            j += step
    share = min(pool / gap, 1.0) if gap > 0.0 else 0.0
    for j in range(columns):
        room = (strip.area[k, j] + strip.spread[k, j] * surface[j]) * surface[j] - volume[k, j]
        if surface[j] >= 0.0 and room > 0.0 and share > 0.0:
            volume[k, j] += share * room
            pool -= share * room
            height[k, j] = column_height(strip.area[k, j], strip.spread[k, j], volume[k, j])
    return max(pool, 0.0)


@kernel
def _draw(
    strip: Strip,
    volume: Array,
    height: Array,
    centre: Array,
    radius: float,
    pool: float,
    first: int,
    last: int,
    surface: Array,
) -> float:
    """One position of the ball: it takes what is above its underside, then fills its nearest row."""
    columns = strip.area.shape[1]
    nearest, least = first, np.inf
    for k in range(first, last):
        ahead = 0.0
        for a in range(3):
            ahead += (strip.base[k, columns // 2, a] - centre[a]) * strip.along[k, a]
        if abs(ahead) < least:
            nearest, least = k, abs(ahead)
        for j in range(columns):
            lowest = _under(strip, k, j, centre, radius)
            if 0.0 <= lowest < height[k, j]:
                kept = (strip.area[k, j] + strip.spread[k, j] * lowest) * lowest
                pool += volume[k, j] - kept
                volume[k, j], height[k, j] = kept, lowest
    for j in range(columns):
        surface[j] = _under(strip, nearest, j, centre, radius)
    return float(_fill(strip, volume, height, nearest, surface, pool))


@kernel
def _draw_all(
    strip: Strip,
    volume: Array,
    height: Array,
    centres: Array,
    rows: NDArray[np.int64],
    reach: int,
    radius: float,
) -> float:
    pool = 0.0
    surface = np.empty(strip.area.shape[1])
    for n in range(len(centres)):
        first, last = max(rows[n] - reach, 0), min(rows[n] + reach + 1, len(strip.arc))
        if first < last:
            pool = _draw(strip, volume, height, centres[n], radius, pool, first, last, surface)
    return pool


def smooth(bead: Bead, i: int, centres: Array, s: Array, cfg: SmoothingCfg) -> float:
    """Draws the ball over one bead.

    Args:
        bead: The beads.
        i: Which of them, changed in place.
        centres: Positions of the ball's centre in the part's frame in order of travel, not further apart than
            the strip's columns, shape (n, 3), m.
        s: Arc lengths beside which they are, shape (n,), m.
        cfg: The tool.

    Returns:
        What the ball has taken off and kept [m^3]; with what lies on the part it is what lay there before.
    """
    spacing = bead.strip.arc[1] - bead.strip.arc[0]
    rows = np.rint((s - bead.strip.arc[0]) / spacing).astype(np.int64)
    reach = int(np.ceil(1.5 * cfg.radius_m / spacing))
    centres = np.ascontiguousarray(centres, dtype=np.float64)
    return float(_draw_all(bead.strip, bead.volume[i], bead.height[i], centres, rows, reach, cfg.radius_m))
