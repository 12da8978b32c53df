"""The seam in a depth profile: the corner of two lines in a fillet, the middle of a groove.

Median filter, split and merge into lines, their intersection; or the midpoint of the two steepest places
(after Manorathna et al. 2014, Zhou et al.'s reference 19).
"""

from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import is_number, require
from seal_gym.core.frames import Array

_TRIMS = 5
_MAD_TO_SIGMA = 1.4826
_PLATE_SHARE = 0.6


@dataclass(frozen=True, kw_only=True)
class SeamPointCfg:
    """How the seam is found in a profile.

    Attributes:
        median: Points in the median filter, odd.
        tolerance_m: A line is split where the profile is farther from it [m].
        min_points: Of a line.
        trim: Points left out at either end of a line: the median filter rounds corners.
        turn_rad: Smallest and largest turn from one line to the next that is a fillet [rad].
        gap_m: Largest distance from a line's end to the corner [m].
        groove_depth_m: What is deeper below the plate belongs to a groove [m].
        groove_width_m: Smallest and largest width of a groove [m].
    """

    median: int = 3
    tolerance_m: float = 2.5e-4
    min_points: int = 6
    trim: int = 1
    turn_rad: tuple[float, float] = (float(np.deg2rad(50.0)), float(np.deg2rad(140.0)))
    gap_m: float = 2e-3
    groove_depth_m: float = 4e-4
    groove_width_m: tuple[float, float] = (3e-4, 4e-3)

    def __post_init__(self) -> None:
        """Checks the ranges."""
        require(
            is_number(self.median) and self.median >= 1 and self.median % 2 == 1,
            f"SeamPointCfg.median = {self.median!r}: must be odd and >= 1",
        )
        require(
            is_number(self.trim) and self.trim >= 0,
            f"SeamPointCfg.trim = {self.trim!r}: must be >= 0",
        )
        require(
            is_number(self.min_points) and self.min_points >= 2 * self.trim + 3,
            f"SeamPointCfg.min_points = {self.min_points!r}: must be >= 2 trim + 3 = {2 * self.trim + 3}",
        )
        for name in ("tolerance_m", "gap_m", "groove_depth_m"):
            value = getattr(self, name)
            require(is_number(value) and value > 0, f"SeamPointCfg.{name} = {value!r}: must be > 0")
        for name in ("turn_rad", "groove_width_m"):
            low, high = getattr(self, name)
            require(0 < low < high, f"SeamPointCfg.{name} = {(low, high)!r}: must be 0 < smallest < largest")


class Fix(NamedTuple):
    """Where the seam is in a profile.

    Attributes:
        across_m: [m].
        depth_m: [m].
        points: Of the shorter line, or of the groove.
    """

    across_m: float
    depth_m: float
    points: int


class Line(NamedTuple):
    """A straight stretch of a profile.

    Attributes:
        first: Its first point, shape (2,), m.
        last: Its last point, shape (2,), m.
        centre: Mean of its points, shape (2,), m.
        direction: Unit vector from left to right, shape (2,).
        points: How many.
    """

    first: Array
    last: Array
    centre: Array
    direction: Array
    points: int


def find_seam(across_m: Array, depth_m: Array, cfg: SeamPointCfg | None = None) -> Fix | None:
    """The seam in one profile: a groove's middle, or else a fillet's corner.

    The groove comes first: its floor and a bank make hollow corners of their own.

    Args:
        across_m: Shape (points,), NaN where there is none, m.
        depth_m: Shape (points,), NaN where there is none, m.
        cfg: Parameters.

    Returns:
        The seam, or None if neither is there.
    """
    cfg = cfg or SeamPointCfg()
    valid = np.isfinite(depth_m)
    if valid.sum() < 2 * cfg.min_points:
        return None
    profile = np.column_stack((across_m[valid], median_filter(depth_m[valid], cfg.median)))
    return groove(profile, cfg) or fillet(split(profile, cfg), cfg)


def median_filter(values: Array, width: int) -> Array:
    """Running median; the ends repeat their last value.

    Args:
        values: Shape (n,).
        width: Odd.

    Returns:
        Shape (n,).
    """
    padded = np.pad(values, width // 2, mode="edge")
    return np.asarray(np.median(np.lib.stride_tricks.sliding_window_view(padded, width), axis=-1))


def split(profile: Array, cfg: SeamPointCfg) -> list[Line]:
    """Lines of a profile by split and merge (Duda and Hart's iterative end-point fit, then least squares).

    Args:
        profile: Points from left to right, shape (n, 2), m.
        cfg: Parameters.

    Returns:
        The lines of at least ``min_points``, from left to right.
    """
    cuts, spans = {0, len(profile) - 1}, [(0, len(profile) - 1)]
    while spans:
        a, b = spans.pop()
        if b - a < 2:
            continue
        chord = profile[b] - profile[a]
        off = profile[a + 1 : b] - profile[a]
        distance = np.abs(off[:, 0] * chord[1] - off[:, 1] * chord[0]) / max(float(np.hypot(*chord)), 1e-12)
        if distance.max() > cfg.tolerance_m:
            middle = a + 1 + int(np.argmax(distance))
            cuts.add(middle)
            spans += [(a, middle), (middle, b)]
    pieces = _merged(profile, sorted(cuts), cfg)
    return [fit_line(profile[a : b + 1], cfg.trim) for a, b in pieces if b - a + 1 >= cfg.min_points]


def _merged(profile: Array, cuts: list[int], cfg: SeamPointCfg) -> list[tuple[int, int]]:
    """Neighbouring pieces that one line fits within the tolerance, put together."""
    pieces: list[tuple[int, int]] = []
    for piece in pairwise(cuts):
        if pieces:
            whole = (pieces[-1][0], piece[1])
            stretch = profile[whole[0] : whole[1] + 1]
            line = fit_line(stretch, 0)
            off = stretch - line.centre
            distance = np.abs(off[:, 0] * line.direction[1] - off[:, 1] * line.direction[0])
            if distance.max() <= cfg.tolerance_m:
                pieces[-1] = whole
                continue
        pieces.append(piece)
    return pieces


def fit_line(points: Array, trim: int) -> Line:
    """Total least squares through a stretch without its ends.

    Args:
        points: From left to right, shape (n, 2), m.
        trim: Points left out at either end, fewer than n / 2 - 1.

    Returns:
        The line.
    """
    kept = points[trim : len(points) - trim]
    centre = kept.mean(axis=0)
    a, d = (kept - centre).T
    # Angle of the principal axis of the 2 x 2 scatter matrix.
    angle = 0.5 * np.arctan2(2.0 * float(a @ d), float(a @ a - d @ d))
    direction = np.array([np.cos(angle), np.sin(angle)])
    if direction @ (kept[-1] - kept[0]) < 0:
        direction = -direction
    return Line(points[0], points[-1], centre, direction, len(points))


def fillet(lines: list[Line], cfg: SeamPointCfg) -> Fix | None:
    """The hollow corner between two lines with the most points; noise may leave short pieces between them.

    Args:
        lines: From left to right.
        cfg: Parameters.

    Returns:
        The intersection, or None if no two lines make a hollow corner.
    """
    best: Fix | None = None
    for left, right in combinations(lines, 2):
        turn = _cross(right.direction, left.direction)
        angle = np.arctan2(turn, float(left.direction @ right.direction))
        if not cfg.turn_rad[0] <= angle <= cfg.turn_rad[1]:
            continue
        along = _cross(right.centre - left.centre, right.direction) / -turn
        corner = left.centre + along * left.direction
        gap = max(np.hypot(*(corner - left.last)), np.hypot(*(corner - right.first)))
        points = min(left.points, right.points)
        if gap <= cfg.gap_m and (best is None or points > best.points):
            best = Fix(float(corner[0]), float(corner[1]), points)
    return best


def groove(profile: Array, cfg: SeamPointCfg) -> Fix | None:
    """The middle between the two banks of a groove in a plate, at the plate's surface.

    Args:
        profile: Points from left to right, shape (n, 2), m.
        cfg: Parameters.

    Returns:
        The middle, or None if most points are on no one line, or no stretch of the right width lies deep
        enough below it.
    """
    centre, slope = _plate(profile)
    below = profile[:, 1] - centre[1] - slope * (profile[:, 0] - centre[0])
    if np.mean(np.abs(below) <= cfg.tolerance_m) < _PLATE_SHARE:
        return None
    edges = np.flatnonzero(np.diff((below > cfg.groove_depth_m).astype(np.int8)))
    best: tuple[float, Fix] | None = None
    for i, j in pairwise(edges):
        if below[i] > cfg.groove_depth_m:
            continue  # from a groove's right bank to the next one's left
        left = 0.5 * (profile[i, 0] + profile[i + 1, 0])
        right = 0.5 * (profile[j, 0] + profile[j + 1, 0])
        depth = float(below[i + 1 : j + 1].max())
        if cfg.groove_width_m[0] <= right - left <= cfg.groove_width_m[1] and (not best or depth > best[0]):
            middle = 0.5 * (left + right)
            surface = float(centre[1] + slope * (middle - centre[0]))
            best = (depth, Fix(float(middle), surface, int(j - i)))
    return best[1] if best else None


def _plate(profile: Array) -> tuple[Array, float]:
    """Robust line of depth over across: least squares, without what is beyond three sigma of the rest."""
    kept: NDArray[np.bool_] = np.ones(len(profile), np.bool_)
    centre, slope = profile.mean(axis=0), 0.0
    for _ in range(_TRIMS):
        a, d = profile[kept].T
        centre = np.array([a.mean(), d.mean()])
        slope = float(
            (a - centre[0]) @ (d - centre[1]) / max(float((a - centre[0]) @ (a - centre[0])), 1e-18)
        )
        off = np.abs(profile[:, 1] - centre[1] - slope * (profile[:, 0] - centre[0]))
        kept = off <= max(3.0 * _MAD_TO_SIGMA * float(np.median(off)), 1e-9)
    return centre, slope


def _cross(a: Array, b: Array) -> float:
    return float(a[0] * b[1] - a[1] * b[0])
