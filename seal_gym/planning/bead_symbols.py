"""The bead's geometry as CasADi expressions, which have exact derivatives."""

import importlib
from typing import Any

import numpy as np
from scipy.interpolate import BSpline

from seal_gym.planning.bead_config import INSTALL, PlanningError
from seal_gym.planning.bead_curves import Curve
from seal_gym.planning.bead_geometry import NozzleCfg, distance_ratio, distances, log_height, tilt_of_ratio

SMOOTH_RAD = 1e-3  # |kappa| is rounded within so much of zero: solvers want derivatives
SMOOTH_SHARE = 0.1  # |dp| within so much of the step along the edge


def load_casadi() -> Any:
    """The CasADi module.

    Returns:
        It.

    Raises:
        PlanningError: If it is not installed.
    """
    try:
        return importlib.import_module("casadi")
    except ImportError as error:
        raise PlanningError(f"bead paths need CasADi, which is not installed: {INSTALL}") from error


def curve_functions(curve: Curve, name: str) -> tuple[Any, Any]:
    """A curve and its tangent as CasADi functions of arc length.

    Beyond its ends, where solvers may step, the curve goes straight on.

    Args:
        curve: The curve.
        name: Of the functions, which CasADi wants.

    Returns:
        Position and first derivative, each (1) -> (3).
    """
    ca = load_casadi()
    s = ca.MX.sym("s")
    inside = ca.fmin(ca.fmax(s, 0.0), curve.length_m)

    def value(spline: BSpline) -> Any:
        coefficients = spline.c[: len(spline.t) - spline.k - 1]
        return ca.bspline(inside, ca.DM(coefficients.ravel()), [spline.t.tolist()], [spline.k], 3, {})

    tangent = value(curve.spline.derivative())
    position = value(curve.spline) + (s - inside) * tangent
    return ca.Function(name, [s], [position]), ca.Function(f"{name}_tangent", [s], [tangent])


def node_function(nozzle: NozzleCfg) -> Any:
    """Everything that is known at a node, as a CasADi function.

    Source: Berg 3.1.2 with ``bead_geometry``'s closed forms.

    Args:
        nozzle: Fan and flow.

    Returns:
        (x, x', y, y', udot, wdot, kappa) -> (ln h, ln mu, ln b, ln c, p, 1/sin eta + 1/sin zeta).
    """
    ca, theta = load_casadi(), nozzle.fan_angle_rad
    x, xt, y, yt = (ca.SX.sym(name, 3) for name in ("x", "xt", "y", "yt"))
    u_dot, w_dot, drag = (ca.SX.sym(name) for name in ("u_dot", "w_dot", "drag"))
    chord = y - x
    width = ca.norm_2(chord)
    across = chord / width
    sin_eta, sin_zeta = ca.norm_2(ca.cross(xt, across)), ca.norm_2(ca.cross(yt, across))
    mu = distance_ratio(u_dot, w_dot, sin_eta, sin_zeta, ca)
    b, c = distances(mu, width, theta, ca)
    beta = (np.pi - theta) / 2.0 - tilt_of_ratio(mu, theta, ca)
    normal = ca.cross(xt + yt, across)
    z = normal / ca.norm_2(normal)
    down = ca.cos(drag) * z - ca.sin(drag) * ca.cross(across, z)
    position = x + c * ca.cos(beta) * across - c * ca.sin(beta) * down
    height = log_height(u_dot, w_dot, sin_eta, sin_zeta, width, nozzle, ca)
    spin = 1.0 / sin_eta + 1.0 / sin_zeta
    return ca.Function(
        "node",
        [x, xt, y, yt, u_dot, w_dot, drag],
        [height, ca.log(mu), ca.log(b), ca.log(c), position, spin],
    )


def smooth_modulus(value: Any, width: float, xp: Any = np) -> Any:
    """|value| rounded near zero.

    Args:
        value: Number, array or expression.
        width: Of the rounding.
        xp: numpy or casadi.

    Returns:
        Of the argument's kind; 0 at 0.
    """
    return xp.sqrt(value**2 + width**2) - width
