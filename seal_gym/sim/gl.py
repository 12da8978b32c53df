"""Pictures by MuJoCo's own renderer: the ROIs as a cross-check of the raycaster, and whole scenes.

Needs OpenGL: on a machine without a screen ``MUJOCO_GL=egl`` with ``libegl1 libgl1 libgl1-mesa-dri``.
"""

import mujoco
import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import RenderError
from seal_gym.core.frames import Array, quat_from_matrix
from seal_gym.core.kinematics import T_TOOL0_TIP
from seal_gym.sim.look import Look
from seal_gym.sim.raycast import Images, apply_sensor
from seal_gym.sim.scene import GROUP_COLLISION, GROUP_FURNITURE, GROUP_ROBOT, GUN_PREFIX, Scene

# Averaged down to the ROI: multisampling alone leaves edges a tenth of a pixel rough.
_SUPERSAMPLE = 4
HELP = (
    "set MUJOCO_GL=egl before the first import of mujoco, and install libegl1 libgl1 libgl1-mesa-dri if they "
    "are missing"
)


def offscreen(model: mujoco.MjModel, height: int, width: int) -> mujoco.Renderer:
    """An offscreen renderer, or a clear word why there is none.

    Args:
        model: The model.
        height: Of the pictures [px].
        width: Of the pictures [px].

    Returns:
        MuJoCo's renderer.

    Raises:
        RenderError: If no OpenGL context can be made here.
    """
    try:
        return mujoco.Renderer(model, height, width)
    except Exception as error:
        # PyOpenGL and the EGL loader raise AttributeError, ImportError and classes of their own alike.
        raise RenderError(f"no OpenGL context on this machine ({error}): {HELP}") from error


class GlSensors:
    """Draws the ROI images of N simulations one after the other, with the raycaster's interface.

    Light and material are MuJoCo's, so grey levels differ from the raycaster's; geometry does not.
    """

    def __init__(self, scene: Scene) -> None:
        """Makes the OpenGL contexts.

        Args:
            scene: The compiled scene.

        Raises:
            RenderError: If no OpenGL context can be made here.
        """
        self._scene = scene
        self._data = mujoco.MjData(scene.model)
        self._gun = scene.model.body(GUN_PREFIX + "sealgun").id
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = 0
        self._option.geomgroup[[1, GROUP_ROBOT]] = 1
        self._option.geomgroup[[GROUP_FURNITURE, GROUP_COLLISION]] = 0
        self._option.sitegroup[:] = 0
        self._renderers = [
            offscreen(scene.model, _SUPERSAMPLE * c.height, _SUPERSAMPLE * c.width)
            for c in scene.cell.cameras
        ]
        for renderer in self._renderers:
            for flag in ("mjRND_SHADOW", "mjRND_REFLECTION", "mjRND_SKYBOX"):
                renderer.scene.flags[int(getattr(mujoco.mjtRndFlag, flag))] = False

    def render(
        self, tip_pose: Array, part_pose: Array, look: Look, frame: NDArray[np.uint64], threads: int = 1
    ) -> Images:
        """Draws both views of N simulations.

        Args:
            tip_pose: ``T_world_tip``, shape (N, 4, 4), m.
            part_pose: ``T_world_part``, shape (N, 4, 4), m.
            look: Lamp, exposure and noise of each simulation.
            frame: Frame counters, shape (N,).
            threads: Not used: an OpenGL context belongs to one thread.

        Returns:
            The images and their signal-to-noise ratios.
        """
        del threads
        rows = [self._draw(tip_pose[i], part_pose[i], look, i) for i in range(len(tip_pose))]
        front, side = (np.stack(views) for views in zip(*rows, strict=True))
        return apply_sensor(front, side, look, frame)

    def _draw(self, tip: Array, part: Array, look: Look, i: int) -> list[Array]:
        data = self._data
        data.mocap_pos[0], data.mocap_quat[0] = part[:3, 3], quat_from_matrix(part[:3, :3])
        if len(data.mocap_pos) > 1:
            data.mocap_pos[1] = look.ball[i, :3]
        mujoco.mj_kinematics(self._scene.model, data)
        self._carry_gun(tip @ np.linalg.inv(T_TOOL0_TIP))
        pictures = []
        for camera, renderer in zip(self._scene.cell.cameras, self._renderers, strict=True):
            renderer.update_scene(data, camera=camera.name, scene_option=self._option)
            self._light(renderer.scene, tip[:3, :3] @ look.lamp[i], look.ambient[i], look.diffuse[i])
            big = renderer.render().astype(np.float64)
            k = _SUPERSAMPLE
            pictures.append(big.reshape(camera.height, k, camera.width, k, 3).mean(axis=(1, 3)))
        return pictures

    def _carry_gun(self, gun: Array) -> None:
        """Puts the gun's geoms and cameras where the tip is, whatever the arm's posture would be."""
        model, data = self._scene.model, self._data
        for ids, local_pos, local_quat, pos, mat in (
            (
                np.flatnonzero(model.geom_bodyid == self._gun),
                model.geom_pos,
                model.geom_quat,
                data.geom_xpos,
                data.geom_xmat,
            ),
            (
                np.flatnonzero(model.cam_bodyid == self._gun),
                model.cam_pos,
                model.cam_quat,
                data.cam_xpos,
                data.cam_xmat,
            ),
        ):
            rotation = np.empty(9)
            for k in ids:
                mujoco.mju_quat2Mat(rotation, local_quat[k])
                pos[k] = gun[:3, :3] @ local_pos[k] + gun[:3, 3]
                mat[k] = (gun[:3, :3] @ rotation.reshape(3, 3)).ravel()

    @staticmethod
    def _light(scene: mujoco.MjvScene, direction: Array, ambient: float, diffuse: float) -> None:
        """One lamp on the gun, as the raycaster has it, in place of the room's lights."""
        scene.nlight = 1
        light = scene.lights[0]
        light.type = int(mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
        light.headlight, light.castshadow = 0, 0
        light.dir[:] = -direction
        light.ambient[:], light.diffuse[:], light.specular[:] = ambient, diffuse, 0.0
