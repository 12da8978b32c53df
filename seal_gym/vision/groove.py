"""A groove across its image: a dark band between two banks, whose middle is the seam.

Both banks are edges of the plate, the seam is half-way between them, and what lies between is darker: the
floor and, for a camera that looks in from the side, one of the walls, at another grey level. An edge detector
follows one of these edges. Here the whole section is fitted: four grey levels (plate, two bands, plate) with
three cuts between them, whose distances follow from the groove's size and the camera's place. One place is
left, found by Gauss-Newton steps in which the levels are solved for anew (variable projection, Kaufman, BIT
15, 1975). Levels are per pixel and pixels average over their width, so grooves of two pixels can be placed.
"""

from dataclasses import dataclass

import numpy as np

from seal_gym.core.errors import require
from seal_gym.core.frames import Array
from seal_gym.core.jit import kernel
from seal_gym.vision.features import ViewGeometry
from seal_gym.vision.strip_geometry import to_strip

__all__ = [
    "CUTS",
    "NO_GROOVE",
    "NO_SECTION",
    "SECTION",
    "GrooveCfg",
    "band_centre",
    "coarse_centre",
    "cuts_at",
    "section_of",
]

SECTION, CUTS = 9, 4  # numbers of a section, see ``section_of``, and of its cuts in a row
NO_SECTION = np.zeros(SECTION)
FLANK = 4  # pixels of the plate on either side that give its grey level

_GRID, _GRID_PX = 8, 0.125
_TURNS = 3
_LONGEST_PX = 0.25  # step
# Plate is about as bright as plate, the floor as dark as expected: variance of a profile's noise over that of
# what is expected, (2 / 20)^2 in grey levels. Where a band is narrower than a pixel or out of the picture the
# pixels do not tell its level.
_SAME_PLATE, _SAME_RATIO = 1e-2, 1e-2
_SMALL_M = 1e-4


@dataclass(frozen=True, kw_only=True)
class GrooveCfg:
    """Section of a groove.

    Attributes:
        width_m: From bank to bank [m].
        depth_m: From the plate to the floor [m].
        floor_share: How much darker than the plate the floor is, as a share of what a wall is. The lamp
            shines from above, along a wall and square on the floor. Decides only in grooves of less than
            four pixels, which do not show it.
    """

    width_m: float
    depth_m: float
    floor_share: float = 0.45

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for name in ("width_m", "depth_m"):
            value = getattr(self, name)
            require(0.0 < value < 0.05, f"GrooveCfg.{name} = {value!r}: must be within (0, 0.05) m")
        require(
            0.1 <= self.floor_share <= 10.0,
            f"GrooveCfg.floor_share = {self.floor_share!r}: must be within 0.1..10",
        )

    @property
    def numbers(self) -> tuple[float, float, float]:
        """The same as the kernels take them."""
        return float(self.width_m), float(self.depth_m), float(self.floor_share)


NO_GROOVE = (0.0, 0.0, 1.0)


@kernel
def section_of(
    p: Array,
    d: Array,
    n: Array,
    m: Array,
    view: int,
    g: ViewGeometry,
    groove: tuple[float, float, float],
    out: Array,
) -> bool:
    """What a view makes of a groove near a point of its seam (tip frame), to first order.

    Args:
        p: Point of the seam, shape (3,), m.
        d: Direction of travel, shape (3,).
        n: Normal of the plate, shape (3,).
        m: Across the seam in the plate, shape (3,).
        view: 0 front, 1 side.
        g: The cameras.
        groove: ``GrooveCfg.numbers``, or ``NO_GROOVE`` for a seam that is an edge.
        out: Filled with half the width, the depth [m], o and t of the strip [px] for a metre across, along
            and down, and the floor's share of darkness.

    Returns:
        False if the point is behind the camera.
    """
    for k in range(SECTION):
        out[k] = 0.0
    if groove[0] <= 0.0:
        return True
    a, b, x = np.empty(2), np.empty(2), np.empty(3)
    if not to_strip(p, view, g, a):
        return False
    for axis in range(3):
        for k in range(3):
            step = m[k] if axis == 0 else (d[k] if axis == 1 else -n[k])
            x[k] = p[k] + _SMALL_M * step
        if not to_strip(x, view, g, b):
            return False
        out[2 + 2 * axis], out[3 + 2 * axis] = (b[1] - a[1]) / _SMALL_M, (b[0] - a[0]) / _SMALL_M
    out[0], out[1], out[8] = 0.5 * groove[0], groove[1], groove[2]
    return True


@kernel
def cuts_at(section: Array, q: float, cut: Array) -> None:
    """Where left bank, corner of wall and floor, and right bank are in a row, from the middle [px].

    Args:
        section: From ``section_of``.
        q: Slope of the seam's image in the row: on a bend it differs from that of the section's direction.
        cut: Filled with the three, increasing, and how dark the second band is for each grey level that the
            first one is, shape (4,).
    """
    o_m, t_m, o_d, t_d, o_z, t_z = section[2], section[3], section[4], section[5], section[6], section[7]
    det = o_m * t_d - t_m * o_d
    # The direction (a across, b along) in the plate whose image has the slope q; banks are parallel to it.
    a, b = (t_d * q - o_d) / det, (o_m - t_m * q) / det
    half = section[0] * abs(det) * np.sqrt(a * a + b * b)
    down = section[1] * (o_z - q * t_z)
    cut[0], cut[2] = -half, half
    # From the right one looks at the left wall, down to the floor's corner, and the other way round.
    cut[1] = min(down - half, half) if down > 0.0 else max(down + half, -half)
    cut[3] = section[8] if down > 0.0 else 1.0 / section[8]


@kernel
def _share(low: float, high: float) -> float:
    """How much of the pixel [0, 1] lies between two places."""
    return max(0.0, min(high, 1.0) - max(low, 0.0))


@kernel
def _pixel(x: float, c: float, cut: Array, share: Array, slope: Array) -> None:
    """Shares of plate, bands and plate in the pixel [x, x + 1], and how they change with c."""
    left, middle, right = c + cut[0] - x, c + cut[1] - x, c + cut[2] - x
    share[0], share[1] = _share(-1e9, left), _share(left, middle)
    share[2], share[3] = _share(middle, right), _share(right, 1e9)
    in_left = 1.0 if 0.0 <= left < 1.0 else 0.0
    in_middle = 1.0 if 0.0 <= middle < 1.0 else 0.0
    in_right = 1.0 if 0.0 <= right < 1.0 else 0.0
    slope[0], slope[1] = in_left, in_middle - in_left
    slope[2], slope[3] = in_right - in_middle, -in_right


@kernel
def _factorise(a: Array) -> None:
    """Cholesky's factor of a positive definite matrix, in its lower triangle."""
    for i in range(4):
        for j in range(i + 1):
            total = a[i, j]
            for k in range(j):
                total -= a[i, k] * a[j, k]
            a[i, j] = np.sqrt(total) if i == j else total / a[j, j]


@kernel
def _solve(factor: Array, b: Array) -> None:
    """Solves with the factor, in place."""
    for i in range(4):
        for k in range(i):
            b[i] -= factor[i, k] * b[k]
        b[i] /= factor[i, i]
    for i in range(3, -1, -1):
        for k in range(i + 1, 4):
            b[i] -= factor[k, i] * b[k]
        b[i] /= factor[i, i]


@kernel
def _levels(profile: Array, low: int, high: int, c: float, cut: Array, a: Array, level: Array) -> float:
    """Solves for the four levels, leaves the factor of their normal equations in a, returns the misfit."""
    share, slope, right = np.empty(4), np.empty(4), np.zeros(4)
    for i in range(4):
        for j in range(4):
            a[i, j] = 1e-9 if i == j else 0.0
    a[0, 0] += _SAME_PLATE
    a[3, 3] += _SAME_PLATE
    a[3, 0] -= _SAME_PLATE
    # plate - second band = ratio (plate - first band)
    ratio = cut[3]
    share[0], share[1], share[2], share[3] = 1.0 - ratio, ratio, -1.0, 0.0
    for i in range(4):
        for j in range(i + 1):
            a[i, j] += _SAME_RATIO * share[i] * share[j]
    misfit = 0.0
    for k in range(low, high):
        _pixel(k, c, cut, share, slope)
        misfit += profile[k] * profile[k]
        for i in range(4):
            right[i] += share[i] * profile[k]
            for j in range(i + 1):
                a[i, j] += share[i] * share[j]
    level[:] = right
    _factorise(a)
    _solve(a, level)
    for i in range(4):
        misfit -= right[i] * level[i]
    return misfit


@kernel
def _step(profile: Array, low: int, high: int, c: float, cut: Array, level: Array, out: Array) -> None:
    """A Gauss-Newton step of the place, and what it is known by (out: step, information)."""
    a, pull = np.empty((4, 4)), np.zeros(4)
    share, slope = np.empty(4), np.empty(4)
    _levels(profile, low, high, c, cut, a, level)
    for k in range(low, high):
        _pixel(k, c, cut, share, slope)
        g = 0.0
        for i in range(4):
            g += slope[i] * level[i]
        for i in range(4):
            pull[i] += share[i] * g
    _solve(a, pull)
    gain = info = 0.0
    for k in range(low, high):
        _pixel(k, c, cut, share, slope)
        g = r = 0.0
        for i in range(4):
            g += slope[i] * level[i] - share[i] * pull[i]
            r += share[i] * level[i]
        gain += g * (profile[k] - r)
        info += g * g
    out[0], out[1] = gain / max(info, 1e-9), info


@kernel
def _best_of(profile: Array, low: int, high: int, c: float, cut: Array) -> float:
    """The place of least misfit on a grid: a groove of few pixels has several minima."""
    a, level = np.empty((4, 4)), np.empty(4)
    best, where = 1e300, c
    for step in range(-_GRID, _GRID + 1):
        at = c + step * _GRID_PX
        misfit = _levels(profile, low, high, at, cut, a, level)
        if misfit < best:
            best, where = misfit, at
    return where


@kernel
def coarse_centre(profile: Array, count: int, o: float, search: float, cut: Array, found: Array) -> bool:
    """Where a band of the section's width is darkest against the plate beside it.

    Args:
        profile: Grey levels.
        count: How many.
        o: Where the middle is expected, from the profile's start [px].
        search: How far from there [px].
        cut: From ``cuts_at``.
        found: Filled with the middle, to half a pixel, and the difference [grey levels].

    Returns:
        Whether there is a band darker than the plate.
    """
    found[1] = 0.0
    for step in range(int(np.ceil(-2.0 * search)), int(2.0 * search) + 1):
        c = o + 0.5 * step
        left, right = c + cut[0], c + cut[2]
        if left > count - 1 or right < 1.0 or c < 0.0:
            continue
        inside = outside = n_in = n_out = 0.0
        for k in range(max(int(left) - FLANK, 0), min(int(right) + FLANK + 2, count)):
            w = _share(left - k, right - k)
            inside += w * profile[k]
            n_in += w
            beside = 1.0 - w if left - FLANK < k + 0.5 < right + FLANK else 0.0
            outside += beside * profile[k]
            n_out += beside
        if n_in < 0.5 * (right - left) or n_out < FLANK - 1.0:
            continue
        score = outside / n_out - inside / n_in
        if score > found[1]:
            found[0], found[1] = c, score
    return bool(found[1] > 0.0)


@kernel
def band_centre(profile: Array, count: int, o: float, search: float, cut: Array, found: Array) -> bool:
    """The middle of a groove in a profile across it.

    Args:
        profile: Grey levels.
        count: How many.
        o: Where the middle is expected, from the profile's start [px].
        search: How far from there [px].
        cut: From ``cuts_at``.
        found: Filled with the place [px] and with how sure it is, as the step of an edge as sure [grey
            levels].

    Returns:
        Whether there is a band darker than the plate.
    """
    if not coarse_centre(profile, count, o, search, cut, found):
        return False
    c = found[0]
    level, out = np.empty(4), np.empty(2)
    low = max(int(np.floor(c + cut[0])) - FLANK, 0)
    high = min(int(np.ceil(c + cut[2])) + FLANK, count)
    c = _best_of(profile, low, high, c, cut)
    for _ in range(_TURNS):
        _step(profile, low, high, c, cut, level, out)
        c += min(max(out[0], -_LONGEST_PX), _LONGEST_PX)
    found[0], found[1] = c, np.sqrt(max(out[1], 0.0))
    dark = (level[1] * (cut[1] - cut[0]) + level[2] * (cut[2] - cut[1])) / (cut[2] - cut[0])
    return bool(0.5 * (level[0] + level[3]) > dark)
