"""Edges by the usual methods, behind the interface of ``EdgeStage``: Canny, Sobel and LSD.

Canny, "A computational approach to edge detection" (1986); Sobel's operator; von Gioi, Jakubowicz, Morel and
Randall, "LSD: a line segment detector" (2012). The defaults are the best settings of validation images by
``experiments.tune_edges``.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import require
from seal_gym.core.frames import Array
from seal_gym.vision.edges import Bytes, EdgeCfg, EdgeDetector, EdgeMap, EdgeStage, Mask, check_images

Single = NDArray[np.float32]

_CANNY_SCALE = 16.0  # cv2.Canny takes gradients as 16-bit integers; Sobel's reach 4 x 255
_FILL_PX = 4.0
_LSD_MODES = {"none": 0, "standard": 1, "advanced": 2}


def _check_shares(cfg: Any, names: tuple[str, ...]) -> None:
    for name in names:
        value = getattr(cfg, name)
        require(
            0.0 < value <= 1.0,
            f"{type(cfg).__name__}.{name} = {value!r}: must be within (0, 1]",
        )


def _check_blur(cfg: Any) -> None:
    require(
        0.0 <= cfg.sigma_px <= 10.0,
        f"{type(cfg).__name__}.sigma_px = {cfg.sigma_px!r}: must be within 0..10",
    )


@dataclass(frozen=True, kw_only=True)
class CannyCfg:
    """Parameters of Canny's edges.

    The upper threshold is a quantile of the image's own gradients: fixed levels would ask more of a dull
    image than of a bright one.

    Attributes:
        sigma_px: Of the Gaussian before the gradient [px]; 0 for none.
        share: This fraction of the pixels has a gradient above the upper threshold.
        ratio: Lower over upper threshold.
    """

    sigma_px: float = 1.4
    share: float = 0.12
    ratio: float = 0.2

    def __post_init__(self) -> None:
        """Checks the ranges."""
        _check_blur(self)
        _check_shares(self, ("share", "ratio"))


@dataclass(frozen=True, kw_only=True)
class SobelCfg:
    """Parameters of Sobel's edges.

    Attributes:
        sigma_px: Of the Gaussian before the gradient [px]; 0 for none.
        share: This fraction of the pixels, those of the largest gradients, are edges.
    """

    sigma_px: float = 0.7
    share: float = 0.05

    def __post_init__(self) -> None:
        """Checks the ranges."""
        _check_blur(self)
        _check_shares(self, ("share",))


@dataclass(frozen=True, kw_only=True)
class LsdCfg:
    """Parameters of the line segment detector.

    Attributes:
        sigma_px: Of a Gaussian before the detector's own [px]; 0 for none.
        scale: The detector shrinks the image by this.
        sigma_scale: Its own Gaussian's sigma is ``sigma_scale / scale`` [px].
        quant: Gradients up to ``quant / sin(ang_th)`` grey levels are not looked at.
        angle_deg: Tolerance of a pixel's gradient direction [deg].
        density: Least share of aligned pixels in a segment's rectangle.
        refine: ``"none"``, ``"standard"`` or ``"advanced"``, which also tests the number of false alarms.
        min_length_px: Shorter segments are dropped [px].
    """

    sigma_px: float = 0.7
    scale: float = 1.0
    sigma_scale: float = 0.6
    quant: float = 2.0
    angle_deg: float = 22.5
    density: float = 0.7
    refine: str = "standard"
    min_length_px: float = 5.0

    def __post_init__(self) -> None:
        """Checks the ranges."""
        _check_blur(self)
        _check_shares(self, ("scale", "density"))
        for name, low, high in (
            ("sigma_scale", 0.1, 5.0),
            ("quant", 0.0, 100.0),
            ("angle_deg", 1.0, 90.0),
            ("min_length_px", 0.0, 1000.0),
        ):
            value = getattr(self, name)
            require(low <= value <= high, f"LsdCfg.{name} = {value!r}: must be within {low}..{high}")
        require(
            self.refine in _LSD_MODES,
            f"LsdCfg.refine = {self.refine!r}: must be one of {list(_LSD_MODES)}",
        )


def _grey(image: Bytes) -> Single:
    return np.asarray(image.sum(axis=2, dtype=np.int64) / 3.0, dtype=np.float32)


def _blurred(grey: Single, mask: Mask, sigma_px: float) -> Single:
    """Gaussian mean over what is outside the mask, so that the nozzle does not leak out from under it."""
    if sigma_px <= 0.0:
        return grey
    keep = (~mask).astype(np.float32)

    def smooth(x: Single) -> Single:
        return np.asarray(cv2.GaussianBlur(x, (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE), np.float32)

    weight = smooth(keep)
    far = np.float32(grey[~mask].mean()) if not mask.all() else np.float32(0.0)
    return np.where(weight > 1e-3, smooth(grey * keep) / np.maximum(weight, 1e-3), far)


def _gradient(grey: Single, mask: Mask) -> tuple[Single, Single]:
    """Sobel's differences, zero under the mask [4 grey levels a pixel]."""

    def sobel(dx: int, dy: int) -> Single:
        out = cv2.Sobel(grey, cv2.CV_32F, dx, dy, ksize=3, borderType=cv2.BORDER_REPLICATE)
        return np.asarray(out, dtype=np.float32)

    gx, gy = sobel(1, 0), sobel(0, 1)
    # Rounding of the blur must not make edges of flat ground.
    none = mask | (np.hypot(gx, gy) < 1e-2)
    gx[none] = 0.0
    gy[none] = 0.0
    return gx, gy


def _quantile(length: Single, mask: Mask, share: float) -> float:
    """The gradient that ``share`` of the pixels outside the mask reach."""
    seen = length[~mask]
    return float(np.quantile(seen, 1.0 - share)) if len(seen) else 0.0


def _map_of(vectors: list[Array], intensities: list[Array], edges: list[Mask]) -> EdgeMap:
    vector, edge = np.stack(vectors), np.stack(edges)
    x, y = vector[..., 0], vector[..., 1]
    length = np.hypot(x, y)
    magnitude = np.stack([cv2.blur(m, (3, 3), borderType=cv2.BORDER_REPLICATE) for m in length])
    return EdgeMap(
        vector=vector,
        magnitude=magnitude,
        orientation=np.where(edge, 0.5 * np.arctan2(2.0 * x * y, x * x - y * y), 0.0),
        intensity=np.stack(intensities),
        edge=edge,
    )


def _per_largest(gx: Single, gy: Single) -> tuple[Array, Array]:
    """Vectors over the largest length, and these lengths."""
    vector = np.stack((gx, gy), axis=-1).astype(np.float64)
    length = np.hypot(vector[..., 0], vector[..., 1])
    top = max(float(length.max()), 1e-12)
    return vector / top, length / top


class CannyEdges:
    """Canny's edges: gradient of a smoothed image, its ridges, hysteresis.

    Args:
        cfg: Parameters.
    """

    def __init__(self, cfg: CannyCfg | None = None) -> None:
        self.cfg = cfg or CannyCfg()

    def __call__(self, images: Bytes, mask: Mask | None = None) -> EdgeMap:
        """Finds the edges; see ``EdgeDetector``.

        Args:
            images: Grey or RGB, shape (N, height, width) or (N, height, width, 3).
            mask: True where nothing may be an edge, shape (height, width).

        Returns:
            Edges one pixel wide; the intensity is their gradient over the largest.
        """
        colour, mask = check_images(images, mask)
        return _map_of(*map(list, zip(*(self._one(image, mask) for image in colour), strict=True)))

    def _one(self, image: Bytes, mask: Mask) -> tuple[Array, Array, Mask]:
        gx, gy = _gradient(_blurred(_grey(image), mask, self.cfg.sigma_px), mask)
        dx, dy = (np.rint(_CANNY_SCALE * g).astype(np.int16) for g in (gx, gy))
        # Canny's edges are beyond the thresholds, so that flat ground, where both are 0, has none; a little
        # less lets the pixels at the quantile itself pass.
        high = (1.0 - 1e-4) * _quantile(np.hypot(dx, dy).astype(np.float32), mask, self.cfg.share)
        edge = cv2.Canny(dx, dy, self.cfg.ratio * high, high, L2gradient=True) > 0
        edge &= ~mask
        vector, length = _per_largest(gx, gy)
        return vector, np.where(edge, length, 0.0), edge


class SobelEdges:
    """Sobel's edges: where the gradient is among the largest.

    Args:
        cfg: Parameters.
    """

    def __init__(self, cfg: SobelCfg | None = None) -> None:
        self.cfg = cfg or SobelCfg()

    def __call__(self, images: Bytes, mask: Mask | None = None) -> EdgeMap:
        """Finds the edges; see ``EdgeDetector``.

        Args:
            images: Grey or RGB, shape (N, height, width) or (N, height, width, 3).
            mask: True where nothing may be an edge, shape (height, width).

        Returns:
            Edges several pixels wide; the intensity is their gradient over the largest.
        """
        colour, mask = check_images(images, mask)
        return _map_of(*map(list, zip(*(self._one(image, mask) for image in colour), strict=True)))

    def _one(self, image: Bytes, mask: Mask) -> tuple[Array, Array, Mask]:
        gx, gy = _gradient(_blurred(_grey(image), mask, self.cfg.sigma_px), mask)
        size = np.hypot(gx, gy)
        edge = (size >= _quantile(size, mask, self.cfg.share)) & (size > 0.0) & ~mask
        vector, length = _per_largest(gx, gy)
        return vector, np.where(edge, length, 0.0), edge


class LsdEdges:
    """Segments of OpenCV's line segment detector, drawn as edge pixels.

    Args:
        cfg: Parameters.
    """

    def __init__(self, cfg: LsdCfg | None = None) -> None:
        self.cfg = cfg or LsdCfg()
        self._lsd = cv2.createLineSegmentDetector(
            _LSD_MODES[self.cfg.refine],
            self.cfg.scale,
            self.cfg.sigma_scale,
            self.cfg.quant,
            self.cfg.angle_deg,
            0.0,
            self.cfg.density,
        )

    def __call__(self, images: Bytes, mask: Mask | None = None) -> EdgeMap:
        """Finds the edges; see ``EdgeDetector``.

        Args:
            images: Grey or RGB, shape (N, height, width) or (N, height, width, 3).
            mask: True where nothing may be an edge, shape (height, width).

        Returns:
            Segments two pixels wide: across a segment the intensity says where it lies between the pixels'
            centres; along all it is in proportion to the segment's length.
        """
        colour, mask = check_images(images, mask)
        return _map_of(*map(list, zip(*(self._one(image, mask) for image in colour), strict=True)))

    def segments(self, image: Bytes, mask: Mask) -> Array:
        """The detector's segments.

        Args:
            image: RGB, shape (height, width, 3).
            mask: True where nothing may be an edge, shape (height, width).

        Returns:
            Ends x1, y1, x2, y2, shape (n, 4), px, with the first pixel's centre at 0.5; brighter on the left
            of the way from the first end to the second, as the image is seen.
        """
        grey = _grey(image)
        if mask.any():
            # What the nozzle hides looks like what is around it.
            grey = np.where(mask, _blurred(grey, mask, _FILL_PX), grey)
        grey = _blurred(grey, np.zeros_like(mask), self.cfg.sigma_px)
        found = self._lsd.detect(np.rint(grey).astype(np.uint8))[0]
        if found is None:
            return np.empty((0, 4))
        # The detector scales corners instead of centres: pixel k of the shrunk image is at (k + 0.5) / scale.
        ends = np.asarray(found, dtype=np.float64).reshape(-1, 4) + 0.5 / self.cfg.scale
        length = np.hypot(ends[:, 2] - ends[:, 0], ends[:, 3] - ends[:, 1])
        return ends[length >= self.cfg.min_length_px]

    def _one(self, image: Bytes, mask: Mask) -> tuple[Array, Array, Mask]:
        ends = self.segments(image, mask)
        vector, intensity = np.zeros((*mask.shape, 2)), np.zeros(mask.shape)
        lengths = np.hypot(ends[:, 2] - ends[:, 0], ends[:, 3] - ends[:, 1])
        for k in np.argsort(lengths):  # the longest on top
            _draw(ends[k], lengths[k] / lengths.max(), vector, intensity)
        vector[mask] = 0.0
        intensity[mask] = 0.0
        return vector, intensity, intensity > 0.0


def _draw(ends: Array, vote: float, vector: Array, intensity: Array) -> None:
    """Draws a segment two pixels wide, each row's (or column's) vote shared as the line lies between them."""
    x1, y1, x2, y2 = ends
    length = math.hypot(x2 - x1, y2 - y1)
    bright = np.array([y2 - y1, x1 - x2]) / length
    steep = abs(y2 - y1) >= abs(x2 - x1)
    (t1, o1), (t2, o2) = ((y1, x1), (y2, x2)) if steep else ((x1, y1), (x2, y2))
    if t1 > t2:
        t1, o1, t2, o2 = t2, o2, t1, o1
    height, width = intensity.shape
    along, across = (height, width) if steep else (width, height)
    t = np.arange(max(math.ceil(t1 - 0.5), 0), min(math.floor(t2 - 0.5) + 1, along))
    o = o1 + (o2 - o1) / (t2 - t1) * (t + 0.5 - t1) - 0.5
    low = np.floor(o).astype(np.intp)
    for step in (0, 1):
        column = low + step
        share = 1.0 - np.abs(o - column)
        inside = (column >= 0) & (column < across) & (share > 1e-6)
        at = (t[inside], column[inside]) if steep else (column[inside], t[inside])
        intensity[at] = vote * share[inside]
        vector[at] = vote * bright


SOBEL_PLAIN = SobelCfg(sigma_px=0.0, share=0.05)
# Our stage's best settings for lines of single frames; the tracker was tuned with ``EdgeCfg``'s own.
OURS_TUNED = EdgeCfg(alpha=1.0, length=3, a=0.6, b=0.3, c=0.1, tau=0.55, share=0.03)

DETECTORS: dict[str, Callable[[], EdgeDetector]] = {
    "ours": EdgeStage,
    "ours_tuned": lambda: EdgeStage(OURS_TUNED),
    "canny": CannyEdges,
    "sobel": lambda: SobelEdges(SOBEL_PLAIN),
    "sobel_blurred": SobelEdges,
    "lsd": LsdEdges,
}
"""Every edge method with its best settings, by the name it has in tables."""
