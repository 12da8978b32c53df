"""A plain observer of palettes: colour thresholds and connected components on an RGB-D picture."""

import cv2
import numpy as np
from numpy.typing import NDArray

from seal_gym.core.cell import OverheadCfg
from seal_gym.core.frames import Array
from seal_gym.vision.palette_seen import Depth, Regions, deproject

_REDNESS = 0.22  # of the board's brightness over the black of the cables
_CLOSE_M = 0.010  # more than a cable's width, less than what lies between two zones
_LEAST_M2 = 8e-5
_ABOVE_BOARD_M = 0.013
_REACH_M = 0.008


def red_mask(rgb: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Pixels clearly more red than green and blue, whatever the exposure.

    The picture's own black (cables) and its light parts (the board) set the scale.

    Args:
        rgb: Shape (H, W, 3).

    Returns:
        Shape (H, W).
    """
    smooth = cv2.GaussianBlur(rgb, (5, 5), 1.0).astype(np.float64)
    black, light = np.percentile(smooth.min(axis=2), 1.0), np.percentile(smooth.max(axis=2), 85.0)
    scale = max(float(light - black), 1.0)
    redness = smooth[..., 0] - smooth[..., 1:].max(axis=2)
    return np.asarray(redness > _REDNESS * scale)


def observe(rgb: NDArray[np.uint8], depth_m: Depth, camera: OverheadCfg) -> Regions:
    """Finds the red zones and the ties' heads in them.

    A zone's middle gives x and y, seen at the board's depth; what stands highest near it gives z.

    Args:
        rgb: Shape (H, W, 3).
        depth_m: Along the optical axis, NaN where there is none, shape (H, W), m.
        camera: Which took it.

    Returns:
        The targets, in no particular order.
    """
    red = red_mask(rgb)
    if not red.any() or not np.isfinite(depth_m[red]).any():
        return Regions(np.empty((0, 3)), ())
    pixel_m = float(np.nanmedian(depth_m[red])) / camera.focal_px
    side = 2 * round(0.5 * _CLOSE_M / pixel_m) + 1
    kernel = np.ones((side, side), np.uint8)
    whole = cv2.morphologyEx(red.astype(np.uint8), cv2.MORPH_CLOSE, kernel)
    count, labels, stats, centre = cv2.connectedComponentsWithStats(whole, connectivity=8)
    points = []
    for k in range(1, count):
        if stats[k, cv2.CC_STAT_AREA] * pixel_m**2 < _LEAST_M2:
            continue
        board = np.nanmedian(depth_m[(labels == k) & red])
        middle = centre[k] + 0.5  # pixel (0, 0) reaches from 0 to 1
        on_board = deproject(middle, float(board), camera)
        points.append([*on_board[:2], on_board[2] + _head_height(depth_m, middle, float(board), pixel_m)])
    return Regions(np.reshape(points, (-1, 3)), ("target",) * len(points))


def _head_height(depth_m: Depth, middle: Array, board_m: float, pixel_m: float) -> float:
    """How high the tie's head stands over the board [m], the camera looking straight down."""
    v, u = np.indices(depth_m.shape)
    near = np.hypot(u + 0.5 - middle[0], v + 0.5 - middle[1]) <= _REACH_M / pixel_m
    above = board_m - depth_m[near]
    head = above[above > _ABOVE_BOARD_M]
    return float(np.median(head)) if head.size else _ABOVE_BOARD_M
