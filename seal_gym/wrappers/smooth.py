"""Smooth functions of time that start at rest: what moves parts, lamps and obstacles."""

from typing import NamedTuple

import numpy as np

from seal_gym.core.frames import Array

PERIOD_S = 60.0
_HARMONICS = np.arange(2, 10)
_OMEGA = 2.0 * np.pi / PERIOD_S * _HARMONICS
_GRID = 2048
# Between the grid's points a series exceeds the largest of them by at most (omega step)^2 / 8 = 1e-4.
_MARGIN = 1.001


def eased(t: Array, ramp_s: Array | float) -> tuple[Array, Array]:
    """A clock that starts at rest: its rate rises from 0 to 1 within the ramp (smoothstep) and stays there.

    Args:
        t: Time, any shape, s; before 0 the clock stands at 0.
        ramp_s: Duration of the ramp, > 0 [s].

    Returns:
        Its reading [s] and its rate, of the shape of ``t``.
    """
    x = np.minimum(np.maximum(t / ramp_s, 0.0), 1.0)
    rate = x * x * (3.0 - 2.0 * x)
    return ramp_s * x**3 * (1.0 - 0.5 * x) + np.maximum(t - ramp_s, 0.0), rate


class Series(NamedTuple):
    """Smooth random functions of time for N simulations and C channels, periodic in ``PERIOD_S``.

    Attributes:
        cosine: Fourier coefficients of the harmonics, shape (N, C, 8).
        sine: Shape (N, C, 8).
        start: Value at time 0, shape (N, C): the functions are counted from there.
    """

    cosine: Array
    sine: Array
    start: Array

    @classmethod
    def zeros(cls, n: int, channels: int) -> "Series":
        """Functions that are zero.

        Args:
            n: Number of simulations.
            channels: Number of functions of each.

        Returns:
            The functions, for ``draw`` to fill.
        """
        shape = (n, channels, len(_HARMONICS))
        return cls(np.zeros(shape), np.zeros(shape), np.zeros((n, channels)))

    def draw(self, i: int, rng: np.random.Generator, groups: tuple[tuple[int, float, float], ...]) -> None:
        """Draws one simulation's functions, as large as their bounds allow.

        Coefficients are normal with amplitudes that fall as the frequency rises, so that accelerations stay
        small. A group of channels is a vector: its length and its rate's keep within the bounds and reach
        one of them within the period.

        Args:
            i: Which simulation.
            rng: Source of the draws; their number does not depend on the bounds.
            groups: Number of channels, bound on the distance from the start and bound on the rate [1/s] of
                each group, in the channels' order.
        """
        channels = sum(count for count, _, _ in groups)
        shape = (2, channels, len(_HARMONICS))
        cosine, sine = rng.standard_normal(shape) / _HARMONICS
        t = np.arange(_GRID) * (PERIOD_S / _GRID)
        angle = _OMEGA[:, None] * t
        c, s = np.cos(angle), np.sin(angle)
        value = cosine @ c + sine @ s - cosine.sum(axis=1, keepdims=True)
        rate = (sine * _OMEGA) @ c - (cosine * _OMEGA) @ s
        first = 0
        for count, reach, speed in groups:
            rows = slice(first, first + count)
            far = np.sqrt((value[rows] ** 2).sum(axis=0)).max()
            fast = np.sqrt((rate[rows] ** 2).sum(axis=0)).max()
            scale = min(reach / far, speed / fast) / _MARGIN
            self.cosine[i, rows], self.sine[i, rows] = scale * cosine[rows], scale * sine[rows]
            first += count
        self.start[i] = self.cosine[i].sum(axis=1)

    def at(self, t: Array) -> tuple[Array, Array]:
        """Values and rates.

        Args:
            t: Shape (N, K), s.

        Returns:
            Values counted from time 0 and rates [1/s], shape (N, K, C) each.
        """
        angle = t[:, :, None, None] * _OMEGA
        c, s = np.cos(angle), np.sin(angle)
        a, b = self.cosine[:, None], self.sine[:, None]
        value = (a * c + b * s).sum(axis=-1) - self.start[:, None]
        rate = ((b * c - a * s) * _OMEGA).sum(axis=-1)
        return value, rate
