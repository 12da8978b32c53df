"""What policies written by hand read from an observation (the table in ``SealEnv``), in SI units."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import require
from seal_gym.core.frames import Array
from seal_gym.envs.core import FEATURES
from seal_gym.rmp import SeamErrors

_MM, _DEG = 1e-3, float(np.deg2rad(1.0))
_TWIST = 6
_SEEN_TWIST = [0, 2, 3, 5]  # along x and z, about x and z


class Reading(NamedTuple):
    """N observations.

    Attributes:
        seen: Whether both views show the seam, shape (N,); the errors are old where they do not.
        errors: Where the seam is, in the tip frame, shape (N,) each.
        twist: Of the tip, shape (N, 6), m/s and rad/s.
        seam_twist: Estimated twist of the seam in the tip frame, shape (N, 6), m/s and rad/s.
        tip_accel: Last commanded tip acceleration, shape (N, 6), m/s^2 and rad/s^2.
    """

    seen: NDArray[np.bool_]
    errors: SeamErrors
    twist: Array
    seam_twist: Array
    tip_accel: Array


def rows_of(observation: NDArray[np.float32] | dict[str, NDArray[Any]]) -> tuple[NDArray[np.float32], bool]:
    """The features of one environment or of N, as rows.

    Args:
        observation: As ``SealEnv`` documents it.

    Returns:
        Shape (N, 35), and whether it was a batch.

    Raises:
        ConfigError: If it has another shape.
    """
    features = observation["features"] if isinstance(observation, dict) else observation
    rows = np.atleast_2d(np.asarray(features, dtype=np.float32))
    require(
        rows.ndim == 2 and rows.shape[1] == FEATURES,
        f"observation has shape {np.shape(features)}: must be ({FEATURES},) or (N, {FEATURES})",
    )
    return rows, np.ndim(features) == 2


def read(rows: NDArray[np.float32]) -> Reading:
    """Takes the entries apart.

    Args:
        rows: Shape (N, 35).

    Returns:
        The reading.
    """
    o = rows.astype(np.float64)
    seam = np.zeros((len(o), _TWIST))
    seam[:, _SEEN_TWIST] = np.concatenate((_MM * o[:, 6:8], _DEG * o[:, 8:10]), axis=1)
    return Reading(
        seen=(o[:, 2] > 0.5) & (o[:, 5] > 0.5),
        errors=SeamErrors(_MM * o[:, 0], _DEG * o[:, 1], _MM * o[:, 3], _DEG * o[:, 4], _DEG * o[:, 10]),
        twist=np.concatenate((_MM * o[:, 11:14], _DEG * o[:, 14:17]), axis=1),
        seam_twist=seam,
        tip_accel=o[:, 17:23],
    )
