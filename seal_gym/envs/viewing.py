"""What people look at: a third-person picture with the ROIs as insets, or MuJoCo's viewer."""

import os
import sys
import warnings
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import RenderError, require
from seal_gym.core.frames import Array, normalise
from seal_gym.sim.scene import GROUP_COLLISION
from seal_gym.vision import overlay
from seal_gym.vision.features import ViewGeometry

if TYPE_CHECKING:
    from seal_gym.envs.core import SealCore

HEIGHT, WIDTH = 720, 1280
_PANEL = 624
_GAP = 8
_LABEL = 28  # height of a heading
_INSET = (400, 200)  # the longer and the shorter side of an ROI, enlarged
_BACK_RGB = (28, 30, 34)
_DIM_RGB = (150, 154, 160)
_TEXT_RGB = (235, 235, 235)
_LOST_RGB = (255, 170, 40)
_COLUMNS = (0, 82, 172, 272, 352)
_TRAIL_RGBA = np.array([1.0, 0.45, 0.10, 1.0], np.float32)
_TRAIL_STEP_M = 2e-3
_TRAIL_RADIUS_M = 8e-4
_BEAD_STEP_M = 2e-3
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


def _check_screen() -> None:
    """Asks for a screen before MuJoCo's viewer does, which ends the process where it finds none.

    Raises:
        RenderError: If there is none.
    """
    if sys.platform != "linux":
        return  # there always is one; and macOS lets only the main thread ask
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise RenderError(
            'render_mode="human" needs a screen, and neither DISPLAY nor WAYLAND_DISPLAY is set: use '
            'render_mode="rgb_array"'
        )
    import glfw  # what MuJoCo's viewer opens its window with

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        opened = glfw.init()
    if not opened:
        raise RenderError(
            f'render_mode="human" needs a screen, and none answers at DISPLAY={os.environ.get("DISPLAY")!r}, '
            f'WAYLAND_DISPLAY={os.environ.get("WAYLAND_DISPLAY")!r}: use render_mode="rgb_array"'
        )


def fitted(picture: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """Shrinks a picture that is too large for its place, in proportion.

    Args:
        picture: Shape (H, W, 3).
        width: Of the place [px].
        height: Of the place [px].

    Returns:
        The picture, or a smaller copy.
    """
    share = min(width / picture.shape[1], height / picture.shape[0])
    if share >= 1.0:
        return picture
    size = (max(int(picture.shape[1] * share), 1), max(int(picture.shape[0] * share), 1))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


class SceneView:
    """Shows the first simulation of a core."""

    def __init__(self, core: "SealCore") -> None:
        """Prepares to show; nothing is opened before the first picture.

        Args:
            core: What to show.
        """
        self._core = core
        self._views = ViewGeometry.of(core.cfg.cell)
        self._snr_db = np.zeros(2)
        self._renderers: dict[str, mujoco.Renderer] = {}
        self._trail: list[Array] = []
        self._frame = 0
        self._viewer: Any = None
        self._viewer_data: mujoco.MjData | None = None

    def picture(self) -> NDArray[np.uint8]:
        """The nozzle from ahead on its free side; beside it what the cameras saw, and the whole cell.

        The orange trail is the way of the nozzle mouth along the seam; with sealant, the bead in its place.

        Returns:
            Shape (720, 1280, 3), RGB.

        Raises:
            RenderError: If no OpenGL context can be made here.
        """
        self._extend_trail()
        out = np.full((HEIGHT, WIDTH, 3), _BACK_RGB, np.uint8)
        left = WIDTH - _PANEL
        out[:, :left] = self._shot("nozzle", HEIGHT, left, self._close())
        long, short = _INSET
        front, side = self._insets()
        self._place(out, front, left + _GAP, _LABEL, "front view")
        right = left + 2 * _GAP + short
        self._place(out, side, right, _LABEL, "side view")
        facts = self._facts(WIDTH - _GAP - right)
        self._place(out, facts, right, _LABEL + short + _GAP, "")
        top = _LABEL + long + _LABEL
        cell = self._shot("cell", HEIGHT - top - _GAP, _PANEL - 2 * _GAP, self._wide())
        self._place(out, cell, left + _GAP, top, "cell")
        return out

    @staticmethod
    def _place(out: NDArray[np.uint8], inset: NDArray[np.uint8], left: int, top: int, label: str) -> None:
        """Puts an inset into the panel, its label above it."""
        height, width = inset.shape[:2]
        overlay.write(out, label, (left, top - 8), size=0.5)
        out[top : top + height, left : left + width] = inset

    def _insets(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Both ROIs with what perception made of them; the line stage alone where it is by vision."""
        core = self._core
        images = core.images
        self._snr_db = images.snr_db[0]
        shown = (images.front[0], images.side[0])
        stages = None
        if core.cfg.perception == "vision":
            stages = overlay.line_stage(*shown, core.sensors.nozzle, self._views)
        marks = overlay.view_marks(core.lines, self._views, 0, stages)
        long, short = _INSET
        places = ((short, long), (long, short))
        pictures = []
        for image, seen, (width, height) in zip(shown, marks, places, strict=True):
            scale = max(min(width // image.shape[1], height // image.shape[0]), 1)
            pictures.append(fitted(overlay.draw(image, seen, scale), width, height))
        return pictures[0], pictures[1]

    def _facts(self, width: int) -> NDArray[np.uint8]:
        """The features in numbers, and the legend of the insets."""
        f = self._core.features
        rows = [("", "d [mm]", "theta [deg]", "SNR [dB]", "seam")]
        for v, camera in enumerate(self._core.cfg.cell.cameras):
            d, theta = 1e3 * f.d_m[0, v], np.rad2deg(f.theta_rad[0, v])
            state = "valid" if f.valid[0, v] else "lost"
            # + 0.0: no minus before a rounded zero
            d, theta = round(float(d), 2) + 0.0, round(float(theta), 1) + 0.0
            rows.append((camera.name, f"{d:+.2f}", f"{theta:+.1f}", f"{self._snr_db[v]:.1f}", state))
        table = np.full((24 * len(rows) + 6, width, 3), _BACK_RGB, np.uint8)
        for k, row in enumerate(rows):
            lost = row[4] == "lost"
            for x, text in zip(_COLUMNS, row, strict=True):
                rgb = _LOST_RGB if text == "lost" else _DIM_RGB if lost or k == 0 else _TEXT_RGB
                overlay.write(table, text, (x, 24 * k + 16), rgb)
        legend = overlay.legend(width, vision=self._core.cfg.perception == "vision", columns=1)
        return np.concatenate((table, legend))

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
        if self._core.extrusion is None:
            self._draw_trail(renderer.scene)
        else:
            self._draw_bead(renderer.scene)
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
        ended = core.progress.furthest[0] >= core.scene.workpiece.seam.length
        if core.journey.under_way[0] or ended:  # nothing is laid on the way there and back
            return
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

    def _draw_bead(self, scene: mujoco.MjvScene) -> None:
        """The bead as capsules through its sections' middles, as thick as these are large."""
        extrusion = self._core.extrusion
        assert extrusion is not None
        part, rgba = self._core.arm.part_pose[0], np.array([*extrusion.cfg.fluid.rgb, 1.0], np.float32)
        middle, radius = extrusion.bead.spine(0, _BEAD_STEP_M)
        points = middle @ part[:3, :3].T + part[:3, 3]
        for (a, b), (r, s) in zip(pairwise(points), pairwise(radius), strict=True):
            if min(r, s) <= 0.0:
                continue
            if scene.ngeom >= scene.maxgeom:
                return
            geom = scene.geoms[scene.ngeom]
            capsule = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
            mujoco.mjv_initGeom(geom, capsule, np.zeros(3), np.zeros(3), np.eye(3).ravel(), rgba)
            mujoco.mjv_connector(geom, capsule, 0.5 * (r + s), a, b)
            scene.ngeom += 1

    def sync(self) -> None:
        """Brings MuJoCo's viewer up to date, opening it first.

        Raises:
            RenderError: If there is no screen.
        """
        core = self._core
        if self._viewer is None:
            _check_screen()
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
