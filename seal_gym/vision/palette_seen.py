"""What observers of palettes take and give, and how pixels become points of the world."""

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.cell import OverheadCfg
from seal_gym.core.errors import require
from seal_gym.core.frames import Array

Depth = NDArray[np.floating[Any]]
TARGET_CLASSES = ("target", "tie")
"""Names for what has to be pressed: paper T's Table I calls it tie, Table II target."""


class Seen(Protocol):
    """What an observer gives."""

    @property
    def position_m(self) -> Array:
        """Middles of the tops of what was seen in the world frame, shape (n, 3), m."""

    @property
    def classes(self) -> Sequence[str]:
        """What each is."""


class Observer(Protocol):
    """Finds things in a picture."""

    def __call__(self, rgb: NDArray[np.uint8], depth_m: Depth, camera: OverheadCfg) -> Seen:
        """Looks.

        Args:
            rgb: Shape (H, W, 3).
            depth_m: Along the optical axis, NaN where there is none, shape (H, W), m.
            camera: Which took it.

        Returns:
            What is there.
        """


class Regions(NamedTuple):
    """What an observer has found.

    Attributes:
        position_m: In the world frame, shape (n, 3), m.
        classes: What each is.
    """

    position_m: Array
    classes: tuple[str, ...]


def targets_of(seen: Seen) -> Array:
    """The targets among what was seen.

    Args:
        seen: From an observer.

    Returns:
        Shape (n, 3), m.

    Raises:
        ConfigError: If it is not what an observer has to give.
    """
    places = np.asarray(getattr(seen, "position_m", None), dtype=np.float64)
    classes = list(getattr(seen, "classes", ()))
    require(
        places.shape == (len(classes), 3) and bool(np.isfinite(places).all()),
        f"the observer gave {type(seen).__name__} with position_m of shape {places.shape} and {len(classes)} "
        "classes: must have finite position_m of shape (n, 3), in m, and n classes",
    )
    return places[[name in TARGET_CLASSES for name in classes]]


def deproject(pixel: Array, depth_m: Array | float, camera: OverheadCfg) -> Array:
    """Points of the world from pixels and depths.

    Args:
        pixel: Continuous pixel coordinates, shape (..., 2).
        depth_m: Along the optical axis, shape (...), m.
        camera: Which saw them.

    Returns:
        Shape (..., 3), m.
    """
    width, height = camera.frame_px
    ray = (np.asarray(pixel) - [width / 2, height / 2]) / camera.focal_px
    local = np.concatenate((ray, np.ones((*ray.shape[:-1], 1))), axis=-1) * np.asarray(depth_m)[..., None]
    return np.asarray(local @ camera.pose[:3, :3].T + camera.pose[:3, 3])
