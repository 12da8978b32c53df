"""The bead path problem as the thesis has it: equal steps in time, SciPy's SLSQP.

Kept as the reference that the main solver is compared with. It has the printed unknowns, constraints, start
and cost; only the gradients are exact (CasADi) where the thesis leaves them to finite differences, for time.
"""

from typing import Any

import numpy as np
from scipy.optimize import minimize

from seal_gym.core.errors import ConfigError, require
from seal_gym.core.frames import Array
from seal_gym.planning.bead_config import BeadCfg, BeadNodes, PlanningError
from seal_gym.planning.bead_curves import Edges
from seal_gym.planning.bead_geometry import ratio_of_tilt
from seal_gym.planning.bead_path import check_duration, cost
from seal_gym.planning.bead_solver import BeadSolution
from seal_gym.planning.bead_symbols import (
    SMOOTH_RAD,
    curve_functions,
    load_casadi,
    node_function,
    smooth_modulus,
)

_MAX_ITERATIONS = 200
_TOLERANCE = 1e-6


def _functions(edges: Edges, duration_s: float, cfg: BeadCfg, intervals: int) -> dict[str, Any]:
    """Cost, equalities and inequalities (>= 0) with their derivatives, of the stacked unknowns."""
    ca, n = load_casadi(), intervals + 1
    z = ca.MX.sym("z", 3 * n)
    u_dot, w_dot, drag = (z[k * n : (k + 1) * n].T for k in range(3))
    dt = duration_s / intervals
    u, w = (ca.horzcat(0.0, ca.cumsum((v[:, :-1] + v[:, 1:]) / 2.0 * dt, 1)) for v in (u_dot, w_dot))
    left, left_tangent = (f.map(n)(u) for f in curve_functions(edges.left, "left"))
    right, right_tangent = (f.map(n)(w) for f in curve_functions(edges.right, "right"))
    log_h, log_mu, log_b, log_c, position, spin = node_function(cfg.nozzle).map(n)(
        left, left_tangent, right, right_tangent, u_dot, w_dot, drag
    )
    k1, k2, k3 = cfg.weights
    moved = position[:, 1:] - position[:, :-1]
    value = ca.sum2(k1 * spin + k2 * smooth_modulus(drag, SMOOTH_RAD, ca)) * (
        cfg.cost_intervals + 1
    ) / n + k3 * ca.sum2(ca.sqrt(ca.sum1(moved**2)))
    equal = ca.vertcat(
        (log_h[:, 1:] - log_h[:, :-1]).T,
        u[-1] / edges.left.length_m - 1.0,
        w[-1] / edges.right.length_m - 1.0,
    )
    mu_max = float(np.log(ratio_of_tilt(cfg.tilt_rad, cfg.nozzle.fan_angle_rad)))
    near, far = map(float, np.log(cfg.distance_m))
    limits = ((log_mu, -mu_max, mu_max), (log_b, near, far), (log_c, near, far))
    within = ca.vertcat(*[side.T for v, low, high in limits for side in (v - low, high - v)])
    return {
        name: ca.Function(name, [z], [expression, ca.densify(ca.jacobian(expression, z))])
        for name, expression in (("cost", value), ("equal", equal), ("within", within))
    }


def solve_slsqp(
    edges: Edges, duration_s: float, cfg: BeadCfg | None = None, intervals: int = 60
) -> BeadSolution:
    """The optimal path on equal steps in time.

    Source: Berg 3.1.3: unknowns udot, wdot, kappa at N + 1 times (Eqs. 3.44-3.46); h_i = h_{i-1}, the ends
    and kappa_0 = kappa_N = 0 (3.50-3.54); limits on b, c and rho (3.47-3.49) and bounds (3.55-3.57); mean
    speeds to start from (3.58-3.60); cost (3.61). Limits and heights are written in logarithms.

    Args:
        edges: The edges.
        duration_s: t_f [s].
        cfg: Limits and weights; the thesis' by default.
        intervals: N.

    Returns:
        The path. Nothing holds between the nodes.

    Raises:
        ConfigError: If the duration is not positive or there are fewer than 2 intervals.
        PlanningError: If CasADi is missing or SLSQP ends without a path.
    """
    cfg = cfg or BeadCfg()
    check_duration(edges, duration_s)
    require(intervals >= 2, f"intervals = {intervals!r}: must be at least 2", ConfigError)
    n = intervals + 1
    functions = _functions(edges, duration_s, cfg, intervals)

    def value(name: str, z: Array) -> Array:
        return np.asarray(functions[name](z)[0]).ravel()

    def jacobian(name: str, z: Array) -> Array:
        return np.asarray(functions[name](z)[1])

    start = np.concatenate(
        (
            np.full(n, edges.left.length_m / duration_s),
            np.full(n, edges.right.length_m / duration_s),
            np.zeros(n),
        )
    )
    drag = np.full(n, cfg.drag_rad)
    drag[[0, -1]] = 0.0
    bounds = [cfg.speed_m_per_s] * (2 * n) + [(-d, d) for d in drag]
    found = minimize(
        lambda z: float(value("cost", z)[0]),
        start,
        jac=lambda z: jacobian("cost", z).ravel(),
        method="SLSQP",
        bounds=bounds,
        constraints=[
            {
                "type": kind,
                "fun": lambda z, name=name: value(name, z),
                "jac": lambda z, name=name: jacobian(name, z),
            }
            for kind, name in (("eq", "equal"), ("ineq", "within"))
        ],
        options={"maxiter": _MAX_ITERATIONS, "ftol": _TOLERANCE},
    )
    if not found.success:
        raise PlanningError(
            f"SLSQP ended after {found.nit} iterations without a path ({found.message}): "
            "bead_solver.solve says whether there is one"
        )
    u_dot, w_dot, kappa = found.x.reshape(3, n)
    time = np.linspace(0.0, duration_s, n)
    u, w = (
        np.concatenate(([0.0], np.cumsum((v[1:] + v[:-1]) / 2.0 * np.diff(time)))) for v in (u_dot, w_dot)
    )
    nodes = BeadNodes(
        time_s=time,
        u_m=np.minimum(u, edges.left.length_m),
        w_m=np.minimum(w, edges.right.length_m),
        u_dot=u_dot,
        w_dot=w_dot,
        drag_rad=kappa,
    )
    return BeadSolution(
        edges=edges,
        cfg=cfg,
        nodes=nodes,
        cost=cost(edges, nodes, cfg),
        solver="slsqp",
        iterations=int(found.nit),
        rounds=1,
    )
