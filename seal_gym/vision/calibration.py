"""Calibration of a camera on the gun: a fixed ChArUco board seen from several known tip poses.

Found are focal length, principal point and mount (hand-eye) of a pinhole camera without distortion, and the
board's place. Start values: Zhang's method (``cv2.calibrateCamera``) and Park and Martin's hand-eye solution;
then one least squares over all of them, in which the known tip poses hold the views together, each free to
deviate as much as an arm's do.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from seal_gym.core.cell import CalibrationCfg, CameraCfg
from seal_gym.core.errors import SealGymError, is_number, require
from seal_gym.core.frames import Array, transform

# OpenCV counts pixels from the first one's centre, we from its corner.
HALF_PIXEL = 0.5
_DICTIONARY = cv2.aruco.DICT_4X4_1000
# Rotations between the views must differ in axis: the sine below which they count as one axis.
_MIN_SPREAD = 0.05
# Values that all views share: focal length, principal point, mount, board.
_SHARED = 15
# Ten or so suffice; tip poses that contradict the pictures would take thousands.
_MAX_STEPS = 60
_PINHOLE = (
    cv2.CALIB_FIX_ASPECT_RATIO
    | cv2.CALIB_ZERO_TANGENT_DIST
    | cv2.CALIB_FIX_K1
    | cv2.CALIB_FIX_K2
    | cv2.CALIB_FIX_K3
)


class CalibrationError(SealGymError, ValueError):
    """The views do not determine the camera."""


def as_grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A picture without its colours.

    Args:
        image: Grey, shape (H, W), or RGB, shape (H, W, 3).

    Returns:
        Shape (H, W).
    """
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


@dataclass(frozen=True, kw_only=True)
class Board:
    """A ChArUco board: a chessboard with an ArUco marker in each white square.

    Its frame: origin at the picture's upper left corner, x right, y down, z into the board.

    Attributes:
        squares: Squares in a row and in a column.
        square_m: Side of a square [m].
        marker_m: Side of a marker [m].
    """

    squares: tuple[int, int]
    square_m: float
    marker_m: float

    @classmethod
    def of(cls, cfg: CalibrationCfg) -> Self:
        """The board of a cell.

        Args:
            cfg: The cell's section ``[calibration]``.

        Returns:
            The board.
        """
        columns, rows = map(int, cfg.squares)
        return cls(squares=(columns, rows), square_m=cfg.square_mm * 1e-3, marker_m=cfg.marker_mm * 1e-3)

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height [m]."""
        return (self.squares[0] * self.square_m, self.squares[1] * self.square_m)

    @cached_property
    def corners_m(self) -> Array:
        """The chessboard's inner corners, row by row, shape (n, 3), m."""
        columns, rows = self.squares
        y, x = np.mgrid[1:rows, 1:columns]
        return self.square_m * np.stack((x, y, np.zeros_like(x)), axis=-1).reshape(-1, 3).astype(np.float64)

    @cached_property
    def _board(self) -> cv2.aruco.CharucoBoard:
        dictionary = cv2.aruco.getPredefinedDictionary(_DICTIONARY)
        return cv2.aruco.CharucoBoard(self.squares, self.square_m, self.marker_m, dictionary)

    def picture(self, square_px: int) -> NDArray[np.uint8]:
        """The board's print, without a margin.

        Args:
            square_px: Pixels a square.

        Returns:
            Grey picture, shape (rows * square_px, columns * square_px), black 0 and white 255.
        """
        size = (self.squares[0] * square_px, self.squares[1] * square_px)
        return np.asarray(self._board.generateImage(size, marginSize=0, borderBits=1), dtype=np.uint8)

    def find(self, image: NDArray[np.uint8]) -> "BoardCorners":
        """Finds the chessboard corners that a picture shows, to a fraction of a pixel.

        Args:
            image: Grey, shape (H, W), or RGB, shape (H, W, 3).

        Returns:
            The corners; none (shape (0, ...)) where the board is not recognised.
        """
        pixels, ids, _, _ = cv2.aruco.CharucoDetector(self._board).detectBoard(as_grey(image))
        # With nothing found OpenCV gives None, whatever its types say.
        if ids is None or len(ids) == 0:  # type: ignore[redundant-expr]
            return BoardCorners(np.empty((0, 3)), np.empty((0, 2)))
        where = np.asarray(pixels, np.float64).reshape(-1, 2) + HALF_PIXEL
        return BoardCorners(self.corners_m[np.asarray(ids).ravel()], where)


class BoardCorners(NamedTuple):
    """Corners of a board in one picture.

    Attributes:
        points_m: In the board's frame, shape (n, 3), m.
        pixels: In the picture, (0, 0) its upper left corner, shape (n, 2), px.
    """

    points_m: Array
    pixels: Array


@dataclass(frozen=True, kw_only=True)
class SolveCfg:
    """How a calibration is solved.

    Attributes:
        min_views: Least number of pictures that show the board.
        min_corners: Pictures with fewer corners are left out.
        corner_px: Standard deviation of a corner's coordinate [px].
        outlier_px: Scale beyond which a corner's error counts less (soft L1): the nozzle hides parts of
            squares, and what is left can look like a corner.
        tip_mm: Standard deviation of a tip pose's position, along each axis [mm]; a UR5 repeats to 0.1 mm.
        tip_deg: Standard deviation of a tip pose's rotation, about each axis [deg].
    """

    min_views: int = 5
    min_corners: int = 8
    corner_px: float = 0.1
    outlier_px: float = 0.3
    tip_mm: float = 0.05
    tip_deg: float = 0.02

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for name, low in (("min_views", 3), ("min_corners", 4)):
            value = getattr(self, name)
            require(
                is_number(value) and int(value) == value and value >= low,
                f"SolveCfg.{name} = {value!r}: must be a whole number >= {low}",
            )
        for name in ("corner_px", "outlier_px", "tip_mm", "tip_deg"):
            value = getattr(self, name)
            require(
                is_number(value) and value > 0, f"SolveCfg.{name} = {value!r}: must be a finite number > 0"
            )


class Calibration(NamedTuple):
    """What a calibration found.

    Attributes:
        camera: Intrinsics and mount; its ROI is the calibrated frame (``CameraCfg.window`` gives the ROI).
        T_world_board: The board's place, shape (4, 4), m.
        errors_px: Predicted minus found corners of the pictures used, shape (n, 2), px.
        views: Number of pictures used.
    """

    camera: CameraCfg
    T_world_board: Array
    errors_px: Array
    views: int


def camera_cfg(
    name: str, frame_px: tuple[int, int], focal_px: float, centre_px: Array, T_tip_camera: Array
) -> CameraCfg:
    """A pinhole camera and its mount as the cell file writes them.

    Args:
        name: Of the camera.
        frame_px: Width and height of its picture [px].
        focal_px: Focal length [px].
        centre_px: Principal point, shape (2,), px.
        T_tip_camera: Mount, camera frame x right, y down, z forward, shape (4, 4), m.

    Returns:
        The camera; its target is the point of the optical axis nearest the nozzle mouth.
    """
    rotation, position = T_tip_camera[:3, :3], T_tip_camera[:3, 3]
    mouth = -rotation.T @ position
    target = position + mouth[2] * rotation[:, 2]
    tip = centre_px + focal_px * mouth[:2] / mouth[2]
    position_mm, target_mm, up = (
        (float(v[0]), float(v[1]), float(v[2])) for v in (1e3 * position, 1e3 * target, -rotation[:, 1])
    )
    return CameraCfg(
        name=name,
        position_mm=position_mm,
        target_mm=target_mm,
        up=up,
        roi_px=frame_px,
        focal_px=float(focal_px),
        tip_px=(float(tip[0]), float(tip[1])),
    )


def calibrate(
    name: str,
    frame_px: tuple[int, int],
    T_world_tip: Array,
    seen: Sequence[BoardCorners],
    cfg: SolveCfg | None = None,
) -> Calibration:
    """Finds a camera's intrinsics and mount from pictures of a board that stands still.

    Args:
        name: Of the camera.
        frame_px: Width and height of the pictures [px].
        T_world_tip: Tip pose of each picture, shape (n, 4, 4), m.
        seen: The corners in each picture.
        cfg: How to solve.

    Returns:
        The calibration.

    Raises:
        CalibrationError: If too few pictures show the board, or the tip was not turned about two axes.
    """
    cfg = cfg or SolveCfg()
    used = [k for k, corners in enumerate(seen) if len(corners.pixels) >= cfg.min_corners]
    require(
        len(used) >= cfg.min_views,
        f"{len(used)} of {len(seen)} pictures show {cfg.min_corners} corners or more: at least "
        f"{cfg.min_views} are needed; bring the board nearer or into better light",
        CalibrationError,
    )
    tips, views = np.asarray(T_world_tip, np.float64)[used], [seen[k] for k in used]
    focal, centre, T_camera_board = _zhang(frame_px, views)
    T_tip_camera = hand_eye(tips, T_camera_board)
    problem = _Problem.of(tips, views, cfg)
    start = _pack(focal, centre, T_tip_camera, tips[0] @ T_tip_camera @ T_camera_board[0])
    fit = least_squares(
        problem.residuals,
        np.concatenate((start, np.zeros(6 * len(views)))),
        x_scale="jac",
        loss="soft_l1",
        f_scale=cfg.outlier_px / cfg.corner_px,
        max_nfev=_MAX_STEPS,
    )
    focal, centre, T_tip_camera, T_world_board = _unpack(fit.x)
    return Calibration(
        camera=camera_cfg(name, frame_px, focal, centre, T_tip_camera),
        T_world_board=T_world_board,
        errors_px=problem.errors_px(fit.x),
        views=len(views),
    )


def _zhang(frame_px: tuple[int, int], views: Sequence[BoardCorners]) -> tuple[float, Array, Array]:
    """Focal length, principal point and each view's ``T_camera_board``, by Zhang's method."""
    _, matrix, _, turns, shifts = cv2.calibrateCamera(
        [v.points_m.astype(np.float32) for v in views],
        [v.pixels.astype(np.float32) for v in views],
        frame_px,
        np.eye(3),
        np.zeros(5),
        flags=_PINHOLE,
    )
    rotations = Rotation.from_rotvec(np.reshape(turns, (-1, 3))).as_matrix()
    K = np.asarray(matrix, dtype=np.float64)
    return float(K[0, 0]), K[:2, 2], transform(rotations, np.reshape(shifts, (-1, 3)))


def hand_eye(T_world_tip: Array, T_camera_board: Array) -> Array:
    """The mount of a camera from its views of a fixed board: A X = X B over all pairs of views.

    Source: F. C. Park and B. J. Martin, "Robot sensor calibration: solving AX = XB on the Euclidean group",
    IEEE Trans. Robotics and Automation 10 (1994): the rotation that turns the axes of B into those of A in
    the least squares sense; then the translation by linear least squares.

    Args:
        T_world_tip: Tip poses, shape (n, 4, 4), m.
        T_camera_board: The board as each view saw it, shape (n, 4, 4), m.

    Returns:
        ``T_tip_camera``, shape (4, 4), m.

    Raises:
        CalibrationError: If the tip was turned about one axis only, or not at all.
    """
    i, j = np.triu_indices(len(T_world_tip), 1)
    A = np.linalg.inv(T_world_tip[i]) @ T_world_tip[j]
    B = T_camera_board[i] @ np.linalg.inv(T_camera_board[j])
    alpha, beta = (Rotation.from_matrix(m[:, :3, :3]).as_rotvec() for m in (A, B))
    spread = np.linalg.svd(alpha, compute_uv=False)
    require(
        bool(spread[1] > _MIN_SPREAD * np.sqrt(len(alpha))),
        "the tip poses are turned about one axis or less: turn the gun about two axes by 10 degrees or more",
        CalibrationError,
    )
    rotation = Rotation.align_vectors(alpha, beta)[0].as_matrix()
    left = (A[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = (B[:, :3, 3] @ rotation.T - A[:, :3, 3]).ravel()
    return transform(rotation, np.linalg.lstsq(left, right, rcond=None)[0])


def _pack(focal: float, centre: Array, T_tip_camera: Array, T_world_board: Array) -> Array:
    """Focal length and principal point, px; rotation vector and position of mount and board, rad and m."""
    six = [(Rotation.from_matrix(t[:3, :3]).as_rotvec(), t[:3, 3]) for t in (T_tip_camera, T_world_board)]
    return np.concatenate(([focal], centre, *six[0], *six[1]))


def _unpack(x: Array) -> tuple[float, Array, Array, Array]:
    mount, board = (
        transform(Rotation.from_rotvec(x[k : k + 3]).as_matrix(), x[k + 3 : k + 6]) for k in (3, 9)
    )
    return float(x[0]), x[1:3], mount, board


class _Problem(NamedTuple):
    """The least squares: 15 values of ``_pack``, then each tip pose's deviation in sigmas, turn and shift.

    Corners of all views lie one after another; ``view`` says whose each is.
    """

    tips: Array
    points_m: Array
    pixels: Array
    view: NDArray[np.intp]
    cfg: SolveCfg

    @classmethod
    def of(cls, tips: Array, views: Sequence[BoardCorners], cfg: SolveCfg) -> Self:
        """Puts the views one after another."""
        points, pixels = (np.concatenate(rows) for rows in zip(*views, strict=True))
        return cls(
            tips, points, pixels, np.repeat(np.arange(len(views)), [len(v.pixels) for v in views]), cfg
        )

    def residuals(self, x: Array) -> Array:
        """Everything in standard deviations, flat."""
        return np.concatenate((self.errors_px(x).ravel() / self.cfg.corner_px, x[_SHARED:]))

    def errors_px(self, x: Array) -> Array:
        """Predicted minus found corners, shape (n, 2), px."""
        focal, centre, mount, board = _unpack(x)
        off = x[_SHARED:].reshape(-1, 6)
        turn = Rotation.from_rotvec(np.deg2rad(self.cfg.tip_deg) * off[:, :3]).as_matrix()
        tips = self.tips @ transform(turn, 1e-3 * self.cfg.tip_mm * off[:, 3:])
        T_camera_board = (np.linalg.inv(tips @ mount) @ board)[self.view]
        p = (T_camera_board[:, :3, :3] @ self.points_m[:, :, None])[..., 0] + T_camera_board[:, :3, 3]
        return np.asarray(centre + focal * p[:, :2] / p[:, 2:] - self.pixels)
