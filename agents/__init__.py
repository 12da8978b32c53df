"""Policies: the RMP expert, and what will learn from it."""

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from agents.expert import RmpExpert
from seal_gym.core.errors import ConfigError

__all__ = ["POLICIES", "Policy", "control_of", "load_policy"]


class Policy(Protocol):
    """What an evaluator needs of a policy: Stable-Baselines3's ``predict``, and the control mode.

    Attributes:
        control: The ``control`` its environment needs.
    """

    control: str

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], Any]:
        """Gives the actions for observations, of one environment or of N."""


POLICIES: dict[str, Callable[..., Policy]] = {"rmp_expert": RmpExpert}


def _named(name: str) -> Callable[..., Policy]:
    if name not in POLICIES:
        raise ConfigError(f"policy = {name!r}: must be one of {sorted(POLICIES)}")
    return POLICIES[name]


def control_of(name: str) -> str:
    """The control mode that a policy needs.

    Args:
        name: Of the policy.

    Returns:
        The environment's ``control``.

    Raises:
        ConfigError: If there is no such policy.
    """
    return str(_named(name).control)  # type: ignore[attr-defined]  # every registered policy class has it


def load_policy(name: str, env: Any = None) -> Policy:
    """A policy by name.

    Args:
        name: One of ``POLICIES``.
        env: The environment it will act in: checked against the policy's control mode, and the source of
            the cell's calibration.

    Returns:
        The policy.

    Raises:
        ConfigError: If there is no such policy, or the environment's control mode is another.
    """
    make = _named(name)
    if env is None:
        return make()
    cfg = getattr(env, "unwrapped", env).core.cfg
    if cfg.control != control_of(name):
        raise ConfigError(
            f"policy {name!r} acts with control={control_of(name)!r}, the environment has {cfg.control!r}: "
            f"make it with control={control_of(name)!r}"
        )
    return make(cell=cfg.cell)
