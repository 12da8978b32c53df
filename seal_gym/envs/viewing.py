"""What people look at: a third-person picture with the ROIs as insets, or MuJoCo's viewer."""

from typing import TYPE_CHECKING, Any

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import RenderError, require
from seal_gym.sim.scene import GROUP_COLLISION

if TYPE_CHECKING:
    from seal_gym.envs.core import SealCore

HEIGHT, WIDTH = 720, 960
_ZOOM = 3
_MARGIN = 14
_FRAME_RGB = (245, 245, 245)
_LINE_RGB = (64, 220, 90)
_TIP_RGB = (255, 70, 60)


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
        ends = [tuple(int(round(_ZOOM * v)) for v in np.asarray(point) + s * step) for s in (-1, 1)]
        cv2.line(big, ends[0], ends[1], _LINE_RGB, 1, cv2.LINE_AA)
    centre = tuple(int(round(_ZOOM * v)) for v in tip)
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
        self._renderer: mujoco.Renderer | None = None
        self._viewer: Any = None
        self._viewer_data: mujoco.MjData | None = None

    def picture(self) -> NDArray[np.uint8]:
        """The cell from the side of the bench, the ROIs in the upper right corner.

        Returns:
            Shape (720, 960, 3), RGB.

        Raises:
            RenderError: If no OpenGL context can be made here.
        """
        from seal_gym.sim.gl import offscreen  # noqa: PLC0415  # loads OpenGL: only for pictures

        core = self._core
        if self._renderer is None:
            self._renderer = offscreen(core.scene.model, HEIGHT, WIDTH)
        option = mujoco.MjvOption()
        option.geomgroup[GROUP_COLLISION] = 0
        option.sitegroup[:] = 0
        self._renderer.update_scene(core.arm.data(0), camera=self._camera(), scene_option=option)
        picture = self._renderer.render().copy()
        self._add_insets(picture)
        return picture

    def _camera(self) -> mujoco.MjvCamera:
        """Looks at the middle between the part and the gun, from the free side."""
        camera = mujoco.MjvCamera()
        part = self._core.arm.part_pose[0, :3, 3]
        camera.lookat[:] = 0.5 * (part + self._core.tip.pose[0, :3, 3]) + [-0.06, 0.0, 0.10]
        camera.distance, camera.azimuth, camera.elevation = 0.95, 150.0, -28.0
        return camera

    def _add_insets(self, picture: NDArray[np.uint8]) -> None:
        core = self._core
        images = core.sensors.images(core.tip.pose, core.arm, core.frames)
        top = _MARGIN
        for v, (camera, image) in enumerate(zip(core.cfg.cell.cameras, images[:2], strict=True)):
            seen = bool(core.features.valid[0, v])
            line = core.lines
            inset = roi_inset(
                image[0], line.point[0, v] if seen else None, line.direction[0, v], camera.tip_px
            )
            height, width = inset.shape[:2]
            left = WIDTH - _MARGIN - width
            cv2.rectangle(picture, (left - 2, top - 2), (left + width + 1, top + height + 1), _FRAME_RGB, 2)
            picture[top : top + height, left : left + width] = inset
            cv2.putText(
                picture, camera.name, (left, top + height + 20), cv2.FONT_HERSHEY_SIMPLEX, 0.55,
                _FRAME_RGB, 1, cv2.LINE_AA,
            )
            top += height + 36

    def sync(self) -> None:
        """Brings MuJoCo's viewer up to date, opening it first.

        Raises:
            RenderError: If there is no screen.
        """
        core = self._core
        if self._viewer is None:
            import mujoco.viewer  # noqa: PLC0415  # loads GLFW: only with a screen

            self._viewer_data = mujoco.MjData(core.scene.model)
            try:
                self._viewer = mujoco.viewer.launch_passive(core.scene.model, self._viewer_data)
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
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None
