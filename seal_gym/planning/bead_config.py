"""Limits and weights of the bead path problem, and what a solved one gives."""

from dataclasses import dataclass, field

import numpy as np

from seal_gym.core.errors import ConfigError, SealGymError, is_number, require
from seal_gym.core.frames import Array
from seal_gym.planning.bead_geometry import NozzleCfg

INSTALL = 'pip install "seal-gym[planning]"'


class PlanningError(SealGymError, RuntimeError):
    """A path cannot be planned: a package is missing, or a solver gave up."""


@dataclass(frozen=True, kw_only=True)
class BeadCfg:
    """Limits, weights and tolerances (Berg, Table 4.1, whose rows for the angles are damaged in print).

    Attributes:
        nozzle: Fan and flow.
        distance_m: Smallest and largest distance from the nozzle to either edge, b and c [m].
        tilt_rad: Largest |rho| [rad].
        drag_rad: Largest |kappa| [rad].
        speed_m_per_s: Smallest and largest speed along either edge [m/s].
        weights: k1 (directions across the edges), k2 (drag), k3 (length of the nozzle's path).
        smoothing: k4, of the squared second derivatives of ln mu and kappa by the share of the left edge.
            Ours: it picks the smooth one of paths that the printed cost hardly tells apart.
        height_tolerance_m: By how much the height may differ from its mean, between nodes too [m].
        cost_intervals: N of the printed cost, a sum over N + 1 nodes equidistant in time. The cost is
            evaluated as the integral that this sum stands for, so that grids can be compared.
    """

    nozzle: NozzleCfg = field(default_factory=NozzleCfg)
    distance_m: tuple[float, float] = (0.01, 0.1)
    tilt_rad: float = np.deg2rad(30.0)
    drag_rad: float = np.deg2rad(15.0)
    speed_m_per_s: tuple[float, float] = (0.1, 1.0)
    weights: tuple[float, float, float] = (1.0, 10.0, 100.0)
    smoothing: float = 1e-5
    height_tolerance_m: float = 1e-5
    cost_intervals: int = 60

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for name, unit in (("distance_m", "m"), ("speed_m_per_s", "m/s")):
            value = getattr(self, name)
            require(
                len(value) == 2 and all(map(is_number, value)) and 0.0 < value[0] < value[1] <= 10.0,
                f"BeadCfg.{name} = {value!r}: must be (smallest, largest) in {unit} with 0 < smallest < "
                "largest <= 10",
                ConfigError,
            )
        top = (np.pi - self.nozzle.fan_angle_rad) / 2.0
        require(
            is_number(self.tilt_rad) and 0.0 < self.tilt_rad < top,
            f"BeadCfg.tilt_rad = {self.tilt_rad!r}: must be in (0, {top:.4g}) rad, below a right angle less "
            "half the fan",
            ConfigError,
        )
        require(
            is_number(self.drag_rad) and 0.0 <= self.drag_rad < np.pi / 2,
            f"BeadCfg.drag_rad = {self.drag_rad!r}: must be in [0, pi / 2) rad; check the unit",
            ConfigError,
        )
        require(
            np.shape(self.weights) == (3,) and all(is_number(w) and w >= 0.0 for w in self.weights),
            f"BeadCfg.weights = {self.weights!r}: must be three numbers >= 0",
            ConfigError,
        )
        require(
            is_number(self.smoothing) and 0.0 <= self.smoothing <= 1.0,
            f"BeadCfg.smoothing = {self.smoothing!r}: must be in [0, 1]",
            ConfigError,
        )
        require(
            is_number(self.height_tolerance_m) and 0.0 < self.height_tolerance_m <= 1e-3,
            f"BeadCfg.height_tolerance_m = {self.height_tolerance_m!r}: must be in (0, 1e-3] m",
            ConfigError,
        )
        require(
            is_number(self.cost_intervals)
            and int(self.cost_intervals) == self.cost_intervals
            and 1 <= self.cost_intervals <= 10_000,
            f"BeadCfg.cost_intervals = {self.cost_intervals!r}: must be a whole number in 1..10000",
            ConfigError,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class BeadNodes:
    """A path at its nodes; between them speeds and drag are linear in time (Berg Eqs. 3.10-3.11).

    Attributes:
        time_s: Shape (n,), s.
        u_m: Arc length along the left edge, shape (n,), m.
        w_m: Arc length along the right edge, shape (n,), m.
        u_dot: Speed along the left edge, shape (n,), m/s.
        w_dot: Speed along the right edge, shape (n,), m/s.
        drag_rad: kappa, shape (n,), rad.
    """

    time_s: Array
    u_m: Array
    w_m: Array
    u_dot: Array
    w_dot: Array
    drag_rad: Array

    def finer(self, factor: int) -> "BeadNodes":
        """The same path on a finer grid.

        Args:
            factor: Steps that each interval is cut into, >= 1.

        Returns:
            With ``factor * (n - 1) + 1`` nodes.
        """
        share = np.arange(factor) / factor
        cut = self.time_s[:-1, None] + np.diff(self.time_s)[:, None] * share
        return self.at(np.append(cut.ravel(), self.time_s[-1]))

    def at(self, time_s: Array) -> "BeadNodes":
        """The same path at other times.

        Args:
            time_s: Within the path's, rising, shape (m,), s.

        Returns:
            With m nodes.
        """
        k = np.clip(np.searchsorted(self.time_s, time_s, side="right") - 1, 0, len(self.time_s) - 2)
        since = time_s - self.time_s[k]
        half = since**2 / (2.0 * (self.time_s[k + 1] - self.time_s[k]))
        u = self.u_m[k] + self.u_dot[k] * since + (self.u_dot[k + 1] - self.u_dot[k]) * half
        w = self.w_m[k] + self.w_dot[k] * since + (self.w_dot[k + 1] - self.w_dot[k]) * half
        # Rounding must not take the last node past the end of the edges.
        return BeadNodes(
            time_s=time_s,
            u_m=np.clip(u, self.u_m[0], self.u_m[-1]),
            w_m=np.clip(w, self.w_m[0], self.w_m[-1]),
            u_dot=np.interp(time_s, self.time_s, self.u_dot),
            w_dot=np.interp(time_s, self.time_s, self.w_dot),
            drag_rad=np.interp(time_s, self.time_s, self.drag_rad),
        )
