"""Where the tip is along the seam, how far off it is, and what it has covered (protocol.md)."""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import require
from seal_gym.core.frames import Array
from seal_gym.core.jit import kernel
from seal_gym.workpieces.seam import Seam, nearest_on_path

_BIN_M = 1e-3


@dataclass(frozen=True, kw_only=True)
class SealTaskCfg:
    """What counts as which outcome, and how trials are displaced (protocol.md).

    Attributes:
        reach_m: Largest distance from the desired path at which arc counts as visited and the end as
            reached [m].
        visited_share: Share of the arc that must have been visited, 0..1.
        cover_m: Distance within which arc counts as covered [m].
        lost_m: Distance from the desired path at which an episode is lost [m].
        time_factor: Time limit as a multiple of the nominal time.
        journey_s: What is added to it if the gun starts at the arm's home [s].
        settle_m: Arc length from which ``rmse_mm`` counts [m].
        window_m: How far along the arc progress may move in a frame [m].
        part_shift_m: Largest displacement of the part in x and y [m].
        part_yaw_rad: Largest rotation of the part [rad].
        hover_m: Range of the start's distance beyond the stand-off [m].
        sideways_m: Largest sideways offset of the start [m].
        turned_rad: Largest rotation of the start about z and x [rad].
    """

    reach_m: float = 5e-3
    visited_share: float = 0.95
    cover_m: float = 1e-3
    lost_m: float = 25e-3
    time_factor: float = 3.0
    journey_s: float = 10.0
    settle_m: float = 10e-3
    window_m: float = 10e-3
    part_shift_m: float = 20e-3
    part_yaw_rad: float = float(np.deg2rad(15.0))
    hover_m: tuple[float, float] = (7e-3, 12e-3)
    sideways_m: float = 5e-3
    turned_rad: float = float(np.deg2rad(5.0))

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for f in fields(self):
            value = np.asarray(getattr(self, f.name))
            require(
                bool(np.all(np.isfinite(value)) and np.all(value >= 0)),
                f"SealTaskCfg.{f.name} = {getattr(self, f.name)!r}: must be finite and >= 0",
            )
        require(
            0 < self.visited_share <= 1,
            f"SealTaskCfg.visited_share = {self.visited_share!r}: must be in (0, 1]",
        )
        require(
            self.hover_m[0] <= self.hover_m[1],
            f"SealTaskCfg.hover_m = {self.hover_m!r}: must be (smallest, largest)",
        )
        require(
            self.window_m > 0 and self.time_factor > 0,
            "SealTaskCfg.window_m and time_factor must be > 0",
        )


@kernel
def _advance(
    path: Array,
    arc: Array,
    tip: Array,
    length: float,
    window: float,
    reach: float,
    cover: float,
    s: Array,
    error: Array,
    off_path: Array,
    visited: NDArray[np.bool_],
    covered: NDArray[np.bool_],
) -> None:
    bins = visited.shape[1]
    for i in range(tip.shape[0]):
        local, new = nearest_on_path(path, arc, tip[i], s[i] - window, s[i] + window)
        best, _ = nearest_on_path(path, arc, tip[i], arc[0], arc[-1])
        low, high = min(s[i], new), max(s[i], new)
        if local <= reach and high >= 0.0 and low <= length:
            first = max(0, int(low / length * bins))
            last = min(bins - 1, int(high / length * bins))
            for k in range(first, last + 1):
                visited[i, k] = True
                if local <= cover:
                    covered[i, k] = True
        s[i] = new
        error[i] = best
        off_path[i] = local


class Progress:
    """Follows N tips along one seam.

    Attributes:
        s: Arc length of the path's point nearest the tip, found locally: it moves by at most the window in
            a frame, so it never jumps to another side, shape (N,), m.
        furthest: The largest ``s`` of the episode up to the first beyond the end, shape (N,), m.
        error_m: Distance from the tip to the nearest point of the desired path, shape (N,), m.
        off_path_m: Distance to the path's point at ``s``, shape (N,), m.
    """

    def __init__(self, seam: Seam, stand_off_m: float, n: int, cfg: SealTaskCfg) -> None:
        """Starts all at the seam's beginning.

        Args:
            seam: The seam.
            stand_off_m: Distance of the desired tip path from it [m].
            n: Number of simulations.
            cfg: Tolerances.
        """
        self._seam, self._cfg = seam, cfg
        self._path = seam.tip_path(stand_off_m)
        bins = int(np.ceil(seam.length / _BIN_M))
        self.s = np.zeros(n)
        self.furthest = np.zeros(n)
        self.error_m = np.zeros(n)
        self.off_path_m = np.zeros(n)
        self._visited = np.zeros((n, bins), np.bool_)
        self._covered = np.zeros((n, bins), np.bool_)
        # Sums of squared error: from settle_m on, and over the whole episode; and their counts. Of the seam's
        # own speed squared, where it moves.
        self._sums = np.zeros((n, 5))
        self._moves = False
        self._settled = np.zeros(n, np.bool_)

    def reset(self, i: int, tip: Array) -> None:
        """Puts one tip at the start.

        Args:
            i: Which simulation.
            tip: Its position in the part's frame, shape (3,), m.
        """
        self._visited[i] = self._covered[i] = False
        self._sums[i], self._settled[i] = 0.0, False
        self.off_path_m[i], self.s[i] = self.locate(tip)
        self.error_m[i], self.furthest[i] = self.off_path_m[i], self.s[i]

    def locate(self, tip: Array) -> tuple[float, float]:
        """The path's point nearest a tip at the start.

        Args:
            tip: Its position in the part's frame, shape (3,), m.

        Returns:
            Its distance, and its arc length within a window round zero [m].
        """
        window = self._cfg.window_m
        distance, s = nearest_on_path(self._path, self._seam.arc, tip, -window, window)
        return distance, s

    def advance(self, tip: Array, seam_speed: Array | None = None) -> None:
        """Takes the tips' new positions.

        Args:
            tip: In the part's frame as it lies now, shape (N, 3), m.
            seam_speed: True speed of the seam's point nearest the tip, shape (N,), m/s; None at rest.
        """
        cfg = self._cfg
        _advance(
            self._path,
            self._seam.arc,
            tip,
            self._seam.length,
            cfg.window_m,
            cfg.reach_m,
            cfg.cover_m,
            self.s,
            self.error_m,
            self.off_path_m,
            self._visited,
            self._covered,
        )
        # Past the end there is no ground to gain: who skipped a stretch could go on and be paid for it.
        ahead = np.maximum(self.furthest, self.s)
        self.furthest = np.where(self.furthest < self._seam.length, ahead, self.furthest)
        self._settled |= self.s >= cfg.settle_m
        squared = self.error_m**2
        self._sums[:, 0] += squared * self._settled
        self._sums[:, 1] += self._settled
        self._sums[:, 2] += squared
        self._sums[:, 3] += 1.0
        if seam_speed is not None:
            self._moves = True
            self._sums[:, 4] += seam_speed**2

    @property
    def share(self) -> Array:
        """Share of the seam travelled, 0..1, shape (N,)."""
        return np.minimum(np.maximum(self.s / self._seam.length, 0.0), 1.0)

    @property
    def reached(self) -> NDArray[np.bool_]:
        """Whether the tip has passed the end, having visited the seam, shape (N,)."""
        at_end = (self.s >= self._seam.length) & (self.off_path_m <= self._cfg.reach_m)
        if not at_end.any():
            return at_end
        return np.asarray(at_end & (self._visited.mean(axis=1) >= self._cfg.visited_share))

    @property
    def lost(self) -> NDArray[np.bool_]:
        """Whether the tip is too far from the desired path, shape (N,)."""
        return np.asarray(self.off_path_m > self._cfg.lost_m)

    def metrics(self, i: int) -> dict[str, float]:
        """Errors and coverage of one episode so far.

        Args:
            i: Which simulation.

        Returns:
            ``rmse_mm`` (NaN before ``settle_m``), ``rmse_whole_mm`` and ``coverage_pct``; on moving parts
            ``seam_speed_mm_s``, the root mean square of the seam's own speed under the tip.
        """
        settled, count, whole, steps, speed = self._sums[i]
        moving = {"seam_speed_mm_s": float(1e3 * np.sqrt(speed / max(steps, 1.0)))} if self._moves else {}
        return {
            "rmse_mm": float(1e3 * np.sqrt(settled / count)) if count else float("nan"),
            "rmse_whole_mm": float(1e3 * np.sqrt(whole / steps)) if steps else float("nan"),
            "coverage_pct": float(100.0 * self._covered[i].mean()),
            **moving,
        }
