"""Rotations and rigid transforms as plain arrays; ``R_a_b`` maps coordinates in b to coordinates in a."""

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import require

Array = NDArray[np.float64]


def normalise(v: Array) -> Array:
    """Scales vectors to unit length along the last axis.

    Args:
        v: Shape (..., n), non-zero.

    Returns:
        Shape (..., n).
    """
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


def cross(a: Array, b: Array) -> Array:
    """Cross product along the last axis; a fraction of ``numpy.cross``'s time on small arrays.

    Args:
        a: Shape (..., 3).
        b: Shape (..., 3), broadcast against ``a``.

    Returns:
        Shape (..., 3).
    """
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return np.stack((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx), axis=-1)


def axis_angle(axis: Array, angle_rad: Array | float) -> Array:
    """Rotation matrix by Rodrigues' formula.

    Args:
        axis: Unit vector(s), shape (..., 3).
        angle_rad: Angle(s) [rad], shape (...).

    Returns:
        Shape (..., 3, 3).
    """
    axis = np.asarray(axis, dtype=np.float64)
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    x, y, z = axis[..., 0], axis[..., 1], axis[..., 2]
    t = 1.0 - c
    rows = (
        (t * x * x + c, t * x * y - s * z, t * x * z + s * y),
        (t * x * y + s * z, t * y * y + c, t * y * z - s * x),
        (t * x * z - s * y, t * y * z + s * x, t * z * z + c),
    )
    return np.stack([np.stack(np.broadcast_arrays(*row), axis=-1) for row in rows], axis=-2)


def transform(rotation: Array, position: Array) -> Array:
    """Homogeneous transform from its parts.

    Args:
        rotation: Shape (..., 3, 3).
        position: Shape (..., 3), m.

    Returns:
        Shape (..., 4, 4).
    """
    out = np.zeros((*rotation.shape[:-2], 4, 4))
    out[..., :3, :3] = rotation
    out[..., :3, 3] = position
    out[..., 3, 3] = 1.0
    return out


def tip_rotation(tangent: Array, approach: Array) -> Array:
    """Orientation of a tip that travels along ``tangent`` with its nozzle along ``-approach``.

    Args:
        tangent: Unit direction of travel (tip y), shape (..., 3).
        approach: Direction from the seam back along the nozzle (tip z), shape (..., 3); made
            orthogonal to the tangent.

    Returns:
        ``R_frame_tip``, shape (..., 3, 3), columns x (right of travel), y, z.

    Raises:
        ConfigError: If an approach direction is parallel to its tangent.
    """
    z = approach - tangent * np.sum(approach * tangent, axis=-1, keepdims=True)
    require(
        bool(np.all(np.linalg.norm(z, axis=-1) > 1e-6)),
        "approach is parallel to the tangent: it must point away from the surface, across the seam",
    )
    z = normalise(z)
    return np.stack((cross(tangent, z), tangent, z), axis=-1)


def quat_from_matrix(rotation: Array) -> Array:
    """Unit quaternion (w, x, y, z), w >= 0, of a rotation matrix.

    Args:
        rotation: Shape (3, 3).

    Returns:
        Shape (4,).
    """
    r = np.asarray(rotation, dtype=np.float64)
    # Shepperd's method: divide by the largest of the four components.
    four = np.array(
        [
            1.0 + r[0, 0] + r[1, 1] + r[2, 2],
            1.0 + r[0, 0] - r[1, 1] - r[2, 2],
            1.0 - r[0, 0] + r[1, 1] - r[2, 2],
            1.0 - r[0, 0] - r[1, 1] + r[2, 2],
        ]
    )
    k = int(np.argmax(four))
    candidates = np.array(
        [
            [four[0], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], four[1], r[1, 0] + r[0, 1], r[0, 2] + r[2, 0]],
            [r[0, 2] - r[2, 0], r[1, 0] + r[0, 1], four[2], r[2, 1] + r[1, 2]],
            [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[2, 1] + r[1, 2], four[3]],
        ]
    )
    q = normalise(candidates[k])
    return q if q[0] >= 0 else -q


def yaw_pose(x_m: float, y_m: float, z_m: float, yaw_rad: float) -> Array:
    """Transform of a frame turned about z.

    Args:
        x_m: Position x [m].
        y_m: Position y [m].
        z_m: Position z [m].
        yaw_rad: Angle about z [rad].

    Returns:
        Shape (4, 4).
    """
    return transform(axis_angle(np.array([0.0, 0.0, 1.0]), yaw_rad), np.array([x_m, y_m, z_m]))
