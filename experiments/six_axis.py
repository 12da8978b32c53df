"""The six-axis arm of Carvajal and Martinez-Garcia, section II, with its misprints mended.

Three links carried round by shoulder and wrist: link i stands at the pitch a_i and the roll b_i that its
joints add up to, all at the yaw phi_0. As printed, links change their length (z of Eq. 3: ``l1 s1 s0`` for
``l1 s1``, and ``- s135 s2 s4`` for ``+ s135 s2 s4`` in the bracket of l3), Eqs. 6 and 16-21 err in a sign or
a term, and Eq. 22 repeats dx in its rows of y and z. Every entry here is the derivative of the mended
Eqs. 1-3.
"""

import numpy as np

from seal_gym.core.frames import Array
from seal_gym.planning.newton import Linearised

LENGTHS_M = (0.40, 0.35, 0.25)
"""Of the links; the paper gives none."""
# Which joints turn each link: pitch by joints 1, 3, 5, roll by 2 and 4.
_PITCH = np.array([[0, 1, 0, 0, 0, 0], [0, 1, 0, 1, 0, 0], [0, 1, 0, 1, 0, 1]], dtype=np.float64)
_ROLL = np.array([[0, 0, 0, 0, 0, 0], [0, 0, 1, 0, 0, 0], [0, 0, 1, 0, 1, 0]], dtype=np.float64)
_YAW = np.array([1, 0, 0, 0, 0, 0], dtype=np.float64)
ANGLES = np.stack((_PITCH[2], _ROLL[2], _YAW))
"""Rows of alpha, beta and gamma in the Jacobian; Eq. 22."""


def _links(q: Array) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Sine and cosine of pitch and roll, shape (..., 3), and of yaw, shape (..., 1)."""
    a, b, yaw = q @ _PITCH.T, q @ _ROLL.T, q[..., :1]
    return np.sin(a), np.cos(a), np.sin(b), np.cos(b), np.sin(yaw), np.cos(yaw)


def pose(q: Array) -> Array:
    """Position and angles of the end; Eqs. 1-3.

    Args:
        q: Joint angles, shape (..., 6), rad.

    Returns:
        x, y, z [m], pitch alpha, roll beta and yaw gamma [rad], shape (..., 6).
    """
    sa, ca, sb, cb, s0, c0 = _links(q)
    links = np.stack((ca * s0 * cb + sa * sb, ca * c0, sa * cb - ca * s0 * sb), axis=-2)
    return np.concatenate((links @ np.array(LENGTHS_M), q @ ANGLES.T), axis=-1)


def jacobian(q: Array) -> Array:
    """Derivative of the pose by the joints; Eqs. 4-22.

    Args:
        q: Joint angles, shape (..., 6), rad.

    Returns:
        Shape (..., 6, 6).
    """
    sa, ca, sb, cb, s0, c0 = _links(q)
    zero = np.zeros_like(sa)
    by_pitch = np.stack((-sa * s0 * cb + ca * sb, -sa * c0, ca * cb + sa * s0 * sb), axis=-2)
    by_roll = np.stack((-ca * s0 * sb + sa * cb, zero, -sa * sb - ca * s0 * cb), axis=-2)
    by_yaw = np.stack((ca * c0 * cb, -ca * s0, -ca * c0 * sb), axis=-2)
    turns = ((by_pitch, _PITCH), (by_roll, _ROLL), (by_yaw, np.tile(_YAW, (3, 1))))
    upper = np.sum([(part * LENGTHS_M) @ joints for part, joints in turns], axis=0)
    return np.concatenate((upper, np.broadcast_to(ANGLES, upper.shape)), axis=-2)


def linearised(q: Array, target: Array) -> Linearised:
    """The arm about some postures, for ``newton.solve``; Eqs. 35-38 with the target.

    Args:
        q: Shape (N, 6), rad.
        target: Poses as from ``pose``, shape (N, 6).

    Returns:
        Errors, angles within half a turn.
    """
    error = target - pose(q)
    error[:, 3:] -= 2 * np.pi * np.round(error[:, 3:] / (2 * np.pi))
    return Linearised(error, jacobian(q))
