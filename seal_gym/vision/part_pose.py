"""Where a part is, by the AR code on its plate as a fixed camera above the cell sees it.

Zhou et al. take their ground truth so. One code alone shows its tilt badly, and a part's origin lies a hand's
breadth from it; a part that lies flat at a known height needs only x, y and yaw, which are seen well.
"""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.optimize import least_squares

from seal_gym.core.cell import OverheadCfg
from seal_gym.core.errors import is_number, require
from seal_gym.core.frames import Array, transform, yaw_pose
from seal_gym.vision.calibration import HALF_PIXEL, as_grey

_DICTIONARY = cv2.aruco.DICT_4X4_50
_BITS = 6  # four, and the black rim on both sides
# Refinement of the code's sides: part of a side that is used, reach to both sides of it, samples across it.
_SIDE, _REACH_BITS, _PROFILE, _REFINEMENTS = (0.08, 0.92), 0.33, 24, 3
# Neighbours along a side that share their levels of white and black.
_SMOOTH = 9


@dataclass(frozen=True, kw_only=True, eq=False)
class PartMarker:
    """An AR code on a part.

    Its frame: origin in the code's middle, x to the right and y up in the code's picture, z out of it.

    Attributes:
        id: Number of the code in OpenCV's dictionary 4X4_50.
        size_m: Side of the code's black square [m].
        T_part_marker: Where it is on the part, shape (4, 4), m.
    """

    id: int
    size_m: float
    T_part_marker: Array

    def __post_init__(self) -> None:
        """Checks the ranges."""
        require(
            0 <= self.id < 50,
            f"PartMarker.id = {self.id!r}: must be a whole number in 0..49",
        )
        require(
            is_number(self.size_m) and self.size_m > 0,
            f"PartMarker.size_m = {self.size_m!r}: must be a finite number > 0",
        )
        require(
            np.shape(self.T_part_marker) == (4, 4) and bool(np.isfinite(self.T_part_marker).all()),
            "PartMarker.T_part_marker: must be a transform, shape (4, 4), finite",
        )

    @property
    def label_m(self) -> float:
        """Side of the label: the code with a white margin of one bit on each side [m]."""
        return self.size_m * (_BITS + 2) / _BITS

    @property
    def corners_m(self) -> Array:
        """The code's corners in its own frame, clockwise from the upper left, shape (4, 3), m."""
        half = self.size_m / 2
        return half * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])

    def picture(self, bit_px: int) -> NDArray[np.uint8]:
        """The label's print, its margin included.

        Args:
            bit_px: Pixels a bit.

        Returns:
            Grey picture, shape (8 * bit_px, 8 * bit_px), black 0 and white 255.
        """
        dictionary = cv2.aruco.getPredefinedDictionary(_DICTIONARY)
        code = cv2.aruco.generateImageMarker(dictionary, self.id, _BITS * bit_px, borderBits=1)
        return np.pad(np.asarray(code, dtype=np.uint8), bit_px, constant_values=255)

    def find(self, image: NDArray[np.uint8]) -> Array | None:
        """Finds the code's corners in a picture, to a fraction of a pixel.

        Args:
            image: Grey, shape (H, W), or RGB, shape (H, W, 3).

        Returns:
            The corners in the order of ``corners_m``, shape (4, 2), px; None if the code is not seen.
        """
        grey = as_grey(image)
        detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(_DICTIONARY))
        found, ids, _ = detector.detectMarkers(grey)
        # With nothing found OpenCV gives None for the numbers, whatever its types say.
        numbers = np.empty(0) if len(found) == 0 else np.ravel(ids)
        mine = np.flatnonzero(numbers == self.id).tolist()
        if len(mine) != 1:  # not seen, or seen twice: a mirror image or another part
            return None
        return refine_corners(grey, np.asarray(found[mine[0]], np.float64).reshape(4, 2) + HALF_PIXEL)


def refine_corners(grey: NDArray[np.uint8], corners_px: Array) -> Array:
    """A code's corners as the crossings of its four sides, each fitted to all of its pixels.

    OpenCV's sub-pixel corners err by 0.3 px towards the code's middle, its sides do not: across a side, white
    margin turns into black rim, and the area under the profile tells where, however blurred it is.

    Args:
        grey: The picture, shape (H, W).
        corners_px: To about a pixel, clockwise, shape (4, 2), px.

    Returns:
        The corners, shape (4, 2), px.
    """
    corners = corners_px
    for _ in range(_REFINEMENTS):
        sides = [_side(grey, corners[k], corners[(k + 1) % 4]) for k in range(4)]
        corners = np.stack([_crossing(sides[k - 1], sides[k]) for k in range(4)])
    return corners


def _side(grey: NDArray[np.uint8], start: Array, end: Array) -> Array:
    """Two points of the line on which white turns black, near that from start to end, shape (2, 2), px."""
    along = end - start
    length = float(np.linalg.norm(along))
    inward = np.array([-along[1], along[0]]) / length
    half = _REACH_BITS * length / _BITS
    share = np.linspace(*_SIDE, max(8, round(length)))
    offset = (np.arange(_PROFILE) + 0.5) / _PROFILE * 2 * half - half
    where = start + share[:, None, None] * along + offset[:, None] * inward - HALF_PIXEL
    x, y = (np.ascontiguousarray(v, dtype=np.float32) for v in (where[..., 0], where[..., 1]))
    source = grey.astype(np.float32)
    seen = cv2.remap(source, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    profile = np.asarray(seen, dtype=np.float64)
    rim = _PROFILE // 4
    # Levels place by place: the edge of a shadow may lie across the side.
    white, black = (
        median_filter(p.mean(axis=1), _SMOOTH, mode="nearest") for p in (profile[:, :rim], profile[:, -rim:])
    )
    edge = -half + (profile.mean(axis=1) - black) * 2 * half / np.maximum(white - black, 1.0)
    slope, level = _line(share, edge)
    return np.asarray(np.stack([start + x * along + (level + slope * x) * inward for x in (0.0, 1.0)]))


def _line(x: Array, y: Array) -> tuple[float, float]:
    """Slope and level of a line through most of the points: those within three deviations, found twice."""
    kept = np.ones(len(x), np.bool_)
    slope, level = 0.0, float(np.median(y))
    for _ in range(3):
        error = np.abs(y - level - slope * x)
        kept = error <= 3 * 1.4826 * np.median(error) + 1e-9
        slope, level = map(float, np.polyfit(x[kept], y[kept], 1))
    return slope, level


def _crossing(one: Array, other: Array) -> Array:
    """Where two lines, each through two points, meet, shape (2,)."""
    d, e = one[1] - one[0], other[1] - other[0]
    gap = other[0] - one[0]
    return np.asarray(one[0] + d * (gap[0] * e[1] - gap[1] * e[0]) / (d[0] * e[1] - d[1] * e[0]))


class PartPose(NamedTuple):
    """A part's pose as seen.

    Attributes:
        T_world_part: Shape (4, 4), m.
        residual_px: Root mean square distance from the corners seen to those of the pose [px].
    """

    T_world_part: Array
    residual_px: float


def part_pose(corners_px: Array, marker: PartMarker, camera: OverheadCfg) -> PartPose:
    """The pose from one code, all six freedoms (``cv2.SOLVEPNP_IPPE_SQUARE``).

    Source: T. Collins and A. Bartoli, "Infinitesimal plane-based pose estimation", IJCV 109 (2014). A square
    seen from afar has two poses that look alike; the one that looks more like the picture is taken.

    Args:
        corners_px: From ``PartMarker.find``, shape (4, 2), px.
        marker: The code.
        camera: The camera.

    Returns:
        The pose.
    """
    points, undistorted = marker.corners_m, np.zeros(4)
    _, turns, shifts, _ = cv2.solvePnPGeneric(
        points, corners_px, camera.matrix, undistorted, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    starts = [
        *zip(map(np.ravel, turns), map(np.ravel, shifts), strict=True),
        _facing(corners_px, marker, camera),
    ]
    poses = []
    for start in starts:
        if not np.isfinite(start).all():
            continue  # a code that faces the camera squarely is a singular case of the method
        rough_turn, rough_shift = (np.array(v, np.float64) for v in start)
        turn, shift = cv2.solvePnPRefineLM(
            points, corners_px, camera.matrix, undistorted, rough_turn, rough_shift
        )
        T_camera_marker = transform(cv2.Rodrigues(turn)[0].astype(np.float64), np.ravel(shift))
        pose = camera.pose @ T_camera_marker @ np.linalg.inv(marker.T_part_marker)
        poses.append(PartPose(pose, _rms(_errors(pose, corners_px, marker, camera))))
    return min(poses, key=lambda p: p.residual_px)


def _facing(corners_px: Array, marker: PartMarker, camera: OverheadCfg) -> tuple[Array, Array]:
    """Rotation vector and position of a code that faces the camera, as large and turned as it is seen."""
    top = corners_px[1] - corners_px[0]
    side = np.linalg.norm(corners_px - np.roll(corners_px, 1, axis=0), axis=1).mean()
    depth = camera.focal_px * marker.size_m / side
    ray = np.linalg.inv(camera.matrix) @ [*corners_px.mean(axis=0), 1.0]
    # Half a turn about the axis in the picture's plane that bisects the code's x and the picture's.
    half = 0.5 * np.arctan2(top[1], top[0])
    return np.pi * np.array([np.cos(half), np.sin(half), 0.0]), depth * ray


def level_part_pose(corners_px: Array, marker: PartMarker, camera: OverheadCfg, height_m: float) -> PartPose:
    """The pose of a part that lies flat at a known height: x, y and yaw by least squares.

    Args:
        corners_px: From ``PartMarker.find``, shape (4, 2), px.
        marker: The code.
        camera: The camera.
        height_m: z of the part's frame in the world [m].

    Returns:
        The pose; a large residual means that the part does not lie flat there.
    """
    free = part_pose(corners_px, marker, camera).T_world_part
    marker_at = free @ marker.T_part_marker
    yaw = float(np.arctan2(free[1, 0], free[0, 0]))
    # Start from the code's place rather than the part's: its tilt, badly seen, would move the origin.
    turned = yaw_pose(0.0, 0.0, 0.0, yaw)
    start = (marker_at - turned @ marker.T_part_marker)[:2, 3]

    def errors(x: Array) -> Array:
        return _errors(yaw_pose(x[0], x[1], height_m, x[2]), corners_px, marker, camera).ravel()

    fit = least_squares(errors, np.array([*start, yaw]), x_scale=(1e-3, 1e-3, 1e-2))
    pose = yaw_pose(fit.x[0], fit.x[1], height_m, fit.x[2])
    return PartPose(pose, _rms(fit.fun.reshape(-1, 2)))


def _errors(T_world_part: Array, corners_px: Array, marker: PartMarker, camera: OverheadCfg) -> Array:
    """Predicted minus seen corners, shape (4, 2), px."""
    T_camera_marker = np.linalg.inv(camera.pose) @ T_world_part @ marker.T_part_marker
    p = (marker.corners_m @ T_camera_marker[:3, :3].T + T_camera_marker[:3, 3]) @ camera.matrix.T
    return np.asarray(p[:, :2] / p[:, 2:] - corners_px)


def _rms(errors: Array) -> float:
    return float(np.sqrt((errors**2).sum(axis=1).mean()))
