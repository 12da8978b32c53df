"""``ExternalPush``: somebody or something pushes the arm or the gun."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from seal_gym.core.frames import Array
from seal_gym.wrappers.base import DisturbanceCfg, check_choice, check_numbers

# MuJoCo bodies by the names users know.
BODIES = {"gun": "gun/sealgun", "arm": "forearm_link"}
_PUSHES = 64


@dataclass(frozen=True, kw_only=True)
class ExternalPushCfg(DisturbanceCfg):
    """Pushes at random times in random directions at the body's centre of mass; a half sine each.

    At severity 1 a push on the gun moves the nozzle by a few tenths of a millimetre: the arm's servos are
    stiff.

    Attributes:
        on: ``"gun"`` or ``"arm"`` (the forearm).
        force_n: Peak force at severity 1 [N].
        duration_s: Of a push [s].
        pause_s: Mean time between pushes [s]; the pauses are uniform between half and one and a half times
            of it.
    """

    name: ClassVar[str] = "ExternalPush"

    on: str = "gun"
    force_n: float = 10.0
    duration_s: float = 0.4
    pause_s: float = 4.0

    def check(self) -> None:
        """Checks the ranges."""
        check_choice(self, "on", tuple(BODIES))
        check_numbers(self, force_n=(0.0, 1000.0), duration_s=(0.01, 60.0), pause_s=(0.1, 600.0))


class Pushes:
    """The forces on one body of N simulations."""

    def __init__(self, n: int, cfg: ExternalPushCfg) -> None:
        """Starts without pushes.

        Args:
            n: Number of simulations.
            cfg: The pushes.
        """
        self._cfg = cfg
        self.body = BODIES[cfg.on]
        self._begin = np.full((n, _PUSHES), np.inf)
        self._peak = np.zeros((n, _PUSHES, 3))

    def reset(self, i: int, rng: np.random.Generator) -> None:
        """Draws one simulation's pushes.

        Args:
            i: Which simulation.
            rng: Source of the draws.
        """
        cfg = self._cfg
        pause = cfg.pause_s * rng.uniform(0.5, 1.5, _PUSHES)
        self._begin[i] = np.cumsum(pause + cfg.duration_s) - cfg.duration_s
        direction = rng.standard_normal((_PUSHES, 3))
        direction /= np.sqrt((direction**2).sum(axis=1, keepdims=True))
        self._peak[i] = cfg.severity * cfg.force_n * direction

    def at(self, t: Array) -> Array:
        """The forces.

        Args:
            t: Time since the reset, shape (N, K), s.

        Returns:
            In the base frame, shape (N, K, 3), N.
        """
        phase = (t[:, :, None] - self._begin[:, None]) / self._cfg.duration_s
        pushing = (phase >= 0.0) & (phase <= 1.0)
        size = np.where(pushing, np.sin(np.pi * np.where(pushing, phase, 0.0)), 0.0)
        return np.asarray((size[..., None] * self._peak[:, None]).sum(axis=2))
