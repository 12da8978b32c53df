"""The two sensor cameras of N simulations: their look, their renderer, the images' signal-to-noise ratio."""

from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.frames import Array
from seal_gym.envs.config import SealCfg
from seal_gym.sim.arm import ArmBatch
from seal_gym.sim.look import Look
from seal_gym.sim.raycast import Images, Raycaster
from seal_gym.sim.raycast_bead import BeadView
from seal_gym.sim.scene import Scene


class _Renderer(Protocol):
    def render(
        self, tip_pose: Array, part_pose: Array, look: Look, frame: NDArray[np.uint64], threads: int = 1
    ) -> Images: ...


class Sensors:
    """Renders the ROIs on demand; an environment that asks for no image never builds a renderer.

    Attributes:
        look: Light, exposure, noise and texture of each simulation.
        snr_db: Signal-to-noise ratio of the last images, shape (N, 2); None before the first.
    """

    def __init__(self, scene: Scene, cfg: SealCfg, n: int) -> None:
        """Allocates the looks.

        Args:
            scene: The compiled scene.
            cfg: Names the renderer and the ranges of the look.
            n: Number of simulations.
        """
        self._scene, self._cfg = scene, cfg
        self.look = Look.empty(n)
        # The lamp on the gun shines from above the plate: on the other side if the wall is on the right.
        start = scene.workpiece.seam.at(0.0)
        right = np.cross(start.tangent, [0.0, 0.0, 1.0])
        self._mirrored = bool(start.approach @ right < -1e-6)
        self.snr_db: Array | None = None

    def reset(self, i: int, rng: np.random.Generator) -> None:
        """Draws one simulation's look.

        Args:
            i: Which simulation.
            rng: Source of the draws.
        """
        self.look.draw(i, rng, self._cfg.look)
        if self._mirrored:
            self.look.lamp[i, 0] *= -1.0

    def images(
        self, tip_pose: Array, arm: ArmBatch, frame: NDArray[np.int64], bead: BeadView | None = None
    ) -> Images:
        """Both ROIs of all simulations.

        Args:
            tip_pose: ``T_base_tip``, shape (N, 4, 4), m.
            arm: The physics: where the parts are.
            frame: Number of the frame in its episode, shape (N,): the same frame has the same noise.
            bead: Sealant on the parts; the raycaster alone draws it.

        Returns:
            The images and their signal-to-noise ratio.
        """
        renderer, counters = self._renderer, frame.astype(np.uint64)
        threads = self._cfg.threads
        if isinstance(renderer, Raycaster):
            out = renderer.render(tip_pose, arm.part_pose, self.look, counters, threads, bead)
        else:
            out = renderer.render(tip_pose, arm.part_pose, self.look, counters, threads)
        self.snr_db = out.snr_db
        return out

    @cached_property
    def nozzle(self) -> tuple[Array, Array]:
        """The nozzle's coverage of each pixel, 0..1, front and side, shape (height, width)."""
        drawn = self._renderer
        if not isinstance(drawn, Raycaster):
            drawn = Raycaster(self._scene.workpiece.surface, self._scene.cell, self._scene.tool)
        return drawn.nozzle_alpha

    @cached_property
    def _renderer(self) -> _Renderer:
        if self._cfg.renderer == "gl":
            from seal_gym.sim.gl import GlSensors  # needs OpenGL: only when asked for

            return GlSensors(self._scene)
        return Raycaster(self._scene.workpiece.surface, self._scene.cell, self._scene.tool)
