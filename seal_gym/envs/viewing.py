"""What people look at: a third-person picture with the ROIs as insets, or MuJoCo's viewer."""

import os
import sys
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import RenderError, require
from seal_gym.core.frames import Array, normalise
from seal_gym.sim.scene import GROUP_COLLISION

if TYPE_CHECKING:
    from seal_gym.envs.core import SealCore

HEIGHT, WIDTH = 720, 960
_PANEL = 304
_ZOOM = 3
_BACK_RGB = (28, 30, 34)
_TEXT_RGB = (235, 235, 235)
_LINE_RGB = (64, 220, 90)
_TIP_RGB = (255, 70, 60)
_TRAIL_RGBA = np.array([1.0, 0.45, 0.10, 1.0], np.float32)
_TRAIL_STEP_M = 2e-3
_TRAIL_RADIUS_M = 8e-4
# Viewing direction of the close-up in the tip frame.
_CLOSE_VIEW = normalise(np.array([-0.34, -0.62, -0.72]))


def check_render_mode(render_mode: str | None, allowed: list[str]) -> None:
    """Refuses an unknown render mode.

    Args:
        render_mode: What the user asked for.
        allowed: The modes there are.

    Raises:
        ConfigError: If it is not one of them.
    """
    require(
        render_mode is None or render_mode in allowed,
        f"render_mode = {render_mode!r}: must be None or one of {allowed}",
    )


def roi_inset(image: NDArray[np.uint8], point: Any, direction: Any, tip: Any) -> NDArray[np.uint8]:
    """An ROI enlarged, with the seam line and the nozzle mouth drawn in.

    Args:
        image: Shape (H, W, 3).
        point: A point on the line, shape (2,), px; None without a line.
        direction: The line's direction, shape (2,).
        tip: The nozzle mouth, shape (2,), px.

    Returns:
        Shape (3 H, 3 W, 3).
    """
    height, width = image.shape[:2]
    big = cv2.resize(image, (width * _ZOOM, height * _ZOOM), interpolation=cv2.INTER_NEAREST)
    if point is not None:
        step = 300.0 * np.asarray(direction) / max(float(np.linalg.norm(direction)), 1e-9)
        ends = [tuple(round(_ZOOM * v) for v in np.asarray(point) + s * step) for s in (-1, 1)]
        cv2.line(big, ends[0], ends[1], _LINE_RGB, 1, cv2.LINE_AA)
    centre = tuple(round(_ZOOM * v) for v in tip)
    cv2.drawMarker(big, centre, _TIP_RGB, cv2.MARKER_CROSS, 9, 1, cv2.LINE_AA)
    return np.asarray(big, dtype=np.uint8)


class SceneView:
    """Shows the first simulation of a core."""

    def __init__(self, core: "SealCore") -> None:
        """Prepares to show; nothing is opened before the first picture.

        Args:
            core: What to show.
        """
        self._core = core
        self._renderers: dict[str, mujoco.Renderer] = {}
        self._trail: list[Array] = []
        self._frame = 0
        self._viewer: Any = None
        self._viewer_data: mujoco.MjData | None = None

    def picture(self) -> NDArray[np.uint8]:
        """The nozzle from ahead on its free side; beside it the two ROIs and the whole cell.

        The orange trail is the way of the nozzle mouth on the part.

        Returns:
            Shape (720, 960, 3), RGB.

        Raises:
            RenderError: If no OpenGL context can be made here.
        """
        self._extend_trail()
        out = np.full((HEIGHT, WIDTH, 3), _BACK_RGB, np.uint8)
        out[:, : WIDTH - _PANEL] = self._shot("nozzle", HEIGHT, WIDTH - _PANEL, self._close())
        core = self._core
        images = core.sensors.images(core.tip.pose, core.arm, core.frames)
        top = 0
        for v, (camera, image) in enumerate(zip(core.cfg.cell.cameras, images[:2], strict=True)):
            seen = bool(core.features.valid[0, v])
            line = core.lines
            inset = roi_inset(
                image[0], line.point[0, v] if seen else None, line.direction[0, v], camera.tip_px
            )
            top = self._place(out, inset, top, f"{camera.name} view")
        height = HEIGHT - top - 30
        self._place(out, self._shot("cell", height, _PANEL - 4, self._wide()), top, "cell")
        return out

    @staticmethod
    def _place(out: NDArray[np.uint8], inset: NDArray[np.uint8], top: int, label: str) -> int:
        """Puts an inset and its label into the panel; returns where the next one goes."""
        height, width = inset.shape[:2]
        left = WIDTH - _PANEL + (_PANEL - width) // 2
        where = (left, top + 20)
        cv2.putText(out, label, where, cv2.FONT_HERSHEY_SIMPLEX, 0.5, _TEXT_RGB, 1, cv2.LINE_AA)
        out[top + 28 : top + 28 + height, left : left + width] = inset
        return int(top + 28 + height)

    def _shot(self, name: str, height: int, width: int, camera: mujoco.MjvCamera) -> NDArray[np.uint8]:
        from seal_gym.sim.gl import offscreen  # loads OpenGL: only for pictures

        if name not in self._renderers:
            renderer = offscreen(self._core.scene.model, height, width)
            # Nothing here mirrors, and software OpenGL is slow: shadows only where they show depth.
            renderer.scene.flags[int(mujoco.mjtRndFlag.mjRND_REFLECTION)] = False
            renderer.scene.flags[int(mujoco.mjtRndFlag.mjRND_SHADOW)] = name == "nozzle"
            self._renderers[name] = renderer
        renderer = self._renderers[name]
        option = mujoco.MjvOption()
        option.geomgroup[GROUP_COLLISION] = 0
        option.sitegroup[:] = 0
        renderer.update_scene(self._core.arm.data(0), camera=camera, scene_option=option)
        self._draw_trail(renderer.scene)
        return np.asarray(renderer.render())

    def _wide(self) -> mujoco.MjvCamera:
        camera = mujoco.MjvCamera()
        camera.lookat[:] = self._core.arm.part_pose[0, :3, 3] + [-0.14, 0.0, 0.14]
        camera.distance, camera.azimuth, camera.elevation = 1.1, 205.0, -30.0
        return camera

    def _close(self) -> mujoco.MjvCamera:
        """From ahead of the nozzle on its free side, whichever way the gun has turned."""
        pose = self._core.tip.pose[0]
        view = pose[:3, :3] @ _CLOSE_VIEW
        camera = mujoco.MjvCamera()
        camera.lookat[:] = pose[:3, 3] + 0.006 * pose[:3, 2]
        camera.distance = 0.24
        camera.azimuth = float(np.rad2deg(np.arctan2(view[1], view[0])))
        camera.elevation = float(np.rad2deg(np.arcsin(np.clip(view[2], -1.0, 1.0))))
        return camera

    def _extend_trail(self) -> None:
        core = self._core
        if core.frames[0] < self._frame:
            self._trail.clear()
        self._frame = int(core.frames[0])
        part = core.arm.part_pose[0]
        mouth = part[:3, :3].T @ (core.tip.pose[0, :3, 3] - part[:3, 3])
        if not self._trail or np.linalg.norm(mouth - self._trail[-1]) >= _TRAIL_STEP_M:
            self._trail.append(mouth)

    def _draw_trail(self, scene: mujoco.MjvScene) -> None:
        part = self._core.arm.part_pose[0]
        points = [part[:3, :3] @ p + part[:3, 3] for p in self._trail]
        for a, b in pairwise(points):
            if scene.ngeom >= scene.maxgeom:
                return
            geom = scene.geoms[scene.ngeom]
            capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
            mujoco.mjv_initGeom(geom, int(capsule), np.zeros(3), np.zeros(3), np.eye(3).ravel(), _TRAIL_RGBA)
            mujoco.mjv_connector(geom, int(capsule), _TRAIL_RADIUS_M, a, b)
            scene.ngeom += 1

    def sync(self) -> None:
        """Brings MuJoCo's viewer up to date, opening it first.

        Raises:
            RenderError: If there is no screen.
        """
        core = self._core
        if self._viewer is None:
            # GLFW ends the process where it finds no screen: ask before.
            if sys.platform == "linux" and not (
                os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
            ):
                raise RenderError(
                    'render_mode="human" needs a screen, and neither DISPLAY nor WAYLAND_DISPLAY is set: use '
                    'render_mode="rgb_array"'
                )
            from mujoco import viewer  # loads GLFW: only with a screen

            self._viewer_data = mujoco.MjData(core.scene.model)
            try:
                self._viewer = viewer.launch_passive(core.scene.model, self._viewer_data)
            except Exception as error:
                raise RenderError(
                    f'render_mode="human" needs a screen ({error}): use render_mode="rgb_array" without one'
                ) from error
        data = core.arm.data(0)
        mujoco.mj_copyState(
            core.scene.model, data, self._viewer_data, int(mujoco.mjtState.mjSTATE_INTEGRATION)
        )
        mujoco.mj_forward(core.scene.model, self._viewer_data)
        self._viewer.sync()

    def close(self) -> None:
        """Closes what was opened; safe to call twice."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None
