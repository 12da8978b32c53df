"""The seam's line in one image: RANSAC on edge pixels, sub-pixel edges row by row, a local curve at the tip.

Both views are worked on as *strips*: rows along the travel, columns across it, with the brighter plate at the
larger column. The front view upside down is a strip, and so is the transposed side view. A line is written
``o = p + q (t - t_ref)`` with t along and o across, which does not jump as end points do.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import require
from seal_gym.core.frames import Array
from seal_gym.core.jit import kernel
from seal_gym.vision.edges import EdgeDetector, grey_sum
from seal_gym.vision.groove import CUTS, NO_SECTION, band_centre, coarse_centre, cuts_at
from seal_gym.vision.groove import FLANK as PLATE_FLANK

Grey = NDArray[np.int64]
Mask = NDArray[np.bool_]

_HALF_ROWS = 2  # a row's profile is the mean of five rows along the edge
_FLANK = 3  # pixels on either side that give the two grey levels
_GAP = 3  # rows without an edge that a chain passes over
_MAX_POINTS = 1024
_HALF_PROFILE = 31  # of what a profile holds
# Where a bend's seam crosses the rows aslant, the middle between the banks along a row is off the seam: by
# h^2 q^2 sqrt(1 + q^2) / 2R with half the width h, 0.08 mm at this slope in a groove of 2 mm round 5 mm.
_STEEPEST = 0.8
_LEAST_BESIDE_PX = 0.5
NARROW_PX = 4.0  # of a groove this wide or wider one bank is enough
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_S27, _S30, _S31, _S33 = (np.uint64(k) for k in (27, 30, 31, 33))


@dataclass(frozen=True, kw_only=True)
class LineCfg:
    """Parameters of the line stage.

    Attributes:
        bright_side: +1 if the plate (larger column of the strip) is the brighter side, -1 if the darker.
        hypotheses: Pairs of pixels that RANSAC tries.
        inlier_px: Largest distance of an inlier [px].
        max_slope: Of a line against the travel.
        reach_px: Pixels this far from the tip count half in RANSAC's vote.
        min_contrast: Smallest step of an edge [grey levels].
        min_points: Rows with an edge that make a line.
        search_px: How far from its expected place a row's edge is looked for.
        window_px: Length of the local curve on either side of the tip.
        seed: Of RANSAC's draws, the same in each frame.
    """

    bright_side: int = 1
    hypotheses: int = 96
    inlier_px: float = 1.5
    max_slope: float = 1.2
    reach_px: float = 40.0
    min_contrast: float = 8.0
    min_points: int = 12
    search_px: float = 3.0
    window_px: float = 30.0
    seed: int = 1

    def __post_init__(self) -> None:
        """Checks the ranges."""
        require(self.bright_side in (-1, 1), f"LineCfg.bright_side = {self.bright_side!r}: must be -1 or 1")
        for name, low, high in (("hypotheses", 1, 10_000), ("min_points", 4, 1000), ("seed", 0, 2**31)):
            value = getattr(self, name)
            require(
                int(value) == value and low <= value <= high,
                f"LineCfg.{name} = {value!r}: must be a whole number in {low}..{high}",
            )
        for name, top in (("inlier_px", 20.0), ("max_slope", 5.0), ("reach_px", 1e3), ("min_contrast", 255.0),
                          ("search_px", 8.0), ("window_px", 1e3)):  # fmt: skip
            value = getattr(self, name)
            require(0.0 < value <= top, f"LineCfg.{name} = {value!r}: must be within (0, {top}]")

    @property
    def numbers(self) -> "LineNumbers":
        """The same as the kernels take them."""
        return LineNumbers(*(float(getattr(self, name)) for name in LineNumbers._fields))


class LineNumbers(NamedTuple):
    """``LineCfg`` as the kernels take it; see there."""

    bright_side: float
    hypotheses: float
    inlier_px: float
    max_slope: float
    reach_px: float
    min_contrast: float
    min_points: float
    search_px: float
    window_px: float
    seed: float


class StripLine(NamedTuple):
    """The line of N strips.

    Attributes:
        line: p, q of the tangent at the seam's point nearest the reference, and its t, shape (N, 3), px.
        raw: p, q of RANSAC's unrefined line, NaN where it found none, shape (N, 2), px.
        confidence: Mean step of the edges found [grey levels]; 0 without a line, shape (N,).
        valid: Whether there is a line, shape (N,).
    """

    line: Array
    raw: Array
    confidence: Array
    valid: Mask


def strips(front: NDArray[np.uint8], side: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Both views as strips.

    Args:
        front: Shape (N, height, width, 3).
        side: Likewise.

    Returns:
        Strips, shape (N, length, width, 3).
    """
    return np.ascontiguousarray(front[:, ::-1]), np.ascontiguousarray(side.transpose(0, 2, 1, 3))


def dilated(alpha: tuple[Array, Array], margin: int = 2) -> tuple[Mask, Mask]:
    """The nozzle's mask in either strip, with a margin for the blur and the reach of the masks.

    Args:
        alpha: The nozzle's coverage of each pixel, front and side, shape (height, width).
        margin: In pixels.

    Returns:
        True where the nozzle may be.
    """
    out = []
    for raw in (alpha[0][::-1], alpha[1].T):
        hit = raw > 0.005
        wide = np.pad(hit, margin)
        height, width = hit.shape
        k = 2 * margin + 1
        out.append(
            np.logical_or.reduce([wide[i : i + height, j : j + width] for i in range(k) for j in range(k)])
        )
    return out[0], out[1]


@kernel
def _random(word: np.uint64) -> np.uint64:
    z = word
    z = (z ^ (z >> _S30)) * _MIX_1
    z = (z ^ (z >> _S27)) * _MIX_2
    return z ^ (z >> _S31)


@kernel
def _profile(grey: Grey, row: int, q: float, first: int, count: int, sign: float, profile: Array) -> bool:
    """Mean of a few rows along the edge, brighter to the right; False without enough rows."""
    height, width = grey.shape
    for k in range(count):
        profile[k] = 0.0
    rows = 0
    for y in range(max(row - _HALF_ROWS, 0), min(row + _HALF_ROWS + 1, height)):
        shift = q * (y - row)
        whole = int(np.floor(shift))
        part = shift - whole
        if first + whole < 0 or first + count + whole + 1 > width:
            continue
        rows += 1
        for k in range(count):
            x = first + k + whole
            profile[k] += (1.0 - part) * grey[y, x] + part * grey[y, min(x + 1, width - 1)]
    if rows < 2:
        return False
    for k in range(count):
        profile[k] *= sign / (3.0 * rows)
    return True


@kernel
def _boundary(profile: Array, count: int, first: int, o: float, search: float) -> int:
    """The boundary between two pixels of a profile with the largest step up, or -1."""
    best, where = 0.0, -1
    for b in range(_FLANK, count - _FLANK + 1):
        if abs(first + b - o) > search + 0.5:
            continue
        step = 0.0
        for k in range(_FLANK):
            step += profile[b + k] - profile[b - 1 - k]
        if step > best:
            best, where = step, b
    return where


@kernel
def _place(profile: Array, count: int, where: int, found: Array) -> None:
    """Sub-pixel place and step of the edge at a boundary of the profile."""
    low = high = 0.0
    n_low = n_high = 0
    # The pixels beside the boundary hold the edge itself: the levels are those beyond them.
    for k in range(1, _FLANK + 1):
        if where - 1 - k >= 0:
            low += profile[where - 1 - k]
            n_low += 1
        if where + k < count:
            high += profile[where + k]
            n_high += 1
    low /= n_low
    high /= n_high
    found[0], found[1] = 0.0, high - low
    if high <= low:
        return
    # Each pixel of the transition is on the darker side to the share that the edge lies behind it.
    found[0] = where - 2.0
    for k in range(where - 2, where + 2):
        found[0] += 0.5 if k < 0 or k >= count else (high - profile[k]) / (high - low)


@kernel
def _allowed(mask: Mask, edge: Mask, row: int, column: int) -> bool:
    """Whether the edge stage found an edge here, and the nozzle is not near."""
    height, width = mask.shape
    for y in range(max(row - 1, 0), min(row + 2, height)):
        for x in range(max(column - 3, 0), min(column + 4, width)):
            if mask[y, x]:
                return False
    seen = False
    for x in range(max(column - 1, 0), min(column + 2, width)):
        seen = seen or edge[row, x]
    return bool(seen)


@kernel
def _bank_seen(edge: Mask, row: int, o: float, cut: Array) -> bool:
    """Whether the edge stage found one of the banks."""
    seen = False
    for side in range(0, 3, 2):
        bank = int(np.floor(o + cut[side]))
        for x in range(max(bank - 1, 0), min(bank + 2, edge.shape[1])):
            seen = seen or edge[row, x]
    return bool(seen)


@kernel
def _free_stretch(mask: Mask, row: int, middle: int, half: int, border: int) -> tuple[int, int]:
    """First and last + 1 column round the middle that the nozzle leaves free; the same if there is none."""
    low, high = max(middle - half, border), min(middle + half, mask.shape[1] - border)
    first = last = middle
    if not low <= middle <= high:
        return first, last
    while first > low and not mask[row, first - 1]:
        first -= 1
    while last < high and not mask[row, last]:
        last += 1
    # The profile's outer rows reach beyond the mask's margin.
    if first > low:
        first += 1
    if last < high:
        last -= 1
    return first, last


@kernel
def _covered(mask: Mask, row: int, o: float, cut: Array) -> bool:
    """Whether the nozzle hides a bank that is needed: a groove of a few pixels has to show both."""
    if cut[2] - cut[0] >= NARROW_PX:
        return False
    first, last = int(o + cut[0]) - PLATE_FLANK, int(o + cut[2]) + PLATE_FLANK + 1
    covered = False
    for x in range(max(first, 0), min(last, mask.shape[1])):
        covered = covered or mask[row, x]
    return bool(covered)


@kernel
def _row_groove(
    grey: Grey,
    mask: Mask,
    edge: Mask,
    row: int,
    o: float,
    q: float,
    search: float,
    section: Array,
    par: LineNumbers,
    profile: Array,
    found: Array,
) -> bool:
    """``row_edge`` of a groove: its middle."""
    if abs(q) > _STEEPEST:
        return False
    cut = np.empty(CUTS)
    cuts_at(section, q, cut)
    half = min(int(search + cut[2]) + PLATE_FLANK + 2, _HALF_PROFILE)
    # So far from the border that all of a profile's rows, sheared, are in the strip.
    border = int(_HALF_ROWS * abs(q)) + 1
    first, last = _free_stretch(mask, row, int(np.floor(o + 0.5)), half, border)
    count = last - first
    # A bank may be hidden, the middle may not.
    if count < 2 * _FLANK or abs(o - 0.5 * (first + last)) > 0.5 * count - _LEAST_BESIDE_PX:
        return False
    if not _profile(grey, row, q, first, count, 1.0, profile):
        return False
    if not band_centre(profile, count, o - first, search, cut, found):
        return False
    found[0] += first
    if found[1] < par.min_contrast or abs(found[0] - o) > search + 1.0:
        return False
    return bool(_bank_seen(edge, row, found[0], cut) and not _covered(mask, row, found[0], cut))


@kernel
def row_edge(
    grey: Grey,
    mask: Mask,
    edge: Mask,
    row: int,
    o: float,
    q: float,
    search: float,
    section: Array,
    par: LineNumbers,
    profile: Array,
    found: Array,
) -> bool:
    """The edge, or a groove's middle, near its expected place in a row, to a fraction of a pixel.

    Args:
        grey: The strip's sum of channels.
        mask: Where the nozzle is.
        edge: Where the edge stage found an edge.
        row: The row; its centre is at t = row + 0.5.
        o: Where the edge is expected in it.
        q: The edge's slope: the profile is a mean along it.
        search: How far from there [px].
        section: Of the groove; ``NO_SECTION`` for an edge.
        par: ``LineCfg.numbers``.
        profile: Scratch, at least 64 long.
        found: Filled with the place [px] and the step [grey levels].

    Returns:
        Whether there is one.
    """
    height, width = grey.shape
    if row < 0 or row >= height or not abs(o) < 2.0 * width:
        return False
    if section[0] > 0.0:
        return bool(_row_groove(grey, mask, edge, row, o, q, search, section, par, profile, found))
    half = int(search) + 1 + _FLANK
    middle = int(np.floor(o + 0.5))  # a boundary between the pixels middle - 1 and middle
    # Near the border: as much of the search as there is.
    first, last = max(middle - half, 0), min(middle + half, width)
    count = last - first
    if count < 2 * _FLANK or not _profile(grey, row, q, first, count, par.bright_side, profile):
        return False
    where = _boundary(profile, count, first, o, search)
    if where < 0:
        return False
    _place(profile, count, where, found)
    found[0] += first
    if found[1] < par.min_contrast or abs(found[0] - o) > search + 1.0:
        return False
    return bool(_allowed(mask, edge, row, min(max(int(found[0]), 0), width - 1)))


@kernel
def follow(
    grey: Grey,
    mask: Mask,
    edge: Mask,
    t_ref: float,
    p: float,
    q: float,
    ahead: float,
    behind: float,
    section: Array,
    par: LineNumbers,
    profile: Array,
    points: Array,
) -> int:
    """Follows the edge, or the groove's middle, from the reference row ahead, then behind.

    Args:
        grey: The strip's sum of channels.
        mask: Where the nozzle is.
        edge: Where the edge stage found an edge.
        t_ref: The reference's t [px].
        p: Expected place of the edge at the reference [px].
        q: Expected slope there.
        ahead: How far to go ahead [px].
        behind: How far to go back [px].
        section: Of the groove; ``NO_SECTION`` for an edge.
        par: ``LineCfg.numbers``.
        profile: Scratch.
        points: Filled with rows t - t_ref, o, step.

    Returns:
        Number of points.
    """
    found = np.empty(2)
    count = 0
    # From above a bend turns faster in the picture than in a fillet, and a groove's rows are surer.
    place_gain, slope_gain = (0.7, 0.15) if section[0] > 0.0 else (0.5, 0.06)
    start = int(t_ref)
    for way in (1, -1):
        o, slope = p + q * (start + 0.5 - t_ref), q
        row, missed = start, 0
        if way < 0:
            row -= 1
            o -= q
        reach = ahead if way > 0 else behind
        hits = 0
        while abs(row + 0.5 - t_ref) <= reach and missed <= _GAP + 20 * (hits == 0) and abs(slope) < 2.0:
            search = par.search_px if hits == 0 else min(par.search_px, 1.5)
            if count < len(points) and row_edge(
                grey, mask, edge, row, o, slope, search, section, par, profile, found
            ):
                error = found[0] - o
                o += place_gain * error
                slope += way * slope_gain * error
                points[count, 0], points[count, 1], points[count, 2] = row + 0.5 - t_ref, found[0], found[1]
                count += 1
                hits += 1
                missed = 0
            else:
                missed += 1
            o += way * slope
            row += way
    return count


@kernel
def fit_curve(
    y: Array, x: Array, w: Array, n: int, prior: tuple[float, float, float], clip: float, out: Array
) -> float:
    """Weighted least squares of x = out[0] + out[1] y + out[2] y^2, outliers weighed down.

    Args:
        y: Abscissae.
        x: Ordinates.
        w: Weights, inverse variances.
        n: How many.
        prior: Inverse variances of out about 0.
        clip: Residuals beyond this weigh less.
        out: The coefficients.

    Returns:
        The sum of the weights in the end, or 0 if there is no curve.
    """
    total = 0.0
    for turn in range(3):
        s0 = s1 = s2 = s3 = s4 = b0 = b1 = b2 = 0.0
        for k in range(n):
            weight = w[k]
            if turn > 0:
                r = abs(x[k] - (out[0] + out[1] * y[k] + out[2] * y[k] * y[k]))
                if r > clip:
                    weight *= (clip / r) ** 2
            u = weight * y[k]
            uu = u * y[k]
            s0 += weight
            s1 += u
            s2 += uu
            s3 += uu * y[k]
            s4 += uu * y[k] * y[k]
            b0 += weight * x[k]
            b1 += u * x[k]
            b2 += uu * x[k]
        total = s0
        s0 += prior[0]
        s4 += prior[2]
        # Cholesky's factors of the three normal equations.
        if total <= 0.0:
            return 0.0
        l0 = np.sqrt(s0)
        l1, l2 = s1 / l0, s2 / l0
        d1 = s2 + prior[1] - l1 * l1
        if d1 <= 1e-12 * s2:
            return 0.0
        m1 = np.sqrt(d1)
        m2 = (s3 - l1 * l2) / m1
        d2 = s4 - l2 * l2 - m2 * m2
        if d2 <= 1e-14 * s4:
            return 0.0
        k2 = np.sqrt(d2)
        z0 = b0 / l0
        z1 = (b1 - l1 * z0) / m1
        z2 = (b2 - l2 * z0 - m2 * z1) / k2
        out[2] = z2 / k2
        out[1] = (z1 - m2 * out[2]) / m1
        out[0] = (z0 - l1 * out[1] - l2 * out[2]) / l0
    return total


@kernel
def _ransac(t: Array, o: Array, vote: Array, n: int, par: LineNumbers, seed: np.uint64, line: Array) -> float:
    """The line with the most votes, then fitted to its inliers; returns their votes."""
    best = 0.0
    word = seed
    inlier, max_slope = par.inlier_px, par.max_slope
    for _ in range(int(par.hypotheses)):
        word += _GOLDEN
        r = _random(word)
        i, j = int((r >> _S33) % np.uint64(n)), int((r & np.uint64(0x7FFFFFFF)) % np.uint64(n))
        dt = t[j] - t[i]
        if abs(dt) < 5.0:
            continue
        q = (o[j] - o[i]) / dt
        if abs(q) > max_slope:
            continue
        p = o[i] - q * t[i]
        reach = inlier * np.sqrt(1.0 + q * q)
        votes = 0.0
        for k in range(n):
            if abs(o[k] - p - q * t[k]) <= reach:
                votes += vote[k]
        if votes > best:
            best, line[0], line[1] = votes, p, q
    if best <= 0.0:
        return 0.0
    s0 = s1 = s2 = b0 = b1 = 0.0
    for k in range(n):
        if abs(o[k] - line[0] - line[1] * t[k]) <= inlier * np.sqrt(1.0 + line[1] * line[1]):
            s0 += vote[k]
            s1 += vote[k] * t[k]
            s2 += vote[k] * t[k] * t[k]
            b0 += vote[k] * o[k]
            b1 += vote[k] * o[k] * t[k]
    det = s0 * s2 - s1 * s1
    if det > 1e-9 * s0 * s2:
        line[0], line[1] = (b0 * s2 - b1 * s1) / det, (b1 * s0 - b0 * s1) / det
    return best


@kernel
def ransac_line(
    edge: Mask,
    mask: Mask,
    intensity: Array,
    ex: Array,
    ey: Array,
    t_ref: float,
    par: LineNumbers,
    line: Array,
) -> bool:
    """The line through the edge pixels of the expected polarity that are not the nozzle's.

    Args:
        edge: Where the edge stage found an edge.
        mask: Where the nozzle is.
        intensity: Edge intensity.
        ex: Edge vector across the strip.
        ey: Edge vector along the strip.
        t_ref: The reference's t [px].
        par: ``LineCfg.numbers``.
        line: p and q, filled.

    Returns:
        Whether there is one.
    """
    t, o, vote = np.empty(_MAX_POINTS), np.empty(_MAX_POINTS), np.empty(_MAX_POINTS)
    n = 0
    height, width = edge.shape
    # The rows and columns at the border have masks that reach out of the picture.
    for i in range(1, height - 1):
        for j in range(1, width - 1):
            if not edge[i, j] or mask[i, j] or n >= _MAX_POINTS:
                continue
            across = along = 0.0
            for y in range(i - 1, i + 2):
                for x in range(j - 1, j + 2):
                    across += ex[y, x]
                    along += ey[y, x]
            if par.bright_side * across <= 0.5 * abs(along):
                continue
            t[n], o[n] = i + 0.5 - t_ref, j + 0.5
            vote[n] = intensity[i, j] / (1.0 + (t[n] / par.reach_px) ** 2)
            n += 1
    if n < par.min_points:
        return False
    return bool(_ransac(t, o, vote, n, par, np.uint64(int(par.seed)), line) > 0.0)


@kernel
def groove_line(
    grey: Grey,
    mask: Mask,
    edge: Mask,
    t_ref: float,
    section: Array,
    par: LineNumbers,
    profile: Array,
    line: Array,
) -> bool:
    """The line through the darkest bands as wide as the groove, one a row.

    Args:
        grey: The strip's sum of channels.
        mask: Where the nozzle is.
        edge: Where the edge stage found an edge.
        t_ref: The reference's t [px].
        section: Of the groove.
        par: ``LineCfg.numbers``.
        profile: Scratch.
        line: p and q, filled.

    Returns:
        Whether there is one.
    """
    t, o, vote = np.empty(_MAX_POINTS), np.empty(_MAX_POINTS), np.empty(_MAX_POINTS)
    cut, found = np.empty(CUTS), np.empty(2)
    cuts_at(section, 0.0, cut)
    height, width = grey.shape
    n = 0
    for row in range(min(height, _MAX_POINTS)):
        left = right = 0
        # The widest stretch of the row beside the nozzle.
        x = 0
        while x < width:
            first = x
            while x < width and not mask[row, x]:
                x += 1
            if x - first > right - left:
                left, right = first, x
            x += 1
        count = min(right, width - 1, left + 2 * _HALF_PROFILE) - left
        if count < 2 * _FLANK or not _profile(grey, row, 0.0, left, count, 1.0, profile):
            continue
        if not coarse_centre(profile, count, 0.5 * count, 0.5 * count, cut, found):
            continue
        o[n] = left + found[0]
        if found[1] < par.min_contrast or not _bank_seen(edge, row, o[n], cut):
            continue
        t[n] = row + 0.5 - t_ref
        vote[n] = found[1] / (1.0 + (t[n] / par.reach_px) ** 2)
        n += 1
    if n < par.min_points:
        return False
    return bool(_ransac(t, o, vote, n, par, np.uint64(int(par.seed)), line) > 0.0)


@kernel
def local_line(
    points: Array, n: int, t_ref: float, o_ref: float, p: float, par: LineNumbers, work: Array, line: Array
) -> float:
    """Tangent of the local curve at its point nearest the reference; returns the mean step, 0 without."""
    if n < par.min_points:
        return 0.0
    step = 0.0
    window = par.window_px
    # Abscissae in windows keep the equations well conditioned.
    for k in range(n):
        u = points[k, 0] / window
        work[0, k], work[1, k] = u, points[k, 1] - p
        work[2, k] = 1.0 / (1.0 + 2.0 * u * u)
        step += points[k, 2]
    curve = np.zeros(3)
    if fit_curve(work[0], work[1], work[2], n, (0.0, 0.0, 0.01), 1.0, curve) <= 0.0:
        return 0.0
    c0, c1, c2 = p + curve[0] - o_ref, curve[1] / window, curve[2] / (window * window)
    s = 0.0
    for _ in range(5):
        x, slope = c0 + (c1 + c2 * s) * s, c1 + 2.0 * c2 * s
        s -= (s + x * slope) / max(0.5, 1.0 + slope * slope + 2.0 * c2 * x)
        s = min(max(s, -0.5 * window), 0.5 * window)
    q = c1 + 2.0 * c2 * s
    line[0], line[1], line[2] = o_ref + c0 + (c1 + c2 * s) * s - q * s, q, s
    return step / n


@kernel
def _find_batch(
    images: NDArray[np.uint8],
    mask: Mask,
    reference: Array,
    vector: Array,
    intensity: Array,
    edge: Mask,
    par: LineNumbers,
    line: Array,
    raw: Array,
    confidence: Array,
    valid: Mask,
) -> None:
    n, height, width = images.shape[:3]
    grey = np.empty((height, width), np.int64)
    ex, ey = np.empty((height, width)), np.empty((height, width))
    profile, points, columns = np.empty(64), np.empty((2 * height, 3)), np.empty((3, 2 * height))
    for k in range(n):
        valid[k], confidence[k] = False, 0.0
        for i in range(height):
            for j in range(width):
                ex[i, j], ey[i, j] = vector[k, i, j, 0], vector[k, i, j, 1]
        if not ransac_line(edge[k], mask, intensity[k], ex, ey, reference[0], par, raw[k]):
            continue
        grey_sum(images[k], grey)
        p, q = raw[k, 0], raw[k, 1]
        count = follow(
            grey,
            mask,
            edge[k],
            reference[0],
            p,
            q,
            par.window_px,
            par.window_px,
            NO_SECTION,
            par,
            profile,
            points,
        )
        confidence[k] = local_line(points, count, reference[0], reference[1], p, par, columns, line[k])
        valid[k] = confidence[k] > 0.0


def find_lines(
    images: NDArray[np.uint8],
    mask: Mask,
    reference: Array,
    detector: EdgeDetector,
    cfg: LineCfg | None = None,
) -> StripLine:
    """Finds the seam's line in strips, each by itself.

    Args:
        images: Strips, shape (N, length, width, 3).
        mask: Where the nozzle is, shape (length, width).
        reference: t and o of the point one stand-off before the nozzle mouth, shape (2,), px.
        detector: Finds the edges.
        cfg: Parameters.

    Returns:
        The lines; without one, ``valid`` is false.
    """
    n = len(images)
    edges = detector(images, mask)
    out = StripLine(np.zeros((n, 3)), np.full((n, 2), np.nan), np.zeros(n), np.zeros(n, np.bool_))
    found = (edges.vector, edges.intensity, edges.edge)
    _find_batch(np.ascontiguousarray(images), mask, reference, *found, (cfg or LineCfg()).numbers, *out)
    return out
