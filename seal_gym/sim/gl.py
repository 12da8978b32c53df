"""Pictures by MuJoCo's own renderer: the third-person view, and the ROIs as a cross-check.

Needs OpenGL: ``MUJOCO_GL=egl`` with ``libegl1 libgl1 libgl1-mesa-dri`` on a machine without a screen.
"""

import mujoco
import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import RenderError
from seal_gym.core.frames import Array, quat_from_matrix
from seal_gym.core.kinematics import T_TOOL0_TIP
from seal_gym.sim.look import Look
from seal_gym.sim.raycast import Images, apply_sensor
from seal_gym.sim.scene import GROUP_COLLISION, GUN_PREFIX, Scene

# MuJoCo has no image-space anti-aliasing without multisampling: render larger, then average.
_SUPERSAMPLE = 4
HELP = "install libegl1 libgl1 libgl1-mesa-dri and set MUJOCO_GL=egl before the first import of mujoco"


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
        # PyOpenGL and the EGL loader raise AttributeError, ImportError and their own classes alike.
        raise RenderError(f"no OpenGL context on this machine ({error}): {HELP}") from error
