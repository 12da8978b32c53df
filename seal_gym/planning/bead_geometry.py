"""A fan nozzle over the two edges of a bead: closed forms for heights, distances, tilt and pose.

Berg 3.1.2. The nozzle at p spreads its flow evenly over the angle theta; the fan's borders meet the left
edge in x and the right one in y. In the triangle x-y-p: a = |xy|, b = |yp|, c = |xp|, beta is the angle at x,
gamma at y. The functions of scalars take numpy arrays and CasADi expressions alike, so that solver and
check share one formula; tests hold each against brute-force geometry.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from seal_gym.core.errors import ConfigError, is_number, require
from seal_gym.core.frames import Array, axis_angle, cross, normalise
from seal_gym.planning.bead_curves import Edges


@dataclass(frozen=True, kw_only=True)
class NozzleCfg:
    """A fan nozzle and its flow.

    The thesis prints a mass flow of 15 g/s and neither the density nor the fan's angle.

    Attributes:
        fan_angle_rad: theta, over which the flow spreads evenly [rad].
        flow_m3_per_s: Volume flow [m^3/s].
    """

    fan_angle_rad: float = np.deg2rad(40.0)
    flow_m3_per_s: float = 12.5e-6

    def __post_init__(self) -> None:
        """Checks the ranges."""
        require(
            is_number(self.fan_angle_rad) and 0.01 <= self.fan_angle_rad <= 2.8,
            f"NozzleCfg.fan_angle_rad = {self.fan_angle_rad!r}: must be in [0.01, 2.8] rad; check the unit",
            ConfigError,
        )
        require(
            is_number(self.flow_m3_per_s) and 0.0 < self.flow_m3_per_s <= 1e-3,
            f"NozzleCfg.flow_m3_per_s = {self.flow_m3_per_s!r}: must be in (0, 1e-3] m^3/s; check the unit "
            "(1 cm^3/s is 1e-6)",
            ConfigError,
        )


def distance_ratio(u_dot: Any, w_dot: Any, sin_eta: Any, sin_zeta: Any, xp: Any = np) -> Any:
    """Ratio mu = b / c for which both edges get the same height.

    Source: Berg Eq. 3.28.

    Args:
        u_dot: Speed along the left edge [m/s].
        w_dot: Speed along the right edge [m/s].
        sin_eta: Sine of the angle between the left edge and the line across.
        sin_zeta: The same of the right edge.
        xp: Module of the functions: numpy, or casadi for its expressions.

    Returns:
        mu, of the arguments' kind.
    """
    return xp.sqrt(u_dot * sin_eta / (w_dot * sin_zeta))


def distances(mu: Any, width_m: Any, fan_angle_rad: float, xp: Any = np) -> tuple[Any, Any]:
    """Distances from the nozzle to the edges.

    Source: Berg Eqs. 3.29-3.31. Its nomenclature list swaps b and c; the text's meaning is used.

    Args:
        mu: b / c.
        width_m: a, from edge to edge [m].
        fan_angle_rad: theta [rad].
        xp: See ``distance_ratio``.

    Returns:
        b (to the right edge) and c (to the left edge) [m].
    """
    c = width_m / xp.sqrt(mu**2 - 2.0 * mu * np.cos(fan_angle_rad) + 1.0)
    return mu * c, c


def tilt_of_ratio(mu: Any, fan_angle_rad: float, xp: Any = np) -> Any:
    """Tilt of the nozzle from the normal of the line across.

    Source: Berg Eq. 3.34 as rho = (gamma - beta) / 2, in closed form: the arc sines of Eqs. 3.32-3.33 take
    the wrong branch where an angle is obtuse.

    Args:
        mu: b / c.
        fan_angle_rad: theta [rad].
        xp: See ``distance_ratio``.

    Returns:
        rho [rad], positive where the nozzle leans over the right edge (mu < 1).
    """
    return xp.arctan((1.0 - mu) / (1.0 + mu) / np.tan(fan_angle_rad / 2.0))


def ratio_of_tilt(tilt_rad: float, fan_angle_rad: float) -> float:
    """The largest mu within a tilt; the smallest is its inverse. Inverse of ``tilt_of_ratio`` at -tilt.

    Args:
        tilt_rad: Largest tilt [rad], below a right angle less half the fan.
        fan_angle_rad: theta [rad].

    Returns:
        mu_m >= 1.
    """
    t = np.tan(tilt_rad) * np.tan(fan_angle_rad / 2.0)
    return float((1.0 + t) / (1.0 - t))


def log_height(
    u_dot: Any, w_dot: Any, sin_eta: Any, sin_zeta: Any, width_m: Any, nozzle: NozzleCfg, xp: Any = np
) -> Any:
    """Logarithm of the height at both edges, which are equal with mu of ``distance_ratio``.

    Source: Berg Eqs. 3.22-3.23 with 3.28 put in: h = V sin(theta) / (theta a sqrt(u' w' sin eta sin zeta)).

    Args:
        u_dot: Speed along the left edge [m/s].
        w_dot: Speed along the right edge [m/s].
        sin_eta: See ``distance_ratio``.
        sin_zeta: See ``distance_ratio``.
        width_m: a [m].
        nozzle: Fan and flow.
        xp: See ``distance_ratio``.

    Returns:
        ln(h / 1 m).
    """
    theta = nozzle.fan_angle_rad
    scale = float(np.log(nozzle.flow_m3_per_s * np.sin(theta) / theta))
    return scale - xp.log(width_m) - 0.5 * xp.log(u_dot * w_dot * sin_eta * sin_zeta)


def edge_heights(at: "Across", u_dot: Array, w_dot: Array, nozzle: NozzleCfg) -> tuple[Array, Array]:
    """Heights at the left and the right edge.

    Source: Berg Eqs. 3.22-3.23 with the area its Fig. 3.3 shows: h = (V / theta) sin beta / (c u' sin eta).

    Args:
        at: Where the fan's borders meet the edges.
        u_dot: Speed along the left edge, shape (n,), m/s.
        w_dot: Speed along the right edge, shape (n,), m/s.
        nozzle: Fan and flow.

    Returns:
        g and h, each of shape (n,), m.
    """
    theta = nozzle.fan_angle_rad
    mu = distance_ratio(u_dot, w_dot, at.sin_eta, at.sin_zeta)
    b, c = distances(mu, at.width_m, theta)
    tilt = tilt_of_ratio(mu, theta)
    upright = (np.pi - theta) / 2.0
    per_angle = nozzle.flow_m3_per_s / theta
    g = per_angle * np.sin(upright - tilt) / (c * u_dot * at.sin_eta)
    h = per_angle * np.sin(upright + tilt) / (b * w_dot * at.sin_zeta)
    return g, h


@dataclass(frozen=True, eq=False)
class Across:
    """The line across a bead at given arc lengths of its edges.

    Attributes:
        left: x, shape (n, 3), m.
        right: y, shape (n, 3), m.
        left_tangent: x', shape (n, 3).
        right_tangent: y', shape (n, 3).
        direction: yhat, unit, from left to right, shape (n, 3).
        width_m: a, shape (n,), m.
        sin_eta: Sine of the angle between x' and yhat, shape (n,).
        sin_zeta: Sine of the angle between y' and yhat, shape (n,).
    """

    left: Array
    right: Array
    left_tangent: Array
    right_tangent: Array
    direction: Array
    width_m: Array
    sin_eta: Array
    sin_zeta: Array

    @classmethod
    def of(cls, edges: Edges, u_m: Array, w_m: Array) -> "Across":
        """The line across.

        Source: Berg Eqs. 3.14-3.18.

        Args:
            edges: The edges.
            u_m: Arc lengths along the left edge, shape (n,), m.
            w_m: Arc lengths along the right edge, shape (n,), m.

        Returns:
            The line.
        """
        left, right = edges.left(u_m), edges.right(w_m)
        left_tangent, right_tangent = edges.left.tangent(u_m), edges.right.tangent(w_m)
        chord = right - left
        width = np.linalg.norm(chord, axis=-1)
        direction = chord / width[..., None]
        return cls(
            left,
            right,
            left_tangent,
            right_tangent,
            direction,
            width,
            np.linalg.norm(cross(left_tangent, direction), axis=-1),
            np.linalg.norm(cross(right_tangent, direction), axis=-1),
        )

    def frame(self) -> Array:
        """The bead's own frame.

        Source: Berg Eqs. 3.36-3.39.

        Returns:
            Columns: xhat along the bead, yhat to the right, zhat into the part; shape (n, 3, 3).
        """
        z = normalise(cross(self.left_tangent + self.right_tangent, self.direction))
        return np.stack((cross(self.direction, z), self.direction, z), axis=-1)


@dataclass(frozen=True, eq=False)
class Pose:
    """Poses of the nozzle.

    Attributes:
        position_m: Of its mouth, shape (n, 3), m.
        rotation: Columns are the tip frame's x (right of travel), y (along travel) and z (back along the
            nozzle), shape (n, 3, 3).
    """

    position_m: Array
    rotation: Array


def thesis_to_tip(rotation: Array) -> Array:
    """From the thesis' nozzle frame to this package's tip frame.

    Args:
        rotation: Columns: along travel, to the right, along the nozzle into the part; shape (..., 3, 3).

    Returns:
        Columns: to the right, along travel, back along the nozzle; shape (..., 3, 3).
    """
    return np.stack((rotation[..., 1], rotation[..., 0], -rotation[..., 2]), axis=-1)


def nozzle_pose(at: Across, mu: Array, drag_rad: Array, fan_angle_rad: float) -> Pose:
    """The nozzle whose fan's borders meet both edges.

    Source: Berg Eqs. 3.35 and 3.40. The rotation is R(-kappa, yhat) R(rho, xhat) R_s, first the tilt in the
    plane of the triangle, then the drag about the line across: in the printed order the nozzle's axis misses
    the fan's bisector by up to 1.3 deg.

    Args:
        at: Where the fan's borders meet the edges.
        mu: b / c, shape (n,).
        drag_rad: kappa, positive with the nozzle ahead of its bead, shape (n,), rad.
        fan_angle_rad: theta [rad].

    Returns:
        Poses in the edges' frame.
    """
    _, c = distances(mu, at.width_m, fan_angle_rad)
    tilt = tilt_of_ratio(mu, fan_angle_rad)
    beta = (np.pi - fan_angle_rad) / 2.0 - tilt
    sealant = at.frame()
    x, y, z = sealant[..., 0], sealant[..., 1], sealant[..., 2]
    down = np.cos(drag_rad)[:, None] * z - np.sin(drag_rad)[:, None] * x
    position = at.left + (c * np.cos(beta))[:, None] * y - (c * np.sin(beta))[:, None] * down
    rotation = axis_angle(y, -drag_rad) @ axis_angle(x, tilt) @ sealant
    return Pose(position, thesis_to_tip(rotation))


@dataclass(frozen=True, kw_only=True, eq=False)
class BeadPath:
    """A timed path of the nozzle with its flow, which a robot can be made to execute.

    Attributes:
        time_s: From 0, rising, shape (n,), s.
        position_m: Nozzle mouth, shape (n, 3), m, in the edges' frame.
        rotation: Columns are the tip frame's x (right of travel), y (along travel) and z (back along the
            nozzle, away from the part), shape (n, 3, 3).
        flow_m3_per_s: Volume flow, shape (n,), m^3/s.
    """

    time_s: Array
    position_m: Array
    rotation: Array
    flow_m3_per_s: Array

    def __post_init__(self) -> None:
        """Checks shapes and time."""
        n = len(self.time_s)
        shapes = {
            "time_s": (n,),
            "position_m": (n, 3),
            "rotation": (n, 3, 3),
            "flow_m3_per_s": (n,),
        }
        for name, shape in shapes.items():
            given = np.shape(getattr(self, name))
            require(
                given == shape,
                f"BeadPath.{name}: shape {given}: must be {shape}, one entry a time",
                ConfigError,
            )
        require(
            n >= 2 and bool(np.all(np.diff(self.time_s) > 0)),
            "BeadPath.time_s: must rise from entry to entry and have at least two",
            ConfigError,
        )
