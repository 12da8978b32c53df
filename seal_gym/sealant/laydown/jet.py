"""The free jet from nozzle to substrate: parcels that fly ballistically, and what they bring to each face.

The tip may move, turn and change its flow in any way. Each parcel keeps the volume it was given, so that the
inflow's integral over time is the nozzle's to rounding; a jet that the tip stretches or compresses on its way
arrives stretched or compressed.

A fan's sheet is some 0.2 mm thick where it lands, far thinner than an affordable cell: let in through the top
of the mesh it has to be made thicker and slower, and then sticks to the lid and never comes down. The real
one loses its momentum within about its own thickness (Reynolds number of the impact about 2). Its fluid is
therefore given to the substrate's faces where it comes down, without momentum, and pushes up what is there.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from seal_gym.core.frames import Array
from seal_gym.sealant.laydown.config import LaydownCfg, LaydownError
from seal_gym.sealant.laydown.mesh import Mesh
from seal_gym.sealant.laydown.substrates import Height

_PER_SAMPLE = 4  # emissions in a sample of the inlet
_RAYS = 120  # across a fan, or over a round jet's section
_LAYERS = 5  # through a fan's thickness
_MARCH = 128
_BISECT = 30


@dataclass(frozen=True)
class Parcels:
    """Small volumes of the jet as they leave the nozzle.

    Attributes:
        times_s: Of emission, shape (n,).
        positions: Shape (n, 3) [m].
        velocities: In the substrate's frame, shape (n, 3) [m/s].
        volumes_m3: Shape (n,).
        across: Unit vector across a fan's sheet, zero for a round jet, shape (n, 3).
    """

    times_s: Array
    positions: Array
    velocities: Array
    volumes_m3: Array
    across: Array


def _disc(radius_m: float) -> Array:
    """Points that cover a disc evenly, shape (n, 2)."""
    k = np.arange(_RAYS) + 0.5
    r, angle = radius_m * np.sqrt(k / _RAYS), k * math.pi * (3.0 - math.sqrt(5.0))
    return np.stack((r * np.cos(angle), r * np.sin(angle)), -1)


def emit(cfg: LaydownCfg) -> Parcels:
    """Cuts the jet into parcels.

    Args:
        cfg: The simulation.

    Returns:
        Parcels whose volumes sum to the path's.
    """
    path, nozzle = cfg.path, cfg.nozzle
    knots = np.union1d(np.arange(0.0, path.times_s[-1], cfg.grid.inlet_dt_s / _PER_SAMPLE), path.times_s)
    knots = knots[np.append(True, np.diff(knots) > 1e-12)]
    middle, dt = 0.5 * (knots[1:] + knots[:-1]), np.diff(knots)
    tip, rotation, flow = path.at(middle)  # linear flow: the midpoint rule is exact
    volumes = np.repeat((flow * dt / _RAYS)[:, None], _RAYS, 1)
    if nozzle.kind == "fan":
        angle = nozzle.fan_angle_rad * ((np.arange(_RAYS) + 0.5) / _RAYS - 0.5)
        rays = np.stack((np.sin(angle), np.zeros(_RAYS), -np.cos(angle)), -1)
        start = np.repeat(tip[:, None], _RAYS, 1)
        across = np.repeat(rotation[:, None, :, 1], _RAYS, 1)
    else:
        rays = np.repeat([[0.0, 0.0, -1.0]], _RAYS, 0)
        disc = _disc(nozzle.radius_m)
        start = tip[:, None] + np.einsum("tij,rj->tri", rotation[:, :, :2], disc)
        across = np.zeros((len(middle), _RAYS, 3))
    velocity = nozzle.jet_speed_mps * np.einsum("tij,rj->tri", rotation, rays)
    velocity = velocity + path.velocities(middle)[:, None]
    times = np.repeat(middle[:, None], _RAYS, 1)
    flat = (times.reshape(-1), start.reshape(-1, 3), velocity.reshape(-1, 3), volumes.reshape(-1))
    return Parcels(*flat, across.reshape(-1, 3))


def fly(
    start: Array, velocity: Array, gravity: Array, surface: Height, *, reach_s: float
) -> tuple[Array, Array, Array]:
    """Where ballistic parcels first meet a height field.

    Args:
        start: Shape (n, 3) [m].
        velocity: Shape (n, 3) [m/s].
        gravity: Shape (3,) [m/s2].
        surface: z [m] of (x, y) [m].
        reach_s: Longest flight [s].

    Returns:
        Flight times (n,) [s], places (n, 3) [m], velocities (n, 3) [m/s]; NaN for those that do not meet it.
    """

    def place(t: Array) -> Array:
        return np.asarray(start + velocity * t[:, None] + 0.5 * gravity * (t**2)[:, None])

    def above(t: Array) -> Array:
        p = place(t)
        return np.asarray(p[:, 2] - surface(p[:, 0], p[:, 1]))

    n = len(start)
    low, high, found = np.zeros(n), np.full(n, np.nan), np.zeros(n, dtype=bool)
    started = above(low) > 0
    for k in range(1, _MARCH + 1):
        t = np.full(n, reach_s * k / _MARCH)
        hit = ~found & (above(t) <= 0)
        low[hit], high[hit] = t[hit] - reach_s / _MARCH, t[hit]
        found |= hit
        if found.all():
            break
    for _ in range(_BISECT):
        middle = 0.5 * (low + high)
        up = above(middle) > 0
        low, high = np.where(up, middle, low), np.where(up, high, middle)
    t = np.where(found & started, 0.5 * (low + high), np.nan)
    return t, place(t), np.asarray(velocity + gravity * t[:, None])


def _reach_s(cfg: LaydownCfg) -> float:
    """A flight time that brings any useful parcel down: three times the tip's height at the jet's speed."""
    x, y, z = cfg.path.positions.T
    height = float(np.max(z - np.minimum(cfg.part.height(x, y), 0.0))) + 0.03
    return 3.0 * height / cfg.nozzle.jet_speed_mps


def landings(cfg: LaydownCfg) -> tuple[Parcels, Array, Array]:
    """Where the jet comes down.

    Args:
        cfg: The simulation.

    Returns:
        The parcels, their times of arrival (n,) [s] and places (n, 3) [m].

    Raises:
        LaydownError: If a part of the jet misses the substrate.
    """
    jet = emit(cfg)
    gravity = np.asarray(cfg.gravity_mps2)
    t, place, _ = fly(jet.positions, jet.velocities, gravity, cfg.part.height, reach_s=_reach_s(cfg))
    if np.isnan(t).any():
        part = f"{np.isnan(t).mean():.1%} of the jet"
        raise LaydownError(f"{part} does not come down on the substrate: tilt or drag less")
    return jet, jet.times_s + t, place


@dataclass(frozen=True)
class Inflow:
    """What comes in through the faces of a patch, linear between samples.

    Attributes:
        times_s: Shape (s,), evenly spaced from 0; nothing flows at the first and the last.
        flows_m3s: Through each face at each sample, shape (s, f).
        velocities: On each face, as fast as the flow asks of a face that it fills, shape (s, f, 3) [m/s].
    """

    times_s: Array
    flows_m3s: Array
    velocities: Array

    def volume_m3(self) -> float:
        """The volume that comes in.

        Returns:
            The integral of the flow [m3].
        """
        return float(np.trapezoid(self.flows_m3s.sum(1), self.times_s))


def inflow(cfg: LaydownCfg, mesh: Mesh) -> Inflow:
    """The jet on the faces where it comes in.

    Args:
        cfg: The simulation.
        mesh: Its mesh.

    Returns:
        Samples from 0 to after the last parcel, along the substrate's normal; their volume is the path's to
        rounding.

    Raises:
        LaydownError: If a part of the jet misses the substrate.
    """
    jet, arrival, place = landings(cfg)
    centres, areas = mesh.faces_of("substrate")
    dt, faces = cfg.grid.inlet_dt_s, cKDTree(centres)
    index, part = np.divmod(arrival / dt + 1.0, 1.0)
    shape = int(index.max()) + 3, faces.n
    size = shape[0] * shape[1]
    flows = np.zeros(size)
    for layer in (np.arange(_LAYERS) + 0.5) / _LAYERS - 0.5:
        _, face = faces.query(place + layer * cfg.nozzle.strip_m * jet.across)
        for sample, weight in ((index, 1.0 - part), (index + 1, part)):
            at = sample.astype(int) * faces.n + face
            amount = jet.volumes_m3 / _LAYERS * weight / dt
            flows += np.bincount(at, weights=amount, minlength=size)
    flow = flows.reshape(shape)
    per_area = flow / (areas**2).sum(-1)  # so that velocity . area = -flow
    return Inflow(np.arange(shape[0], dtype=float) * dt, flow, -areas * per_area[:, :, None])
