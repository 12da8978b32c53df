"""Whether any path within a tilt limit brings both fan borders to the ends of their edges together."""

import numpy as np

from seal_gym.core.frames import Array
from seal_gym.planning.bead_curves import Edges
from seal_gym.planning.bead_geometry import Across, ratio_of_tilt

_STEPS = 1000
_MARGIN = 1e-3  # of the right edge's length; the integration's own error is far below


def reachable_ends(edges: Edges, fan_angle_rad: float, tilt_rad: Array) -> tuple[Array, Array]:
    """How far along the right edge a path can be when it ends on the left one.

    Equal heights need mu^2 = (udot sin eta) / (wdot sin zeta) (Berg Eq. 3.28), and |rho| <= rho_max is
    1 / mu_m <= mu <= mu_m. So every path w(u) within the limit has a slope dw/du between sin eta / sin zeta
    divided and multiplied by mu_m^2. By the comparison theorem of scalar differential equations it runs
    between the two solutions that take the smallest and the largest slope everywhere, whatever its speeds,
    time, drag and discretisation.

    Args:
        edges: The edges.
        fan_angle_rad: theta [rad].
        tilt_rad: Limits to try, shape (n,), rad.

    Returns:
        Smallest and largest w, each of shape (n,), m; past its end the right edge counts as straight on, for
        a twentieth of its length.
    """
    steepest = np.array([ratio_of_tilt(float(t), fan_angle_rad) ** 2 for t in tilt_rad])
    factor = np.concatenate((1.0 / steepest, steepest))
    length = edges.right.length_m
    u = np.linspace(0.0, edges.left.length_m, _STEPS + 1)
    step = u[1]

    def slope(at: float, w: Array) -> Array:
        across = Across.of(edges, np.full(len(w), at), np.minimum(w, length))
        return factor * across.sin_eta / across.sin_zeta

    w = np.zeros(len(factor))
    for k in range(_STEPS):
        half = slope(u[k] + step / 2, w + step / 2 * slope(u[k], w))
        w = np.minimum(w + step * half, 1.05 * length)
    return w[: len(tilt_rad)], w[len(tilt_rad) :]


def least_tilt(edges: Edges, fan_angle_rad: float, tilt_rad: float) -> float | None:
    """The tilt without which no path exists, if it is more than a limit.

    A proof that there is none within the limit: it holds for every path, not only for those near some
    solver's start. The other way round it proves nothing: the other limits may forbid what the tilt allows.

    Args:
        edges: The edges.
        fan_angle_rad: theta [rad].
        tilt_rad: The limit [rad].

    Returns:
        A tilt that is still not enough, to a tenth of a degree [rad]; None if the limit allows a path.
    """
    top = (np.pi - fan_angle_rad) / 2.0
    tilts = np.append(tilt_rad, np.arange(tilt_rad, top - 1e-3, np.deg2rad(0.1))[1:])
    low, high = reachable_ends(edges, fan_angle_rad, tilts)
    length = edges.right.length_m
    short = (high < (1.0 - _MARGIN) * length) | (low > (1.0 + _MARGIN) * length)
    if not short[0]:
        return None
    return float(tilts[short][-1])
