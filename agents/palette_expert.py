"""A scripted policy for palettes: tau-Jerk motions from place to place, each tie pressed until it is home."""

import math
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.cell import CellCfg, load_cell
from seal_gym.core.errors import is_number, require
from seal_gym.core.frames import Array, transform
from seal_gym.core.kinematics import tip_kinematics
from seal_gym.planning import ik, ik_kernel
from seal_gym.planning.tau_jerk import RateLimitsCfg
from seal_gym.planning.tau_jerk_pose import plan_pose
from seal_gym.workpieces.palette import MAX_TARGETS, TRAVEL_M

_MM = 1e-3
_Q, _QD = slice(45, 51), slice(51, 57)
_PLACES, _OPEN = slice(0, 3 * MAX_TARGETS), slice(3 * MAX_TARGETS, 4 * MAX_TARGETS)
_ANGULAR = RateLimitsCfg(speed=2.0, acceleration=8.0, jerk=80.0)
_UPRIGHT = np.eye(3)


@dataclass(frozen=True, kw_only=True)
class PaletteExpertCfg:
    """How the tool moves.

    Attributes:
        clearance_m: Height over the ties at which it goes from place to place [m].
        hover_m: Height over a tie from which it presses [m].
        beyond_m: How far below the seat a press aims [m].
        brake_frames: In which a press comes to rest once the tie is home.
        wait_frames: For which it waits at a press's end for the tie to come home.
        move: Limits of the tip's motion between places [m].
        press: Limits of the tip's motion in a press [m].
    """

    clearance_m: float = 0.065
    hover_m: float = 0.008
    beyond_m: float = 0.004
    brake_frames: int = 3
    wait_frames: int = 10
    move: RateLimitsCfg = field(default_factory=lambda: RateLimitsCfg(speed=0.5, acceleration=2.0, jerk=20.0))
    press: RateLimitsCfg = field(
        default_factory=lambda: RateLimitsCfg(speed=0.03, acceleration=0.3, jerk=5.0)
    )

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for f in fields(self):
            value = getattr(self, f.name)
            if not isinstance(value, RateLimitsCfg):
                require(
                    is_number(value) and value > 0,
                    f"PaletteExpertCfg.{f.name} = {value!r}: must be a finite number > 0",
                )


class Way(NamedTuple):
    """A motion of the joints at the control rate, from the next frame on.

    Attributes:
        q: Shape (m, 6), rad.
        qd: Shape (m, 6), rad/s.
    """

    q: Array
    qd: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Memory:
    """What the policy remembers of an episode.

    Attributes:
        q: Commanded joint angles, shape (6,), rad.
        qd: Commanded joint speeds, shape (6,), rad/s.
        ways: What is left of the plan: the motions, the first under way.
        frame: Of the first.
        place: Which place is being pressed; -1 before the first.
        given_up: Places that did not come home, shape (8,).
    """

    q: Array
    qd: Array
    ways: tuple[Way, ...] = ()
    frame: int = 0
    place: int = -1
    given_up: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(MAX_TARGETS, np.bool_))


class PaletteExpert:
    """Goes to the nearest open place, presses until it is closed, and goes on.

    It reads where to press from the observation: with the environment's ``perception="oracle"`` that is the
    truth, with ``"vision"`` what the environment's ``observer`` saw.

    Attributes:
        control: The ``control`` its environment needs.
    """

    control = "joint"

    def __init__(self, cell: CellCfg | None = None, cfg: PaletteExpertCfg | None = None) -> None:
        """Takes the limits.

        Args:
            cell: Control rate and what an action of 1 means.
            cfg: How the tool moves.
        """
        self._cell, self._cfg = cell or load_cell(), cfg or PaletteExpertCfg()
        self._dt = self._cell.timing.frame_s

    @classmethod
    def of(cls, env: Any, cfg: PaletteExpertCfg | None = None) -> Self:
        """The expert for an environment.

        Args:
            env: A ``PaletteEnv``, wrapped or not.
            cfg: How the tool moves.

        Returns:
            The expert, with the environment's cell.

        Raises:
            ConfigError: If the environment takes other actions.
        """
        settings = env.unwrapped.cfg
        require(
            settings.control == cls.control,
            f"control = {settings.control!r}: the expert acts with control={cls.control!r}; make the "
            "environment with that",
        )
        return cls(settings.cell, cfg)

    def predict(
        self,
        observation: NDArray[np.float32] | dict[str, NDArray[Any]],
        state: Memory | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], Memory]:
        """The action for an observation of one environment.

        Args:
            observation: As ``PaletteEnv`` documents it.
            state: From the last call; None at an episode's start.
            episode_start: If true, ``state`` is forgotten.
            deterministic: The expert always is.

        Returns:
            Action of shape (6,), and what it remembers.
        """
        del deterministic
        rows = np.asarray(
            observation["features"] if isinstance(observation, dict) else observation, np.float64
        )
        if state is None or (episode_start is not None and bool(np.all(episode_start))):
            state = Memory(q=rows[_Q], qd=rows[_QD])
        state = self._think(rows, state)
        return self._follow(state)

    # -- what to do -------------------------------------------------------------------------------------

    def _think(self, rows: Array, memory: Memory) -> Memory:
        """A new plan where the old one is over or the tie has come home."""
        still_open = rows[_OPEN] > 0.5
        pressing = memory.place >= 0 and len(memory.ways) == 1
        if pressing and not still_open[memory.place]:
            return replace(memory, ways=(self._brake(memory),), frame=0, place=-1)
        if memory.ways:
            return memory
        if memory.place >= 0:  # pressed to the end and not closed
            given_up = memory.given_up.copy()
            given_up[memory.place] = True
            memory = replace(memory, given_up=given_up, place=-1)
        choice = still_open & ~memory.given_up
        if not choice.any():
            return memory
        tip = tip_kinematics(memory.q[None], memory.qd[None]).pose[0]
        measured = tip_kinematics(rows[_Q][None], rows[_QD][None]).pose[0]
        places = measured[:3, 3] + _MM * rows[_PLACES].reshape(-1, 3) @ measured[:3, :3].T
        away = np.where(choice, np.linalg.norm(places - tip[:3, 3], axis=1), np.inf)
        place = int(np.argmin(away))
        return replace(memory, ways=self._plan(memory.q, tip, places[place]), frame=0, place=place)

    def _plan(self, q: Array, tip: Array, place: Array) -> tuple[Way, ...]:
        """Up, across, down to the hover, and the press."""
        cfg = self._cfg
        safe = place[2] + cfg.clearance_m
        stops = [np.array([*place[:2], safe]), place + np.array([0.0, 0.0, cfg.hover_m])]
        if tip[2, 3] < safe:
            stops.insert(0, np.array([*tip[:2, 3], safe]))
        goals = [*stops, place - [0.0, 0.0, TRAVEL_M + cfg.beyond_m]]
        ways = []
        for k, goal in enumerate(goals):
            limits = cfg.press if k == len(goals) - 1 else cfg.move
            way = self._straight(q, tip, transform(_UPRIGHT, goal), limits)
            q, tip = way.q[-1], transform(_UPRIGHT, goal)
            ways.append(way)
        last = ways[-1]
        rest = np.repeat(last.q[-1:], cfg.wait_frames, axis=0)
        ways[-1] = Way(np.concatenate((last.q, rest)), np.concatenate((last.qd, np.zeros_like(rest))))
        return tuple(ways)

    def _straight(self, q: Array, start: Array, goal: Array, limits: RateLimitsCfg) -> Way:
        """A tau-Jerk motion of the tip along a line, in the joints."""
        motion = plan_pose(start, goal, limits, _ANGULAR)
        frames = max(math.ceil(float(motion.duration_s) / self._dt), 1)
        sampled = motion.sample(np.arange(1, frames + 1, dtype=np.float64) * self._dt)
        angles = ik.nearest(ik_kernel.solve(sampled.pose), q)
        require(
            bool(np.isfinite(angles).all()),
            f"the way from {start[:3, 3]} to {goal[:3, 3]} m leaves the arm's reach: check what was seen",
        )
        body = np.swapaxes(sampled.pose[:, :3, :3], 1, 2)
        twist = np.concatenate([(body @ sampled.twist[:, k : k + 3, None])[..., 0] for k in (0, 3)], axis=1)
        jacobian = tip_kinematics(angles, np.zeros_like(angles)).jacobian
        return Way(angles, np.linalg.solve(jacobian, twist[..., None])[..., 0])

    def _brake(self, memory: Memory) -> Way:
        """To rest, at constant deceleration."""
        n = self._cfg.brake_frames
        left = 1.0 - np.arange(1, n + 1)[:, None] / n
        qd = left * memory.qd
        before = np.concatenate((memory.qd[None], qd[:-1]))
        return Way(memory.q + np.cumsum(0.5 * (before + qd) * self._dt, axis=0), qd)

    # -- how to do it -----------------------------------------------------------------------------------

    def _follow(self, memory: Memory) -> tuple[NDArray[np.float32], Memory]:
        """The acceleration that brings the command to the plan's next frame."""
        if memory.ways:
            way = memory.ways[0]
            q, qd = way.q[memory.frame], way.qd[memory.frame]
        else:
            q, qd = memory.q, np.zeros(6)
        # Speeds are met; of the position's error, the trapezoidal rule's, half goes in each frame.
        error = q - (memory.q + 0.5 * (memory.qd + qd) * self._dt)
        scale = self._cell.limits.joint_rad_s2
        action = np.clip((qd - memory.qd + error / self._dt) / (self._dt * scale), -1.0, 1.0).astype(
            np.float32
        )
        speed = memory.qd + action.astype(np.float64) * scale * self._dt
        new = replace(
            memory, q=memory.q + 0.5 * (memory.qd + speed) * self._dt, qd=speed, frame=memory.frame + 1
        )
        if new.ways and new.frame == len(new.ways[0].q):
            new = replace(new, ways=new.ways[1:], frame=0)
        return action, new
