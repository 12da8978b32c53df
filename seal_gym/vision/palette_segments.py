"""Colours of a palette of cables: thresholds, the masks of its elements, and areas of one colour.

Carvajal and Martinez-Garcia, Eqs. 39-42. Elements are told by which of the channels red, green and blue are
bright: cables none, connectors blue, rivets green, target zones (where a tie belongs) red, and the board and
the white ties all three.
"""

from dataclasses import dataclass
from enum import IntEnum

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from seal_gym.core.errors import require

Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Levels = tuple[int, int, int]

CODES = 8
# A code is 4 red + 2 green + blue, each 0 or 1: a row of the paper's tables.
CABLE_CODE, CONNECTOR_CODE, RIVET_CODE, TARGET_CODE, PALETTE_CODE = 0b000, 0b001, 0b010, 0b100, 0b111


class PaletteClass(IntEnum):
    """What an area of the picture shows."""

    PALETTE = 0
    CABLE = 1
    CONNECTOR = 2
    RIVET = 3
    TARGET = 4
    TIE = 5
    UNKNOWN = 6


@dataclass(frozen=True, kw_only=True)
class AreaCfg:
    """How the picture is divided into areas of one colour, whatever the thresholds.

    Attributes:
        median_px: Side of the median filter that steadies noise, odd [px]; 1 for none.
        edge_level: Neighbours that differ by more than this in a channel are an edge [grey levels].
        noise_factor: And by more than so many standard deviations of the filtered noise.
        least_px: Smaller areas belong to a neighbour [px].
    """

    median_px: int = 5
    edge_level: float = 24.0
    noise_factor: float = 6.0
    least_px: int = 8

    def __post_init__(self) -> None:
        """Checks the ranges."""
        require(
            self.median_px in (1, 3, 5),
            f"AreaCfg.median_px = {self.median_px!r}: must be 1, 3 or 5",
        )
        for name, low, high in (("edge_level", 1, 255), ("noise_factor", 0, 50), ("least_px", 1, 10_000)):
            value = getattr(self, name)
            require(low <= value <= high, f"AreaCfg.{name} = {value!r}: must be within {low}..{high}")


def check_rgb(rgb: Bytes) -> None:
    """Checks a picture.

    Args:
        rgb: Should have shape (H, W, 3), 8 bit.

    Raises:
        ConfigError: If it has not.
    """
    require(
        np.ndim(rgb) == 3 and np.shape(rgb)[2] == 3 and np.asarray(rgb).dtype == np.uint8,
        f"rgb: must be of uint8, shape (H, W, 3), not {np.asarray(rgb).dtype}, shape {np.shape(rgb)}",
    )
    require(min(rgb.shape[:2]) >= 8, f"rgb: shape {rgb.shape}: must have at least 8 x 8 pixels")


def check_levels(levels: Levels) -> None:
    """Checks thresholds.

    Args:
        levels: Should be whole numbers in 1..254.

    Raises:
        ConfigError: If they are not.
    """
    require(
        np.shape(levels) == (3,) and all(1 <= v <= 254 and int(v) == v for v in levels),
        f"levels = {levels!r}: must be 3 whole numbers in 1..254 (red, green, blue)",
    )


def otsu_levels(rgb: Bytes, inside: Mask | None = None) -> Levels:
    """Thresholds from the picture's own histograms, so that they follow the light.

    Source: N. Otsu, "A threshold selection method from gray-level histograms", IEEE SMC 9 (1979).

    Args:
        rgb: Shape (H, W, 3).
        inside: The pixels that count, shape (H, W); all by default.

    Returns:
        Of red, green and blue [grey levels].
    """
    pixels = rgb.reshape(-1, 3) if inside is None else rgb[inside]
    found = [cv2.threshold(np.ascontiguousarray(pixels[:, c]), 0, 255, cv2.THRESH_OTSU)[0] for c in range(3)]
    red, green, blue = (int(np.clip(v, 1, 254)) for v in found)
    return red, green, blue


def codes(rgb: Bytes, levels: Levels) -> Bytes:
    """Each pixel's thresholded channels as a row of the paper's Table I.

    Args:
        rgb: Shape (H, W, 3).
        levels: Thresholds of red, green and blue [grey levels]; brighter is 1.

    Returns:
        0..7, shape (H, W).
    """
    bright = (rgb > np.asarray(levels, dtype=np.uint8)).astype(np.uint8)
    return np.asarray(4 * bright[..., 0] + 2 * bright[..., 1] + bright[..., 2], dtype=np.uint8)


def element_masks(rgb: Bytes, levels: Levels, *, printed: bool = False) -> dict[PaletteClass, Mask]:
    """Eqs. 39-42 with each channel's threshold for all elements and no upper end of the bands.

    As printed, the connectors' and ties' conditions are joined by "or", so that black cables count as both
    and the board too; joined by "and" they are rows 001 and 100 of Table I.

    Args:
        rgb: Shape (H, W, 3).
        levels: Thresholds of red, green and blue [grey levels].
        printed: Join by "or".

    Returns:
        Board, cables, connectors and target zones, each of shape (H, W).
    """
    red, green, blue = np.moveaxis(rgb > np.asarray(levels, dtype=np.uint8), -1, 0)
    join = np.logical_or if printed else np.logical_and
    return {
        PaletteClass.PALETTE: red & green & blue,
        PaletteClass.CABLE: ~red & ~green & ~blue,
        PaletteClass.CONNECTOR: join(~red & ~green, blue),
        PaletteClass.TARGET: join(red, ~green & ~blue),
    }


def noise_level(rgb: Bytes) -> float:
    """Standard deviation of a picture's noise, from the median of its Laplacian.

    Source: the mask of J. Immerkaer, "Fast noise variance estimation", CVIU 64 (1996), which planes and edges
    along the axes leave at zero; the median keeps other edges out.

    Args:
        rgb: Shape (H, W, 3).

    Returns:
        Of the noisiest channel [grey levels].
    """
    mask = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]]) / 6.0
    response = np.abs(cv2.filter2D(rgb.astype(np.float32), -1, mask.astype(np.float32)))
    return float(1.4826 * np.median(response.reshape(-1, 3), axis=0).max())


def areas(rgb: Bytes, cfg: AreaCfg) -> tuple[NDArray[np.int32], Mask]:
    """Divides a picture into areas within which neighbours look alike.

    A pixel of an edge belongs to the nearest area; in the middle of an edge, to the one of the more similar
    colour.

    Args:
        rgb: Shape (H, W, 3).
        cfg: Parameters.

    Returns:
        Number of the area of each pixel from 0 on, shape (H, W), and which pixels are no edge, shape (H, W).
    """
    smooth = cv2.medianBlur(rgb, cfg.median_px) if cfg.median_px > 1 else rgb
    kernel = np.ones((3, 3), dtype=np.uint8)
    step = (cv2.dilate(smooth, kernel) - cv2.erode(smooth, kernel)).max(axis=2)
    filtered_noise = 1.25 * noise_level(rgb) / cfg.median_px  # a median's, of independent pixels
    flat = step <= max(cfg.edge_level, cfg.noise_factor * filtered_noise)
    count, label, stats, _ = cv2.connectedComponentsWithStats(flat.astype(np.uint8), connectivity=4)
    kept = stats[:, cv2.CC_STAT_AREA] >= cfg.least_px
    kept[0] = False
    if not kept.any():  # nothing but edges: one area
        return np.zeros(flat.shape, dtype=np.int32), np.ones(flat.shape, dtype=np.bool_)
    number = np.full(count, -1, dtype=np.int32)
    number[kept] = np.arange(kept.sum(), dtype=np.int32)
    core = kept[label]
    own = number[label]
    one, other = _nearest(own, core), np.rot90(_nearest(np.rot90(own, 2), np.rot90(core, 2)), 2)
    tied = one != other
    pixels = np.bincount(own[core])[:, None]
    colour = np.stack([np.bincount(own[core], weights=rgb[core, c]) for c in range(3)], axis=1) / pixels
    seen = smooth[tied].astype(np.float64)
    away = [((seen - colour[area[tied]]) ** 2).sum(axis=1) for area in (one, other)]
    one[tied] = np.where(away[0] <= away[1], one[tied], other[tied])
    return one, core


def _nearest(number: NDArray[np.int32], core: Mask) -> NDArray[np.int32]:
    """Number of the core pixel next to each; of several as near, one that depends on the order of pixels."""
    index = ndimage.distance_transform_edt(~core, return_distances=False, return_indices=True)
    return np.asarray(number[tuple(index)], dtype=np.int32)
