"""Markers as cameras see them: pictures of a flat print without OpenGL, and labels in a MuJoCo scene."""

from dataclasses import dataclass

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import SeamError, is_number, require
from seal_gym.core.frames import Array, quat_from_matrix, transform
from seal_gym.workpieces.workpiece import Workpiece

Grey = NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True)
class ShotCfg:
    """How a picture of a print is taken.

    Attributes:
        black: Grey level of the print's black, of 255.
        white: Grey level of the print's white.
        surround: Grey level of everything else.
        blur_px: Standard deviation of the lens's and motion's blur [px].
        noise_sigma: Standard deviation of the sensor noise, of 255.
        supersample: Samples a pixel, along each side.
    """

    black: float = 40.0
    white: float = 215.0
    surround: float = 120.0
    blur_px: float = 0.7
    noise_sigma: float = 8.0
    supersample: int = 4

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for name, high in (("black", 255.0), ("white", 255.0), ("surround", 255.0), ("noise_sigma", 128.0)):
            value = getattr(self, name)
            require(
                is_number(value) and 0 <= value <= high,
                f"ShotCfg.{name} = {value!r}: must be within 0..{high:g}",
            )
        require(
            is_number(self.blur_px) and 0 <= self.blur_px <= 10,
            f"ShotCfg.blur_px = {self.blur_px!r}: must be within 0..10",
        )
        require(
            isinstance(self.supersample, int) and 1 <= self.supersample <= 16,
            f"ShotCfg.supersample = {self.supersample!r}: must be a whole number in 1..16",
        )


def shoot(
    picture: Grey,
    size_m: tuple[float, float],
    T_camera_print: Array,
    matrix: Array,
    frame_px: tuple[int, int],
    rng: np.random.Generator,
    cfg: ShotCfg,
    hidden_by: Array | None = None,
) -> Grey:
    """A pinhole camera's picture of a flat print, in even light.

    Args:
        picture: The print, grey, shape (h, w): black 0, white 255.
        size_m: The print's width and height [m].
        T_camera_print: The print's frame: origin at its upper left corner, x right, y down; shape (4, 4), m.
        matrix: Intrinsic matrix for continuous pixel coordinates, (0, 0) the first pixel's corner; (3, 3).
        frame_px: Width and height of the picture to take [px].
        rng: Source of the noise.
        cfg: Light, blur and noise.
        hidden_by: Triangles in the camera's frame that stand before the print, shape (n, 3, 3), m; black.

    Returns:
        Shape (height, width).
    """
    width, height = frame_px
    k = cfg.supersample
    # Both pictures' coordinates continuous; OpenCV's count from pixel centres, half a pixel less.
    to_metres = np.diag([size_m[0] / picture.shape[1], size_m[1] / picture.shape[0], 1.0])
    fine = np.diag([k, k, 1.0]) @ matrix
    flat = fine @ np.column_stack((T_camera_print[:3, :2], T_camera_print[:3, 3])) @ to_metres
    shift = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
    flat = np.linalg.inv(shift) @ flat @ shift
    levels = cfg.black + (cfg.white - cfg.black) / 255.0 * picture.astype(np.float32)
    canvas = np.full((k * height, k * width), cfg.surround, np.float32)
    cv2.warpPerspective(
        levels, flat, canvas.shape[::-1], canvas, cv2.INTER_LINEAR, cv2.BORDER_TRANSPARENT
    )
    if hidden_by is not None:
        _cover(canvas, hidden_by, fine)
    if cfg.blur_px > 0:
        canvas = cv2.GaussianBlur(canvas, (0, 0), k * cfg.blur_px)
    image = canvas.reshape(height, k, width, k).mean(axis=(1, 3), dtype=np.float64)
    image += rng.normal(0.0, cfg.noise_sigma, image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _cover(canvas: NDArray[np.float32], triangles: Array, matrix: Array) -> None:
    """Fills the images of triangles with black."""
    p = triangles @ matrix.T
    before = (p[..., 2] > 1e-3).all(axis=1)
    # Sixteenths of a pixel, counted from pixel centres.
    corners = np.rint((p[before, :, :2] / p[before, :, 2:] - 0.5) * 16).astype(np.int32)
    for triangle in corners:
        cv2.fillConvexPoly(canvas, triangle, 0.0, lineType=cv2.LINE_8, shift=4)
