"""``ActuationDelay``: actions reach the controller late."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from seal_gym.core.frames import Array
from seal_gym.wrappers.base import DisturbanceCfg, check_numbers


@dataclass(frozen=True, kw_only=True)
class ActuationDelayCfg(DisturbanceCfg):
    """What is executed in a frame is the action of some frames ago, at first none (zeros).

    Of a delay that is no whole number of frames, a frame executes the mean of the two actions it would hold
    one after the other. The fixed leaves of ``control="rmp"`` run beside the arm and are not late.

    Attributes:
        frames: Delay at severity 1 [frames of 1/30 s].
    """

    name: ClassVar[str] = "ActuationDelay"

    frames: float = 1.0

    def check(self) -> None:
        """Checks the range."""
        check_numbers(self, frames=(0.0, 30.0))


class Delay:
    """The actions on their way, of N simulations."""

    def __init__(self, n: int, size: int, cfg: ActuationDelayCfg) -> None:
        """Starts with nothing on the way.

        Args:
            n: Number of simulations.
            size: Of an action.
            cfg: The delay.
        """
        delay = cfg.severity * cfg.frames
        self._whole = int(delay)
        self._part = delay - self._whole
        self._late = np.zeros((self._whole + 2, n, size))  # the newest first

    def reset(self, i: int) -> None:
        """Forgets one simulation's actions.

        Args:
            i: Which simulation.
        """
        self._late[:, i] = 0.0

    def __call__(self, action: Array) -> Array:
        """Takes a frame's actions.

        Args:
            action: Shape (N, size).

        Returns:
            Those to execute, shape (N, size).
        """
        self._late = np.concatenate((action[None], self._late[:-1]))
        new, old = self._late[self._whole], self._late[self._whole + 1]
        return np.asarray(new + self._part * (old - new) if self._part else new)
