"""The hand-designed RMP expert on the ROI features."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.cell import CellCfg, load_cell
from seal_gym.core.frames import Array
from seal_gym.envs.adapters import CHOLESKY_SCALE
from seal_gym.rmp import SealingCfg, SeamErrors, blend, metric_to_cholesky, reference_twist, seam_policies

_MM, _DEG = 1e-3, float(np.deg2rad(1.0))


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
        limits = self._cell.limits
        self._scale = np.array([limits.linear_m_s2] * 3 + [limits.angular_rad_s2] * 3)

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
        features = observation["features"] if isinstance(observation, dict) else observation
        rows = np.atleast_2d(np.asarray(features, dtype=np.float64))
        action = self._act(rows).astype(np.float32)
        return (action if features.ndim == 2 else action[0]), state

    def _act(self, o: Array) -> Array:
        # The features of a lost view are old: following them would drive the gun on.
        seen = np.where(o[:, 2] * o[:, 5] > 0.5, 1.0, 0.0)
        distance, angle = _MM * seen, _DEG * seen
        errors = SeamErrors(
            distance * o[:, 0], angle * o[:, 1], distance * o[:, 3], angle * o[:, 4], _DEG * o[:, 10]
        )
        twist = np.concatenate((_MM * o[:, 11:14], _DEG * o[:, 14:17]), axis=1)
        seam = np.zeros_like(twist)
        seam[:, [0, 2]], seam[:, [3, 5]] = _MM * o[:, 6:8], _DEG * o[:, 8:10]
        speed = seen * self._cell.process.speed_m_s
        policy = blend(seam_policies(errors, twist, reference_twist(speed, seam), self._sealing))
        action = np.concatenate(
            (policy.accel / self._scale, metric_to_cholesky(policy.metric) / CHOLESKY_SCALE), axis=1
        )
        return np.asarray(np.minimum(np.maximum(action, -1.0), 1.0))
