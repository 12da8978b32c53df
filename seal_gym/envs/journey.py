"""Guns that start at the arm's home: which are still on their way to the hover where they begin to look."""

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import ConfigError
from seal_gym.core.frames import Array

STARTS = ("hover", "home")
_NEAR_M, _NEAR_RAD = 3e-3, np.deg2rad(3.0)


def check_start(options: dict[str, object] | None) -> str:
    """Where an episode starts.

    Args:
        options: Of ``reset``: ``{"start": "hover"}`` or ``{"start": "home"}``; the hover by default.

    Returns:
        One of ``STARTS``.

    Raises:
        ConfigError: If there is another option or another start.
    """
    rest = dict(options or {})
    start = rest.pop("start", STARTS[0])
    if rest or start not in STARTS:
        raise ConfigError(f"options = {options!r}: reset takes {{'start': one of {list(STARTS)}}}")
    return str(start)


class Journey:
    """The ways of N guns to their hovers.

    Attributes:
        hover: ``T_base_tip`` where each gun begins to look for its seam, shape (N, 4, 4), m.
        under_way: Which have not been there yet, shape (N,).
        from_home: Which started at home, shape (N,).
        frames: Frames each needed to its hover, shape (N,); 0 if it started there.
    """

    def __init__(self, n: int) -> None:
        """Starts all in their hovers.

        Args:
            n: Number of simulations.
        """
        self.hover = np.tile(np.eye(4), (n, 1, 1))
        self.under_way = np.zeros(n, np.bool_)
        self.from_home = np.zeros(n, np.bool_)
        self.frames = np.zeros(n, np.int64)
        self._in_part = np.zeros((n, 3))

    def reset(self, i: int, hover: Array, in_part: Array, start: str) -> None:
        """Begins an episode of one gun.

        Args:
            i: Which simulation.
            hover: ``T_base_tip``, shape (4, 4), m.
            in_part: The hover's position in the part's frame, shape (3,), m.
            start: One of ``STARTS``.
        """
        self.hover[i], self._in_part[i] = hover, in_part
        self.from_home[i] = self.under_way[i] = start == "home"
        self.frames[i] = 0

    def arrive(self, tip: Array) -> NDArray[np.intp]:
        """Counts a frame of those under way, and lets those at their hovers arrive.

        Args:
            tip: ``T_base_tip``, shape (N, 4, 4), m.

        Returns:
            Which have arrived just now.
        """
        self.frames += self.under_way
        away = np.sqrt(((tip[:, :3, 3] - self.hover[:, :3, 3]) ** 2).sum(axis=1))
        trace = (self.hover[:, :3, :3] * tip[:, :3, :3]).sum(axis=(1, 2))  # of the turn from one to the other
        there = self.under_way & (away <= _NEAR_M) & (trace >= 1.0 + 2.0 * np.cos(_NEAR_RAD))
        self.under_way &= ~there
        return np.flatnonzero(there)

    def held(self, in_part: Array) -> Array:
        """Positions along the seam's side: guns under way count as where they are expected.

        Args:
            in_part: Of the tips in the parts' frames, shape (N, 3), m.

        Returns:
            The same, with the hover's for those under way.
        """
        return np.where(self.under_way[:, None], self._in_part, in_part)
