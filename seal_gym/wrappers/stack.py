"""All disturbances of a core's N simulations: each takes effect at its place, in whatever order they come."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.frames import Array
from seal_gym.sim.arm import Outside
from seal_gym.sim.look import Look
from seal_gym.sim.raycast import Images
from seal_gym.sim.scene import Scene
from seal_gym.vision.features import SeamLines
from seal_gym.wrappers.actuation_delay import ActuationDelayCfg, Delay
from seal_gym.wrappers.base import DisturbanceCfg, fork, stream
from seal_gym.wrappers.cameras import (
    CameraDropoutCfg,
    CameraLatencyCfg,
    CameraNoiseCfg,
    Feed,
    HandEye,
    HandEyeErrorCfg,
)
from seal_gym.wrappers.external_push import ExternalPushCfg, Pushes
from seal_gym.wrappers.lighting import Lamp, LightingCfg
from seal_gym.wrappers.moving_obstacle import Fist, MovingObstacleCfg, Obstacle
from seal_gym.wrappers.moving_workpiece import MovingWorkpieceCfg, PartMotion

_Cfg = TypeVar("_Cfg", bound=DisturbanceCfg)


def _of(cfgs: tuple[DisturbanceCfg, ...], kind: type[_Cfg]) -> _Cfg | None:
    return next((c for c in cfgs if isinstance(c, kind)), None)


class Disturbances:
    """What acts on N simulations from outside; with none, every call hands through what it is given."""

    def __init__(self, cfgs: tuple[DisturbanceCfg, ...], n: int, action_size: int, scene: Scene) -> None:
        """Starts all of them at rest; ``reset`` every row before use.

        Args:
            cfgs: The disturbances; those of severity 0 are left out.
            n: Number of simulations.
            action_size: Of an action.
            scene: The scene, with an obstacle if there is to be one.
        """
        on = tuple(c for c in cfgs if c.severity > 0)
        moving, obstacle = _of(on, MovingWorkpieceCfg), _of(on, MovingObstacleCfg)
        push = _of(on, ExternalPushCfg)
        lighting, hand_eye = _of(on, LightingCfg), _of(on, HandEyeErrorCfg)
        dropout, latency = _of(on, CameraDropoutCfg), _of(on, CameraLatencyCfg)
        noise, delay = _of(on, CameraNoiseCfg), _of(on, ActuationDelayCfg)
        self._any = bool(on)
        self._part = PartMotion(n, moving) if moving else None
        self._fist = Fist(n, obstacle, scene) if obstacle else None
        self._pushes = Pushes(n, push) if push else None
        self._lamp = Lamp(n, lighting) if lighting else None
        self._noise = noise.severity * noise.sigma if noise else 0.0
        self._feed = Feed(n, dropout, latency) if dropout or latency else None
        self._hand_eye = HandEye(n, hand_eye, scene.cell) if hand_eye else None
        self._delay = Delay(n, action_size, delay) if delay else None
        timing = scene.cell.timing
        self._step_s, self._substeps = timing.step_s, timing.substeps
        self._steps = np.arange(timing.substeps + 1)

    def reset(self, i: int, rng: np.random.Generator, part_pose: Array, look: Look) -> None:
        """Starts a new episode in one simulation; draws nothing from the generator itself.

        Args:
            i: Which simulation.
            rng: The environment's, after its own draws.
            part_pose: ``T_base_part`` as drawn, shape (4, 4), m.
            look: The looks; row i has just been drawn.
        """
        if not self._any:
            return
        words = fork(rng)

        def own(kind: type[DisturbanceCfg]) -> np.random.Generator:
            return stream(words, kind.name)

        if self._part:
            self._part.reset(i, own(MovingWorkpieceCfg), part_pose)
        if self._fist:
            self._fist.reset(i, own(MovingObstacleCfg), part_pose)
        if self._pushes:
            self._pushes.reset(i, own(ExternalPushCfg))
        if self._lamp:
            self._lamp.reset(i, own(LightingCfg), look)
        if self._feed:
            self._feed.reset(i, own(CameraDropoutCfg), own(CameraLatencyCfg))
        if self._hand_eye:
            self._hand_eye.reset(i, own(HandEyeErrorCfg))
        if self._delay:
            self._delay.reset(i)
        if self._noise:
            look.noise_sigma[i] = np.sqrt(look.noise_sigma[i] ** 2 + self._noise**2)

    # -- on the way to the arm --------------------------------------------------------------------------

    def delayed(self, action: Array) -> Array:
        """What is executed in place of an action.

        Args:
            action: Shape (N, size).

        Returns:
            Shape (N, size).
        """
        return self._delay(action) if self._delay else action

    def outside(self, frame: NDArray[np.int64], s: Array, held: NDArray[np.bool_]) -> Outside | None:
        """What moves and pushes in the coming frame.

        Args:
            frame: Frames since each reset, shape (N,).
            s: Arc length that the tips have come to, shape (N,), m.
            held: For which nothing moves yet, shape (N,).

        Returns:
            Bodies and forces in each physics step; None if there are none.
        """
        if not (self._part or self._fist or self._pushes):
            return None
        # By whole steps, so that a frame begins at the very pose where the last one ended.
        t = np.asarray((frame[:, None] * self._substeps + self._steps) * self._step_s, dtype=np.float64)
        t[held] = 0.0
        if self._fist:
            self._fist.watch(s, t[:, 0])
        return Outside(
            part=self._part.poses(t) if self._part else None,
            part_pose=self._part.matrices(t[:, -1]) if self._part else None,
            obstacle=self._fist.at(t)[0] if self._fist else None,
            force=self._pushes.at(t[:, :-1]) if self._pushes else None,
            pushed=self._pushes.body if self._pushes else "",
        )

    # -- on the way from the cameras --------------------------------------------------------------------

    def bracket(self, tip_pose: Array) -> Array:
        """Pose of a tip whose calibrated cameras would see what the real ones see.

        Args:
            tip_pose: ``T_base_tip``, shape (N, 4, 4), m.

        Returns:
            Shape (N, 4, 4), m.
        """
        return self._hand_eye.bracket(tip_pose) if self._hand_eye else tip_pose

    def illuminate(self, look: Look, frame: NDArray[np.int64]) -> None:
        """Brings looks up to date, in place.

        Args:
            look: Of N simulations.
            frame: Frames since each reset, shape (N,).
        """
        if self._lamp:
            self._lamp.shine(look, self._now(frame)[:, 0])
        if self._fist:
            look.ball[:, :3], look.ball[:, 3] = self._fist.at(self._now(frame))[0][:, 0], self._fist.radius

    def images(self, images: Images, frame: NDArray[np.int64]) -> Images:
        """What arrives of the images.

        Args:
            images: As exposed in this frame.
            frame: Frames since each reset, shape (N,).

        Returns:
            Perhaps older ones, or black.
        """
        if not self._feed:
            return images
        self._feed.expose(frame)
        front, side = self._feed("images", (images.front, images.side))
        return images._replace(front=front, side=side)

    def lines(self, lines: SeamLines, frame: NDArray[np.int64]) -> SeamLines:
        """What arrives of the oracle's lines, as if they had been seen in images.

        Args:
            lines: As projected in this frame.
            frame: Frames since each reset, shape (N,).

        Returns:
            Perhaps older ones, or none.
        """
        if not self._feed:
            return lines
        self._feed.expose(frame)
        return SeamLines(*self._feed("lines", tuple(lines)))

    # -- what others may ask ----------------------------------------------------------------------------

    def _now(self, frame: NDArray[np.int64]) -> Array:
        return np.asarray(frame[:, None] * self._substeps * self._step_s, dtype=np.float64)

    def obstacle(self, frame: NDArray[np.int64]) -> Obstacle | None:
        """Where the obstacles are.

        Args:
            frame: Frames since each reset, shape (N,).

        Returns:
            None if there are none.
        """
        return self._fist.obstacle(self._now(frame)[:, 0]) if self._fist else None

    def part_twist(self, frame: NDArray[np.int64]) -> Array | None:
        """How the parts move: for metrics, never for policies.

        Args:
            frame: Frames since each reset, shape (N,).

        Returns:
            Velocity of their origins and angular velocity in the base frame, shape (N, 6), m/s and rad/s;
            None if they stand still.
        """
        return self._part.twist(self._now(frame)[:, 0]) if self._part else None
