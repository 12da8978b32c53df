"""Where arm and tool may be over a palette: postures by inverse kinematics, collisions by MuJoCo."""

import copy

import mujoco
import numpy as np
from numpy.typing import NDArray

from seal_gym.core.frames import Array, quat_from_matrix, transform
from seal_gym.planning import ik, ik_kernel
from seal_gym.sim.arm import ArmScene
from seal_gym.sim.scene import ENVIRONMENT


class ToolCheck:
    """Answers for one scene with the tool upright.

    The scene is looked at, never stepped; use one object in each thread.
    """

    def __init__(self, scene: ArmScene, part_pose: Array, posture: Array, margin_m: float = 0.003) -> None:
        """Takes the scene.

        Args:
            scene: With the arm; its slides stay where they are at rest.
            part_pose: ``T_base_part``, shape (4, 4), m.
            posture: Near which the inverse kinematics stays, shape (6,), rad.
            margin_m: Things nearer than this to arm or tool collide with it [m].
        """
        self._model = copy.deepcopy(scene.model)
        # Margins of a pair add up: only what stands around has one. The broad phase looks at the bodies'.
        around = np.flatnonzero(self._model.geom_contype == ENVIRONMENT["contype"])
        self._model.geom_margin[around] = margin_m
        self._model.body_margin[self._model.geom_bodyid[around]] = margin_m
        self._data = mujoco.MjData(self._model)
        self._data.mocap_pos[0] = part_pose[:3, 3]
        self._data.mocap_quat[0] = quat_from_matrix(part_pose[:3, :3])
        self._posture = posture.copy()

    def postures(self, points: Array) -> Array:
        """Joint angles with the upright tool's tip at some points.

        Args:
            points: Shape (m, 3), m.

        Returns:
            Shape (m, 6), rad; NaN out of reach.
        """
        upright = np.broadcast_to(np.eye(3), (len(points), 3, 3))
        return ik.nearest(ik_kernel.solve(transform(upright, points)), self._posture)

    def free_postures(self, q: Array) -> NDArray[np.bool_]:
        """Whether nothing collides at some joint angles.

        Args:
            q: Shape (m, 6), rad.

        Returns:
            Shape (m,); false where an angle is NaN.
        """
        free = np.array(np.isfinite(q).all(axis=1))
        for k in np.flatnonzero(free):
            self._data.qpos[:6] = q[k]
            mujoco.mj_kinematics(self._model, self._data)
            mujoco.mj_collision(self._model, self._data)
            free[k] = self._data.ncon == 0
        return free

    def free(self, points: Array) -> NDArray[np.bool_]:
        """Whether nothing collides with the upright tool's tip at some points.

        Args:
            points: Shape (m, 3), m.

        Returns:
            Shape (m,); false out of reach.
        """
        return self.free_postures(self.postures(points))
