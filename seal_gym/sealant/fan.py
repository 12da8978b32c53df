"""What a flat fan nozzle sprays lands where its rays meet the surface or the bead that is already there.

The flow spreads evenly over the fan's angle. Each step's volume is carried by rays of equal share, to the
columns round the point where they first meet the surface or a bead laid before. The front that the fan is
just laying lets rays through: it is still flowing. Were it solid, a fan that leans forward along its travel
would heap up ridges that shade what is ahead of them.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from seal_gym.core.errors import ConfigError, is_number, require
from seal_gym.core.frames import Array, cross
from seal_gym.core.jit import kernel
from seal_gym.sealant.deposition import column_height
from seal_gym.sealant.levelling import level
from seal_gym.sealant.pneumatics import Sealant
from seal_gym.sealant.strip import Strip

# Between two steps no ray's hit moves further than this share of a column.
_STEP_COLUMNS = 0.5
# Rays are followed in steps of this share of a column, high over the surface of this share of that height.
_MARCH_COLUMNS = 0.5
_MARCH_SHARE = 0.25
# Sealant is in a ray's way when the fan has moved on by once or twice this.
_FRONT_M = 5e-3
_LEVEL_STEP_S = 1.0 / 30.0
_MOST_TURN_RAD = 0.3
# Rays nearer to the surface's tangent than this never come down.
_LEAST_FALL = 0.05
# Multiples of the golden ratio fill an interval evenly however many there are: the rays of one step are
# taken at such times within it, and the steps' rays are turned against each other by such shares of the
# angle between two. So the pattern of rays does not beat with that of the columns.
_GOLDEN = 0.6180339887498949


@dataclass(frozen=True, kw_only=True)
class FanCfg:
    """A flat fan nozzle.

    Attributes:
        angle_rad: theta, over which the flow spreads evenly, in the plane of the tip's x and z [rad].
        rays: That carry the flow of one step.
    """

    angle_rad: float = np.deg2rad(40.0)
    rays: int = 256

    def __post_init__(self) -> None:
        """Checks the ranges."""
        require(
            is_number(self.angle_rad) and 0.01 <= self.angle_rad <= 2.8,
            f"FanCfg.angle_rad = {self.angle_rad!r}: must be in [0.01, 2.8] rad; check the unit",
            ConfigError,
        )
        require(
            is_number(self.rays) and int(self.rays) == self.rays and 16 <= self.rays <= 4096,
            f"FanCfg.rays = {self.rays!r}: must be a whole number in 16..4096",
            ConfigError,
        )


class Laid(NamedTuple):
    """What lies on a strip.

    Attributes:
        volume: Sealant in each column, shape (S, U), m^3.
        height: Of each column, shape (S, U), m.
        missed_m3: What fell beside the columns [m^3].
        sprayed_m3: What left the nozzle [m^3].
    """

    volume: Array
    height: Array
    missed_m3: float
    sprayed_m3: float


class _Surface(NamedTuple):
    """A strip as rays see it: rows with their own axes, the feet's height over each row's middle column."""

    strip: Strip
    side: Array
    foot: Array


@kernel
def _gap_in_row(surface: _Surface, height: Array, point: Array, k: int) -> tuple[float, float]:
    """Height of a point over the surface of a row, and its place across in columns."""
    strip = surface.strip
    middle, columns = strip.area.shape[1] // 2, strip.area.shape[1]
    u, z = 0.0, 0.0
    for a in range(3):
        off = point[a] - strip.base[k, middle, a]
        u += off * surface.side[k, a]
        z += off * strip.column[k, a]
    place = middle + u / (strip.across[1] - strip.across[0])
    # Beside the strip its surface goes on as at its border: what comes down there is missed.
    inside = min(max(place, 0.0), columns - 1.0)
    j = min(int(inside), columns - 2)
    share = inside - j
    left, right = surface.foot[k, j] + height[k, j], surface.foot[k, j + 1] + height[k, j + 1]
    return z - (left + share * (right - left)), place


@kernel
def _ahead(strip: Strip, point: Array, k: int) -> float:
    out = 0.0
    for a in range(3):
        out += (point[a] - strip.base[k, strip.area.shape[1] // 2, a]) * strip.along[k, a]
    return out


@kernel
def _gap(surface: _Surface, height: Array, point: Array, k: int) -> tuple[float, int, float, float]:
    """Height of a point over the surface; the row before it, the share of the way to the next, the column.

    The row is looked for from row k on, so that a strip that comes back to where it began is no riddle.
    """
    strip = surface.strip
    rows = strip.area.shape[0]
    here = _ahead(strip, point, k)
    while here < 0.0 and k > 0:
        k -= 1
        here = _ahead(strip, point, k)
    k = min(k, rows - 2)
    here, after = _ahead(strip, point, k), _ahead(strip, point, k + 1)
    while after >= 0.0 and k < rows - 2:
        k += 1
        here, after = after, _ahead(strip, point, k + 1)
    share = here / max(here - after, 1e-12)
    within = min(max(share, 0.0), 1.0)
    first, before = _gap_in_row(surface, height, point, k)
    second, behind = _gap_in_row(surface, height, point, k + 1)
    return first + within * (second - first), k, share, before + within * (behind - before)


@kernel
def _follow(
    surface: _Surface, height: Array, mouth: Array, ray: Array, k: int, top: float, low: float
) -> tuple[float, int, float, float]:
    """Follows a ray to the surface: distance (negative: none), row, share of the way to the next, column."""
    strip = surface.strip
    over, fall, middle = 0.0, 0.0, strip.area.shape[1] // 2
    for a in range(3):
        over += (mouth[a] - strip.base[k, middle, a]) * strip.column[k, a]
        fall -= ray[a] * strip.column[k, a]
    if fall < _LEAST_FALL:
        return -1.0, k, 0.0, 0.0
    step = _MARCH_COLUMNS * (strip.across[1] - strip.across[0])
    # Nothing is in the way above the highest column.
    reach = max((over - top) / fall - step, 0.0)
    last = 2.0 * max(over - low, 0.0) / fall + 4.0 * step
    point, before, passed = np.empty(3), 0.0, -1.0
    while reach < last:
        for a in range(3):
            point[a] = mouth[a] + reach * ray[a]
        gap, k, share, place = _gap(surface, height, point, k)
        if gap <= 0.0:
            if passed >= 0.0:
                reach -= (reach - passed) * gap / (gap - before)
                for a in range(3):
                    point[a] = mouth[a] + reach * ray[a]
                _, k, share, place = _gap(surface, height, point, k)
            return reach, k, share, place
        before, passed = gap, reach
        reach += max(step, _MARCH_SHARE * gap)
    return -1.0, k, 0.0, 0.0


@kernel
def _drop(
    strip: Strip, volume: Array, height: Array, amount: float, k: int, share: float, place: float
) -> float:
    """Puts an amount on the four columns round a hit; gives what missed: all or nothing."""
    rows, columns = strip.area.shape
    if not (-0.5 <= k + share <= rows - 0.5 and -0.5 <= place <= columns - 0.5):
        return amount
    along = min(max(share, 0.0), 1.0)
    inside = min(max(place, 0.0), columns - 1.0)
    j = min(int(inside), columns - 2)
    across = inside - j
    # A hit whose nearest column is missing went through a gap.
    if strip.area[k + (1 if along >= 0.5 else 0), j + (1 if across >= 0.5 else 0)] <= 0.0:
        return amount
    total = 0.0
    for r in range(2):
        for c in range(2):
            if strip.area[k + r, j + c] > 0.0:
                total += (along if r == 1 else 1.0 - along) * (across if c == 1 else 1.0 - across)
    for r in range(2):
        for c in range(2):
            area = strip.area[k + r, j + c]
            if area > 0.0:
                weight = (along if r == 1 else 1.0 - along) * (across if c == 1 else 1.0 - across)
                volume[k + r, j + c] += amount * weight / total
                height[k + r, j + c] = column_height(area, strip.spread[k + r, j + c], volume[k + r, j + c])
    return 0.0


@kernel
def _aim(mouths: Array, turns: Array, n: int, when: float, angle: float, mouth: Array, ray: Array) -> None:
    """Mouth and unit direction of a ray at a share of the way from pose n to the next."""
    sine, cosine, square = np.sin(angle), np.cos(angle), 0.0
    for a in range(3):
        mouth[a] = mouths[n, a] + when * (mouths[n + 1, a] - mouths[n, a])
        x = turns[n, a, 0] + when * (turns[n + 1, a, 0] - turns[n, a, 0])
        z = turns[n, a, 2] + when * (turns[n + 1, a, 2] - turns[n, a, 2])
        ray[a] = sine * x - cosine * z
        square += ray[a] * ray[a]
    for a in range(3):
        ray[a] /= np.sqrt(square)


@kernel
def _travel(
    surface: _Surface,
    height: Array,
    mouths: Array,
    turns: Array,
    n: int,
    half: float,
    k: int,
    top: float,
    low: float,
) -> float:
    """How far the faster border of the fan moves from pose n to the next."""
    mouth, ray, to_mouth, to_ray = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    longest = 0.0
    for border in range(2):
        angle = -half if border == 0 else half
        _aim(mouths, turns, n, 0.0, angle, mouth, ray)
        _aim(mouths, turns, n, 1.0, angle, to_mouth, to_ray)
        reach = max(_follow(surface, height, mouth, ray, k, top, low)[0], 0.0)
        square = 0.0
        for a in range(3):
            square += (to_mouth[a] + reach * to_ray[a] - mouth[a] - reach * ray[a]) ** 2
        longest = max(longest, np.sqrt(square))
    return longest


@kernel
def _spray(
    surface: _Surface,
    volume: Array,
    height: Array,
    times: Array,
    mouths: Array,
    turns: Array,
    flows: Array,
    angle: float,
    rays: int,
    k: int,
) -> float:
    """Lays a path's sealant; changes volume and height, gives what missed."""
    strip, half = surface.strip, 0.5 * angle
    column = min(strip.arc[1] - strip.arc[0], strip.across[1] - strip.across[0])
    mouth, ray = np.empty(3), np.empty(3)
    low = surface.foot.min()
    firm, setting, since, top = height.copy(), height.copy(), 0.0, (surface.foot + height).max()
    missed, turn = 0.0, 0.0
    for n in range(len(times) - 1):
        travel = _travel(surface, firm, mouths, turns, n, half, k, top, low)
        pieces, lost = int(travel / (_STEP_COLUMNS * column)) + 1, 0.0
        for p in range(pieces):
            flow = flows[n] + (p + 0.5) / pieces * (flows[n + 1] - flows[n])
            amount = flow * (times[n + 1] - times[n]) / pieces / rays
            turn = (turn + _GOLDEN) % 1.0
            for i in range(rays):
                when = (p + (i * _GOLDEN) % 1.0) / pieces
                _aim(mouths, turns, n, when, angle * (i + turn) / rays - half, mouth, ray)
                reach, k, share, place = _follow(surface, firm, mouth, ray, k, top, low)
                if reach < 0.0:
                    lost += amount
                else:
                    lost += _drop(strip, volume, height, amount, k, share, place)
        missed += lost
        since += travel
        if since > _FRONT_M:
            firm, setting, since = setting, height.copy(), 0.0
            top = (surface.foot + firm).max()
    return missed


def _first_row(strip: Strip, mouth: Array, axis: Array) -> int:
    """The row of the foot that is nearest to the nozzle's axis."""
    off = strip.base - mouth
    ahead = np.maximum(off @ axis, 0.0)
    beside = np.sum((off - ahead[..., None] * axis) ** 2, axis=-1)
    return int(np.unravel_index(np.argmin(beside), beside.shape)[0])


def lay_path(
    strip: Strip,
    time_s: Array,
    position_m: Array,
    rotation: Array,
    flow_m3_per_s: Array,
    cfg: FanCfg | None = None,
) -> Laid:
    """Lays what a fan nozzle sprays along a timed path.

    Between two times position, direction and flow are linear. The flow through a column's area does not
    depend on the columns' size. Sealant is in the way of rays only once the fan has moved on by
    5 to 10 mm: a nozzle that stands still does not see its own heap.

    Args:
        strip: The columns, in the path's frame.
        time_s: Rising, shape (n,), s.
        position_m: Nozzle mouth, shape (n, 3), m.
        rotation: Columns are the tip frame's x (right of travel), y (along travel) and z (back along the
            nozzle), shape (n, 3, 3).
        flow_m3_per_s: Volume flow, shape (n,), m^3/s.
        cfg: The nozzle; the default one if none is given.

    Returns:
        The bead. What lies on the columns and what missed them add up to what was sprayed.

    Raises:
        ConfigError: If shapes do not fit, times do not rise, a flow is negative, something is not finite, or
            the nozzle turns too far from one time to the next.
    """
    cfg = cfg or FanCfg()
    times, mouths, turns, flows = (
        np.ascontiguousarray(x, dtype=np.float64) for x in (time_s, position_m, rotation, flow_m3_per_s)
    )
    n = times.size
    shapes = (times.shape, mouths.shape, turns.shape, flows.shape)
    wanted = ((n,), (n, 3), (n, 3, 3), (n,))
    require(
        n >= 2 and shapes == wanted,
        f"time_s, position_m, rotation and flow_m3_per_s have shapes {shapes}: must be {wanted}, with at "
        "least two times",
        ConfigError,
    )
    require(
        all(bool(np.all(np.isfinite(x))) for x in (times, mouths, turns, flows)),
        "time_s, position_m, rotation and flow_m3_per_s: must be finite",
        ConfigError,
    )
    require(bool(np.all(np.diff(times) > 0.0)), "time_s: must rise from entry to entry", ConfigError)
    require(
        bool(np.all(flows >= 0.0)),
        f"flow_m3_per_s: smallest {flows.min():g}: must not be negative",
        ConfigError,
    )
    # |R1 - R0| = 2 sqrt 2 sin(angle / 2) in the Frobenius norm.
    chord = np.linalg.norm(np.diff(turns, axis=0), axis=(1, 2)).max() / (2.0 * np.sqrt(2.0))
    turned = 2.0 * np.arcsin(min(float(chord), 1.0))
    require(
        turned <= _MOST_TURN_RAD,
        f"rotation: turns by {turned:.2g} rad from one time to the next: at most {_MOST_TURN_RAD} rad; "
        "sample the path more finely",
        ConfigError,
    )
    middle = strip.base[:, [strip.area.shape[1] // 2]]
    surface = _Surface(
        strip=strip,
        side=np.ascontiguousarray(cross(strip.along, strip.column)),
        foot=np.ascontiguousarray(np.sum((strip.base - middle) * strip.column[:, None], axis=2)),
    )
    volume, height = np.zeros_like(strip.area), np.zeros_like(strip.area)
    first = _first_row(strip, mouths[0], -turns[0, :, 2])
    missed = _spray(
        surface, volume, height, times, mouths, turns, flows, float(cfg.angle_rad), int(cfg.rays), first
    )
    return Laid(volume, height, float(missed), float(np.trapezoid(flows, times)))


def settled(strip: Strip, laid: Laid, sealant: Sealant, duration_s: float) -> Laid:
    """The bead some time after laying, when it has crept under its weight.

    A bead thinner than tau_y / (rho g), 15 mm for neutral silicone, stays as it was laid.

    Args:
        strip: The columns.
        laid: The bead.
        sealant: What it is made of.
        duration_s: For which it is left alone [s]; rounded up to thirtieths of a second.

    Returns:
        The bead then.

    Raises:
        ConfigError: If the duration is negative or not finite.
    """
    require(
        is_number(duration_s) and duration_s >= 0.0,
        f"duration_s = {duration_s!r}: must be a number of seconds >= 0",
        ConfigError,
    )
    volume, height = laid.volume.copy(), laid.height.copy()
    for _ in range(int(np.ceil(duration_s / _LEVEL_STEP_S - 1e-9))):
        level(
            strip,
            volume,
            height,
            _LEVEL_STEP_S,
            sealant.density_kg_m3,
            sealant.yield_stress_pa,
            sealant.consistency_pa_sn,
            1.0 / sealant.flow_index,
            0,
            len(strip.arc),
        )
    return laid._replace(volume=volume, height=height)
