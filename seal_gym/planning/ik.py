"""Closed-form inverse kinematics of the UR5."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.frames import Array, transform
from seal_gym.core.kinematics import (
    DH_A,
    DH_COS_ALPHA,
    DH_D,
    DH_SIN_ALPHA,
    JOINT_LOWER,
    JOINT_UPPER,
    T_TOOL0_TIP,
)

# Branch index = 4 shoulder + 2 wrist + elbow; 0 and 1 choose the sign of each square root.
BRANCHES = 8
_SINGULAR = 1e-9
_TURN = 2.0 * np.pi
_STOPPED_RAD = 1e-9  # a joint that a limit moved is not the solution's any more


def _link(k: int, angle: NDArray[np.floating[Any]]) -> Array:
    """``T_{k-1,k}`` for joint angles, shape (..., 4, 4)."""
    c, s = np.cos(angle), np.sin(angle)
    ca, sa = DH_COS_ALPHA[k], DH_SIN_ALPHA[k]
    zero = np.zeros_like(c)
    rotation = np.stack(
        [
            np.stack((c, -s * ca, s * sa), -1),
            np.stack((s, c * ca, -c * sa), -1),
            np.stack((zero, zero + sa, zero + ca), -1),
        ],
        -2,
    )
    return transform(rotation, np.stack((DH_A[k] * c, DH_A[k] * s, zero + DH_D[k]), -1))


def _inverse(t: Array) -> Array:
    rotation = np.swapaxes(t[..., :3, :3], -1, -2)
    return transform(rotation, -(rotation @ t[..., :3, 3:])[..., 0])


def _wrap(angle: Array) -> Array:
    return np.asarray(np.mod(angle + np.pi, 2 * np.pi) - np.pi)


def solve(pose_tip: Array, tool: Array = T_TOOL0_TIP) -> Array:
    """All joint angles that put the tip at a pose.

    Source: K. P. Hawkins, "Analytic inverse kinematics for the Universal Robots UR-5/UR-10 arms" (2013),
    re-derived for the standard DH parameters.

    Args:
        pose_tip: ``T_base_tip``, shape (..., 4, 4), m.
        tool: ``T_tool0_tip``, shape (4, 4), m.

    Returns:
        Shape (..., 8, 6), rad in [-pi, pi): one row a branch, NaN where the branch does not reach the
        pose. Where the wrist is singular (sin q5 = 0) q6 is 0
        by choice, and a pose that needs another q6 for the forearm to reach it counts as out of reach.
    """
    pose = np.asarray(pose_tip @ _inverse(tool))
    branch = np.arange(BRANCHES)
    shoulder, wrist, elbow = (1.0 - 2.0 * ((branch >> bit) & 1) for bit in (2, 1, 0))
    t06 = np.broadcast_to(pose[..., None, :, :], (*pose.shape[:-2], BRANCHES, 4, 4))
    with np.errstate(invalid="ignore", divide="ignore"):
        p05 = t06[..., :3, 3] - DH_D[5] * t06[..., :3, 2]
        q1 = (
            np.arctan2(p05[..., 1], p05[..., 0])
            + shoulder * np.arccos(DH_D[3] / np.hypot(p05[..., 0], p05[..., 1]))
            + np.pi / 2
        )
        s1, c1 = np.sin(q1), np.cos(q1)
        # sin q5 from the rotation, not from cos q5, which carries q5 to the square root of the rounding only.
        sine = -t06[..., 0, 1] * s1 + t06[..., 1, 1] * c1
        cosine = t06[..., 0, 0] * s1 - t06[..., 1, 0] * c1
        s5 = wrist * np.hypot(sine, cosine)
        q5 = np.arctan2(s5, t06[..., 0, 2] * s1 - t06[..., 1, 2] * c1)
        singular = np.abs(s5) < _SINGULAR
        q6 = np.where(singular, 0.0, np.arctan2(wrist * sine, wrist * cosine))
        t14: Array = _inverse(_link(0, q1)) @ t06 @ _inverse(_link(4, q5) @ _link(5, q6))
        p13 = t14[..., :3, 3] - DH_D[3] * t14[..., :3, 1]
        reach2 = p13[..., 0] ** 2 + p13[..., 1] ** 2
        cos3 = (reach2 - DH_A[1] ** 2 - DH_A[2] ** 2) / (2 * DH_A[1] * DH_A[2])
        q3 = elbow * np.arccos(np.where(np.abs(cos3) < 1 + 1e-12, np.clip(cos3, -1.0, 1.0), np.nan))
        q2 = np.arctan2(p13[..., 1], p13[..., 0]) - np.arctan2(
            DH_A[2] * np.sin(q3), DH_A[1] + DH_A[2] * np.cos(q3)
        )
        t34 = _inverse(_link(1, q2) @ _link(2, q3)) @ t14
        q4 = np.arctan2(t34[..., 1, 0], t34[..., 0, 0])
    q = _wrap(np.stack((q1, q2, q3, q4, q5, q6), axis=-1))
    return np.where(np.all(np.isfinite(q), axis=-1, keepdims=True), q, np.nan)


def nearest(solutions: Array, reference: Array) -> Array:
    """The solution closest to a posture, each joint unwrapped to within half a turn of it.

    Args:
        solutions: From ``solve``, shape (..., 8, 6), rad.
        reference: Posture to stay near, shape (6,), rad.

    Returns:
        Shape (..., 6), rad; NaN where no branch reaches the pose.
    """
    unwrapped = reference + _wrap(solutions - reference)
    distance = np.sum((unwrapped - reference) ** 2, axis=-1)
    best = np.argmin(np.where(np.isnan(distance), np.inf, distance), axis=-1)
    return np.take_along_axis(unwrapped, best[..., None, None], axis=-2)[..., 0, :]


def within(q: Array, lower: Array, upper: Array) -> Array:
    """The same postures within limits: by whole turns where that does, else at the nearest limit.

    Args:
        q: Shape (..., d), rad.
        lower: Shape (d,), rad.
        upper: Shape (d,), rad.

    Returns:
        Shape (..., d), rad.
    """
    outside = (q < lower) | (q > upper)
    # Of the turns that end within, the one closest to the limit that was passed.
    turned = np.where(
        q > upper, q - _TURN * np.ceil((q - upper) / _TURN), q + _TURN * np.ceil((lower - q) / _TURN)
    )
    fits = outside & (turned >= lower) & (turned <= upper)
    return np.where(fits, turned, np.clip(q, lower, upper))


def nearest_within(
    solutions: Array, reference: Array, lower: Array = JOINT_LOWER, upper: Array = JOINT_UPPER
) -> Array:
    """The solution closest to a posture among those that whole turns of joints bring within limits.

    Args:
        solutions: From ``solve``, shape (..., 8, 6), rad.
        reference: Posture to stay near, shape (6,), rad.
        lower: Smallest joint angles, shape (6,), rad.
        upper: Largest joint angles, shape (6,), rad.

    Returns:
        Shape (..., 6), rad; NaN where no branch reaches the pose within the limits.
    """
    turned = within(reference + _wrap(solutions - reference), lower, upper)
    stopped = np.abs(_wrap(turned - solutions)).max(axis=-1) > _STOPPED_RAD
    distance = np.where(stopped, np.nan, np.sum((turned - reference) ** 2, axis=-1))
    best = np.argmin(np.where(np.isnan(distance), np.inf, distance), axis=-1)[..., None]
    chosen = np.take_along_axis(turned, best[..., None], axis=-2)[..., 0, :]
    return np.where(np.isnan(np.take_along_axis(distance, best, axis=-1)), np.nan, chosen)
