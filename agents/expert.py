"""The hand-designed RMP expert on the ROI features."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.reading import Reading, read, rows_of
from seal_gym.core.cell import CellCfg, load_cell
from seal_gym.core.frames import Array
from seal_gym.envs.adapters import CHOLESKY_SCALE, tip_scale
from seal_gym.rmp import SealingCfg, SeamErrors, blend, metric_to_cholesky, reference_twist, seam_policies


class RmpExpert:
    """Zhou et al.'s Table 1 as a policy: attraction, heading and forward-speed leaves from the features.

    The leaves are summed into one (f, A) in the tip's space, which the ``rmp`` adapter resolves with its
    fixed leaves. The estimated motion of the seam is fed forward. A view without a line slows the gun down.

    Attributes:
        control: The ``control`` its environment needs.
    """

    control = "rmp"

    def __init__(self, cell: CellCfg | None = None, sealing: SealingCfg | None = None) -> None:
        """Takes the gains.

        Args:
            cell: Speed and limits.
            sealing: Configuration of the leaves.
        """
        self._cell = cell or load_cell()
        self._sealing = sealing or SealingCfg()
        self._scale = tip_scale(self._cell.limits)

    def predict(
        self,
        observation: NDArray[np.float32] | dict[str, NDArray[Any]],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], Any]:
        """Actions for observations, as Stable-Baselines3's policies give them.

        Args:
            observation: Of one environment or of N, as ``SealEnv`` documents it.
            state: Passed through: the expert has no memory.
            episode_start: Not needed.
            deterministic: The expert always is.

        Returns:
            Actions of shape (27,) or (N, 27), and the state.
        """
        del episode_start, deterministic
        rows, many = rows_of(observation)
        action = self._act(read(rows)).astype(np.float32)
        return (action if many else action[0]), state

    def _act(self, now: Reading) -> Array:
        # The features of a lost view are old: following them would drive the gun on.
        seen = np.where(now.seen, 1.0, 0.0)
        d_front, theta_front, d_side, theta_side, lean = now.errors
        errors = SeamErrors(seen * d_front, seen * theta_front, seen * d_side, seen * theta_side, lean)
        reference = reference_twist(seen * self._cell.process.speed_m_s, now.seam_twist, self._sealing)
        policy = blend(seam_policies(errors, now.twist, reference, self._sealing))
        action = np.concatenate(
            (policy.accel / self._scale, metric_to_cholesky(policy.metric) / CHOLESKY_SCALE), axis=1
        )
        return np.asarray(np.minimum(np.maximum(action, -1.0), 1.0))
