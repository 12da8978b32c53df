"""Episodes driven by a policy and labelled by the expert, and closed-loop scores; N environments at once."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.episodes import tip_acceleration, tip_action, tip_scale
from agents.expert import RmpExpert
from seal_gym.core.errors import require
from seal_gym.envs.adapters import RmpAdapter
from seal_gym.envs.core import SealCore
from seal_gym.envs.sb3 import SealSb3VecEnv

FloatRows = NDArray[np.float32]
FIRST_VALIDATION_SEED = 500_000  # protocol.md: training below, tables from 1,000,000
_AT_ONCE = 32


class Episode(NamedTuple):
    """States that a policy visited, and what the expert would have done there.

    Attributes:
        observations: Shape (T, 35).
        tip: The expert's action as ``control="tip"`` takes it, shape (T, 6).
        rmp: The expert's action as ``control="rmp"`` takes it, shape (T, 27).
    """

    observations: FloatRows
    tip: FloatRows
    rmp: FloatRows


class Labeller:
    """The expert's actions in both spaces, in the state in which simulations are."""

    def __init__(self, core: SealCore) -> None:
        """Takes the cell.

        Args:
            core: The simulations, of any control mode.
        """
        cell = core.cfg.cell
        self._core, self._expert, self._adapter = core, RmpExpert(cell), RmpAdapter(cell)
        self._scale = tip_scale(cell)

    def __call__(self, observation: FloatRows) -> tuple[FloatRows, FloatRows]:
        """Labels one frame.

        Args:
            observation: What the simulations saw last, shape (N, 35).

        Returns:
            The tip action, which is the tip acceleration that the ``rmp`` adapter makes of the expert's
            leaf and the fixed leaves, shape (N, 6); the rmp action, shape (N, 27).
        """
        rmp, _ = self._expert.predict(observation)
        state = self._core.arm_state()
        qdd = self._adapter(rmp.astype(np.float64), state)
        return tip_action(tip_acceleration(qdd, state), self._scale), rmp


def _vec(policy_control: str, workpiece: str, n: int, perception: str, **kwargs: Any) -> SealSb3VecEnv:
    return SealSb3VecEnv(n, workpiece=workpiece, control=policy_control, perception=perception, **kwargs)


def roll(
    policy: Any,
    *,
    workpiece: str,
    seed: int,
    episodes: int,
    perception: str = "vision",
    expert_share: float = 0.0,
) -> list[Episode]:
    """Lets a policy act and the expert label what it meets.

    Args:
        policy: With ``control`` ``"tip"`` or ``"rmp"``.
        workpiece: Name of the part.
        seed: Of the first episode; the others follow.
        episodes: How many.
        perception: ``"vision"`` or ``"oracle"``.
        expert_share: Probability that the expert acts in the policy's place, drawn anew each frame (beta of
            Ross et al. 2011, "A Reduction of Imitation Learning ... to No-Regret Online Learning").

    Returns:
        One a seed, from reset to the state before its last action.
    """
    require(policy.control in ("tip", "rmp"), f"policy.control = {policy.control!r}: must be 'tip' or 'rmp'")
    out: list[Episode] = []
    for first in range(seed, seed + episodes, _AT_ONCE):
        out += _roll_at_once(
            policy, workpiece, first, min(_AT_ONCE, seed + episodes - first), perception, expert_share
        )
    return out


def _roll_at_once(
    policy: Any, workpiece: str, seed: int, n: int, perception: str, expert_share: float
) -> list[Episode]:
    venv = _vec(policy.control, workpiece, n, perception)
    venv.seed(seed)
    observation: Any = venv.reset()
    label = Labeller(venv.core)
    rng = np.random.default_rng([seed, n])
    frames: list[list[FloatRows]] = [[], [], []]
    lengths, live = np.zeros(n, np.int64), np.ones(n, np.bool_)
    state, start = None, np.ones(n, np.bool_)
    while live.any():
        tip, rmp = label(observation)
        action, state = policy.predict(observation, state=state, episode_start=start)
        theirs = rmp if policy.control == "rmp" else tip
        action = np.where(rng.random((n, 1)) < expert_share, theirs, action)
        for rows, new in zip(frames, (observation, tip, rmp), strict=True):
            rows.append(new)
        lengths += live
        observation, _, start, _ = venv.step(action)
        live &= ~start
    venv.close()
    stacked = [np.stack(rows) for rows in frames]
    return [Episode(*(rows[: lengths[i], i].copy() for rows in stacked)) for i in range(n)]


def score(
    policy: Any,
    *,
    workpiece: str,
    trials: int,
    perception: str = "vision",
    seed: int = FIRST_VALIDATION_SEED,
    **kwargs: Any,
) -> dict[str, Any]:
    """Drives a policy in closed loop on validation seeds.

    Args:
        policy: With ``control``.
        workpiece: Name of the part.
        trials: How many episodes.
        perception: ``"vision"`` or ``"oracle"``.
        seed: Of the first trial.
        **kwargs: Further keyword arguments of the environment.

    Returns:
        Counts of the outcomes, and the mean of ``rmse_mm`` over the trials that reached (None without one).
    """
    metrics: list[dict[str, Any]] = []
    for first in range(seed, seed + trials, _AT_ONCE):
        metrics += _episode_metrics(
            policy, workpiece, first, min(_AT_ONCE, seed + trials - first), perception, **kwargs
        )
    reached = [m["rmse_mm"] for m in metrics if m["reached"]]
    return {
        "trials": trials,
        "reached": len(reached),
        "collision": sum(m["collision"] for m in metrics),
        "timeout": sum(m["timeout"] for m in metrics),
        "rmse_mm": float(np.mean(reached)) if reached else None,
    }


def _episode_metrics(
    policy: Any, workpiece: str, seed: int, n: int, perception: str, **kwargs: Any
) -> list[dict[str, Any]]:
    venv = _vec(policy.control, workpiece, n, perception, **kwargs)
    venv.seed(seed)
    observation: Any = venv.reset()
    ended: dict[int, dict[str, Any]] = {}
    state, start = None, np.ones(n, np.bool_)
    while len(ended) < n:
        action, state = policy.predict(observation, state=state, episode_start=start)
        observation, _, start, infos = venv.step(action)
        for i in map(int, np.flatnonzero(start)):
            ended.setdefault(i, infos[i]["episode_metrics"])
    venv.close()
    return [ended[i] for i in range(n)]
