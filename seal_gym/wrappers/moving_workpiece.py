"""``MovingWorkpiece``: the part moves on the table during the run (protocol.md, dynamic regime)."""

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np

from seal_gym.core.frames import Array, quat_from_matrix
from seal_gym.sim.arm import Poses
from seal_gym.wrappers.base import DisturbanceCfg, check_choice, check_numbers
from seal_gym.wrappers.smooth import Series, eased

MOTIONS = ("both", "translation", "rotation")
PROFILES = ("smooth", "sinusoidal", "step")
_MM, _DEG = 1e-3, float(np.deg2rad(1.0))
# The rest before a move, and how many of them the longest episode can hold.
_PAUSE_S, _MOVES = (1.5, 4.5), 64
_STEP_RAMP_S = 0.1


@dataclass(frozen=True, kw_only=True)
class MovingWorkpieceCfg(DisturbanceCfg):
    """The part translates in the plane of its plate and turns about the plate's normal through its origin.

    It starts at rest, and its pose and velocity are continuous. At severity 1 the bounds are the attributes;
    severity scales them all alike. Every episode's motion comes up to its bounds: the amplitude's or the
    speed's, whichever is met first.

    Attributes:
        motion: ``"both"``, ``"translation"`` or ``"rotation"``.
        profile: ``"smooth"``: random, of periods between 6.7 and 30 s; ``"sinusoidal"``: to and fro in a
            random direction; ``"step"``: rests, then goes to another place as fast as it may, and so on.
        amplitude_mm: Largest displacement from where the part lay at the start [mm].
        speed_mm_s: Largest speed of the part's origin [mm/s].
        yaw_deg: Largest rotation [deg].
        yaw_rate_deg_s: Largest rate of rotation [deg/s].
        ramp_s: Duration in which the motion sets in [s]; of a step, ``_STEP_RAMP_S``.
    """

    name: ClassVar[str] = "MovingWorkpiece"

    motion: str = "both"
    profile: str = "smooth"
    amplitude_mm: float = 20.0
    speed_mm_s: float = 10.0
    yaw_deg: float = 10.0
    yaw_rate_deg_s: float = 3.0
    ramp_s: float = 1.0

    def check(self) -> None:
        """Checks the ranges."""
        check_choice(self, "motion", MOTIONS)
        check_choice(self, "profile", PROFILES)
        check_numbers(
            self,
            amplitude_mm=(0.01, 200.0),
            speed_mm_s=(0.01, 200.0),
            yaw_deg=(0.01, 90.0),
            yaw_rate_deg_s=(0.01, 90.0),
            ramp_s=(0.05, 60.0),
        )

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Displacement [m], speed [m/s], rotation [rad] and rate of rotation [rad/s] at this severity."""
        shift = self.severity * _MM * (self.motion != "rotation")
        turn = self.severity * _DEG * (self.motion != "translation")
        return (
            shift * self.amplitude_mm,
            shift * self.speed_mm_s,
            turn * self.yaw_deg,
            turn * self.yaw_rate_deg_s,
        )


class _Profile(Protocol):
    """Displacements over time: x and y in the plate's plane [m] and yaw [rad]."""

    def draw(self, i: int, rng: np.random.Generator) -> None: ...
    def at(self, t: Array) -> tuple[Array, Array]: ...


class _Smooth:
    def __init__(self, n: int, cfg: MovingWorkpieceCfg) -> None:
        self._series, self._ramp = Series.zeros(n, 3), cfg.ramp_s
        shift, speed, turn, rate = cfg.bounds
        self._groups = ((2, shift, speed), (1, turn, rate))

    def draw(self, i: int, rng: np.random.Generator) -> None:
        self._series.draw(i, rng, self._groups)

    def at(self, t: Array) -> tuple[Array, Array]:
        clock, pace = eased(t, self._ramp)
        value, rate = self._series.at(clock)
        return value, rate * pace[..., None]


def _direction(rng: np.random.Generator) -> Array:
    """A unit vector in the plane, and the sense of a rotation, shape (3,)."""
    angle = rng.uniform(-np.pi, np.pi)
    return np.array([np.cos(angle), np.sin(angle), np.sign(rng.uniform(-1.0, 1.0))])


class _Sinusoidal:
    def __init__(self, n: int, cfg: MovingWorkpieceCfg) -> None:
        self._way, self._ramp = np.zeros((n, 3)), cfg.ramp_s
        shift, speed, turn, rate = cfg.bounds
        self._reach = np.array([shift, shift, turn])
        # No motion has no frequency either.
        omega = [v / a if a > 0.0 else 0.0 for a, v in ((shift, speed), (turn, rate))]
        self._omega = np.array([omega[0], omega[0], omega[1]])

    def draw(self, i: int, rng: np.random.Generator) -> None:
        self._way[i] = self._reach * _direction(rng)

    def at(self, t: Array) -> tuple[Array, Array]:
        clock, pace = eased(t, self._ramp)
        angle, way = clock[..., None] * self._omega, self._way[:, None]
        return way * np.sin(angle), way * self._omega * np.cos(angle) * pace[..., None]


class _Step:
    def __init__(self, n: int, cfg: MovingWorkpieceCfg) -> None:
        self._bounds = cfg.bounds
        self._begin = np.full((n, _MOVES), np.inf)
        self._lasts = np.ones((n, _MOVES, 3))
        self._velocity = np.zeros((n, _MOVES, 3))

    def draw(self, i: int, rng: np.random.Generator) -> None:
        shift, speed, turn, rate = self._bounds
        angle, radius, yaw = (
            rng.uniform(-np.pi, np.pi, _MOVES),
            rng.random(_MOVES),
            rng.uniform(-1, 1, _MOVES),
        )
        radius = shift * np.sqrt(radius)
        places = np.column_stack((radius * np.cos(angle), radius * np.sin(angle), turn * yaw))
        moves = np.diff(places, axis=0, prepend=0.0)
        length = np.sqrt((moves[:, :2] ** 2).sum(axis=1))
        tiny = np.finfo(float).tiny
        lasts = np.column_stack((length, length, np.abs(moves[:, 2]))) / np.maximum(
            (speed, speed, rate), tiny
        )
        self._lasts[i] = lasts
        self._velocity[i] = moves / np.maximum(lasts, tiny)
        pause = rng.uniform(*_PAUSE_S, _MOVES)
        ends = np.cumsum(pause + lasts.max(axis=1) + _STEP_RAMP_S)
        self._begin[i] = ends - lasts.max(axis=1) - _STEP_RAMP_S

    def at(self, t: Array) -> tuple[Array, Array]:
        since = (t[:, :, None] - self._begin[:, None])[..., None]
        on, on_rate = eased(since, _STEP_RAMP_S)
        off, off_rate = eased(since - self._lasts[:, None], _STEP_RAMP_S)
        velocity = self._velocity[:, None]
        return (velocity * (on - off)).sum(axis=2), (velocity * (on_rate - off_rate)).sum(axis=2)


_PROFILES: dict[str, type[_Smooth] | type[_Sinusoidal] | type[_Step]] = {
    "smooth": _Smooth,
    "sinusoidal": _Sinusoidal,
    "step": _Step,
}


class PartMotion:
    """Where the parts of N simulations are at any time."""

    def __init__(self, n: int, cfg: MovingWorkpieceCfg) -> None:
        """Starts with all parts at rest.

        Args:
            n: Number of simulations.
            cfg: The motion.
        """
        self._profile: _Profile = _PROFILES[cfg.profile](n, cfg)
        self._start = np.tile(np.eye(4), (n, 1, 1))
        self._quat = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))

    def reset(self, i: int, rng: np.random.Generator, part_pose: Array) -> None:
        """Draws one simulation's motion.

        Args:
            i: Which simulation.
            rng: Source of the draws.
            part_pose: ``T_base_part`` at the episode's start, shape (4, 4), m.
        """
        self._profile.draw(i, rng)
        self._start[i] = part_pose
        self._quat[i] = quat_from_matrix(part_pose[:3, :3])

    def poses(self, t: Array) -> Poses:
        """Poses as MuJoCo takes them.

        Args:
            t: Time since the reset, shape (N, K), s.

        Returns:
            Of the parts in the base frame.
        """
        offset, _ = self._profile.at(t)
        start = self._start[:, None]
        position = (
            start[..., :3, 3] + offset[..., :1] * start[..., :3, 0] + offset[..., 1:2] * start[..., :3, 1]
        )
        c, s = np.cos(0.5 * offset[..., 2]), np.sin(0.5 * offset[..., 2])
        w, x, y, z = (self._quat[:, k, None] for k in range(4))
        return Poses(
            position, np.stack((w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s), axis=-1)
        )

    def matrices(self, t: Array) -> Array:
        """``T_base_part``.

        Args:
            t: Time since the reset, shape (N,), s.

        Returns:
            Shape (N, 4, 4), m.
        """
        offset = self._profile.at(t[:, None])[0][:, 0, :, None]
        c, s = np.cos(offset[:, 2]), np.sin(offset[:, 2])
        start, out = self._start, self._start.copy()
        out[:, :3, 0] = c * start[:, :3, 0] + s * start[:, :3, 1]
        out[:, :3, 1] = c * start[:, :3, 1] - s * start[:, :3, 0]
        out[:, :3, 3] += offset[:, 0] * start[:, :3, 0] + offset[:, 1] * start[:, :3, 1]
        return out

    def twist(self, t: Array) -> Array:
        """The parts' true motion.

        Args:
            t: Time since the reset, shape (N,), s.

        Returns:
            Velocity of the part's origin and angular velocity in the base frame, shape (N, 6), m/s and
            rad/s.
        """
        rate = self._profile.at(t[:, None])[1][:, 0, :, None]
        start = self._start[:, :3]
        linear = rate[:, 0] * start[..., 0] + rate[:, 1] * start[..., 1]
        return np.concatenate((linear, rate[:, 2] * start[..., 2]), axis=1)
