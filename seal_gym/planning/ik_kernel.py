"""Closed-form inverse kinematics of the UR5, compiled: microseconds for one pose.

The branches and conventions are ``ik.solve``'s, which stays for the environments: published runs repeat to
the bit, and compiled code rounds otherwise in the last place. What differs is at singularities alone: the
stretched arm is found from poses that other software has rounded too, and where the wrist is singular joint 6
takes an angle with which the forearm reaches the pose if 0 does not do.
"""

import math

import numpy as np

from seal_gym.core.frames import Array
from seal_gym.core.jit import kernel
from seal_gym.core.kinematics import DH_A, DH_COS_ALPHA, DH_D, DH_SIN_ALPHA, T_TOOL0_TIP
from seal_gym.planning.ik import BRANCHES

_SINGULAR = 1e-9
_STRETCHED = 1e-9  # of the elbow's cosine: a pose 0.2 nm out of reach counts as that of the stretched arm


@kernel
def _link(k: int, angle: float, ca: Array, sa: Array, out: Array) -> None:
    """Rotation of ``T_{k-1,k}``."""
    c, s = math.cos(angle), math.sin(angle)
    out[0, 0], out[0, 1], out[0, 2] = c, -s * ca[k], s * sa[k]
    out[1, 0], out[1, 1], out[1, 2] = s, c * ca[k], -c * sa[k]
    out[2, 0], out[2, 1], out[2, 2] = 0.0, sa[k], ca[k]


@kernel
def _free_q6(r16: Array, x: float, y: float, d5: float, near: float, far: float) -> float:
    """Joint 6 where the wrist is singular and joints 4 and 6 share the turn: 0, or what the forearm reaches.

    Joint 3's origin lies on a circle of radius d5 about (x, y) of frame 1, opposite to joint 5's axis.
    """
    reach = math.hypot(x + d5 * r16[0, 1], y + d5 * r16[1, 1])
    if near <= reach <= far:
        return 0.0
    side = (1.0 if reach > far else -1.0) / math.hypot(x, y)
    ux, uy = side * x, side * y  # joint 5's axis
    return math.atan2(-(r16[0, 0] * ux + r16[1, 0] * uy), -(r16[0, 1] * ux + r16[1, 1] * uy))


@kernel
def _solve(  # noqa: PLR0912  # small matrix products written out, in one pass along the chain
    poses: Array, tool: Array, d: Array, a: Array, ca: Array, sa: Array, out: Array
) -> None:
    r06 = np.empty((3, 3))
    p06 = np.empty(3)
    r01, r45, r56 = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    r46, r14, r16 = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    p13, p16 = np.empty(3), np.empty(3)
    for i in range(poses.shape[0]):
        # T_0_6 = T_base_tip T_tool0_tip^-1
        for r in range(3):
            for c in range(3):
                r06[r, c] = 0.0
                for m in range(3):
                    r06[r, c] += poses[i, r, m] * tool[c, m]
            p06[r] = poses[i, r, 3]
            for m in range(3):
                p06[r] -= r06[r, m] * tool[m, 3]
        x, y = p06[0] - d[5] * r06[0, 2], p06[1] - d[5] * r06[1, 2]
        radius = math.hypot(x, y)
        out[i] = np.nan
        if not radius >= abs(d[3]):
            continue
        for b in range(8):
            shoulder, wrist, elbow = 1.0 - 2.0 * (b >> 2), 1.0 - 2.0 * ((b >> 1) & 1), 1.0 - 2.0 * (b & 1)
            q1 = math.atan2(y, x) + shoulder * math.acos(d[3] / radius) + math.pi / 2
            s1, c1 = math.sin(q1), math.cos(q1)
            # sin q5 from the rotation, not from cos q5, which carries q5 to the square root of the rounding.
            sine = -r06[0, 1] * s1 + r06[1, 1] * c1
            cosine = r06[0, 0] * s1 - r06[1, 0] * c1
            s5 = wrist * math.hypot(sine, cosine)
            q5 = math.atan2(s5, r06[0, 2] * s1 - r06[1, 2] * c1)
            _link(0, q1, ca, sa, r01)
            for r in range(3):
                for c in range(3):
                    r16[r, c] = r01[0, r] * r06[0, c] + r01[1, r] * r06[1, c] + r01[2, r] * r06[2, c]
                p16[r] = r01[0, r] * p06[0] + r01[1, r] * p06[1] + r01[2, r] * (p06[2] - d[0])
            if abs(s5) < _SINGULAR:
                x5, y5 = p16[0] - d[5] * r16[0, 2], p16[1] - d[5] * r16[1, 2]
                q6 = _free_q6(r16, x5, y5, d[4], abs(a[1] - a[2]), abs(a[1] + a[2]))
            else:
                q6 = math.atan2(wrist * sine, wrist * cosine)
            _link(4, q5, ca, sa, r45)
            _link(5, q6, ca, sa, r56)
            for r in range(3):
                for c in range(3):
                    r46[r, c] = r45[r, 0] * r56[0, c] + r45[r, 1] * r56[1, c] + r45[r, 2] * r56[2, c]
            for r in range(3):
                for c in range(3):
                    r14[r, c] = r16[r, 0] * r46[c, 0] + r16[r, 1] * r46[c, 1] + r16[r, 2] * r46[c, 2]
            for r in range(3):
                p13[r] = p16[r]
                for m in range(3):
                    p46 = (d[4] if m == 2 else 0.0) + r45[m, 2] * d[5]
                    p13[r] -= r14[r, m] * p46
                p13[r] -= d[3] * r14[r, 1]
            cos3 = (p13[0] ** 2 + p13[1] ** 2 - a[1] ** 2 - a[2] ** 2) / (2 * a[1] * a[2])
            if not abs(cos3) < 1 + _STRETCHED:
                continue
            q3 = elbow * math.acos(min(max(cos3, -1.0), 1.0))
            q2 = math.atan2(p13[1], p13[0]) - math.atan2(a[2] * math.sin(q3), a[1] + a[2] * math.cos(q3))
            c23, s23 = math.cos(q2 + q3), math.sin(q2 + q3)
            q4 = math.atan2(c23 * r14[1, 0] - s23 * r14[0, 0], c23 * r14[0, 0] + s23 * r14[1, 0])
            q = (q1, q2, q3, q4, q5, q6)
            for k in range(6):
                out[i, b, k] = (q[k] + math.pi) % (2 * math.pi) - math.pi


def solve(pose_tip: Array, tool: Array = T_TOOL0_TIP) -> Array:
    """All joint angles that put the tip at a pose; see ``ik.solve``.

    Args:
        pose_tip: ``T_base_tip``, shape (..., 4, 4), m.
        tool: ``T_tool0_tip``, shape (4, 4), m.

    Returns:
        Shape (..., 8, 6), rad in [-pi, pi): one row a branch, NaN where the branch does not reach the pose.
    """
    poses = np.ascontiguousarray(pose_tip, dtype=np.float64).reshape(-1, 4, 4)
    out = np.empty((len(poses), BRANCHES, 6))
    _solve(poses, np.ascontiguousarray(tool), DH_D, DH_A, DH_COS_ALPHA, DH_SIN_ALPHA, out)
    return out.reshape(*pose_tip.shape[:-2], BRANCHES, 6)
