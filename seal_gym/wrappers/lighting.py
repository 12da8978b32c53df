"""``Lighting``: light that changes during the run, and a shadow that moves across the view."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from seal_gym.core.frames import Array, normalise
from seal_gym.sim.look import Look
from seal_gym.wrappers.base import DisturbanceCfg, check_numbers
from seal_gym.wrappers.smooth import Series, eased

_RAMP_S = 1.0
# Largest rate of the changes, in amplitudes a second.
_RATE_S = 0.7
_DARKEST, _FLATTEST = 0.05, -0.9
_MAX_DEPTH = 0.95
# The shadow's middle swings about the view's, from outside its far end on; seconds to and fro.
_MIDDLE_M, _SWING_M, _HALF_WIDTH_M = 8e-3, 35e-3, 6e-3
_SWING_S = (6.0, 10.0)


@dataclass(frozen=True, kw_only=True)
class LightingCfg(DisturbanceCfg):
    """Smooth random changes of the light about the run's own look; each starts from it.

    Needs images: features of ``perception="oracle"`` are not touched. The exposure still keeps the images
    from clipping. At large severities the lamp comes to directions that leave no contrast at the seam.

    Attributes:
        level: Largest relative change of all light at severity 1.
        contrast: Largest change of the grey levels' relative spread at severity 1.
        direction: Largest change of the slopes x / z and y / z of the lamp's direction at severity 1.
        shadow: Share of the light that a moving shadow takes at severity 1 (at most 0.95); 0: no shadow.
    """

    name: ClassVar[str] = "Lighting"

    level: float = 0.2
    contrast: float = 0.15
    direction: float = 0.2
    shadow: float = 0.3

    def check(self) -> None:
        """Checks the ranges."""
        check_numbers(self, level=(0.0, 1.0), contrast=(0.0, 1.0), direction=(0.0, 5.0), shadow=(0.0, 0.95))


class Lamp:
    """The light of N simulations."""

    def __init__(self, n: int, cfg: LightingCfg) -> None:
        """Starts without changes.

        Args:
            n: Number of simulations.
            cfg: The changes.
        """
        self._cfg = cfg
        self._series = Series.zeros(n, 4)
        self._own = Look.empty(n)  # the runs' own looks
        self._period = np.ones(n)
        self._normal = np.zeros((n, 3))
        self._depth = min(cfg.severity * cfg.shadow, _MAX_DEPTH)

    def reset(self, i: int, rng: np.random.Generator, look: Look) -> None:
        """Draws one simulation's changes.

        Args:
            i: Which simulation.
            rng: Source of the draws.
            look: With the run's own look in row i.
        """
        c = self._cfg
        for kept, new in zip(self._own, look, strict=True):
            kept[i] = new[i]
        amounts = [c.severity * x for x in (c.level, c.contrast, c.direction)]
        groups = tuple((n, a, _RATE_S * a) for n, a in zip((1, 1, 2), amounts, strict=True))
        self._series.draw(i, rng, groups)
        self._period[i] = rng.uniform(*_SWING_S)
        angle = rng.uniform(-np.pi, np.pi)
        # A straight edge's shadow lies in a plane with the lamp's direction.
        across = np.cross(look.lamp[i], [np.cos(angle), np.sin(angle), 0.0])
        self._normal[i] = normalise(across)

    def shine(self, look: Look, t: Array) -> None:
        """Brings looks up to date, in place.

        Args:
            look: Of N simulations.
            t: Time since the reset, shape (N,), s.
        """
        own = self._own
        change = self._series.at(eased(t, _RAMP_S)[0][:, None])[0][:, 0]
        level = np.maximum(1.0 + change[:, 0], _DARKEST)
        look.ambient[:], look.diffuse[:] = own.ambient * level, own.diffuse * level
        look.contrast[:] = np.maximum(own.contrast + change[:, 1], _FLATTEST)
        look.lamp[:, :2] = own.lamp[:, :2] / own.lamp[:, 2:] + change[:, 2:]
        look.lamp[:, 2] = 1.0
        look.lamp[:] /= np.sqrt((look.lamp**2).sum(axis=1, keepdims=True))
        if self._depth:
            look.shadow[:, :3] = self._normal
            look.shadow[:, 3] = _MIDDLE_M + _SWING_M * np.cos(2.0 * np.pi * t / self._period)
            look.shadow[:, 4], look.shadow[:, 5] = _HALF_WIDTH_M, self._depth
