"""Closed-form kinematics of the UR5 with the sealing gun: pose, body Jacobian and its drift.

The robot's joint angles q give the pose of the tip (TCP) in the base frame; body twists are
[vx, vy, vz, wx, wy, wz] of the tip origin, resolved in the tip frame [m/s, rad/s].
"""

from typing import NamedTuple

import numpy as np

from seal_gym.core.frames import Array
from seal_gym.core.jit import kernel

# Standard Denavit-Hartenberg parameters of the UR5 (not the UR5e), from the maker's table.
DH_D = np.array([0.089159, 0.0, 0.0, 0.10915, 0.09465, 0.0823])
DH_A = np.array([0.0, -0.425, -0.39225, 0.0, 0.0, 0.0])
# Cosine and sine of the twist angles (pi/2, 0, 0, pi/2, -pi/2, 0), exact.
DH_COS_ALPHA = np.array([0.0, 1.0, 1.0, 0.0, 0.0, 1.0])
DH_SIN_ALPHA = np.array([1.0, 0.0, 0.0, 1.0, -1.0, 0.0])

JOINT_LOWER = np.array([-2.0, -2.0, -1.0, -2.0, -2.0, -2.0]) * np.pi
JOINT_UPPER = -JOINT_LOWER
JOINT_SPEED = np.array([3.15, 3.15, 3.15, 3.2, 3.2, 3.2])
HOME_Q = np.radians([-15.0, -90.0, -80.0, -100.0, 90.0, -60.0])
"""The arm's posture of rest: the gun upright, some 0.3 m above the table's middle [rad]."""
JOINT_TORQUE = np.array([150.0, 150.0, 150.0, 28.0, 28.0, 28.0])

# Nozzle mouth on the tool flange's z axis; the tip's z points back along the nozzle.
TOOL_LENGTH_M = 0.25
T_TOOL0_TIP = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, TOOL_LENGTH_M], [0.0, 0.0, 0.0, 1.0]]
)


class TipKinematics(NamedTuple):
    """Kinematics of the tip of N arms.

    Attributes:
        pose: ``T_base_tip``, shape (N, 4, 4), m.
        jacobian: Body Jacobian, twist = J qd, shape (N, 6, 6).
        drift: ``Jdot qd``, so that d/dt twist = J qdd + drift, shape (N, 6).
        twist: Body twist, shape (N, 6), m/s and rad/s.
    """

    pose: Array
    jacobian: Array
    drift: Array
    twist: Array


@kernel
def _tip_kinematics(  # noqa: PLR0912, PLR0915  # one pass along the chain; split, it would run twice
    q: Array,
    qd: Array,
    dh_d: Array,
    dh_a: Array,
    dh_ca: Array,
    dh_sa: Array,
    tool: Array,
    pose: Array,
    jacobian: Array,
    drift: Array,
    twist: Array,
) -> None:
    axis = np.empty((6, 3))
    origin = np.empty((6, 3))
    t = np.empty((3, 4))
    new = np.empty((3, 4))
    local = np.empty((3, 4))
    for i in range(q.shape[0]):
        t[:] = 0.0
        t[0, 0] = t[1, 1] = t[2, 2] = 1.0
        for k in range(7):
            if k < 6:
                c, s = np.cos(q[i, k]), np.sin(q[i, k])
                local[0, 0], local[0, 1], local[0, 2] = c, -s * dh_ca[k], s * dh_sa[k]
                local[1, 0], local[1, 1], local[1, 2] = s, c * dh_ca[k], -c * dh_sa[k]
                local[2, 0], local[2, 1], local[2, 2] = 0.0, dh_sa[k], dh_ca[k]
                local[0, 3], local[1, 3], local[2, 3] = dh_a[k] * c, dh_a[k] * s, dh_d[k]
                for r in range(3):
                    axis[k, r] = t[r, 2]
                    origin[k, r] = t[r, 3]
            else:
                for r in range(3):
                    for m in range(4):
                        local[r, m] = tool[r, m]
            for r in range(3):
                for m in range(4):
                    total = t[r, 0] * local[0, m] + t[r, 1] * local[1, m] + t[r, 2] * local[2, m]
                    new[r, m] = total + (t[r, 3] if m == 3 else 0.0)
            t[:] = new
        for r in range(3):
            for m in range(4):
                pose[i, r, m] = t[r, m]
            pose[i, 3, r] = 0.0
        pose[i, 3, 3] = 1.0

        # World frame: angular velocity of the link that carries each axis, and the two drift sums.
        wx = wy = wz = 0.0  # angular velocity
        vx = vy = vz = 0.0  # velocity of the point of the moving body that is at the world origin
        px, py, pz = t[0, 3], t[1, 3], t[2, 3]
        cp = np.zeros(3)
        cw = np.zeros(3)
        tip_v = np.zeros(3)
        for k in range(6):
            zx, zy, zz = axis[k, 0], axis[k, 1], axis[k, 2]
            ox, oy, oz = origin[k, 0], origin[k, 1], origin[k, 2]
            rate = qd[i, k]
            # Column of the Jacobian, in world axes: z x (p - o) and z.
            rx, ry, rz = px - ox, py - oy, pz - oz
            jx, jy, jz = zy * rz - zz * ry, zz * rx - zx * rz, zx * ry - zy * rx
            for r in range(3):
                jacobian[i, r, k] = t[0, r] * jx + t[1, r] * jy + t[2, r] * jz
                jacobian[i, 3 + r, k] = t[0, r] * zx + t[1, r] * zy + t[2, r] * zz
            tip_v[0] += jx * rate
            tip_v[1] += jy * rate
            tip_v[2] += jz * rate
            # d/dt of the axis: carried round by the links before it.
            ax, ay, az = wy * zz - wz * zy, wz * zx - wx * zz, wx * zy - wy * zx
            cw[0] += ax * rate
            cw[1] += ay * rate
            cw[2] += az * rate
            cp[0] += (ay * rz - az * ry) * rate
            cp[1] += (az * rx - ax * rz) * rate
            cp[2] += (ax * ry - ay * rx) * rate
            # d/dt of p - o: minus the velocity of the axis' origin; the tip's follows after the loop.
            ux, uy, uz = (
                vx + wy * oz - wz * oy,
                vy + wz * ox - wx * oz,
                vz + wx * oy - wy * ox,
            )
            cp[0] -= (zy * uz - zz * uy) * rate
            cp[1] -= (zz * ux - zx * uz) * rate
            cp[2] -= (zx * uy - zy * ux) * rate
            wx += zx * rate
            wy += zy * rate
            wz += zz * rate
            vx += (oy * zz - oz * zy) * rate
            vy += (oz * zx - ox * zz) * rate
            vz += (ox * zy - oy * zx) * rate
        cp[0] += wy * tip_v[2] - wz * tip_v[1]
        cp[1] += wz * tip_v[0] - wx * tip_v[2]
        cp[2] += wx * tip_v[1] - wy * tip_v[0]
        for r in range(3):
            twist[i, r] = t[0, r] * tip_v[0] + t[1, r] * tip_v[1] + t[2, r] * tip_v[2]
            twist[i, 3 + r] = t[0, r] * wx + t[1, r] * wy + t[2, r] * wz
        # d/dt (R^T v) = R^T (dv/dt) - omega_body x v_body.
        bx, by, bz = twist[i, 0], twist[i, 1], twist[i, 2]
        gx, gy, gz = twist[i, 3], twist[i, 4], twist[i, 5]
        spin = (gy * bz - gz * by, gz * bx - gx * bz, gx * by - gy * bx)
        for r in range(3):
            drift[i, r] = t[0, r] * cp[0] + t[1, r] * cp[1] + t[2, r] * cp[2] - spin[r]
            drift[i, 3 + r] = t[0, r] * cw[0] + t[1, r] * cw[1] + t[2, r] * cw[2]


def tip_kinematics(q: Array, qd: Array, tool: Array = T_TOOL0_TIP) -> TipKinematics:
    """Pose, body Jacobian, drift and twist of the tip.

    Source: standard DH convention; the drift is the term that Zhou et al.'s Eqs. 20-21 omit.

    Args:
        q: Joint angles, shape (N, 6), rad.
        qd: Joint speeds, shape (N, 6), rad/s.
        tool: ``T_tool0_tip``, shape (4, 4), m.

    Returns:
        See ``TipKinematics``.
    """
    n = len(q)
    out = TipKinematics(np.empty((n, 4, 4)), np.empty((n, 6, 6)), np.empty((n, 6)), np.empty((n, 6)))
    _tip_kinematics(q, qd, DH_D, DH_A, DH_COS_ALPHA, DH_SIN_ALPHA, tool, *out)
    return out
