"""From the arm's home to a seam's start and home again by tau-Jerk; in between any policy seals."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents import Policy
from seal_gym.core.cell import CellCfg, load_cell
from seal_gym.core.errors import require
from seal_gym.core.frames import Array
from seal_gym.core.kinematics import HOME_Q, tip_kinematics
from seal_gym.envs.adapters import CHOLESKY_SCALE, CONTROLS, tip_scale
from seal_gym.envs.core import FEATURES
from seal_gym.planning.approach import Approach, ApproachCfg, plan_departure, plan_journey
from seal_gym.rmp import metric_to_cholesky

_Q, _QD = slice(23, 29), slice(29, 35)
_STIFFNESS, _DAMPING = 64.0, 16.0  # of the way back to the plan [1/s^2, 1/s]
_WAIT_FRAMES = 30  # in which what the leaves have held back may still arrive
TRAVEL = ApproachCfg(tip_m_s2=0.7)  # an action's tip acceleration ends at 1 m/s^2; the rest is for control


Observation = NDArray[np.float32] | dict[str, NDArray[Any]]


def _rows(observation: Observation) -> Array:
    """The features of one environment, shape (n,)."""
    return np.asarray(observation["features"] if isinstance(observation, dict) else observation, np.float64)


class Follower:
    """Follows a planned motion of the joints, whatever an action means.

    Attributes:
        way: The motion.
        frame: Of its next command.
    """

    def __init__(self, way: Approach, control: str, cell: CellCfg | None = None) -> None:
        """Takes a motion.

        Args:
            way: Of one arm.
            control: What an action means, see ``SealEnv``.
            cell: Its scales.
        """
        require(control in CONTROLS, f"control = {control!r}: must be one of {list(CONTROLS)}")
        limits = (cell or load_cell()).limits
        self.way, self.frame = way, 0
        self._control, self._joint, self._tip = control, limits.joint_rad_s2, tip_scale(limits)

    @property
    def over(self) -> bool:
        """Whether the motion has come to its end."""
        return self.frame >= len(self.way.time_s) - 1

    def act(self, observation: Observation) -> NDArray[np.float32]:
        """The next action.

        Args:
            observation: Of one environment, as ``SealEnv`` documents it.

        Returns:
            Shape (n,); with sealant the valve stays shut.
        """
        rows = _rows(observation)
        action = self._action(self._acceleration(rows[_Q], rows[_QD]), rows[_Q], rows[_QD])
        if len(rows) > FEATURES:
            action = np.append(action, -1.0)
        return np.clip(action, -1.0, 1.0).astype(np.float32)

    def _acceleration(self, q: Array, qd: Array) -> Array:
        """Planned for the coming frame, and back to the plan, shape (6,), rad/s^2."""
        k, self.frame = min(self.frame, len(self.way.time_s) - 1), self.frame + 1
        then = min(k + 1, len(self.way.time_s) - 1)
        frame_s = self.way.time_s[1] - self.way.time_s[0]
        planned = (self.way.qd[then] - self.way.qd[k]) / frame_s
        return np.asarray(planned + _STIFFNESS * (self.way.q[k] - q) + _DAMPING * (self.way.qd[k] - qd))

    def _action(self, qdd: Array, q: Array, qd: Array) -> Array:
        if self._control == "joint":
            return qdd / self._joint
        tip = tip_kinematics(q[None], qd[None])
        accel = (tip.jacobian[0] @ qdd + tip.drift[0]) / self._tip
        if self._control == "tip":
            return np.asarray(accel)
        metric = metric_to_cholesky(CHOLESKY_SCALE**2 * np.eye(6)[None])[0]  # the largest there is
        return np.concatenate((accel, metric / CHOLESKY_SCALE))


def play_from_home(
    policy: Policy, env: Any, seed: int, watch: Callable[[Any, dict[str, Any]], None] | None = None
) -> dict[str, Any]:
    """One episode from home to home: the policy seals, the ways there and back are tau-Jerk motions.

    The way back is after the episode's end: it earns nothing, but touching something then is told.

    Args:
        policy: With SB3's ``predict``.
        env: ``SealEnv`` with the policy's control mode.
        seed: Of the episode.
        watch: Called with the environment and the info after the reset and after each step.

    Returns:
        ``episode_metrics``, with ``return``, ``seed``, and, if the seam was sealed, ``home_s`` (duration of
        the way back) and ``home_touched`` (whether anything was touched on it).

    Raises:
        ConfigError: If the hover is out of reach from home.
    """
    observation, info = env.reset(seed=seed, options={"start": "home"})
    cell, control, total = env.unwrapped.core.cfg.cell, policy.control, 0.0
    look = watch or (lambda *_: None)
    look(env, info)
    there = Follower(plan_journey(HOME_Q, info["hover_pose"], cell, TRAVEL), control, cell)
    state, start, done = None, np.array([True]), False
    while not done:
        if not there.over or (info["under_way"] and there.frame < len(there.way.time_s) + _WAIT_FRAMES):
            action = there.act(observation)
        else:
            action, state = policy.predict(observation, state=state, episode_start=start)
            start = np.array([False])
        observation, reward, terminated, truncated, info = env.step(action)
        total, done = total + float(reward), terminated or truncated
        look(env, info)
    metrics = {**info["episode_metrics"], "return": total, "seed": seed}
    if not metrics["reached"]:
        return metrics
    q = _rows(observation)[_Q]
    back, touched = Follower(plan_departure(q, HOME_Q, cell, TRAVEL), control, cell), False
    while not back.over:
        observation, _, _, _, info = env.step(back.act(observation))
        touched = touched or info["collision"]
        look(env, info)
    return {**metrics, "home_s": float(back.way.time_s[-1]), "home_touched": touched}
