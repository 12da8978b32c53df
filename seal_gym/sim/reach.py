"""Whether the cell can seal a part: room for the gun, sight of the seam, and the arm's postures.

Gun, cameras and part are rigid: room and sight are the same wherever the part stands. The arm's postures are
looked at along the whole seam at every displacement of the part.
"""

from functools import lru_cache
from itertools import product
from typing import NamedTuple

import mujoco
import numpy as np

from seal_gym.core.errors import SeamError
from seal_gym.core.frames import Array, yaw_pose
from seal_gym.core.kinematics import JOINT_LOWER, JOINT_UPPER, tip_kinematics
from seal_gym.planning import ik
from seal_gym.sim.gun_room import room_along, sight_along, tip_poses
from seal_gym.sim.scene import Scene
from seal_gym.workpieces.seam import Seam

_STEP_M = 5e-3
# Below this the tip's speed costs joint speeds the arm does not have (smallest singular value, rotation
# scaled by the distance from flange to mouth).
_MIN_SINGULAR = 0.05
_LENGTH_M = 0.25
_TURN_RAD = np.deg2rad(15.0)
# What the joints may turn together (root of the sum of squares) where the seam bends: beyond about this the
# servos' lag swings the nozzle by the millimetre it is off the wall.
_MAX_SPEED_RAD_S = 2.7
# From station to station no joint turns as far, unless the branch ends in between.
_JUMP_RAD = 1.0
# Beside the part stations lie closer together.
_ROOM_STEP_M, _SIGHT_STEP_M = 1.25e-3, 2.5e-3
# In a hollow bend the mouth, nearer to its centre than the seam, goes a shorter way round: in tighter ones
# the loop through servo and nearest point rings, and the mouth meets the wall.
_MIN_HOLLOW_M = 15e-3
_LEANS_IN = 0.4  # share of the approach direction towards the bend's centre that makes it a hollow one
_ELBOW_UP = 5
_TRY_DISTANCE_M = (0.45, 0.35, 0.40, 0.50)
_TRY_YAW_RAD = (0.0, 0.79, 1.57, 2.36, 3.14, -2.36, -1.57, -0.79)


class Reach(NamedTuple):
    """How the arm seals a part.

    Attributes:
        part_pose: Nominal ``T_base_part``: the part's own, or a better one if the user gave none.
        start_q: Posture at the seam's start with the part in its nominal pose, shape (6,), rad.
        smallest_singular: Of the scaled Jacobian over all postures checked.
        joint_range: Smallest and largest joint angles met, shape (2, 6), rad.
        joint_speed: What the joints turn together, root of the sum of squares, where they have to turn
            fastest to follow the seam at nominal speed [rad/s].
    """

    part_pose: Array
    start_q: Array
    smallest_singular: float
    joint_range: Array
    joint_speed: float


def _displacements(shift_m: float, yaw_rad: float) -> Array:
    """The nominal pose and the corners of the displacement's range, shape (9, 4, 4)."""
    corners = product((-shift_m, shift_m), (-shift_m, shift_m), (-yaw_rad, yaw_rad))
    return np.stack([np.eye(4), *(yaw_pose(x, y, 0.0, yaw) for x, y, yaw in corners)])


@lru_cache(maxsize=32)
def check_reach(scene: Scene, shift_m: float, yaw_rad: float, *, by_vision: bool = False) -> Reach:
    """Checks that one branch of the inverse kinematics carries the gun along the whole seam.

    Before it looks at the arm it checks what no place of the part can mend: the gun's room beside the part
    and, for vision, the cameras' sight of the seam past the part.

    Args:
        scene: The scene with the part.
        shift_m: Largest displacement of the part in x and y [m].
        yaw_rad: Largest rotation of the part about its origin [rad].
        by_vision: Whether the cameras have to see the seam.

    Returns:
        The posture to start from, and how close the arm comes to its limits.

    Raises:
        SeamError: If the gun has no room, the seam cannot be seen, a stretch is out of reach, at a joint
            limit, too fast or singular, or gun, arm or cameras touch something there; the message names the
            place, and a pose that would do if there is one.
    """
    part = scene.workpiece
    _check_beside_part(scene, by_vision)
    displacements = _displacements(shift_m, yaw_rad)
    found = _try(scene, part.pose, displacements, _STEP_M)
    if isinstance(found, Reach):
        return found
    better = _better_pose(scene, displacements)
    if better and not part.placed:
        moved = _try(scene, yaw_pose(*better), displacements, _STEP_M)
        if isinstance(moved, Reach):
            return moved
    raise SeamError(
        f"workpiece {part.name!r} cannot be sealed by this cell: {found}. "
        + (
            f"It can with pose=({', '.join(f'{v:.3g}' for v in better)})"
            if better
            else "Nor at other places and angles that were tried: change the part, or cut its seam in two"
        )
        + f"; the part may be displaced by {shift_m * 1e3:.0f} mm and {np.rad2deg(yaw_rad):.0f} deg"
    )


def _check_beside_part(scene: Scene, by_vision: bool) -> None:
    """Refuses a part that leaves the gun no room or hides the seam, wherever it stands."""
    name, seam = scene.workpiece.name, scene.workpiece.seam
    if why := _too_hollow(seam):
        raise SeamError(f"workpiece {name!r} cannot be sealed: {why}")
    if why := room_along(scene, _stations(seam, _ROOM_STEP_M)):
        raise SeamError(
            f"workpiece {name!r} leaves the gun no room: {why} (a bend tighter than the gun allows, or a "
            "wall in its way), wherever the part stands: widen the bend, lower the wall, change the approach "
            "direction or travel the other way"
        )
    if by_vision and (why := sight_along(scene, _stations(seam, _SIGHT_STEP_M))):
        raise SeamError(
            f"workpiece {name!r} cannot be sealed by vision: {why}: widen the bend, lower the wall or travel "
            "the other way; perception='oracle' needs no sight"
        )


def _too_hollow(seam: Seam) -> str:
    """The first bend round the gun that is tighter than the gun can follow; empty if there is none."""
    curvature = np.diff(seam.tangent, axis=0) / np.diff(seam.arc)[:, None]
    size = np.linalg.norm(curvature, axis=1)
    inward = np.sum(curvature * seam.approach[:-1], axis=1) > _LEANS_IN * size
    inside = (seam.arc[1:] > 0.0) & (seam.arc[:-1] < seam.length)
    tight = np.flatnonzero(inward & inside & (size * _MIN_HOLLOW_M > 1.0 + 1e-3))
    if not len(tight):
        return ""
    first = int(tight[0])
    return (
        f"the hollow bend at {max(seam.arc[first], 0.0) * 1e3:.0f} mm along the seam has a radius of "
        f"{1e3 / size[first]:.1f} mm, and the gun, leaning over it, follows {_MIN_HOLLOW_M * 1e3:g} mm or "
        "more: enlarge corner_radius, or give more points along the bend"
    )


def _try(scene: Scene, part_pose: Array, displacements: Array, step_m: float) -> Reach | str:
    """How the arm seals the part at a nominal pose, or why it cannot."""
    seam = scene.workpiece.seam
    s = _stations(seam, step_m)
    displaced = part_pose @ displacements
    q = np.unwrap(
        ik.solve(displaced[:, None] @ tip_poses(scene, s)[None]), axis=1
    )  # (displacement, station, branch, joint)
    # A whole turn more or less keeps the posture: bring the middle of each joint's travel near zero.
    q -= 2 * np.pi * np.round((q.max(axis=1, keepdims=True) + q.min(axis=1, keepdims=True)) / (4 * np.pi))
    path = tip_poses(scene, s)[:, :3, 3]
    took_s = np.linalg.norm(np.diff(path, axis=0), axis=1) / scene.cell.process.speed_m_s
    fits = [_fit(q[:, :, b], s, took_s) for b in range(ik.BRANCHES)]
    # Elbow up first: the branch of the nominal parts, which keeps the forearm off the table. Then the
    # branch that stays farthest from a singularity.
    order = sorted(range(ik.BRANCHES), key=lambda b: (b != _ELBOW_UP, -fits[b].singular))
    contacts = []
    for b in order:
        if fits[b].why:
            continue
        why = _touching(scene, q[:, :, b], displaced, s)
        if not why:
            flat = q[:, :, b].reshape(-1, 6)
            return Reach(
                part_pose=part_pose,
                start_q=q[0, 0, b],
                smallest_singular=fits[b].singular,
                joint_range=np.stack((flat.min(axis=0), flat.max(axis=0))),
                joint_speed=fits[b].speed,
            )
        contacts.append(why)
    return contacts[0] if contacts else fits[_ELBOW_UP].why


def _stations(seam: Seam, step_m: float) -> Array:
    """Arc lengths to look at: closer together where the seam turns, so that no joint turns far in between."""
    turn = np.linalg.norm(np.diff(seam.tangent, axis=0), axis=1) * _STEP_M / _TURN_RAD
    effort = np.concatenate(([0.0], np.cumsum((np.diff(seam.arc) + turn) / step_m)))
    first, last = np.interp([0.0, seam.length], seam.arc, effort)
    s = np.interp(np.linspace(first, last, int(np.ceil(last - first)) + 1), effort, seam.arc)
    s[[0, -1]] = 0.0, seam.length
    return s


def _better_pose(scene: Scene, displacements: Array) -> tuple[float, float, float, float] | None:
    """A pose x, y, z, yaw at which the part can be sealed, of a few at other distances and angles."""
    seam = scene.workpiece.seam
    inside = seam.position[(seam.arc >= 0) & (seam.arc <= seam.length)]
    middle = (inside.min(axis=0) + inside.max(axis=0)) / 2
    height = scene.workpiece.pose[2, 3]
    for distance, yaw in product(_TRY_DISTANCE_M, _TRY_YAW_RAD):
        turned = yaw_pose(0.0, 0.0, 0.0, yaw)[:3, :3] @ (middle * [1.0, 1.0, 0.0])
        x, y, z = (float(v) for v in np.round(np.array([distance, 0.0, height]) - turned, 3))
        pose = yaw_pose(x, y, z, yaw)
        # Coarsely first: most poses fail somewhere.
        if all(isinstance(_try(scene, pose, displacements, step), Reach) for step in (4 * _STEP_M, _STEP_M)):
            return x, y, z, yaw
    return None


def _smallest_singular(q: Array) -> Array:
    jacobian = tip_kinematics(q, np.zeros_like(q)).jacobian.copy()
    jacobian[:, 3:] *= _LENGTH_M
    return np.asarray(np.linalg.svd(jacobian, compute_uv=False)[:, -1])


class _Fit(NamedTuple):
    """Why a branch cannot carry the gun along the seam, empty if it can; smallest singular value, speed."""

    why: str
    singular: float = 0.0
    speed: float = np.inf


def _fit(q: Array, s: Array, took_s: Array) -> _Fit:
    """Judges one branch; q: (displacement, station, joint), took_s: from station to station."""
    missing = np.isnan(q).any(axis=(0, 2))
    if missing.any():
        return _Fit(f"the seam at {s[missing][0] * 1e3:.0f} mm is out of the arm's reach")
    turned = np.diff(q, axis=1)
    jump = (np.abs(turned) > _JUMP_RAD).any(axis=(0, 2))
    if jump.any():
        return _Fit(f"the wrist would turn over at {s[1:][jump][0] * 1e3:.0f} mm along the seam")
    outside = ((q < JOINT_LOWER) | (q > JOINT_UPPER)).any(axis=0)
    if outside.any():
        station, joint = np.argwhere(outside)[0]
        return _Fit(
            f"joint {joint + 1} would go beyond its limit at {s[station] * 1e3:.0f} mm along the seam"
        )
    smallest = _smallest_singular(q.reshape(-1, 6)).reshape(q.shape[:2]).min(axis=0)
    if smallest.min() < _MIN_SINGULAR:
        return _Fit(f"the arm is near a singularity at {s[np.argmin(smallest)] * 1e3:.0f} mm along the seam")
    speed = (np.linalg.norm(turned, axis=2) / took_s).max(axis=0)
    worst = int(np.argmax(speed))
    if speed[worst] > _MAX_SPEED_RAD_S:
        return _Fit(
            f"the joints would have to turn at {speed[worst]:.1f} rad/s together at {s[worst] * 1e3:.0f} mm "
            f"along the seam, more than the {_MAX_SPEED_RAD_S:g} rad/s they follow without swinging: widen "
            "the bend there"
        )
    return _Fit("", float(smallest.min()), float(speed[worst]))


def _touching(scene: Scene, q: Array, displaced: Array, s: Array) -> str:
    """The first place along the seam where geoms touch; empty if there is none."""
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
                return f"{names[0]} and {names[1]} touch at {station * 1e3:.0f} mm along the seam"
    return ""
