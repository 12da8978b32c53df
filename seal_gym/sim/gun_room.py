"""Room for the gun beside a part and its cameras' sight of the seam, wherever the part stands."""

import copy

import mujoco
import numpy as np

from seal_gym.core.frames import Array, axis_angle, quat_from_matrix, tip_rotation, transform
from seal_gym.core.kinematics import tip_kinematics
from seal_gym.sim.scene import GUN_PREFIX, PART_PREFIX, Scene

# Room for what the tip's path is off.
_ROOM_M = 2e-4
# A follower of second order (12 /s, damping ratio 0.7) lags a seam that starts to turn by up to 0.46 / 12 s,
# and runs ahead by as much where it stops.
_LAG_S = 0.04
# Within this distance of a change of the seam's turning the gun may still swing.
_SWING_M = 3e-3
# What the cameras must see: the seam ahead of the tip, from the mouth to where trackers look.
_AHEAD_M = (0.0, 3.5e-3, 7e-3)
# A ray that ends this close to the seam has found it: the part collides as chords of its curves.
_SEEN_M = 5e-4
_SIGHT_GROUP = 5


class GunRoom:
    """The gun with its cameras, and the part at any pose in the tip frame."""

    def __init__(self, scene: Scene) -> None:
        """Takes the gun and the part out of a scene.

        Args:
            scene: The compiled scene; not changed.
        """
        model = copy.copy(scene.model)
        names = [model.geom(g).name for g in range(model.ngeom)]
        gun = np.array([n.startswith(GUN_PREFIX) for n in names])
        part = np.array([n.startswith(PART_PREFIX) for n in names])
        model.geom_contype[~(gun | part)] = model.geom_conaffinity[~(gun | part)] = 0
        model.geom_margin[:] = np.where(gun, _ROOM_M, 0.0)  # MuJoCo adds the margins of a pair
        model.geom_group[part] = _SIGHT_GROUP
        self._model, self._names = model, names
        self._data = mujoco.MjData(model)
        self._T_world_tip = tip_kinematics(np.zeros((1, 6)), np.zeros((1, 6))).pose[0]
        self._groups = (np.arange(mujoco.mjNGROUP) == _SIGHT_GROUP).astype(np.uint8)
        self._cameras = [(c.name, self._T_world_tip[:3, :3] @ c.position_m) for c in scene.cell.cameras]

    def _place(self, T_part_tip: Array) -> Array:
        """Moves the part to where the tip has a pose in its frame; gives ``T_world_part``."""
        pose = self._T_world_tip @ np.linalg.inv(T_part_tip)
        self._data.mocap_pos[0] = pose[:3, 3]
        self._data.mocap_quat[0] = quat_from_matrix(pose[:3, :3])
        mujoco.mj_kinematics(self._model, self._data)
        return np.asarray(pose)

    def touching(self, T_part_tip: Array) -> tuple[str, str] | None:
        """What of the gun comes closer to what of the part than the room it needs.

        Args:
            T_part_tip: Tip pose, shape (4, 4), m.

        Returns:
            Names of a geom of the gun and one of the part; None if there are none.
        """
        self._place(T_part_tip)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_collision(self._model, self._data)
        if not self._data.ncon:
            return None
        contact = self._data.contact[0]
        one, two = sorted((self._names[contact.geom1], self._names[contact.geom2]), reverse=True)
        return one, two

    def hidden_from(self, T_part_tip: Array, points: Array) -> str:
        """The first camera from which the part hides a point.

        Args:
            T_part_tip: Tip pose, shape (4, 4), m.
            points: In the part's frame, shape (k, 3), m.

        Returns:
            The camera's name, empty if both see all points.
        """
        pose = self._place(T_part_tip)
        goals = points @ pose[:3, :3].T + pose[:3, 3]
        hit = np.zeros(1, np.int32)
        for name, offset in self._cameras:
            eye = self._T_world_tip[:3, 3] + offset
            for ray in goals - eye:
                distance = float(np.linalg.norm(ray))
                seen = mujoco.mj_ray(
                    self._model,
                    self._data,
                    eye,
                    ray / distance,
                    self._groups,
                    1,
                    -1,
                    hit,
                    None,
                )
                if 0.0 <= seen < distance - _SEEN_M:
                    return name
        return ""


def _turning(scene: Scene, s: Array) -> Array:
    """How the seam turns near arc lengths: the largest d(tangent angle)/ds within reach of the gun's swing.

    Args:
        scene: The scene.
        s: Arc lengths, shape (n,), m.

    Returns:
        Axis times rate in the part's frame, shape (n, 3), rad/m.
    """
    seam = scene.workpiece.seam
    t = seam.tangent
    rate = np.cross(t[:-1], t[1:]) / np.diff(seam.arc)[:, None]
    size = np.linalg.norm(rate, axis=1)
    low = np.searchsorted(seam.arc, s - _SWING_M, side="right") - 1
    high = np.searchsorted(seam.arc, s + _SWING_M, side="left")
    largest = [a + int(np.argmax(size[a:b])) for a, b in zip(np.maximum(low, 0), high, strict=True)]
    return np.asarray(rate[largest])


def room_along(scene: Scene, s: Array) -> str:
    """The first place along the seam where the gun has no room beside the part.

    Where the seam turns, the gun must have room turned too little and too far as well.

    Args:
        scene: The scene.
        s: Arc lengths to look at, shape (n,), m.

    Returns:
        What touches where; empty if nothing does.
    """
    room = GunRoom(scene)
    swings = _LAG_S * scene.cell.process.speed_m_s * _turning(scene, s)
    for at, pose, swing in zip(s, tip_poses(scene, s), swings, strict=True):
        angle = float(np.linalg.norm(swing))
        for share in (0.0, -1.0, 1.0) if angle > 1e-6 else (0.0,):
            turned = pose.copy()
            if share:
                turned[:3, :3] = axis_angle(swing / angle, share * angle) @ pose[:3, :3]
            if pair := room.touching(turned):
                degrees = f"{np.rad2deg(angle):.1f} deg"
                by = f", swung by {degrees} as it may be where the seam turns" if share else ""
                return f"{pair[0]} and {pair[1]} touch at {at * 1e3:.0f} mm along the seam{by}"
    return ""


def sight_along(scene: Scene, s: Array) -> str:
    """The first place along the seam where the part itself hides the seam from a camera.

    Args:
        scene: The scene.
        s: Arc lengths to look at, shape (n,), m.

    Returns:
        Which camera where; empty if both see the seam all along.
    """
    room, seam = GunRoom(scene), scene.workpiece.seam
    for at, pose in zip(s, tip_poses(scene, s), strict=True):
        if name := room.hidden_from(pose, seam.at(at + np.array(_AHEAD_M)).position):
            return f"the part hides the seam from the {name} camera at {at * 1e3:.0f} mm along it"
    return ""


def tip_poses(scene: Scene, s: Array) -> Array:
    """``T_part_tip`` of the desired motion.

    Args:
        scene: The scene.
        s: Arc lengths, shape (n,), m.

    Returns:
        Shape (n, 4, 4), m.
    """
    p, t, a = scene.workpiece.seam.at(s)
    return transform(tip_rotation(t, a), p + scene.cell.process.stand_off_m * a)
