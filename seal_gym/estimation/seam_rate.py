"""The seam's own motion, from the line seen in successive frames and the tip's pose."""

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.frames import Array, cross, normalise


class SeamRate:
    """Estimates how the seam's line moves and turns under the tip.

    On a part at rest the estimate is the turning of a curved seam as the tip travels; on a moving part it
    holds the part's motion across the seam as well. Motion along the seam cannot be seen.

    Attributes:
        twist: Estimated twist of the line in the tip frame, components about and along y zero,
            shape (N, 6), m/s and rad/s.
    """

    def __init__(self, n: int, dt_s: float, gain: float = 0.5) -> None:
        """Starts without a line.

        Args:
            n: Number of simulations.
            dt_s: Duration of a frame [s].
            gain: Share of a new difference in the estimate, 0..1.
        """
        self.twist = np.zeros((n, 6))
        self._point = np.zeros((n, 3))
        self._direction = np.zeros((n, 3))
        self._seen = np.zeros(n, np.bool_)
        self._dt = dt_s
        self._gain = gain

    def reset(self, i: int) -> None:
        """Forgets one simulation's line.

        Args:
            i: Which simulation.
        """
        self.twist[i] = 0.0
        self._seen[i] = False

    def update(
        self,
        point: Array,
        direction: Array,
        tip_pose: Array,
        valid: NDArray[np.bool_],
        rows: NDArray[np.bool_] | None = None,
    ) -> None:
        """Takes the lines of a new frame.

        Args:
            point: The line's point at y = 0 in the tip frame, shape (N, 3), m.
            direction: Its unit direction in the tip frame, shape (N, 3).
            tip_pose: ``T_world_tip``, shape (N, 4, 4), m.
            valid: Whether the line was seen, shape (N,).
            rows: Simulations that have a new frame, shape (N,), all by default.
        """
        rotation = tip_pose[:, :3, :3]
        p = (rotation @ point[:, :, None])[..., 0] + tip_pose[:, :3, 3]
        d = (rotation @ direction[:, :, None])[..., 0]
        # The chord of an arc is parallel to the mean of its end tangents: travel along the seam drops out.
        mean = normalise(d + self._direction + 1e-12)
        shift = p - self._point
        shift -= mean * np.sum(shift * mean, axis=1, keepdims=True)
        turn = cross(self._direction, d)
        world = np.stack((shift, turn), axis=1) / self._dt
        raw = (world @ rotation).reshape(-1, 6)
        raw[:, 1] = raw[:, 4] = 0.0
        gain = np.where(valid, self._gain * self._seen, self._gain)[:, None]
        if rows is not None:
            gain = gain * rows[:, None]
            p, d = np.where(rows[:, None], p, self._point), np.where(rows[:, None], d, self._direction)
            valid = np.where(rows, valid, self._seen)
        self.twist += gain * (np.where((valid & self._seen)[:, None], raw, 0.0) - self.twist)
        self._point, self._direction, self._seen = p, d, valid.copy()
