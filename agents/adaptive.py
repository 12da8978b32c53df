"""The classical adaptive baseline: map the seam ahead with laser profiles, replan, play back.

Manorathna et al. 2014 ("Feature extraction and tracking of a weld joint for adaptive robotic welding"), with
which Zhou et al. compare themselves (their reference 19, Table 4). Each frame a depth profile across the
seam gives one point of it, a look-ahead before the tip. Points are gated, moved to the base frame and kept.
Every few points a polynomial through the last ones becomes the path, which a position servo follows at
fixed speed. Two variants:

- ``plain()``: the method as it was published. One line, and the part is taken to stand still: when the tip
  comes to a point, the point is look-ahead / speed = 0.3 s old, and 10 mm/s of the part are 3 mm of error.
- ``AdaptiveCfg()``: two lines, and the part's motion is estimated. With one line a moving straight seam and
  a resting slanted one give the same points. Of two lines the second one comes to a place where the first
  has been, and what has changed there is motion. So the fit has columns of time beside those of arc length
  (velocity and acceleration of the part), points are moved along to the present, and the servo is fed
  forward. Seam trackers with several lines are sold, and the depth sensor that Zhou et al. put in the
  laser's place sees an area. Motion along a straight seam cannot be seen, and is not needed there; at a
  corner it is, and a box that moves is still hit there at times. Zhou et al. report no such compensation.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import ConfigError, is_number, require
from seal_gym.core.frames import Array
from seal_gym.core.kinematics import tip_kinematics
from seal_gym.envs.core import SealCore
from seal_gym.sim.depth import DepthCfg, DepthSensor
from seal_gym.sim.depth_seam import SeamPointCfg, find_seam

_MM, _DEG = 1e-3, float(np.deg2rad(1.0))
_MAD_TO_SIGMA = 1.4826
_NEWTON_STEPS = 3
_REACH_M = 0.1  # from a path's end; nothing is looked for farther away
_Y = 1


@dataclass(frozen=True, kw_only=True)
class AdaptiveCfg:
    """Sensor, path and servo; ``python -m agents.tune_adaptive`` compares their settings.

    Attributes:
        depth: The sensor; its look-ahead is that of the line nearer to the tip.
        second_line_m: A second line lies this far ahead of the first one [m]; 0: there is none.
        motion: Order in time of the part's estimated motion: 0 stands still, 1 velocity, 2 acceleration too.
        point_m: Assumed standard deviation of a point of the seam [m].
        velocity_m_s: How far the velocity may be from what the last fit foretold [m/s].
        accel_m_s2: How large its acceleration may be [m/s^2].
        seam: How the seam is found in a profile.
        window: Points of each line that a path is fitted through (W).
        replan: Points from one fit to the next (K).
        order: Largest order of the polynomial.
        spacing_m: A point this far beyond the last one is kept [m].
        span_m: Length of the points that each order of the polynomial needs [m].
        gate_mad: Points farther from the path than this many MAD of the others are outliers.
        gate_floor_m: Distance from the path that is never an outlier [m].
        patience: Outliers in a row after which the map is given up and begun anew.
        extrapolate_m: How far beyond its last point a path is followed [m].
        braking_m_s2: Deceleration towards the end of the path [m/s^2].
        omega_n: Natural frequency of the servo [rad/s].
        zeta: Its damping ratio.
        approach_m_s: Largest speed towards the path [m/s].
        turning_rad_s: Largest speed of turning towards the path [rad/s].
        land_m: Distance from the path below which the gun begins to travel [m].
    """

    depth: DepthCfg = field(default_factory=DepthCfg)
    seam: SeamPointCfg = field(default_factory=SeamPointCfg)
    second_line_m: float = 1.5e-3
    motion: int = 1
    point_m: float = 5e-5
    velocity_m_s: float = 5e-3
    accel_m_s2: float = 1e-2
    window: int = 12
    replan: int = 1
    order: int = 3
    spacing_m: float = 2e-4
    span_m: float = 2e-3
    gate_mad: float = 3.0
    gate_floor_m: float = 1e-3
    patience: int = 5
    extrapolate_m: float = 2e-3
    braking_m_s2: float = 0.1
    omega_n: float = 12.0
    zeta: float = 0.8
    approach_m_s: float = 0.025
    turning_rad_s: float = 1.0
    land_m: float = 1e-3

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for name, low, high in (
            ("window", 4, 1000),
            ("replan", 1, 1000),
            ("order", 1, 3),
            ("patience", 1, 1000),
            ("motion", 0, 2),
        ):
            value = getattr(self, name)
            require(
                is_number(value) and int(value) == value and low <= value <= high,
                f"AdaptiveCfg.{name} = {value!r}: must be a whole number in {low}..{high}",
            )
        for name in ("spacing_m", "span_m", "gate_mad", "gate_floor_m", "braking_m_s2", "omega_n", "zeta"):
            self._positive(name)
        for name in ("approach_m_s", "turning_rad_s", "land_m", "point_m", "velocity_m_s", "accel_m_s2"):
            self._positive(name)
        for name in ("extrapolate_m", "second_line_m"):
            value = getattr(self, name)
            require(is_number(value) and value >= 0, f"AdaptiveCfg.{name} = {value!r}: must be >= 0")
        require(
            self.motion == 0 or self.second_line_m > 0,
            f"AdaptiveCfg.motion = {self.motion}, second_line_m = 0: one line cannot tell the part's motion "
            "from the seam's slant; give second_line_m > 0, or motion=0",
        )

    @classmethod
    def plain(cls, **kwargs: Any) -> Self:
        """The method as it was published: one line, and the part is taken to stand still.

        Args:
            **kwargs: Other settings.

        Returns:
            The configuration.
        """
        return cls(second_line_m=0.0, motion=0, **kwargs)

    def _positive(self, name: str) -> None:
        value = getattr(self, name)
        require(is_number(value) and value > 0, f"AdaptiveCfg.{name} = {value!r}: must be > 0")


class Path(NamedTuple):
    """A polynomial in arc length through points of the seam, and its motion.

    Attributes:
        coefficients: Of 1, (u - origin), (u - origin)^2, ..., shape (order + 1, 3), m.
        origin: Arc length about which the polynomial is written [m].
        end: Arc length of the last point [m].
        spread: Median distance of the points from it [m].
        drift: Its velocity and acceleration, as far as they are estimated, shape (motion, 3), m/s and m/s^2.
        time_s: For which it holds [s].
    """

    coefficients: Array
    origin: float
    end: float
    spread: float
    drift: Array = np.empty((0, 3))
    time_s: float = 0.0

    def moved(self, time_s: float) -> "Path":
        """The path at another time [s]."""
        dt = time_s - self.time_s
        if not len(self.drift):
            return self._replace(time_s=time_s)
        coefficients, drift = self.coefficients.copy(), self.drift.copy()
        coefficients[0] += _clock(dt, len(drift)) @ drift
        drift[0] += _clock(dt, len(drift) - 1) @ drift[1:]
        return self._replace(coefficients=coefficients, drift=drift, time_s=time_s)

    def across(self, u: float) -> Array:
        """Velocity across its own direction at an arc length, shape (3,), m/s."""
        if not len(self.drift):
            return np.zeros(3)
        tangent = self.slope(u)
        velocity = self.drift[0]
        return np.asarray(velocity - (velocity @ tangent) / (tangent @ tangent) * tangent)

    def foot(self, point: Array) -> tuple[float, float]:
        """Where a point lies: beyond the end on the straight continuation, before it on the curve.

        Args:
            point: Shape (3,), m.

        Returns:
            Arc length and distance [m].
        """
        tangent = self.slope(self.end)
        along = float((point - self.at(self.end)) @ tangent / (tangent @ tangent))
        u = self.end + along
        if along >= 0.0:
            return (
                self.end + along * float(np.linalg.norm(tangent)),
                float(np.linalg.norm(point - self.at(self.end) - along * tangent)),
            )
        for _ in range(_NEWTON_STEPS):
            slope = self.slope(u)
            u += float((point - self.at(u)) @ slope / max(float(slope @ slope), 0.3))
            u = float(np.clip(u, self.end - _REACH_M, self.end + _REACH_M))
        return u, float(np.linalg.norm(point - self.at(u)))

    def at(self, u: Array | float) -> Array:
        """Positions at arc lengths of shape (...): shape (..., 3), m."""
        return np.asarray(self._powers(u) @ self.coefficients)

    def slope(self, u: float) -> Array:
        """First derivative by arc length, shape (3,)."""
        n = np.arange(1, len(self.coefficients))
        return np.asarray((n * self._powers(u)[: len(n)]) @ self.coefficients[1:])

    def bend(self, u: float) -> Array:
        """Second derivative by arc length, shape (3,), 1/m."""
        n = np.arange(2, len(self.coefficients))
        return np.asarray((n * (n - 1) * self._powers(u)[: len(n)]) @ self.coefficients[2:])

    def _powers(self, u: Array | float) -> Array:
        return np.power.outer(
            np.asarray(u, dtype=np.float64) - self.origin, np.arange(len(self.coefficients))
        )


class Track(NamedTuple):
    """What the controller remembers of one simulation.

    Attributes:
        points: Kept points of the seam in the base frame where they were seen, oldest first, shape (k, 3), m.
        arc: Their arc length from the first point of the episode, shape (k,), m.
        times: When they were seen, shape (k,), s.
        path: The planned path; None before the first point.
        unplanned: Points kept since it was fitted.
        outliers: Points refused in a row.
        at: Arc length of the path abreast of the tip [m].
        landed: Whether the gun has come down to the path and travels.
    """

    points: Array = np.empty((0, 3))
    arc: Array = np.empty(0)
    times: Array = np.empty(0)
    path: Path | None = None
    unplanned: int = 0
    outliers: int = 0
    at: float = 0.0
    landed: bool = False


# -- the map ---------------------------------------------------------------------------------------------


def extend(track: Track, points: Sequence[Array], time_s: float, pose: Array, cfg: AdaptiveCfg) -> Track:
    """Takes a frame's measured points of the seam into the map, or refuses them.

    Args:
        track: The map.
        points: One of each line that found the seam, the nearer one's first, in the base frame, shape (3,)
            each, m.
        time_s: When they were seen [s].
        pose: ``T_base_tip``, shape (4, 4), m.
        cfg: Gate, spacing and fit.

    Returns:
        The new map, its path moved to this time.
    """
    forward = pose[:3, _Y]
    if track.path is not None:
        track = track._replace(path=track.path.moved(time_s))
    for k, point in enumerate(points):
        if track.path is None or not (track.landed or cfg.motion):
            # The gun stands, and a later point is as good as an earlier one, and newer.
            track = _begin(point, time_s, forward, cfg)
        else:
            track = _join(track, track.path, point, time_s, forward, cfg, again=k > 0)
    if track.path is None or track.unplanned < cfg.replan:
        return track
    path = fit(track.points, track.arc, track.times, forward, cfg, track.path)
    return track._replace(path=path, unplanned=0)


def _join(
    track: Track, path: Path, point: Array, time_s: float, forward: Array, cfg: AdaptiveCfg, *, again: bool
) -> Track:
    """One point into a map that has a path; ``again``: another of this frame has been there before."""
    u, off = path.foot(point)
    if off > max(cfg.gate_mad * path.spread, cfg.gate_floor_m):
        if again or track.outliers < cfg.patience:
            return track._replace(outliers=track.outliers + (not again))
        begun = _begin(point, time_s, forward, cfg)
        return begun._replace(landed=track.landed)
    if not cfg.motion and u - track.arc[-1] < cfg.spacing_m:
        return track._replace(outliers=0)
    kept = slice(-cfg.window * (1 + (cfg.second_line_m > 0)), None)
    return track._replace(
        points=np.concatenate((track.points, point[None]))[kept],
        arc=np.append(track.arc, u)[kept],
        times=np.append(track.times, time_s)[kept],
        unplanned=track.unplanned + (not again),
        outliers=track.outliers if again else 0,
    )


def _begin(point: Array, time_s: float, forward: Array, cfg: AdaptiveCfg) -> Track:
    """A map of one point: the path goes straight ahead through it, and stands still."""
    path = Path(np.stack((point, forward)), 0.0, 0.0, 0.0, np.zeros((cfg.motion, 3)), time_s)
    return Track(
        points=point[None],
        arc=np.zeros(1),
        times=np.array([time_s]),
        path=path,
        at=-cfg.depth.look_ahead_m,
    )


def fit(points: Array, arc: Array, times: Array, forward: Array, cfg: AdaptiveCfg, last: Path) -> Path:
    """Least-squares polynomial through points of the seam: in arc length, and in time where it moves.

    The motion is drawn weakly towards what the last path foretold: without the second line's points nothing
    else holds it.

    Args:
        points: Oldest first, shape (k, 3), m.
        arc: Their arc lengths, shape (k,), m.
        times: When they were seen, shape (k,), s.
        forward: Direction of travel, for points too close together to have one, shape (3,).
        cfg: Largest order, the span that each order needs, and the motion.
        last: The last path, moved to the present.

    Returns:
        The path at the time of ``last``.
    """
    start, end = float(arc.min()), float(arc.max())
    origin, span = 0.5 * (start + end), end - start
    order = min(cfg.order, int(span / cfg.span_m), len(arc) - 2)
    straight = order < 1
    if straight:
        order, origin = 0, float(arc.mean())
    columns = np.vander((arc - origin) / max(span, 1e-6), order + 1, increasing=True)
    seen = points - np.outer(arc - origin, forward) if straight else points
    clock = _clock(times - last.time_s, cfg.motion)
    doubt = np.array([cfg.velocity_m_s, cfg.accel_m_s2])[: cfg.motion] / cfg.point_m
    hold = np.hstack((np.zeros((cfg.motion, order + 1)), np.diag(1.0 / doubt)))
    foretold = np.concatenate((last.drift[:1], np.zeros((max(cfg.motion - 1, 0), 3))))
    rows = np.vstack((np.hstack((columns, clock)), hold))
    moving = np.linalg.lstsq(rows, np.vstack((seen, foretold / doubt[:, None])), rcond=None)[0]
    # A seam that moves along itself looks the same: the points' arc length, found on the last path, says
    # nothing of it, and would only feed back what was believed.
    along = last.slope(last.end)
    along = along / np.linalg.norm(along)
    across = np.eye(3) - np.outer(along, along)
    resting = np.linalg.lstsq(columns, seen @ np.outer(along, along), rcond=None)[0]
    found = moving @ across
    found[: order + 1] += resting
    coefficients = found[: order + 1] / max(span, 1e-6) ** np.arange(order + 1)[:, None]
    if straight:
        coefficients = np.stack((coefficients[0], forward))
    path = Path(coefficients, origin, end, 0.0, found[order + 1 :], last.time_s)
    off = np.linalg.norm(path.at(arc) + clock @ path.drift - points, axis=1)
    return path._replace(spread=_MAD_TO_SIGMA * float(np.median(off)))


def _clock(dt: Array | float, order: int) -> Array:
    """Columns of time: dt, dt^2 / 2, shape (..., order)."""
    t = np.asarray(dt, dtype=np.float64)
    return np.stack([t, 0.5 * t * t][:order], axis=-1) if order else np.empty((*t.shape, 0))


# -- the servo -------------------------------------------------------------------------------------------


class Aim(NamedTuple):
    """Where the path is in the tip frame, and how it goes on.

    Attributes:
        error: Displacement and rotation vector that bring the tip onto the path, shape (6,), m and rad.
        reference: Twist of a tip that travels on it, shape (6,), m/s and rad/s.
    """

    error: Array
    reference: Array


def abreast(path: Path, pose: Array, start: float) -> float:
    """Arc length of the path where it crosses the tip's xz plane.

    Args:
        path: The path.
        pose: ``T_base_tip``, shape (4, 4), m.
        start: Where to begin the search [m].

    Returns:
        Arc length [m].
    """
    u = start
    for _ in range(_NEWTON_STEPS):
        ahead = float((path.at(u) - pose[:3, 3]) @ pose[:3, _Y])
        # A path that turns away must not send the search off.
        u -= ahead / max(float(path.slope(u) @ pose[:3, _Y]), 0.3)
        u = float(np.clip(u, path.end - _REACH_M, path.end + _REACH_M))
    return u


def speed_left(left_m: float, speed_m_s: float, braking_m_s2: float) -> float:
    """Speed from which a gun still stops within the path that is left: ``sqrt(2 a d)``, at most nominal.

    Args:
        left_m: Length of path that is left [m].
        speed_m_s: Nominal [m/s].
        braking_m_s2: Deceleration [m/s^2].

    Returns:
        [m/s].
    """
    return float(min(speed_m_s, np.sqrt(2.0 * braking_m_s2 * max(left_m, 0.0))))


def aim(path: Path, at: float, pose: Array, speed_m_s: float, stand_off_m: float, lean_rad: float) -> Aim:
    """Where the tip should be and how it should move.

    Args:
        path: The path: on the seam.
        at: Arc length abreast of the tip [m].
        pose: ``T_base_tip``, shape (4, 4), m.
        speed_m_s: Of the tip along the path [m/s].
        stand_off_m: From the seam back along the nozzle [m].
        lean_rad: Rotation about y that restores the taught lean [rad].

    Returns:
        Error and reference in the tip frame; on a path that moves the reference moves with it.
    """
    turn = pose[:3, :3].T
    seam = turn @ (path.at(at) - pose[:3, 3])
    slope = turn @ path.slope(at)
    length = float(np.linalg.norm(slope))
    tangent, bend = slope / length, turn @ path.bend(at) / length**2
    heading = np.array([np.arctan2(tangent[2], tangent[1]), lean_rad, -np.arctan2(tangent[0], tangent[1])])
    # The tip travels on a parallel of the seam: on the outside of a bend it has farther to go.
    rate = speed_m_s / max(1.0 - stand_off_m * bend[2], 0.5)
    turning = rate * np.array([bend[2], 0.0, -bend[0]])
    offset = np.array([seam[0], 0.0, seam[2] + stand_off_m])
    return Aim(
        np.concatenate((offset, heading)),
        np.concatenate((speed_m_s * tangent + turn @ path.across(at), turning)),
    )


def servo(target: Aim, twist: Array, cfg: AdaptiveCfg) -> Array:
    """Second-order position servo with saturated errors.

    Args:
        target: Where to.
        twist: Body twist of the tip, shape (6,), m/s and rad/s.
        cfg: Gains and limits.

    Returns:
        Tip acceleration ``omega_n^2 sat(error) + 2 zeta omega_n (reference - twist)``, shape (6,).
    """
    damping = 2.0 * cfg.zeta * cfg.omega_n
    stiffness = cfg.omega_n**2
    shift = _saturated(target.error[:3], cfg.approach_m_s * damping / stiffness)
    turn = _saturated(target.error[3:], cfg.turning_rad_s * damping / stiffness)
    return np.asarray(
        stiffness * np.concatenate((shift, turn)) + damping * (target.reference - twist), dtype=np.float64
    )


def _saturated(error: Array, limit: float) -> Array:
    """The vector, shortened to a length if it is longer."""
    return np.asarray(error * min(1.0, limit / max(float(np.linalg.norm(error)), 1e-12)))


# -- the policy ------------------------------------------------------------------------------------------


class Adaptive:
    """Maps, replans and follows, for every simulation of an environment.

    It reads joint angles, twist and lean from the observation, and its own sensor from the simulation: never
    the pose of the part or of the seam. Between calls it keeps nothing: its memory is the ``state`` of
    ``predict``, which must be handed back, and the sensor's noise depends on the episode's seed and the
    frame alone.

    Attributes:
        control: The ``control`` its environment needs.
        cfg: The configuration.
    """

    control = "tip"

    def __init__(self, core: SealCore, cfg: AdaptiveCfg | None = None) -> None:
        """Mounts the sensor on the guns.

        Args:
            core: The simulations.
            cfg: The configuration.
        """
        self.cfg = cfg or AdaptiveCfg()
        self._core = core
        depth, ahead = self.cfg.depth, self.cfg.second_line_m
        lines = [depth, replace(depth, look_ahead_m=depth.look_ahead_m + ahead)][: 1 + (ahead > 0)]
        self._sensors = [DepthSensor(core.scene, line) for line in lines]
        cell = core.cfg.cell
        self._process = cell.process
        self._scale = np.array([cell.limits.linear_m_s2] * 3 + [cell.limits.angular_rad_s2] * 3)

    @classmethod
    def of(cls, env: Any, cfg: AdaptiveCfg | None = None) -> Self:
        """The policy of an environment.

        Args:
            env: Single or vectorised, wrapped or not.
            cfg: The configuration.

        Returns:
            The policy.

        Raises:
            ConfigError: If there is no environment to mount the sensor in.
        """
        core = getattr(getattr(env, "unwrapped", env), "core", None)
        if not isinstance(core, SealCore):
            raise ConfigError(
                f"policy 'adaptive' with env = {env!r}: it has a sensor of its own, so give the environment: "
                "load_policy('adaptive', env)"
            )
        return cls(core, cfg)

    def predict(
        self,
        observation: NDArray[np.float32] | dict[str, NDArray[Any]],
        state: tuple[Track, ...] | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], tuple[Track, ...]]:
        """Actions for observations, as Stable-Baselines3's recurrent policies give them.

        Args:
            observation: Of the environment's N simulations (or of its only one), as ``SealEnv`` documents it,
                just observed: the sensor measures now.
            state: What the last call gave; None at the start.
            episode_start: Which simulations begin an episode, shape (N,).
            deterministic: It always is.

        Returns:
            Actions of shape (6,) or (N, 6), and the new state.
        """
        del deterministic
        features = observation["features"] if isinstance(observation, dict) else observation
        rows = np.atleast_2d(np.asarray(features, dtype=np.float64))
        n = len(rows)
        require(
            n == self._core.n,
            f"observation of {n} simulations: the environment that this policy was made for has "
            f"{self._core.n}",
        )
        fresh = self._core.frames == 0
        if episode_start is not None:
            fresh = fresh | np.asarray(episode_start)
        old = state or (Track(),) * n
        tracks = [Track() if new else track for track, new in zip(old, fresh, strict=True)]
        pose = tip_kinematics(np.ascontiguousarray(rows[:, 23:29]), np.ascontiguousarray(rows[:, 29:35])).pose
        points = self._points(pose)
        times = self._core.frames * self._core.cfg.cell.timing.frame_s
        acted = [self._act(*row) for row in zip(tracks, points, times, pose, rows, strict=True)]
        accel = np.stack([a for _, a in acted])
        action = np.clip(accel / self._scale, -1.0, 1.0).astype(np.float32)
        return (action if features.ndim == 2 else action[0]), tuple(track for track, _ in acted)

    def _points(self, pose: Array) -> list[list[Array]]:
        """The seam's points that the lines see now, in the base frame, of each simulation."""
        core = self._core
        # As the cameras' noise: the same frame of the same episode has the same.
        rngs = [
            np.random.default_rng([int(seed), int(frame)])
            for seed, frame in zip(core.sensors.look.seed, core.frames, strict=True)
        ]
        points: list[list[Array]] = [[] for _ in rngs]
        for sensor in self._sensors:
            profile = sensor.measure(core.tip.pose, core.arm.part_pose, rngs)
            for row, across, depth, T in zip(points, *profile, pose, strict=True):
                fix = find_seam(across, depth, self.cfg.seam)
                if fix is not None:
                    row.append(sensor.to_base(np.array(fix.across_m), np.array(fix.depth_m), T))
        return points

    def _act(
        self, track: Track, points: list[Array], time_s: float, pose: Array, row: Array
    ) -> tuple[Track, Array]:
        """One simulation's new memory and tip acceleration."""
        cfg, process = self.cfg, self._process
        twist = np.concatenate((_MM * row[11:14], _DEG * row[14:17]))
        track = extend(track, points, time_s, pose, cfg)
        if track.path is None:
            return track, servo(Aim(np.zeros(6), np.zeros(6)), twist, cfg)
        path = track.path
        at = abreast(path, pose, track.at)
        left = path.end + cfg.extrapolate_m - at
        speed = speed_left(left, process.speed_m_s, cfg.braking_m_s2) if track.landed else 0.0
        target = aim(path, at, pose, speed, process.stand_off_m, _DEG * row[10])
        landed = track.landed or bool(np.linalg.norm(target.error[:3]) < cfg.land_m)
        return track._replace(at=at, landed=landed), servo(target, twist, cfg)
