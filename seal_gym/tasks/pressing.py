"""The palette task: which ties are home, what was touched by mistake, how the tip went; and the reward."""

from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import is_number, require
from seal_gym.core.frames import Array


def _check_numbers(cfg: object, *may_be_zero: str) -> None:
    for f in fields(cfg):  # type: ignore[arg-type]  # called with dataclasses
        value = getattr(cfg, f.name)
        low = ">= 0" if f.name in may_be_zero else "> 0"
        require(
            is_number(value) and (value > 0 or (f.name in may_be_zero and value == 0)),
            f"{type(cfg).__name__}.{f.name} = {value!r}: must be a finite number {low}",
        )


@dataclass(frozen=True, kw_only=True)
class PressTaskCfg:
    """What counts as done, and when an episode ends.

    Attributes:
        force_n: Least force of the pad on a tie that is home [N].
        seat_m: Least way of its head [m].
        stop_n: Force on anything at which the arm's protective stop ends the episode [N].
        time_s: Time limit for a palette without ties [s].
        time_each_s: More of it for each tie [s].
    """

    force_n: float = 15.0
    seat_m: float = 0.0055
    stop_n: float = 150.0
    time_s: float = 10.0
    time_each_s: float = 8.0

    def __post_init__(self) -> None:
        """Checks the ranges."""
        _check_numbers(self)
        require(
            self.force_n < self.stop_n,
            f"PressTaskCfg.force_n = {self.force_n!r}: must be below stop_n = {self.stop_n!r}",
        )


@dataclass(frozen=True, kw_only=True)
class PressRewardCfg:
    """Weights of the reward's terms.

    Attributes:
        target: For a tie pressed home.
        completed: For the last of them.
        approach: Of the decrease of the distance to the nearest open tie, in units of ``approach_m``.
        approach_m: That unit [m].
        wrong: Penalty of a wrong touch.
        stopped: Penalty of a protective stop.
        smoothness: Weight of the change of the action.
        time: Penalty of a frame.
    """

    target: float = 10.0
    completed: float = 20.0
    approach: float = 2.0
    approach_m: float = 0.1
    wrong: float = 5.0
    stopped: float = 20.0
    smoothness: float = 0.05
    time: float = 0.01

    def __post_init__(self) -> None:
        """Checks the ranges."""
        weights = {f.name for f in fields(self)} - {"approach_m"}
        _check_numbers(self, *weights)


class Events(NamedTuple):
    """What a frame brought.

    Attributes:
        home: Ties that came home in it, shape (n,).
        wrong: Number of new wrong touches.
        completed: All ties are home.
        stopped: A force was too large.
        timeout: The time is over, and neither of these.
        approached_m: Decrease of the distance to the nearest tie that is open at the frame's end [m].
    """

    home: NDArray[np.bool_]
    wrong: int
    completed: bool
    stopped: bool
    timeout: bool
    approached_m: float


class Pressing:
    """Keeps the score of one palette.

    A wrong touch begins in the frame in which something that is not to be touched is touched and was not in
    the frame before; it lasts until let go.

    Attributes:
        home: Which ties are home, shape (n,).
        touched: Which classes are touched by mistake now, shape (c,).
        wrong: Wrong touches so far, by class, shape (c,).
        force_n: Largest force of the pad on a tie in the last frame [N].
        peak_n: Largest force on anything so far [N].
        frames: Since the start.
    """

    def __init__(
        self, target_m: Array, tip_m: Array, classes: int, frame_s: float, cfg: PressTaskCfg
    ) -> None:
        """Starts with all ties open.

        Args:
            target_m: Where the ties are to be pressed, shape (n, 3), m.
            tip_m: Where the tip is, shape (3,), m.
            classes: Number of classes of wrong touches.
            frame_s: Duration of a frame [s].
            cfg: What counts.
        """
        self._cfg, self._target, self._frame_s = cfg, target_m, frame_s
        self.home: NDArray[np.bool_] = np.zeros(len(target_m), np.bool_)
        self.touched: NDArray[np.bool_] = np.zeros(classes, np.bool_)
        self.wrong = np.zeros(classes, np.int64)
        self.force_n = 0.0
        self.peak_n = 0.0
        self.frames = 0
        self._tip = tip_m.copy()
        self._commands = [tip_m.copy()]
        self._path_m = self._jerk = 0.0
        self.time_limit = int(np.ceil((cfg.time_s + cfg.time_each_s * len(target_m)) / frame_s))

    def advance(
        self,
        press_n: Array,
        slide_m: Array,
        wrong: NDArray[np.bool_],
        wrong_n: Array,
        tip: Array,
        command: Array,
    ) -> Events:
        """Takes a frame of S physics steps.

        Args:
            press_n: Force of the pad on each tie after each step, shape (S, n), N.
            slide_m: How far each has been pressed, shape (S, n), m.
            wrong: Which classes were touched by mistake, shape (S, c).
            wrong_n: Forces on them, shape (S, k), N.
            tip: Where the tip is now, shape (3,), m.
            command: Where it is commanded to be, shape (3,), m.

        Returns:
            What the frame brought.
        """
        cfg = self._cfg
        self.frames += 1
        pressed = ((press_n >= cfg.force_n) & (slide_m >= cfg.seat_m)).any(axis=0)
        home = np.asarray(pressed & ~self.home)
        self.home = self.home | pressed
        touched = np.asarray(wrong.any(axis=0))
        fresh = touched & ~self.touched
        self.touched = touched
        self.wrong += fresh
        self.force_n = float(press_n.max())
        largest = max(self.force_n, float(wrong_n.max(initial=0.0)))
        self.peak_n = max(self.peak_n, largest)
        approached = self._away(self._tip) - self._away(tip)
        self._move(tip, command)
        stopped = largest >= cfg.stop_n
        completed = bool(self.home.all()) and not stopped
        timeout = self.frames >= self.time_limit and not (completed or stopped)
        return Events(home, int(fresh.sum()), completed, stopped, timeout, approached)

    def _away(self, tip: Array) -> float:
        """Distance to the nearest open tie, 0 with none left [m]."""
        if self.home.all():
            return 0.0
        return float(np.linalg.norm(self._target[~self.home] - tip, axis=1).min())

    def _move(self, tip: Array, command: Array) -> None:
        self._path_m += float(np.linalg.norm(tip - self._tip))
        self._tip = tip.copy()
        self._commands = [*self._commands[-3:], command.copy()]
        if len(self._commands) == 4:
            third = np.diff(np.array(self._commands), n=3, axis=0)[0]
            self._jerk = max(self._jerk, float(np.linalg.norm(third)) / self._frame_s**3)

    def metrics(self) -> dict[str, Any]:
        """Of the episode so far.

        Returns:
            ``targets``, ``targets_done``, ``wrong_touches``, ``path_mm`` (the tip's way), ``peak_jerk_m_s3``
            (of the commanded tip, by third differences of its positions at the frames), ``peak_force_n`` and
            ``time_s``.
        """
        return {
            "targets": len(self.home),
            "targets_done": int(self.home.sum()),
            "wrong_touches": int(self.wrong.sum()),
            "path_mm": 1e3 * self._path_m,
            "peak_jerk_m_s3": self._jerk,
            "peak_force_n": self.peak_n,
            "time_s": self.frames * self._frame_s,
        }


def reward(events: Events, action_change: float, cfg: PressRewardCfg) -> float:
    """Reward of one frame.

    r = w_t [ties home] + w_c [completed] + w_a (d - d') / d_0 - w_w [new wrong touches] - w_p [stopped]
        - w_s c - w_T,
    with the distance d to the nearest open tie and the mean absolute change of action c, halved to 0..1. A
    tie pays once: neither going to and fro nor pressing again does.

    Args:
        events: Of the frame.
        action_change: 0..1.
        cfg: Weights.

    Returns:
        The reward.
    """
    return float(
        cfg.target * events.home.sum()
        + cfg.completed * events.completed
        + cfg.approach * events.approached_m / cfg.approach_m
        - cfg.wrong * events.wrong
        - cfg.stopped * events.stopped
        - cfg.smoothness * action_change
        - cfg.time
    )
