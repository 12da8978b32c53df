"""The reward of the sealing task."""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import require
from seal_gym.core.frames import Array


@dataclass(frozen=True, kw_only=True)
class RewardCfg:
    """Weights and scales of the reward's terms; every term but the outcome is bounded by its weight.

    Attributes:
        progress: Weight of the new ground along the seam, in nominal steps, times the tracking quality.
        approach: Weight of the change of the tip error's potential.
        heading: Weight of the heading error.
        smoothness: Weight of the change of the action.
        reached: Bonus for sealing the seam.
        failed: Penalty for a collision or for losing the seam.
        error_m: Tip error that halves the tracking quality [m].
        heading_rad: Heading error that costs the whole weight [rad].
        potential_m: Scale of the tip error's potential [m].
    """

    progress: float = 1.0
    approach: float = 2.0
    heading: float = 0.1
    smoothness: float = 0.05
    reached: float = 20.0
    failed: float = 20.0
    error_m: float = 1e-3
    heading_rad: float = 0.2
    potential_m: float = 5e-3

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for f in fields(self):
            value = getattr(self, f.name)
            require(
                bool(np.isfinite(value)) and value >= 0,
                f"RewardCfg.{f.name} = {value!r}: must be finite and >= 0",
            )
        require(
            min(self.error_m, self.heading_rad, self.potential_m) > 0,
            "RewardCfg.error_m, heading_rad and potential_m are scales: must be > 0",
        )

    @property
    def bound(self) -> float:
        """Largest magnitude of a step's reward."""
        return self.progress + self.approach + self.heading + self.smoothness + max(self.reached, self.failed)


def reward(
    ground_steps: Array,
    error_m: Array,
    previous_error_m: Array,
    heading_rad: Array,
    action_change: Array,
    reached: NDArray[np.bool_],
    failed: NDArray[np.bool_],
    cfg: RewardCfg,
) -> Array:
    """Reward of one step.

    r = w_p clip(ground, 0, 1) q + w_a (P(e') - P(e)) - w_h min(1, |theta| / theta_0) - w_s c
        + [reached] w_r - [failed] w_f,
    with the quality q = 1 / (1 + (e / e_0)^2), the potential P(e) = e / (e + e_P) and the mean absolute
    change of action c, halved to 0..1. Only ground that no earlier frame of the episode had reached counts:
    neither going to and fro nor hurrying pays.

    Args:
        ground_steps: New ground along the seam in units of the nominal speed times a frame, shape (N,).
        error_m: Tip error [m], shape (N,).
        previous_error_m: Tip error a frame ago [m], shape (N,).
        heading_rad: Angle between the tip's y axis and the seam in the frame the action was chosen on [rad],
            shape (N,).
        action_change: Mean absolute change of the action, halved, 0..1, shape (N,).
        reached: Whether the episode ended with the seam sealed, shape (N,).
        failed: Whether it ended with a collision or lost, shape (N,).
        cfg: Weights.

    Returns:
        Shape (N,), within +-``cfg.bound``.
    """
    ground = np.minimum(np.maximum(ground_steps, 0.0), 1.0)
    quality = 1.0 / (1.0 + (error_m / cfg.error_m) ** 2)
    potential = error_m / (error_m + cfg.potential_m)
    previous = previous_error_m / (previous_error_m + cfg.potential_m)
    return np.asarray(
        cfg.progress * ground * quality
        + cfg.approach * (previous - potential)
        - cfg.heading * np.minimum(1.0, heading_rad / cfg.heading_rad)
        - cfg.smoothness * action_change
        + cfg.reached * reached
        - cfg.failed * failed
    )
