"""The seam's own motion, from the line seen in successive frames and the tip's pose."""

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.frames import Array
from seal_gym.core.jit import kernel

SEAM_RATE_GAIN = 0.4
_SPAN = 2
"""Frames between which the line is compared. Over one, a tip that shakes by the frame would see the seam of a
bend shake with it, and what is fed forward would keep it shaking; over two this drops out."""


@kernel
def _update(
    point: Array,
    direction: Array,
    tip_pose: Array,
    valid: NDArray[np.bool_],
    fresh: NDArray[np.bool_],
    dt: float,
    gain: float,
    twist: Array,
    points: Array,
    directions: Array,
    seen: NDArray[np.int64],
) -> None:
    p, d, mean, shift = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(point.shape[0]):
        if not fresh[i]:
            continue
        span = min(seen[i], _SPAN)
        last = max(span, 1) - 1
        size = along = 0.0
        for r in range(3):
            p[r], d[r] = tip_pose[i, r, 3], 0.0
            for k in range(3):
                p[r] += tip_pose[i, r, k] * point[i, k]
                d[r] += tip_pose[i, r, k] * direction[i, k]
            # The chord of an arc is parallel to the mean of its end tangents: travel along it drops out.
            mean[r] = d[r] + directions[i, last, r]
            shift[r] = p[r] - points[i, last, r]
            size += mean[r] * mean[r]
            along += shift[r] * mean[r]
        both = valid[i] and span > 0 and size > 0.0
        weight = gain if both or not valid[i] else 0.0
        if both:
            for r in range(3):
                shift[r] -= along / size * mean[r]
        q = directions[i, last]
        turn = (q[1] * d[2] - q[2] * d[1], q[2] * d[0] - q[0] * d[2], q[0] * d[1] - q[1] * d[0])
        for r in range(3):
            v = w = 0.0
            if both and r != 1:
                for k in range(3):
                    v += tip_pose[i, k, r] * shift[k] / (span * dt)
                    w += tip_pose[i, k, r] * turn[k] / (span * dt)
            twist[i, r] += weight * (v - twist[i, r])
            twist[i, 3 + r] += weight * (w - twist[i, 3 + r])
        for r in range(3):
            for k in range(_SPAN - 1, 0, -1):
                points[i, k, r], directions[i, k, r] = points[i, k - 1, r], directions[i, k - 1, r]
            points[i, 0, r], directions[i, 0, r] = p[r], d[r]
        seen[i] = seen[i] + 1 if valid[i] else 0


class SeamRate:
    """Estimates how the seam's line moves and turns under the tip.

    On a part at rest the estimate is the turning of a curved seam as the tip travels; on a moving part it
    holds the part's motion across the seam as well. Motion along the seam cannot be seen.

    Attributes:
        twist: Estimated twist of the line in the tip frame, components about and along y zero,
            shape (N, 6), m/s and rad/s.
    """

    def __init__(self, n: int, dt_s: float, gain: float = SEAM_RATE_GAIN) -> None:
        """Starts without a line.

        Args:
            n: Number of simulations.
            dt_s: Duration of a frame [s].
            gain: Share of a new difference in the estimate, 0..1.
        """
        self.twist = np.zeros((n, 6))
        self._points = np.zeros((n, _SPAN, 3))
        self._directions = np.zeros((n, _SPAN, 3))
        self._seen = np.zeros(n, np.int64)  # frames in a row
        self._dt = dt_s
        self._gain = gain

    def reset(self, i: int) -> None:
        """Forgets one simulation's line.

        Args:
            i: Which simulation.
        """
        self.twist[i] = 0.0
        self._seen[i] = 0

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
        fresh = np.ones(len(point), np.bool_) if rows is None else rows
        _update(
            point,
            direction,
            tip_pose,
            valid,
            fresh,
            self._dt,
            self._gain,
            self.twist,
            self._points,
            self._directions,
            self._seen,
        )
