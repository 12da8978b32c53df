"""The optimal nozzle path for two edges, or why there is none."""

import logging
from dataclasses import dataclass, replace

import numpy as np

from seal_gym.core.frames import Array
from seal_gym.planning.bead_config import BeadCfg, BeadNodes, PlanningError
from seal_gym.planning.bead_curves import Edges
from seal_gym.planning.bead_geometry import ratio_of_tilt
from seal_gym.planning.bead_path import FINER, check_duration, cost, quantities
from seal_gym.planning.bead_program import ProgramResult, solve_program
from seal_gym.planning.bead_reach import least_tilt

_FIRST_INTERVALS = 240
_MOST_INTERVALS = 1500
_ROUNDS = 8
_BEND_WEIGHT = 1.0  # of the edges' curvature in the density of the first nodes
_PASSED = 2e-3  # of a limit between nodes, as a logarithm
_SMOOTHER = 100.0
_ELASTIC_INTERVALS = 60
_FOUND = 1e-3  # slack, as a logarithm, that counts as a limit passed

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, eq=False)
class BeadSolution:
    """An optimal path.

    Attributes:
        edges: The edges.
        cfg: Limits and weights.
        nodes: The path at its nodes.
        cost: Of the path on the finer grid, see ``cost``.
        solver: ``"ipopt"`` or ``"slsqp"``.
        iterations: Of the solver, all rounds together.
        rounds: How often the nodes were refined and the problem solved again, the first time included.
    """

    edges: Edges
    cfg: BeadCfg
    nodes: BeadNodes
    cost: float
    solver: str
    iterations: int
    rounds: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Infeasibility:
    """Why there is no path.

    Attributes:
        constraint: The limit that cannot be met: one of ``bead_program.GROUPS``.
        u_m: Where it is passed furthest: arc length along the left edge [m].
        w_m: The same along the right edge [m].
        stretch_m: From and to which arc length along the left edge it is passed [m].
        value: Of the limited quantity there, in ``unit``.
        limit: That it passes.
        unit: ``"deg"``, ``"mm"`` or ``"m/s"``.
        proven: Whether no path at all can meet the limits; otherwise a local solver found none near its
            start.
        hint: What would help.
    """

    constraint: str
    u_m: float
    w_m: float
    stretch_m: tuple[float, float]
    value: float
    limit: float
    unit: str
    proven: bool
    hint: str

    def __str__(self) -> str:
        """One sentence for people."""
        return (
            f"no path within the limits: {self.constraint} {self.value:.3g} {self.unit} "
            f"(limit {self.limit:.3g}) at {self.u_m * 1e3:.1f} mm of the left and {self.w_m * 1e3:.1f} mm of "
            "the right edge, passed "
            f"between {self.stretch_m[0] * 1e3:.1f} and {self.stretch_m[1] * 1e3:.1f} mm; {self.hint}"
        )


def first_nodes(edges: Edges, duration_s: float, intervals: int) -> BeadNodes:
    """Constant mean speeds and no drag on nodes that are denser where the edges bend.

    Source: Berg Eqs. 3.58-3.60.

    Args:
        edges: The edges.
        duration_s: t_f [s].
        intervals: N.

    Returns:
        The start of a solve.
    """
    share = np.linspace(0.0, 1.0, 2001)
    bend = np.mean(
        [np.linalg.norm(e(share * e.length_m, 2), axis=1) * e.length_m for e in (edges.left, edges.right)],
        axis=0,
    )
    density = 1.0 + _BEND_WEIGHT * np.sqrt(bend)
    rising = np.concatenate(([0.0], np.cumsum(density[1:] + density[:-1])))
    k = np.interp(np.linspace(0.0, rising[-1], intervals + 1), rising, share)
    mean_u, mean_w = edges.left.length_m / duration_s, edges.right.length_m / duration_s
    return BeadNodes(
        time_s=k * duration_s,
        u_m=k * edges.left.length_m,
        w_m=k * edges.right.length_m,
        u_dot=np.full(intervals + 1, mean_u),
        w_dot=np.full(intervals + 1, mean_w),
        drag_rad=np.zeros(intervals + 1),
    )


def _refined(edges: Edges, nodes: BeadNodes, cfg: BeadCfg) -> BeadNodes | None:
    """More nodes where heights or limits are missed between them; None if they are not."""
    q = quantities(edges, nodes.finer(FINER), cfg)
    heights = np.stack((q.g_m, q.h_m))
    off = np.max(np.abs(heights - heights.mean()), axis=0) / cfg.height_tolerance_m
    near, far = cfg.distance_m
    mu_max = ratio_of_tilt(cfg.tilt_rad, cfg.nozzle.fan_angle_rad)
    mu = q.b_m / q.c_m
    ratios = [mu / mu_max, 1.0 / (mu * mu_max)]
    ratios += [r for d in (q.b_m, q.c_m) for r in (d / far, near / d)]
    off = np.maximum(off, np.log(np.max(ratios, axis=0)) / _PASSED)
    worst = np.maximum(off[:-1].reshape(-1, FINER).max(axis=1), off[FINER::FINER])
    if worst.max() <= 1.0:
        return None
    # The error of a linear piece falls with the square of its length; aim a little below the tolerance.
    cuts = np.clip(np.ceil(np.sqrt(worst / 0.7)), 1, 4).astype(int)
    time = [
        t0 + (t1 - t0) * np.arange(n) / n
        for t0, t1, n in zip(nodes.time_s[:-1], nodes.time_s[1:], cuts, strict=True)
    ]
    return nodes.at(np.concatenate((*time, nodes.time_s[-1:])))


def solve(edges: Edges, duration_s: float, cfg: BeadCfg | None = None) -> BeadSolution | Infeasibility:
    """The optimal path for two edges.

    Source: Berg 3.1, solved with IPOPT on nodes that are added until heights keep within the tolerance and
    limits hold between the nodes too.

    Args:
        edges: The edges.
        duration_s: t_f, which sets the bead's height [s].
        cfg: Limits and weights; the thesis' by default.

    Returns:
        The path, or why there is none.

    Raises:
        ConfigError: If the duration is not positive.
        PlanningError: If CasADi is missing or the solver neither finds a path nor a limit that forbids one.
    """
    cfg = cfg or BeadCfg()
    check_duration(edges, duration_s)
    tilt = least_tilt(edges, cfg.nozzle.fan_angle_rad, cfg.tilt_rad)
    forbidden = _forbidden(edges, duration_s, cfg, tilt)
    if forbidden is not None:
        return forbidden
    guess = first_nodes(edges, duration_s, _FIRST_INTERVALS)
    iterations = 0
    for k in range(_ROUNDS):
        found = solve_program(edges, duration_s, cfg, guess)
        iterations += found.iterations
        _log.debug("round %d: %d intervals, %s", k + 1, len(guess.u_m) - 1, found.status)
        if not found.solved:  # a smoother problem is easier, and its path a better start
            smooth = replace(cfg, smoothing=_SMOOTHER * max(cfg.smoothing, 1e-6))
            found = solve_program(edges, duration_s, cfg, _nodes(edges, duration_s, smooth, guess))
        if not found.solved:
            raise PlanningError(
                f"IPOPT found neither a path nor a limit that forbids it ({found.status}): smooth the edges "
                "more, raise BeadCfg.smoothing or change duration_s"
            )
        finer = _refined(edges, found.nodes, cfg)
        if finer is None:
            return BeadSolution(
                edges=edges,
                cfg=cfg,
                nodes=found.nodes,
                cost=cost(edges, found.nodes, cfg),
                solver="ipopt",
                iterations=iterations,
                rounds=k + 1,
            )
        guess = finer
        if len(guess.u_m) > _MOST_INTERVALS:
            break
    raise PlanningError(
        f"heights not within {cfg.height_tolerance_m * 1e3:.3g} mm between the nodes after {k + 1} "
        "refinements: raise BeadCfg.height_tolerance_m or smooth the edges more"
    )


def _nodes(edges: Edges, duration_s: float, cfg: BeadCfg, guess: BeadNodes) -> BeadNodes:
    """The path of a program if it is solved, else the guess."""
    found = solve_program(edges, duration_s, cfg, guess)
    return found.nodes if found.solved else guess


def _forbidden(edges: Edges, duration_s: float, cfg: BeadCfg, tilt: float | None) -> Infeasibility | None:
    """The limit that cannot be met, by the least slack with which a path exists; None if it needs none.

    Args:
        edges: The edges.
        duration_s: t_f [s].
        cfg: Limits.
        tilt: A tilt proven too small [rad], if any.
    """
    found = solve_program(
        edges, duration_s, cfg, first_nodes(edges, duration_s, _ELASTIC_INTERVALS), elastic=True
    )
    name = max(found.slack, key=lambda group: float(found.slack[group].max()))
    if not found.solved or found.slack[name].max() < _FOUND:
        return None
    return _reason(edges, duration_s, cfg, found, name, tilt)


def _reason(
    edges: Edges, duration_s: float, cfg: BeadCfg, found: ProgramResult, name: str, tilt: float | None
) -> Infeasibility:
    slack, q = found.slack[name], quantities(edges, found.nodes, cfg)
    k = int(np.argmax(slack))
    passed = np.flatnonzero(slack > _FOUND)
    values, limits, unit = {
        "tilt": (np.rad2deg(q.tilt_rad), np.rad2deg([-cfg.tilt_rad, cfg.tilt_rad]), "deg"),
        "distance b": (1e3 * q.b_m, 1e3 * np.array(cfg.distance_m), "mm"),
        "distance c": (1e3 * q.c_m, 1e3 * np.array(cfg.distance_m), "mm"),
        "speed left": (found.nodes.u_dot, np.array(cfg.speed_m_per_s), "m/s"),
        "speed right": (found.nodes.w_dot, np.array(cfg.speed_m_per_s), "m/s"),
    }[name]
    low, high = limits
    limit = high if values[k] > (low + high) / 2 else low
    means = np.array([edges.left.length_m, edges.right.length_m]) / duration_s
    slow, fast = cfg.speed_m_per_s
    too_slow_or_fast = bool(np.any((means < slow) | (means > fast)))
    return Infeasibility(
        constraint=name,
        u_m=float(found.nodes.u_m[k]),
        w_m=float(found.nodes.w_m[k]),
        stretch_m=(float(found.nodes.u_m[passed[0]]), float(found.nodes.u_m[passed[-1]])),
        value=float(values[k]),
        limit=float(limit),
        unit=unit,
        proven=tilt is not None or (too_slow_or_fast and name.startswith("speed")),
        hint=_hint(edges, cfg, name, tilt, means),
    )


def _hint(edges: Edges, cfg: BeadCfg, name: str, tilt: float | None, means: Array) -> str:
    if name == "tilt":
        mu = ratio_of_tilt(cfg.tilt_rad, cfg.nozzle.fan_angle_rad)
        long, short = max(means), min(means)
        text = (
            f"one edge is {long / short:.3f} times as long as the other and this tilt balances "
            f"mu_m^2 = {mu**2:.3f} times where both meet the line across at equal angles"
        )
        if tilt is not None:
            text += f"; no path at all has |tilt| below {np.rad2deg(tilt):.1f} deg"
        return text + ": allow more tilt, a wider fan or a narrower bead"
    if name.startswith("distance"):
        return "change the bead's width, the fan's angle or BeadCfg.distance_m"
    return (
        f"the mean speeds are {means[0]:.3g} m/s (left) and {means[1]:.3g} m/s (right): change duration_s or "
        "BeadCfg.speed_m_per_s"
    )
