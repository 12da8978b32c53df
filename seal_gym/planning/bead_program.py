"""The bead path problem as a sparse nonlinear program with exact derivatives, for IPOPT through CasADi.

The thesis takes equal steps in time and the speeds as unknowns; arc lengths are their sums, so that every
constraint depends on every earlier speed. Here the nodes have fixed places on the left edge, dense where the
edges bend, and the time between them follows; the right edge's arc length is an unknown of its own, tied to
its speed from node to node. The paths are the same, the derivatives are sparse and the left edge constant.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from seal_gym.core.frames import Array
from seal_gym.planning.bead_config import BeadCfg, BeadNodes
from seal_gym.planning.bead_curves import Edges
from seal_gym.planning.bead_geometry import Across, log_height, ratio_of_tilt
from seal_gym.planning.bead_symbols import (
    SMOOTH_RAD,
    SMOOTH_SHARE,
    curve_functions,
    load_casadi,
    node_function,
    smooth_modulus,
)

_MAX_ITERATIONS = 300
_ELASTIC_RANGE = float(np.log(20.0))  # how far an elastic solve may take speeds past their limits
_ELASTIC_SQUARE = 0.1  # a share of squared slacks makes the least slacks unique
_SOLVED = ("Solve_Succeeded", "Solved_To_Acceptable_Level")
GROUPS = ("tilt", "distance b", "distance c", "speed left", "speed right")


@dataclass(frozen=True, eq=False)
class ProgramResult:
    """What IPOPT made of a program.

    Attributes:
        nodes: The path, whether or not it meets the constraints.
        slack: Of an elastic program: by how much each limit is passed at each node, as the logarithm of
            mu (tilt), distance or speed, by ``GROUPS``; else empty.
        status: IPOPT's word.
        iterations: IPOPT's.
    """

    nodes: BeadNodes
    slack: dict[str, Array]
    status: str
    iterations: int

    @property
    def solved(self) -> bool:
        """Whether IPOPT converged."""
        return self.status in _SOLVED


@dataclass(frozen=True, eq=False)
class _Symbols:
    """The unknowns and what follows from them; rows of one entry a node, dt of one an interval."""

    ln_u_dot: Any
    ln_w_dot: Any
    w: Any  # share of the right edge's length
    drag: Any
    ln_h: Any
    log_h: Any
    log_mu: Any
    log_b: Any
    log_c: Any
    position: Any
    spin: Any
    dt: Any
    weight: Any  # of a node in a mean over time


def _symbols(ca: Any, edges: Edges, duration_s: float, cfg: BeadCfg, u_m: Array) -> _Symbols:
    n = len(u_m)
    ln_u_dot, ln_w_dot, w, drag = (ca.MX.sym(name, 1, n) for name in ("ln_u_dot", "ln_w_dot", "w", "drag"))
    u_dot, w_dot = ca.exp(ln_u_dot), ca.exp(ln_w_dot)
    right, tangent = (f.map(n)(w * edges.right.length_m) for f in curve_functions(edges.right, "right"))
    at_nodes = node_function(cfg.nozzle).map(n)(
        edges.left(u_m).T, edges.left.tangent(u_m).T, right, tangent, u_dot, w_dot, drag
    )
    log_h, log_mu, log_b, log_c, position, spin = at_nodes
    dt = 2.0 * np.diff(u_m)[None] / (u_dot[:, :-1] + u_dot[:, 1:])
    weight = (ca.horzcat(dt, 0.0) + ca.horzcat(0.0, dt)) / (2.0 * duration_s)
    ln_h = ca.MX.sym("ln_h")
    return _Symbols(
        ln_u_dot, ln_w_dot, w, drag, ln_h, log_h, log_mu, log_b, log_c, position, spin, dt, weight
    )


class _Rules:
    """A growing list of constraints with their bounds."""

    def __init__(self, ca: Any) -> None:
        self._ca = ca
        self.values: list[Any] = []
        self.low: list[Array] = []
        self.high: list[Array] = []

    def add(self, value: Any, low: float, high: float) -> None:
        column = self._ca.vec(value)
        self.values.append(column)
        self.low.append(np.full(column.shape[0], low))
        self.high.append(np.full(column.shape[0], high))


def _limits(at: _Symbols, cfg: BeadCfg) -> dict[str, tuple[Any, float, float]]:
    mu_max = float(np.log(ratio_of_tilt(cfg.tilt_rad, cfg.nozzle.fan_angle_rad)))
    near, far = map(float, np.log(cfg.distance_m))
    slow, fast = map(float, np.log(cfg.speed_m_per_s))
    return {
        "tilt": (at.log_mu, -mu_max, mu_max),
        "distance b": (at.log_b, near, far),
        "distance c": (at.log_c, near, far),
        "speed left": (at.ln_u_dot, slow, fast),
        "speed right": (at.ln_w_dot, slow, fast),
    }


def _cost(ca: Any, at: _Symbols, cfg: BeadCfg, u_m: Array) -> Any:
    """Berg Eq. 3.61, its sums over equidistant times as integrals."""
    k1, k2, k3 = cfg.weights
    moved = at.position[:, 1:] - at.position[:, :-1]
    modulus = smooth_modulus(at.drag, SMOOTH_RAD, ca)
    # In a tight inner corner the nozzle stops and turns back, where its path's length has a kink.
    rounding = SMOOTH_SHARE * np.diff(u_m)[None]
    length = ca.sum2(ca.sqrt(ca.sum1(moved**2) + rounding**2))
    return (cfg.cost_intervals + 1) * ca.sum2(at.weight * (k1 * at.spin + k2 * modulus)) + k3 * length


def _roughness(ca: Any, at: _Symbols, share: Array) -> Any:
    """Integral of the squared second derivatives of ln mu and kappa by the share of the left edge."""
    step = np.diff(share)[None]
    middle = (step[:, 1:] + step[:, :-1]) / 2.0

    def of(value: Any) -> Any:
        slope = (value[:, 1:] - value[:, :-1]) / step
        return ca.sum2((slope[:, 1:] - slope[:, :-1]) ** 2 / middle)

    return of(at.log_mu) + of(at.drag)


def solve_program(
    edges: Edges, duration_s: float, cfg: BeadCfg, guess: BeadNodes, *, elastic: bool = False
) -> ProgramResult:
    """Solves the problem on given nodes.

    Source: Berg 3.1.3. Unknowns at each node: ln udot, ln wdot, w, kappa; and one ln h for all nodes, which
    Eq. 3.50 says as h_i = h_{i-1}. g = h holds by construction.

    Args:
        edges: The edges.
        duration_s: t_f [s].
        cfg: Limits and weights.
        guess: Where to start; its ``u_m`` are the nodes' places.
        elastic: Whether limits give way: then the least slack is sought in place of the least cost, with the
            height, the ends and the time kept.

    Returns:
        The path and IPOPT's word.

    Raises:
        PlanningError: If CasADi is not installed.
    """
    ca, n = load_casadi(), len(guess.u_m)
    at = _symbols(ca, edges, duration_s, cfg, guess.u_m)
    limits = _limits(at, cfg)
    rules = _Rules(ca)
    w_dot = ca.exp(at.ln_w_dot)
    advance = at.dt * (w_dot[:, :-1] + w_dot[:, 1:]) / (2.0 * edges.right.length_m)
    rules.add(n * (at.w[:, 1:] - at.w[:, :-1] - advance), 0.0, 0.0)  # steps of w are about 1 / n
    rules.add(ca.sum2(at.dt) / duration_s, 1.0, 1.0)
    rules.add(at.log_h - at.ln_h, 0.0, 0.0)

    _, slow, fast = limits["speed left"]
    drag = np.full(n, 0.0 if elastic else cfg.drag_rad)
    drag[[0, -1]] = 0.0
    if elastic:
        slow, fast = slow - _ELASTIC_RANGE, fast + _ELASTIC_RANGE
    last = np.arange(n) == n - 1
    first = np.arange(n) == 0
    # Unknown, lower bound, upper bound, start.
    unknowns: list[tuple[Any, Array, Array, Array]] = [
        (at.ln_u_dot, np.full(n, slow), np.full(n, fast), np.log(guess.u_dot)),
        (at.ln_w_dot, np.full(n, slow), np.full(n, fast), np.log(guess.w_dot)),
        (at.w, 1.0 * last, 1.0 * ~first, guess.w_m / edges.right.length_m),
        (at.drag, -drag, drag, guess.drag_rad),
        (at.ln_h, np.array([-20.0]), np.array([0.0]), _start_height(edges, guess, cfg)),
    ]
    if elastic:
        slack = ca.MX.sym("slack", n, len(GROUPS))
        for k, name in enumerate(GROUPS):
            value, low, high = limits[name]
            rules.add(value - slack[:, k].T, -np.inf, high)
            rules.add(value + slack[:, k].T, low, np.inf)
        count = slack.numel()
        unknowns.append((slack, np.zeros(count), np.full(count, np.inf), np.full(count, 0.1)))
        share = np.gradient(guess.u_m) / edges.left.length_m
        least = ca.sum2(ca.mtimes(share[None], slack + _ELASTIC_SQUARE * slack**2))
        # Where no limit is passed, the line across that turns least decides.
        objective = least + 1e-4 * ca.sum2(at.weight * at.spin)
    else:
        for name in GROUPS[:3]:  # speeds have bounds as unknowns
            rules.add(*limits[name])
        share = guess.u_m / edges.left.length_m
        objective = _cost(ca, at, cfg, guess.u_m) + cfg.smoothing * _roughness(ca, at, share)

    symbols, lowest, highest, start = zip(*unknowns, strict=True)
    solver = ca.nlpsol(
        "bead",
        "ipopt",
        {"x": ca.veccat(*symbols), "f": objective, "g": ca.vertcat(*rules.values)},
        {
            "print_time": False,
            "ipopt": {
                "print_level": 0,
                "sb": "yes",
                "max_iter": _MAX_ITERATIONS,
                "tol": 1e-7,
                "mu_strategy": "adaptive",
            },
        },
    )
    found = solver(
        x0=np.concatenate(start),
        lbx=np.concatenate(lowest),
        ubx=np.concatenate(highest),
        lbg=np.concatenate(rules.low),
        ubg=np.concatenate(rules.high),
    )
    stats = solver.stats()
    z = np.asarray(found["x"]).ravel()
    u_dot, w_dot, w, kappa = np.exp(z[:n]), np.exp(z[n : 2 * n]), z[2 * n : 3 * n], z[3 * n : 4 * n]
    dt = 2.0 * np.diff(guess.u_m) / (u_dot[:-1] + u_dot[1:])
    nodes = BeadNodes(
        time_s=np.concatenate(([0.0], np.cumsum(dt))),
        u_m=guess.u_m,
        w_m=w * edges.right.length_m,
        u_dot=u_dot,
        w_dot=w_dot,
        drag_rad=kappa,
    )
    passed = dict(zip(GROUPS, z[4 * n + 1 :].reshape(len(GROUPS), n), strict=True)) if elastic else {}
    return ProgramResult(nodes, passed, str(stats["return_status"]), int(stats["iter_count"]))


def _start_height(edges: Edges, guess: BeadNodes, cfg: BeadCfg) -> Array:
    at = Across.of(edges, guess.u_m, guess.w_m)
    height = log_height(guess.u_dot, guess.w_dot, at.sin_eta, at.sin_zeta, at.width_m, cfg.nozzle)
    return np.array([np.mean(height)])
