"""Kalman filter with constant velocity for the seam's line in an image (Zhou et al., Eq. 12, Algorithm 1).

The state of a view is where the line crosses two fixed rows of its strip, and the velocities of the two
crossings: ``x = (c1, c2, v1, v2)``. Unlike end points on the ROI's border, the crossings do not jump where
the line passes a corner of it. ``F = [[I, dt I], [0, I]]``, ``H = [I 0]``, ``Q = q G G^T``,
``G = [dt^2/2 I; dt I]``, ``R = r^2 I``, Joseph's update. Algorithm 1 as printed adds the noise W_t to the
predicted state: noise belongs into Q alone.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from filterpy.kalman import predict, update
from numpy.typing import NDArray

from seal_gym.core.errors import is_number, require
from seal_gym.core.frames import Array

Bools = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class LineKalmanCfg:
    """Parameters of the filter; the default is for RANSAC's unrefined lines.

    Attributes:
        q: Variance of a crossing's acceleration [px^2/s^4].
        r: Standard deviation of a measured crossing [px].
        gate: A measurement at this Mahalanobis distance or beyond is not believed.
        rejections: After so many measurements in a row that were not believed, the next starts anew.
        coast_s: A line that was not measured is believed for this long [s].
        speed_px_s: Standard deviation of a crossing's velocity at the start [px/s].
        rows_px: The two rows, as t - t_ref along the travel [px].
    """

    q: float = 20.0
    r: float = 1.0
    gate: float = 4.0
    rejections: int = 5
    coast_s: float = 0.3
    speed_px_s: float = 20.0
    rows_px: tuple[float, float] = (-20.0, 40.0)

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for name in ("q", "r", "gate", "coast_s", "speed_px_s"):
            value = getattr(self, name)
            require(
                is_number(value) and value > 0,
                f"LineKalmanCfg.{name} = {value!r}: must be a finite number > 0",
            )
        require(
            is_number(self.rejections) and self.rejections >= 1 and self.rejections % 1 == 0,
            f"LineKalmanCfg.rejections = {self.rejections!r}: must be a whole number >= 1",
        )
        first, last = self.rows_px
        require(
            is_number(first) and is_number(last) and first < last,
            f"LineKalmanCfg.rows_px = {self.rows_px!r}: must be (first, last), the first being smaller",
        )


class TrackedLines(NamedTuple):
    """Filtered lines ``o = p + q (t - t_ref)``.

    Attributes:
        line: p [px] and q of each view, shape (N, views, 2); zero where not valid.
        valid: Whether there is a line, shape (N, views).
    """

    line: Array
    valid: Bools


class LineKalman:
    """Filters the lines of N simulations and their views, each by itself."""

    def __init__(self, n: int, frame_s: float, cfg: LineKalmanCfg | None = None, views: int = 2) -> None:
        """Starts without lines.

        Args:
            n: Number of simulations.
            frame_s: Duration of a frame [s].
            cfg: Parameters.
            views: Views of each simulation.
        """
        self.cfg = cfg or LineKalmanCfg()
        one, gain = np.eye(2), np.kron([[0.5 * frame_s**2], [frame_s]], np.eye(2))
        self._f = np.kron([[1.0, frame_s], [0.0, 1.0]], one)
        self._h = np.kron([[1.0, 0.0]], one)
        self._q = self.cfg.q * gain @ gain.T
        self._r = self.cfg.r**2 * one
        self._p0 = np.diag([self.cfg.r**2] * 2 + [self.cfg.speed_px_s**2] * 2)
        first, last = self.cfg.rows_px
        self._to_crossings = np.array([[1.0, first], [1.0, last]])
        self._to_line = np.linalg.inv(self._to_crossings)
        self._coast = int(self.cfg.coast_s / frame_s + 1e-9)
        self._x = np.zeros((n, views, 4))
        self._p = np.zeros((n, views, 4, 4))
        self._tracking = np.zeros((n, views), np.bool_)
        self._missed = np.zeros((n, views), np.int64)
        self._rejected = np.zeros((n, views), np.int64)

    def reset(self, i: int) -> None:
        """Forgets one simulation's lines.

        Args:
            i: Which simulation.
        """
        self._tracking[i] = False

    def update(self, line: Array, valid: Bools, rows: Bools | None = None) -> TrackedLines:
        """Takes the lines measured in a new frame.

        Args:
            line: p [px] and q of ``o = p + q (t - t_ref)``, shape (N, views, 2).
            valid: Whether a line was found, shape (N, views).
            rows: Simulations that have a new frame, shape (N,), all by default; the others keep their lines.

        Returns:
            The filtered lines; a view without a line for the coasting time is invalid.
        """
        measured = valid & np.isfinite(line).all(axis=-1)
        chosen = range(len(line)) if rows is None else np.flatnonzero(rows).tolist()
        for i in chosen:
            for v in range(line.shape[1]):
                self._step(i, v, self._to_crossings @ line[i, v] if measured[i, v] else None)
        out = (self._to_line @ self._x[..., :2, None])[..., 0]
        return TrackedLines(np.where(self._tracking[..., None], out, 0.0), self._tracking.copy())

    def _step(self, i: int, v: int, z: Array | None) -> None:
        if not self._tracking[i, v]:
            if z is not None:
                self._start(i, v, z)
            return
        x, p = predict(self._x[i, v], self._p[i, v], self._f, self._q)
        if z is not None and self._believed(x, p, z):
            self._x[i, v], self._p[i, v] = update(x, p, z, self._r, self._h)
            self._missed[i, v] = self._rejected[i, v] = 0
            return
        self._x[i, v], self._p[i, v] = x, p
        self._missed[i, v] += 1
        given_up = self._missed[i, v] > self._coast
        if z is not None:
            self._rejected[i, v] += 1
            if given_up or self._rejected[i, v] > self.cfg.rejections:
                self._start(i, v, z)
        elif given_up:
            self._tracking[i, v] = False

    def _start(self, i: int, v: int, z: Array) -> None:
        self._x[i, v, :2], self._x[i, v, 2:] = z, 0.0
        self._p[i, v] = self._p0
        self._tracking[i, v] = True
        self._missed[i, v] = self._rejected[i, v] = 0

    def _believed(self, x: Array, p: Array, z: Array) -> bool:
        error = z - self._h @ x
        spread = self._h @ p @ self._h.T + self._r
        return bool(error @ np.linalg.solve(spread, error) < self.cfg.gate**2)
