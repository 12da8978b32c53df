"""Edges by masks of fractional order (Zhou et al., section 2.1, Eqs. 1-11), as restated below.

- Weights (Eq. 2): ``w_0 = 1, w_k = w_{k-1} (k - 1 - alpha) / k``.
- Masks in eight directions, as four antisymmetric pairs: one-sided weights do not sum to zero, and flat
  ground would answer. A pair's answer is divided by its step, and the four add up to the edge vector E.
- Eqs. 6-7 as printed are constants over the ROI; they are read as means over 3x3 neighbours: of the
  magnitude, and of the orientation by its doubled angle.
- Edge intensity (Eq. 8): ``I = max_n (a M(n) + b D(n)) + c C`` over the 8 neighbours n, with M the magnitude,
  D the agreement of orientation, and C a contrast in logarithmic image processing (LIP) arithmetic. Eq. 11
  prints one expression above and below the bar; the difference belongs above, the sum below.
"""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import require
from seal_gym.core.frames import Array
from seal_gym.core.jit import kernel

Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]

_LEVELS = 256.0
_BINS = 512
_THIRDS = np.arange(766) / 3.0
# g ln g of every grey level that the mean of three bytes can take.
_G_LOG_G = np.concatenate(([0.0], _THIRDS[1:] * np.log(_THIRDS[1:])))


@dataclass(frozen=True, kw_only=True)
class EdgeCfg:
    """Parameters of the edge stage.

    Attributes:
        alpha: Order of the derivative, 0 < alpha <= 1.
        length: Number of weights of a mask, the centre's included.
        a: Weight of the magnitude.
        b: Weight of the agreement of orientation.
        c: Weight of the LIP contrast.
        tau: A pixel is an edge from this intensity on.
        share: Only this fraction of the pixels, the strongest, is looked at for orientation and contrast.
    """

    alpha: float = 0.5
    length: int = 3
    a: float = 0.6
    b: float = 0.3
    c: float = 0.1
    tau: float = 0.5
    share: float = 0.25

    def __post_init__(self) -> None:
        """Checks the ranges."""
        require(0.0 < self.alpha <= 1.0, f"EdgeCfg.alpha = {self.alpha!r}: must be within (0, 1]")
        require(
            int(self.length) == self.length and 2 <= self.length <= 9,
            f"EdgeCfg.length = {self.length!r}: must be a whole number in 2..9",
        )
        for name in ("a", "b", "c", "tau"):
            value = getattr(self, name)
            require(0.0 <= value < np.inf, f"EdgeCfg.{name} = {value!r}: must be finite and >= 0")
        require(0.0 < self.share <= 1.0, f"EdgeCfg.share = {self.share!r}: must be within (0, 1]")


class EdgeMap(NamedTuple):
    """Edges of N images, by whatever method.

    Attributes:
        vector: Edge vector (x, y), towards the brighter side, over its largest length in the image, shape
            (N, height, width, 2).
        magnitude: Its length, averaged over 3x3 pixels, shape (N, height, width).
        orientation: Direction of the steepest ascent or descent, within +-pi/2, at least at the edges, shape
            (N, height, width), rad.
        intensity: What an edge pixel's vote for a line is worth, shape (N, height, width).
        edge: Whether a pixel is an edge, shape (N, height, width).
    """

    vector: Array
    magnitude: Array
    orientation: Array
    intensity: Array
    edge: Mask


class EdgeDetector(Protocol):
    """Finds edges: ``EdgeStage``, and the methods it is compared with in ``baselines``."""

    def __call__(self, images: Bytes, mask: Mask | None = None) -> EdgeMap:
        """Finds the edges of each image by itself.

        Args:
            images: Grey, shape (N, height, width), or RGB, shape (N, height, width, 3).
            mask: True where nothing may be an edge, shape (height, width).

        Returns:
            The edges; an image without any contrast has none.
        """
        ...


def check_images(images: Bytes, mask: Mask | None) -> tuple[Bytes, Mask]:
    """What every detector asks of its arguments.

    Args:
        images: See ``EdgeDetector``.
        mask: Likewise.

    Returns:
        The images as RGB, shape (N, height, width, 3), and a mask, shape (height, width).

    Raises:
        ConfigError: If shape or type are none that a detector takes.
    """
    require(
        images.dtype == np.uint8
        and images.ndim in (3, 4)
        and (images.ndim == 3 or images.shape[3] == 3)
        and min(images.shape[1:3]) >= 3,
        f"images of {images.dtype}, shape {images.shape}: must be uint8, (N, height, width) or "
        "(N, height, width, 3), at least 3 px",
    )
    size = images.shape[1:3]
    if mask is None:
        mask = np.zeros(size, np.bool_)
    require(
        mask.dtype == np.bool_ and mask.shape == size,
        f"mask of {mask.dtype}, shape {mask.shape}: must be bool, {size} as the images",
    )
    colour = np.repeat(images[..., None], 3, axis=3) if images.ndim == 3 else images
    return np.ascontiguousarray(colour), np.ascontiguousarray(mask)


def weights(alpha: float, length: int) -> Array:
    """Gruenwald-Letnikov weights of a derivative of fractional order (Eq. 2).

    Args:
        alpha: Order.
        length: How many.

    Returns:
        Shape (length,).
    """
    w = np.ones(length)
    for k in range(1, length):
        w[k] = w[k - 1] * (k - 1 - alpha) / k
    return w


def taps(cfg: EdgeCfg) -> Array:
    """The masks as differences of opposite pixels.

    Args:
        cfg: Order and length.

    Returns:
        Rows dx, dy, wx, wy: E += (wx, wy) (R(x + dx, y + dy) - R(x - dx, y - dy)).
    """
    rows = []
    for ux, uy in ((1, 0), (1, 1), (0, 1), (-1, 1)):
        step2 = ux * ux + uy * uy
        for k, w in enumerate(weights(cfg.alpha, cfg.length)[1:], start=1):
            # Half for the pair (K_180 - K_0) / 2, half for the sum of four directions, which counts twice.
            rows.append((k * ux, k * uy, -0.25 * w * ux / step2, -0.25 * w * uy / step2))
    return np.array(rows, dtype=np.float64)


@kernel
def grey_sum(image: Bytes, out: NDArray[np.int64]) -> None:
    """Sum of the three channels of an image of shape (height, width, 3)."""
    for i in range(image.shape[0]):
        for j in range(image.shape[1]):
            out[i, j] = np.int64(image[i, j, 0]) + np.int64(image[i, j, 1]) + np.int64(image[i, j, 2])


@kernel
def _vectors(
    grey: NDArray[np.int64],
    mask: Mask,
    tap: Array,
    pad: int,
    padded: Array,
    ex: Array,
    ey: Array,
) -> float:
    """Edge vectors in grey levels, none under the mask; returns the largest squared length."""
    height, width = grey.shape
    third = 1.0 / 3.0
    for i in range(height + 2 * pad):
        y = min(max(i - pad, 0), height - 1)
        for j in range(width + 2 * pad):
            padded[i, j] = grey[y, min(max(j - pad, 0), width - 1)] * third
    ex[:] = 0.0
    ey[:] = 0.0
    for t in range(len(tap)):
        dx, dy, wx, wy = int(tap[t, 0]), int(tap[t, 1]), tap[t, 2], tap[t, 3]
        for i in range(height):
            up, down = i + pad + dy, i + pad - dy
            for j in range(width):
                d = padded[up, j + pad + dx] - padded[down, j + pad - dx]
                ex[i, j] += wx * d
                ey[i, j] += wy * d
    top = 0.0
    for i in range(height):
        for j in range(width):
            if mask[i, j]:
                ex[i, j] = ey[i, j] = 0.0
            top = max(top, ex[i, j] * ex[i, j] + ey[i, j] * ey[i, j])
    return top


@kernel
def _mean_magnitude(ex: Array, ey: Array, scale: float, work: Array, out: Array) -> None:
    """Mean length over 3x3 pixels (fewer at the border), and E brought to unit scale."""
    height, width = ex.shape
    for i in range(height):
        for j in range(width):
            ex[i, j] *= scale
            ey[i, j] *= scale
            work[i, j] = np.sqrt(ex[i, j] * ex[i, j] + ey[i, j] * ey[i, j])
    for i in range(height):
        low, high = max(i - 1, 0), min(i + 1, height - 1)
        for j in range(1, width - 1):
            total = 0.0
            for y in range(low, high + 1):
                total += work[y, j - 1] + work[y, j] + work[y, j + 1]
            out[i, j] = total / (3.0 * (high - low + 1))
        left = right = 0.0
        for y in range(low, high + 1):
            left += work[y, 0] + work[y, 1]
            right += work[y, width - 2] + work[y, width - 1]
        out[i, 0], out[i, width - 1] = left / (2.0 * (high - low + 1)), right / (2.0 * (high - low + 1))


@kernel
def _cutoff(magnitude: Array, share: float, bins: NDArray[np.int64]) -> float:
    """A bound that about ``share`` of the pixels, and no fewer, reach."""
    if share >= 1.0:
        return -1.0
    bins[:] = 0
    height, width = magnitude.shape
    for i in range(height):
        for j in range(width):
            bins[min(int(magnitude[i, j] * _BINS), _BINS - 1)] += 1
    left = share * height * width
    for k in range(_BINS - 1, 0, -1):
        left -= bins[k]
        if left <= 0.0:
            return k / _BINS
    return 0.0


@kernel
def _orientation(ex: Array, ey: Array, i: int, j: int) -> float:
    c = s = 0.0
    for y in range(max(i - 1, 0), min(i + 2, ex.shape[0])):
        for x in range(max(j - 1, 0), min(j + 2, ex.shape[1])):
            c += ex[y, x] * ex[y, x] - ey[y, x] * ey[y, x]
            s += 2.0 * ex[y, x] * ey[y, x]
    return float(0.5 * np.arctan2(s, c))


@kernel
def _contrast(grey: NDArray[np.int64], i: int, j: int, g_log_g: Array) -> float:
    """LIP contrast of the brighter and the darker class of 3x3 pixels, weighed by their entropies' gap."""
    top, bottom = max(i - 1, 0), min(i + 2, grey.shape[0])
    left, right = max(j - 1, 0), min(j + 2, grey.shape[1])
    total = 0
    for y in range(top, bottom):
        for x in range(left, right):
            total += grey[y, x]
    count = (bottom - top) * (right - left)
    n_f = n_b = 0
    sum_f = sum_b = log_f = log_b = 0.0
    for y in range(top, bottom):
        for x in range(left, right):
            g = grey[y, x]
            if g * count > total:
                n_f += 1
                sum_f += g / 3.0
                log_f += g_log_g[g]
            else:
                n_b += 1
                sum_b += g / 3.0
                log_b += g_log_g[g]
    if n_f == 0:
        return 0.0
    # Shares p = g / sum g: S = -sum p ln p = ln(sum g) - sum(g ln g) / sum g; a black class has none.
    gap = np.log(sum_f) - log_f / sum_f
    if sum_b > 0.0:
        gap = abs(gap - np.log(sum_b) + log_b / sum_b)
    f, b = sum_f / n_f, sum_b / n_b
    return float(gap * (_LEVELS * (f - b) / (_LEVELS - b)) / (f + b - f * b / _LEVELS))


@kernel
def edge_image(
    grey: NDArray[np.int64],
    mask: Mask,
    tap: Array,
    pad: int,
    par: Array,
    g_log_g: Array,
    padded: Array,
    work: Array,
    bins: NDArray[np.int64],
    ex: Array,
    ey: Array,
    magnitude: Array,
    orientation: Array,
    intensity: Array,
    edge: Mask,
) -> None:
    """The whole stage for one image, from the sum of its channels; nothing under the mask is an edge.

    The mask keeps the nozzle, of any contrast, from setting the scale that the seam is measured by.
    """
    height, width = grey.shape
    a, b, c, tau, share = par[0], par[1], par[2], par[3], par[4]
    orientation[:] = 0.0
    intensity[:] = 0.0
    edge[:] = False
    top = _vectors(grey, mask, tap, pad, padded, ex, ey)
    if top < 1e-18:
        ex[:] = 0.0
        ey[:] = 0.0
        magnitude[:] = 0.0
        return
    _mean_magnitude(ex, ey, 1.0 / np.sqrt(top), work, magnitude)
    cut = _cutoff(magnitude, share, bins)
    work[:] = 0.0  # 1 where the orientation is known
    for i in range(height):
        for j in range(width):
            if magnitude[i, j] < cut or mask[i, j]:
                continue
            for y in range(max(i - 1, 0), min(i + 2, height)):
                for x in range(max(j - 1, 0), min(j + 2, width)):
                    if work[y, x] == 0.0:
                        work[y, x] = 1.0
                        orientation[y, x] = _orientation(ex, ey, y, x)
            best = 0.0
            for y in range(max(i - 1, 0), min(i + 2, height)):
                for x in range(max(j - 1, 0), min(j + 2, width)):
                    if y == i and x == j:
                        continue
                    turn = abs(orientation[i, j] - orientation[y, x])
                    turn = min(turn, np.pi - turn)
                    best = max(best, a * magnitude[y, x] + b * (1.0 - turn / (0.5 * np.pi)))
            intensity[i, j] = best + c * _contrast(grey, i, j, g_log_g)
            edge[i, j] = intensity[i, j] >= tau


@kernel
def _edge_batch(
    images: Bytes,
    mask: Mask,
    tap: Array,
    pad: int,
    par: Array,
    g_log_g: Array,
    vector: Array,
    magnitude: Array,
    orientation: Array,
    intensity: Array,
    edge: Mask,
) -> None:
    n, height, width = images.shape[:3]
    grey = np.empty((height, width), np.int64)
    padded, work = np.empty((height + 2 * pad, width + 2 * pad)), np.empty((height, width))
    ex, ey, bins = np.empty((height, width)), np.empty((height, width)), np.empty(_BINS, np.int64)
    for k in range(n):
        grey_sum(images[k], grey)
        edge_image(
            grey,
            mask,
            tap,
            pad,
            par,
            g_log_g,
            padded,
            work,
            bins,
            ex,
            ey,
            magnitude[k],
            orientation[k],
            intensity[k],
            edge[k],
        )
        vector[k, :, :, 0] = ex
        vector[k, :, :, 1] = ey


class EdgeTables(NamedTuple):
    """A configuration as the kernels take it.

    Attributes:
        tap: See ``taps``.
        pad: Pixels that a mask reaches beyond its centre.
        par: a, b, c, tau, share.
        g_log_g: g ln g of the grey levels 0, 1/3, ... 255.
    """

    tap: Array
    pad: int
    par: Array
    g_log_g: Array

    @classmethod
    def of(cls, cfg: EdgeCfg) -> "EdgeTables":
        """Takes the arrays from a configuration.

        Args:
            cfg: The parameters.

        Returns:
            The tables.
        """
        par = np.array([cfg.a, cfg.b, cfg.c, cfg.tau, cfg.share], dtype=np.float64)
        return cls(taps(cfg), int(cfg.length) - 1, par, _G_LOG_G)


class EdgeStage:
    """Finds the edges of images.

    Args:
        cfg: Parameters.
    """

    def __init__(self, cfg: EdgeCfg | None = None) -> None:
        self.cfg = cfg or EdgeCfg()
        self._tables = EdgeTables.of(self.cfg)

    def __call__(self, images: Bytes, mask: Mask | None = None) -> EdgeMap:
        """Runs the stage.

        Args:
            images: Grey, shape (N, height, width), or RGB, shape (N, height, width, 3).
            mask: True where nothing may be an edge, shape (height, width).

        Returns:
            The edges; an image without any contrast has none.
        """
        colour, mask = check_images(images, mask)
        shape = colour.shape[:3]
        out = EdgeMap(
            np.empty((*shape, 2)),
            np.empty(shape),
            np.empty(shape),
            np.empty(shape),
            np.empty(shape, np.bool_),
        )
        _edge_batch(colour, mask, *self._tables, *out)
        return out
