"""Timed nozzle paths for two edges: from solved nodes, and the naive one they are compared with."""

from dataclasses import dataclass

import numpy as np

from seal_gym.core.errors import ConfigError, is_number, require
from seal_gym.core.frames import Array, cross, normalise, tip_rotation
from seal_gym.planning.bead_config import BeadCfg, BeadNodes
from seal_gym.planning.bead_curves import Curve, Edges
from seal_gym.planning.bead_geometry import (
    Across,
    BeadPath,
    distance_ratio,
    distances,
    edge_heights,
    nozzle_pose,
    tilt_of_ratio,
)
from seal_gym.planning.bead_symbols import SMOOTH_RAD, smooth_modulus

FINER = 10  # heights are checked on a grid so many times finer than the nodes'


@dataclass(frozen=True, kw_only=True, eq=False)
class BeadQuantities:
    """Everything the thesis plots of a path, at given nodes; see ``quantities``.

    Attributes:
        nodes: Times, arc lengths, speeds and drag.
        across: The line across the bead.
        b_m: Nozzle to right edge, shape (n,), m.
        c_m: Nozzle to left edge, shape (n,), m.
        tilt_rad: rho, shape (n,), rad.
        beta_rad: Entry angle at the left edge, shape (n,), rad.
        gamma_rad: Entry angle at the right edge, shape (n,), rad.
        eta_rad: Spin: line across against the left edge, shape (n,), rad in [0, pi].
        zeta_rad: Line across against the right edge, shape (n,), rad in [0, pi].
        g_m: Height at the left edge, shape (n,), m.
        h_m: Height at the right edge, shape (n,), m.
    """

    nodes: BeadNodes
    across: Across
    b_m: Array
    c_m: Array
    tilt_rad: Array
    beta_rad: Array
    gamma_rad: Array
    eta_rad: Array
    zeta_rad: Array
    g_m: Array
    h_m: Array


def quantities(edges: Edges, nodes: BeadNodes, cfg: BeadCfg) -> BeadQuantities:
    """Distances, angles and heights of a path.

    Source: Berg 3.1.2.

    Args:
        edges: The edges.
        nodes: The path.
        cfg: For the nozzle.

    Returns:
        At the same nodes.
    """
    theta = cfg.nozzle.fan_angle_rad
    at = Across.of(edges, nodes.u_m, nodes.w_m)
    mu = distance_ratio(nodes.u_dot, nodes.w_dot, at.sin_eta, at.sin_zeta)
    b, c = distances(mu, at.width_m, theta)
    tilt = tilt_of_ratio(mu, theta)
    g, h = edge_heights(at, nodes.u_dot, nodes.w_dot, cfg.nozzle)
    upright = (np.pi - theta) / 2.0
    eta, zeta = (
        np.arctan2(sine, np.sum(tangent * at.direction, axis=-1))
        for sine, tangent in ((at.sin_eta, at.left_tangent), (at.sin_zeta, at.right_tangent))
    )
    return BeadQuantities(
        nodes=nodes,
        across=at,
        b_m=b,
        c_m=c,
        tilt_rad=tilt,
        beta_rad=upright - tilt,
        gamma_rad=upright + tilt,
        eta_rad=eta,
        zeta_rad=zeta,
        g_m=g,
        h_m=h,
    )


def timed_path(edges: Edges, nodes: BeadNodes, cfg: BeadCfg) -> BeadPath:
    """The nozzle's poses at a path's nodes, with the nozzle's constant flow.

    Args:
        edges: The edges.
        nodes: The path, e.g. ``solution.nodes.finer(10)``.
        cfg: For the nozzle.

    Returns:
        In the edges' frame.
    """
    at = Across.of(edges, nodes.u_m, nodes.w_m)
    mu = distance_ratio(nodes.u_dot, nodes.w_dot, at.sin_eta, at.sin_zeta)
    pose = nozzle_pose(at, mu, nodes.drag_rad, cfg.nozzle.fan_angle_rad)
    return BeadPath(
        time_s=nodes.time_s,
        position_m=pose.position_m,
        rotation=pose.rotation,
        flow_m3_per_s=np.full(len(nodes.time_s), cfg.nozzle.flow_m3_per_s),
    )


def cost(edges: Edges, nodes: BeadNodes, cfg: BeadCfg) -> float:
    """The thesis' cost of a path, as an integral on a finer grid, so that paths of any nodes compare.

    Source: Berg Eq. 3.61; its sum over N + 1 equidistant times is N + 1 times a mean over time.

    Args:
        edges: The edges.
        nodes: The path.
        cfg: For nozzle and weights.

    Returns:
        J.
    """
    fine = nodes.finer(FINER)
    at = Across.of(edges, fine.u_m, fine.w_m)
    k1, k2, k3 = cfg.weights
    rate = k1 * (1.0 / at.sin_eta + 1.0 / at.sin_zeta) + k2 * smooth_modulus(fine.drag_rad, SMOOTH_RAD)
    moved = np.linalg.norm(np.diff(timed_path(edges, fine, cfg).position_m, axis=0), axis=1)
    mean = np.trapezoid(rate, fine.time_s) / (fine.time_s[-1] - fine.time_s[0])
    return float((cfg.cost_intervals + 1) * mean + k3 * moved.sum())


def check_duration(edges: Edges, duration_s: float) -> None:
    """Checks t_f.

    Args:
        edges: For the speeds that the message names.
        duration_s: t_f [s].

    Raises:
        ConfigError: If it is not a positive number.
    """
    require(
        is_number(duration_s) and duration_s > 0.0,
        f"duration_s = {duration_s!r}: must be a positive number of seconds; the mean speeds "
        f"{edges.left.length_m:.3g} m / t_f and {edges.right.length_m:.3g} m / t_f belong within the limits",
        ConfigError,
    )


def naive_path(edges: Edges, duration_s: float, cfg: BeadCfg | None = None, samples: int = 1001) -> BeadPath:
    """What the optimal path is compared with: constant offset and speed over the bead's centre line.

    The nozzle stands normal to the bead's surface, its fan across the direction of travel, at the offset
    where the fan is as wide as the bead is on average; flow and time are the optimal path's.

    Source: Berg 1.1, Fig. 1.2.

    Args:
        edges: The edges.
        duration_s: t_f [s].
        cfg: For the nozzle; the default one if none is given.
        samples: Of the path, equidistant in time, >= 2.

    Returns:
        In the edges' frame.

    Raises:
        ConfigError: If the duration is not positive or the samples are too few.
    """
    cfg = cfg or BeadCfg()
    check_duration(edges, duration_s)
    require(samples >= 2, f"samples = {samples!r}: must be at least 2", ConfigError)
    share = np.linspace(0.0, 1.0, 2001)
    centre = (edges.left(share * edges.left.length_m) + edges.right(share * edges.right.length_m)) / 2.0
    line = Curve.through(centre)
    # Where the samples are in shares of the edges' lengths.
    along = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(centre, axis=0), axis=1))))
    s = np.linspace(0.0, line.length_m, samples)
    share = np.interp(s / line.length_m, along / along[-1], share)
    tangent = line.tangent(s)
    approach = -normalise(cross(tangent, edges.chord(share)))
    width = np.linalg.norm(edges.chord(np.linspace(0.0, 1.0, 2001)), axis=1).mean()
    offset = width / 2.0 / np.tan(cfg.nozzle.fan_angle_rad / 2.0)
    return BeadPath(
        time_s=np.linspace(0.0, duration_s, samples),
        position_m=line(s) + offset * approach,
        rotation=tip_rotation(tangent, approach),
        flow_m3_per_s=np.full(samples, cfg.nozzle.flow_m3_per_s),
    )
