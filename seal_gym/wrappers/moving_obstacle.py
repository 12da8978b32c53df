"""``MovingObstacle``: a fist reaches down over the wall into the gun's way, stays, and withdraws."""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from seal_gym.core.frames import Array, normalise
from seal_gym.sim.scene import Scene
from seal_gym.wrappers.base import DisturbanceCfg, check_numbers
from seal_gym.wrappers.smooth import eased

# Where the fist comes to rest, in the frame of a tip that has reached the crossing: the front camera's body
# ends 81 mm ahead of the nozzle's axis, so that a gun that has come there would overlap a fist of 45 mm.
_AHEAD_OF_CAMERA_M = 65e-3
_LOWEST_M = 95e-3
_ABOVE_WALL_M = 5e-3
_WAY_M = 0.25
_RAMP_S = 0.3
# A gun at nominal speed comes to the crossing that long after the fist has come to rest.
_BEFORE_S = 3.0
# Where along the seam the crossing may be.
_SHARE = (0.35, 0.70)


@dataclass(frozen=True, kw_only=True)
class MovingObstacleCfg(DisturbanceCfg):
    """A ball of the size of a fist that the gun must let pass: who drives on as planned touches it.

    It waits beyond the wall and sets out when the gun, by its progress along the seam, is so far from the
    crossing that at nominal speed it would come there three seconds after the fist. It comes down over the
    wall at 45 degrees and stops where the gun's front camera would be. It collides with gun
    and arm, hides what it stands in front of, and its pose stands in ``info["obstacle"]`` and in
    ``ArmState.obstacle`` for leaves. Severity scales the time it stays.

    Attributes:
        radius_mm: Of the ball [mm].
        speed_mm_s: At which it comes and goes [mm/s].
        stay_s: Time that it keeps the gun from its way at severity 1 [s].
    """

    name: ClassVar[str] = "MovingObstacle"

    radius_mm: float = 45.0
    speed_mm_s: float = 150.0
    stay_s: float = 3.0

    def check(self) -> None:
        """Checks the ranges."""
        check_numbers(self, radius_mm=(5.0, 150.0), speed_mm_s=(10.0, 2000.0), stay_s=(0.0, 60.0))


class Obstacle(NamedTuple):
    """The obstacles of N simulations, in the base frame.

    Attributes:
        position: Centres, shape (N, 3), m.
        velocity: Shape (N, 3), m/s.
        radius: [m].
    """

    position: Array
    velocity: Array
    radius: float


class Fist:
    """Where the obstacles of N simulations are."""

    def __init__(self, n: int, cfg: MovingObstacleCfg, scene: Scene) -> None:
        """Starts with all of them at rest.

        Args:
            n: Number of simulations.
            cfg: The obstacle.
            scene: The scene: seam, height of the wall and nominal speed.
        """
        self.radius = 1e-3 * cfg.radius_mm
        self._speed = 1e-3 * cfg.speed_mm_s
        self._stay = _BEFORE_S + cfg.severity * cfg.stay_s
        self._seam = scene.workpiece.seam
        self._top = float(scene.workpiece.surface.triangles[..., 2].max())
        arrives = _WAY_M / self._speed + _RAMP_S + _BEFORE_S
        self._lead = arrives * scene.cell.process.speed_m_s
        self._start = np.zeros((n, 3))
        self._way = np.zeros((n, 3))
        self._due = np.zeros(n)
        self._since = np.full(n, np.inf)

    def reset(self, i: int, rng: np.random.Generator, part_pose: Array) -> None:
        """Draws where one simulation's obstacle crosses.

        Args:
            i: Which simulation.
            rng: Source of the draw.
            part_pose: ``T_base_part`` at the episode's start, shape (4, 4), m.
        """
        crossing = rng.uniform(*_SHARE) * self._seam.length
        end, way = self._rest(crossing)
        self._way[i] = part_pose[:3, :3] @ way
        self._start[i] = part_pose[:3, :3] @ (end - _WAY_M * way) + part_pose[:3, 3]
        self._due[i] = crossing - self._lead
        self._since[i] = np.inf

    def _rest(self, s: float) -> tuple[Array, Array]:
        """Where the fist stays and the direction it comes in, in the part's frame.

        From above: level with the wall it would withdraw to where a round seam leads the gun later.
        """
        seam = self._seam.at(s)
        height = self._top + self.radius + _ABOVE_WALL_M
        above = max(height / max(seam.approach[2], 0.5), _LOWEST_M)
        end = seam.position + above * seam.approach + (_AHEAD_OF_CAMERA_M + self.radius) * seam.tangent
        way = seam.approach if np.hypot(*seam.approach[:2]) > 0.1 else np.cross(seam.tangent, seam.approach)
        return end, normalise(normalise(way * [1.0, 1.0, 0.0]) - [0.0, 0.0, 1.0])

    def watch(self, s: Array, t: Array) -> None:
        """Sets the obstacles off whose time has come.

        Args:
            s: Arc length that the guns have come to, shape (N,), m.
            t: Time since the reset, shape (N,), s.
        """
        self._since = np.where(np.isinf(self._since) & (s >= self._due), t, self._since)

    def at(self, t: Array) -> tuple[Array, Array]:
        """Centres and velocities.

        Args:
            t: Time since the reset, shape (N, K), s.

        Returns:
            In the base frame, shape (N, K, 3) each, m and m/s.
        """
        since = np.maximum(t - self._since[:, None], 0.0)
        takes = _WAY_M / self._speed
        back = takes + _RAMP_S + self._stay
        gone, pace = np.zeros_like(t), np.zeros_like(t)
        for begins, sign in ((0.0, 1.0), (takes, -1.0), (back, -1.0), (back + takes, 1.0)):
            clock, rate = eased(since - begins, _RAMP_S)
            gone, pace = gone + sign * clock, pace + sign * rate
        way = self._way[:, None]
        return self._start[:, None] + (self._speed * gone)[..., None] * way, (self._speed * pace)[
            ..., None
        ] * way

    def obstacle(self, t: Array) -> Obstacle:
        """What leaves and policies may ask.

        Args:
            t: Time since the reset, shape (N,), s.

        Returns:
            The obstacles now.
        """
        position, velocity = self.at(t[:, None])
        return Obstacle(position[:, 0], velocity[:, 0], self.radius)
