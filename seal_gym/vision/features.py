"""From a seam line in each view to the ROI features, for vision and oracle alike.

A line in a view and the camera's optical centre span a plane that holds the seam. The planes of the two
views meet in the seam's tangent line in the tip frame: this decouples the side view's mixture of x and z.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.cell import CellCfg
from seal_gym.core.frames import Array
from seal_gym.core.jit import kernel

# A view shows the seam if this much of its line lies in the ROI.
MIN_SEEN_PX = 20.0


class SeamLines(NamedTuple):
    """The seam's line in each view of N simulations; view 0 is the front, 1 the side.

    Attributes:
        point: A point on the line, shape (N, 2, 2), px.
        direction: Its direction, of any length, shape (N, 2, 2), px.
        valid: Whether a line was found, shape (N, 2).
    """

    point: Array
    direction: Array
    valid: NDArray[np.bool_]


class RoiFeatures(NamedTuple):
    """What the two ROIs say about the seam (Zhou et al., section 2.1), of N simulations.

    Attributes:
        d_m: Attraction distance: x of the seam in the tip frame (front view), and z of the seam above the
            point one stand-off before the nozzle mouth (side view), shape (N, 2), m. Both zero on the path.
        theta_rad: Seam angle: atan2(dx, dy) (front view) and atan2(dz, dy) (side view) of the seam's
            direction in the tip frame, shape (N, 2), rad.
        d_px: Attraction distance in the image: the x (front) or y (side) component of the vector from
            the stand-off point's image to its foot on the line, shape (N, 2), px.
        theta_px_rad: Angle in the image to the vertical (front) or horizontal (side), wrapped to
            +-pi/2, shape (N, 2), rad.
        valid: Whether the view showed a line, shape (N, 2); the values of a view without are the last.
        point_m: The tangent line's point at y = 0 in the tip frame, shape (N, 3), m.
        direction: The tangent line's unit direction in the tip frame, y > 0, shape (N, 3).
    """

    d_m: Array
    theta_rad: Array
    d_px: Array
    theta_px_rad: Array
    valid: NDArray[np.bool_]
    point_m: Array
    direction: Array

    @classmethod
    def zeros(cls, n: int) -> "RoiFeatures":
        """Features of N simulations that have seen nothing yet.

        Args:
            n: Number of simulations.

        Returns:
            All zero and invalid, pointing along y.
        """
        return cls(
            d_m=np.zeros((n, 2)),
            theta_rad=np.zeros((n, 2)),
            d_px=np.zeros((n, 2)),
            theta_px_rad=np.zeros((n, 2)),
            valid=np.zeros((n, 2), np.bool_),
            point_m=np.zeros((n, 3)),
            direction=np.tile([0.0, 1.0, 0.0], (n, 1)),
        )

    def clear(self, i: int) -> None:
        """Forgets what one simulation has seen.

        Args:
            i: Which simulation.
        """
        for values in self:
            values[i] = 0
        self.direction[i, 1] = 1.0


class ViewGeometry(NamedTuple):
    """The calibrated cameras and the stand-off as bare arrays, for the kernels.

    Attributes:
        rotation: ``R_tip_camera``, shape (2, 3, 3).
        position: Optical centres in the tip frame, shape (2, 3), m.
        focal: Focal lengths, shape (2,), px.
        centre: Principal points, shape (2, 2), px.
        size: ROI widths and heights, shape (2, 2), px.
        reference: Image of the point one stand-off before the nozzle mouth, shape (2, 2), px.
        stand_off: Stand-off [m], shape (1,).
    """

    rotation: Array
    position: Array
    focal: Array
    centre: Array
    size: Array
    reference: Array
    stand_off: Array

    @classmethod
    def of(cls, cell: CellCfg) -> "ViewGeometry":
        """Takes the arrays from a cell.

        Args:
            cell: The cell.

        Returns:
            Its geometry.
        """
        cameras = cell.cameras
        stand_off = cell.process.stand_off_m
        return cls(
            rotation=np.stack([c.rotation for c in cameras]),
            position=np.stack([c.position_m for c in cameras]),
            focal=np.array([c.focal_px for c in cameras]),
            centre=np.stack([c.centre_px for c in cameras]),
            size=np.array([c.roi_px for c in cameras], dtype=np.float64),
            reference=np.stack([c.project(np.array([0.0, 0.0, -stand_off])) for c in cameras]),
            stand_off=np.array([stand_off]),
        )

    def inside(self, margin_px: float) -> "ViewGeometry":
        """The same cameras with smaller ROIs; pixels count from the smaller ROI's corner.

        Args:
            margin_px: Taken off on every side [px].

        Returns:
            Their geometry.
        """
        return self._replace(
            centre=self.centre - margin_px,
            size=self.size - 2.0 * margin_px,
            reference=self.reference - margin_px,
        )


@kernel
def _lines_to_features(
    point: Array,
    direction: Array,
    valid: NDArray[np.bool_],
    rotation: Array,
    position: Array,
    focal: Array,
    centre: Array,
    size: Array,
    reference: Array,
    stand_off: Array,
    d_m: Array,
    theta: Array,
    d_px: Array,
    theta_px: Array,
    out_valid: NDArray[np.bool_],
    point_m: Array,
    out_direction: Array,
) -> None:
    normal = np.empty((2, 3))
    offset = np.empty(2)
    for i in range(point.shape[0]):
        for v in range(2):
            out_valid[i, v] = valid[i, v]
            u, w = direction[i, v, 0], direction[i, v, 1]
            size2 = u * u + w * w
            if valid[i, v] and size2 > 0.0:
                rx, ry = reference[v, 0] - point[i, v, 0], reference[v, 1] - point[i, v, 1]
                along = (rx * u + ry * w) / size2
                d_px[i, v] = (along * u - rx) if v == 0 else (along * w - ry)
                # Angle to the vertical, pointing up (front); to the horizontal, pointing right (side).
                if v == 0:
                    sign = -1.0 if w > 0.0 else 1.0
                    theta_px[i, v] = np.arctan2(sign * u, -sign * w)
                else:
                    sign = -1.0 if u < 0.0 else 1.0
                    theta_px[i, v] = np.arctan2(-sign * w, sign * u)
            x, y = (point[i, v, 0] - centre[v, 0]) / focal[v], (point[i, v, 1] - centre[v, 1]) / focal[v]
            # Ray (x, y, 1) crossed with the direction (u, w, 0): the plane's normal, camera axes.
            cx, cy, cz = -w, u, x * w - y * u
            offset[v] = 0.0
            for r in range(3):
                normal[v, r] = rotation[v, r, 0] * cx + rotation[v, r, 1] * cy + rotation[v, r, 2] * cz
                offset[v] += normal[v, r] * position[v, r]
        if not (valid[i, 0] and valid[i, 1]):
            continue
        dx = normal[0, 1] * normal[1, 2] - normal[0, 2] * normal[1, 1]
        dy = normal[0, 2] * normal[1, 0] - normal[0, 0] * normal[1, 2]
        dz = normal[0, 0] * normal[1, 1] - normal[0, 1] * normal[1, 0]
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        # dy is also the determinant of the two planes at y = 0.
        if not abs(dy) > 1e-9 * length:
            out_valid[i, 0] = out_valid[i, 1] = False
            continue
        sign = 1.0 if dy > 0.0 else -1.0
        out_direction[i, 0] = sign * dx / length
        out_direction[i, 1] = sign * dy / length
        out_direction[i, 2] = sign * dz / length
        point_m[i, 0] = (normal[0, 2] * offset[1] - normal[1, 2] * offset[0]) / dy
        point_m[i, 1] = 0.0
        point_m[i, 2] = (normal[1, 0] * offset[0] - normal[0, 0] * offset[1]) / dy
        d_m[i, 0] = point_m[i, 0]
        d_m[i, 1] = point_m[i, 2] + stand_off[0]
        theta[i, 0] = np.arctan2(out_direction[i, 0], out_direction[i, 1])
        theta[i, 1] = np.arctan2(out_direction[i, 2], out_direction[i, 1])


def update_features(features: RoiFeatures, lines: SeamLines, views: ViewGeometry) -> None:
    """Brings features up to date, in place; a view without a line keeps its last values.

    Args:
        features: Of N simulations; overwritten.
        lines: Lines of N simulations.
        views: The calibrated cameras.
    """
    _lines_to_features(*lines, *views, *features)


@kernel
def length_inside(point: Array, direction: Array, size: Array) -> float:
    """Length of the part of a line that lies in the ROI [px] (Liang and Barsky's clipping)."""
    enter, leave = -np.inf, np.inf
    for r in range(2):
        if abs(direction[r]) < 1e-12:
            if point[r] < 0.0 or point[r] > size[r]:
                return 0.0
            continue
        a, b = -point[r] / direction[r], (size[r] - point[r]) / direction[r]
        enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    length = np.sqrt(direction[0] ** 2 + direction[1] ** 2)
    return float(max(0.0, leave - enter) * length)


@kernel
def _oracle_lines(
    seam_point: Array,
    seam_tangent: Array,
    tip_pose: Array,
    rotation: Array,
    position: Array,
    focal: Array,
    centre: Array,
    size: Array,
    reference: Array,
    stand_off: Array,
    point: Array,
    direction: Array,
    valid: NDArray[np.bool_],
) -> None:
    p, d = np.empty(3), np.empty(3)
    pc, dc = np.empty(3), np.empty(3)
    for i in range(seam_point.shape[0]):
        for r in range(3):
            p[r] = d[r] = 0.0
            for k in range(3):
                p[r] += tip_pose[i, k, r] * (seam_point[i, k] - tip_pose[i, k, 3])
                d[r] += tip_pose[i, k, r] * seam_tangent[i, k]
        for v in range(2):
            for r in range(3):
                pc[r] = dc[r] = 0.0
                for k in range(3):
                    pc[r] += rotation[v, k, r] * (p[k] - position[v, k])
                    dc[r] += rotation[v, k, r] * d[k]
            if pc[2] < 1e-3:
                valid[i, v] = False
                continue
            x, y = pc[0] / pc[2], pc[1] / pc[2]
            point[i, v, 0], point[i, v, 1] = centre[v, 0] + focal[v] * x, centre[v, 1] + focal[v] * y
            u, w = dc[0] - x * dc[2], dc[1] - y * dc[2]
            direction[i, v, 0], direction[i, v, 1] = u, w
            valid[i, v] = length_inside(point[i, v], direction[i, v], size[v]) >= MIN_SEEN_PX


def oracle_lines(seam_point: Array, seam_tangent: Array, tip_pose: Array, views: ViewGeometry) -> SeamLines:
    """The seam's tangent as each camera sees it: the truth that vision estimates (protocol.md).

    Args:
        seam_point: The seam's point nearest the tip, shape (N, 3), m, world frame.
        seam_tangent: Its direction of travel, shape (N, 3), world frame.
        tip_pose: ``T_world_tip``, shape (N, 4, 4), m.
        views: The calibrated cameras.

    Returns:
        Lines; valid where at least ``MIN_SEEN_PX`` of them lie in the ROI.
    """
    n = len(seam_point)
    lines = SeamLines(np.zeros((n, 2, 2)), np.zeros((n, 2, 2)), np.zeros((n, 2), np.bool_))
    _oracle_lines(seam_point, seam_tangent, tip_pose, *views, *lines)
    return lines
