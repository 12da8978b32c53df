"""Named substrates as height fields ``z = carved(x, y) + smooth(x, y)``.

The carved part is piecewise constant; a mesh's lid follows the smooth part.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from seal_gym.core.frames import Array

Height = Callable[[Array, Array], Array]


def _flat(x: Array, y: Array) -> Array:
    return np.zeros(np.broadcast_shapes(np.shape(x), np.shape(y)))


@dataclass(frozen=True, kw_only=True)
class Substrate:
    """A part to be sealed, as a height field in its own frame.

    Attributes:
        carved: Steps [m] of (x, y) [m]; their heights and edges should be whole numbers of cells.
        smooth: A continuous height [m] of (x, y) [m], slopes up to 45 deg.
    """

    carved: Height = _flat
    smooth: Height = _flat

    def height(self, x: Array, y: Array) -> Array:
        """The surface.

        Args:
            x: Shape (...) [m].
            y: Shape (...) [m].

        Returns:
            z, shape (...) [m].
        """
        return np.asarray(self.carved(x, y) + self.smooth(x, y))

    def normal(self, x: Array, y: Array) -> Array:
        """The normal of the smooth part.

        Args:
            x: Shape (...) [m].
            y: Shape (...) [m].

        Returns:
            Unit vectors that point out of the part, shape (..., 3).
        """
        d = 1e-6
        slope_x = (self.smooth(x + d, y) - self.smooth(x - d, y)) / (2 * d)
        slope_y = (self.smooth(x, y + d) - self.smooth(x, y - d)) / (2 * d)
        normal = np.stack((-slope_x, -slope_y, np.ones_like(slope_x)), -1)
        return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))


def _edge(x_m: float, left_m: float, right_m: float) -> Height:
    """Height ``left_m`` where x < x_m, ``right_m`` beyond."""
    return lambda x, y: np.where(x < x_m, left_m, right_m) + 0.0 * y


def _slot(half_width_m: float, depth_m: float) -> Height:
    return lambda x, y: np.where(np.abs(x) < half_width_m, -depth_m, 0.0) + 0.0 * y


def _bump(at_m: float, half_width_m: float, height_m: float) -> Height:
    """A ridge along y with a cosine profile."""

    def height(x: Array, y: Array) -> Array:
        u = np.clip((x - at_m) / half_width_m, -1.0, 1.0)
        return np.asarray(0.5 * height_m * (1.0 + np.cos(np.pi * u)) + 0.0 * y)

    return height


def _dome(x: Array, y: Array) -> Array:
    u = np.clip(np.hypot(x, y) / 22e-3, 0.0, 1.0)
    return np.asarray(0.5 * 7e-3 * (1.0 + np.cos(np.pi * u)))


def _stairs(x: Array, y: Array) -> Array:
    return np.asarray(2e-3 * np.clip(np.floor(x / 8e-3 + 0.5), -1.0, 1.0) + 0.0 * y)


def _box(x: Array, y: Array) -> Array:
    return np.asarray(np.where((x > 3e-3) & (np.abs(y) < 12e-3), 5e-3, 0.0))


def _pocket(x: Array, y: Array) -> Array:
    return np.asarray(np.where((np.abs(x) < 7e-3) & (np.abs(y) < 15e-3), -3e-3, 0.0))


SUBSTRATES: dict[str, Substrate] = {
    # for training
    "plane": Substrate(),
    "step": Substrate(carved=_edge(0.0, 0.0, 4e-3)),
    "trench": Substrate(carved=_slot(3e-3, 4e-3)),
    "gap": Substrate(carved=_slot(1e-3, 4e-3)),
    "inner_corner": Substrate(smooth=lambda x, y: np.abs(x) + 0.0 * y),  # the bisector of wall and floor is z
    "outer_corner": Substrate(carved=_edge(0.0, 0.0, -8e-3)),
    "ridge": Substrate(smooth=_bump(0.0, 15e-3, 6e-3)),
    # for validation
    "stairs": Substrate(carved=_stairs),
    "ramp": Substrate(smooth=lambda x, y: np.tan(np.radians(20.0)) * np.clip(x, 0.0, None) + 0.0 * y),
    "vee": Substrate(smooth=lambda x, y: -np.clip(5e-3 - 0.7 * np.abs(x), 0.0, None) + 0.0 * y),
    "wave": Substrate(smooth=lambda x, y: 2e-3 * np.sin(2 * np.pi * y / 40e-3) + 0.0 * x),
    "dome": Substrate(smooth=_dome),
    "box": Substrate(carved=_box),
    "pocket": Substrate(carved=_pocket),
    "joggle": Substrate(smooth=lambda x, y: 1.5e-3 * (1.0 + np.tanh(x / 3e-3)) + 0.0 * y),
}
