"""Whether the arm can seal a part: every posture along the seam, at every displacement of the part."""

from functools import lru_cache
from itertools import product
from typing import NamedTuple

import mujoco
import numpy as np

from seal_gym.core.errors import SeamError, require
from seal_gym.core.frames import Array, tip_rotation, transform, yaw_pose
from seal_gym.core.kinematics import JOINT_LOWER, JOINT_UPPER, tip_kinematics
from seal_gym.planning import ik
from seal_gym.sim.scene import Scene

_STEP_M = 5e-3
# Below this the tip's speed costs joint speeds the arm does not have (smallest singular value, rotation
# scaled by the distance from flange to mouth).
_MIN_SINGULAR = 0.05
_LENGTH_M = 0.25


class Reach(NamedTuple):
    """How the arm seals a part.

    Attributes:
        start_q: Posture at the seam's start with the part in its nominal pose, shape (6,), rad.
        smallest_singular: Of the scaled Jacobian over all postures checked.
        joint_range: Smallest and largest joint angles met, shape (2, 6), rad.
    """

    start_q: Array
    smallest_singular: float
    joint_range: Array


def _displacements(shift_m: float, yaw_rad: float) -> Array:
    """The nominal pose and the corners of the displacement's range, shape (9, 4, 4)."""
    corners = product((-shift_m, shift_m), (-shift_m, shift_m), (-yaw_rad, yaw_rad))
    return np.stack([np.eye(4), *(yaw_pose(x, y, 0.0, yaw) for x, y, yaw in corners)])


@lru_cache(maxsize=32)
def check_reach(scene: Scene, shift_m: float, yaw_rad: float) -> Reach:
    """Checks that one branch of the inverse kinematics carries the gun along the whole seam.

    Args:
        scene: The scene with the part.
        shift_m: Largest displacement of the part in x and y [m].
        yaw_rad: Largest rotation of the part about its origin [rad].

    Returns:
        The posture to start from, and how close the arm comes to its limits.

    Raises:
        SeamError: If a stretch is out of reach, at a joint limit or singular, or gun, arm or cameras touch
            something there; the message names the place.
    """
    part, seam = scene.workpiece, scene.workpiece.seam
    s = np.linspace(0.0, seam.length, int(np.ceil(seam.length / _STEP_M)) + 1)
    p, t, a = seam.at(s)
    tip = transform(tip_rotation(t, a), p + scene.cell.process.stand_off_m * a)
    displaced = part.pose @ _displacements(shift_m, yaw_rad)
    poses = displaced[:, None] @ tip[None]
    q = np.unwrap(ik.solve(poses), axis=1)  # (displacement, station, branch, joint)
    # A whole turn more or less keeps the posture: bring the middle of each joint's travel near zero.
    with np.errstate(invalid="ignore"):
        q -= 2 * np.pi * np.round(np.mean(q, axis=1, keepdims=True) / (2 * np.pi))
    blocked = [_why_not(q[:, :, b], s) for b in range(ik.BRANCHES)]
    open_branches = [b for b, why in enumerate(blocked) if not why]
    # Elbow up first: the branch of the nominal parts, which keeps the forearm off the table.
    order = sorted(open_branches, key=lambda b: b != 5)
    reasons = []
    for b in order:
        touching = _touching(scene, q[:, :, b], displaced, s)
        if not touching:
            flat = q[:, :, b].reshape(-1, 6)
            return Reach(
                start_q=q[0, 0, b],
                smallest_singular=float(_smallest_singular(flat).min()),
                joint_range=np.stack((flat.min(axis=0), flat.max(axis=0))),
            )
        reasons.append(touching)
    why = reasons[0] if reasons else blocked[5]
    require(
        False,
        f"workpiece {part.name!r} cannot be sealed by this cell: {why}. Move or turn the part (pose=), or "
        f"change the seam; the part may be displaced by {shift_m * 1e3:.0f} mm and "
        f"{np.rad2deg(yaw_rad):.0f} deg",
        SeamError,
    )
    raise AssertionError  # require has raised


def _smallest_singular(q: Array) -> Array:
    jacobian = tip_kinematics(q, np.zeros_like(q)).jacobian.copy()
    jacobian[:, 3:] *= _LENGTH_M
    return np.asarray(np.linalg.svd(jacobian, compute_uv=False)[:, -1])


def _why_not(q: Array, s: Array) -> str:
    """Why a branch cannot carry the gun along the seam; empty if it can. q: (displacement, station, 6)."""
    missing = np.isnan(q).any(axis=(0, 2))
    if missing.any():
        return f"the seam at {s[missing][0] * 1e3:.0f} mm is out of the arm's reach"
    outside = ((q < JOINT_LOWER) | (q > JOINT_UPPER)).any(axis=(0, 2))
    if outside.any():
        return f"the seam at {s[outside][0] * 1e3:.0f} mm needs a joint beyond its limit"
    jump = (np.abs(np.diff(q, axis=1)) > 1.0).any(axis=(0, 2))
    if jump.any():
        return f"the wrist would turn over at {s[1:][jump][0] * 1e3:.0f} mm"
    smallest = _smallest_singular(q.reshape(-1, 6)).reshape(q.shape[:2]).min(axis=0)
    if smallest.min() < _MIN_SINGULAR:
        return f"the arm is singular at {s[np.argmin(smallest)] * 1e3:.0f} mm"
    return ""


def _touching(scene: Scene, q: Array, displaced: Array, s: Array) -> str:
    """The first contact along the seam; empty if there is none."""
    model = scene.model
    data = mujoco.MjData(model)
    for pose, postures in zip(displaced, q, strict=True):
        data.mocap_pos[0] = pose[:3, 3]
        mujoco.mju_mat2Quat(data.mocap_quat[0], np.ascontiguousarray(pose[:3, :3]).ravel())
        for station, posture in zip(s, postures, strict=True):
            data.qpos[:] = posture
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_collision(model, data)
            if data.ncon:
                names = [model.geom(int(g)).name for g in (data.contact[0].geom1, data.contact[0].geom2)]
                return (
                    f"{names[0]} and {names[1]} touch at {station * 1e3:.0f} mm along the seam (a corner "
                    "tighter than the nozzle allows, a wall in the way, or the part too close to the arm)"
                )
    return ""
