"""The bead cases as the reference takes them: height fields carved out of its mesh, and tip paths."""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from experiments.bead_laydown import centre_line
from seal_gym.core.frames import Array
from seal_gym.planning.bead_cases import BeadCase
from seal_gym.planning.bead_curves import Edges
from seal_gym.planning.bead_geometry import BeadPath
from seal_gym.sealant.laydown.config import GridCfg, LaydownCfg, NozzleCfg, TcpPath
from seal_gym.sealant.laydown.run import with_room
from seal_gym.sealant.laydown.substrates import SUBSTRATES, Height, Substrate

GAP_DEPTH_M = 4e-3  # as the substrate "gap": deep enough for what falls into it
WALL_M = 30e-3
_BEYOND_M = 20e-3  # by which profiles go straight on at their ends
_OVER_STEPS_M = 10e-3  # mesh above the highest place where walls make ``with_room`` see heaps


def _gap(edges: Edges, width_m: float) -> Height:
    middle = centre_line(edges)
    line = cKDTree(middle(np.linspace(0.0, middle.length_m, round(middle.length_m / 5e-5)))[:, :2])

    def height(x: Array, y: Array) -> Array:
        feet = np.stack(np.broadcast_arrays(x, y), axis=-1)
        away, _ = line.query(feet, distance_upper_bound=width_m / 2)
        return np.where(np.isfinite(away), -GAP_DEPTH_M, 0.0)

    return height


def _profile(edges: Edges) -> Height:
    """An upright profile that nowhere comes back in x."""
    curve = centre_line(edges)
    s = np.linspace(0.0, curve.length_m, round(curve.length_m / 1e-4) + 1)
    first, last = (curve.tangent(np.array([end]))[0] for end in (0.0, curve.length_m))
    points = np.vstack((curve(s[:1]) - _BEYOND_M * first, curve(s), curve(s[-1:]) + _BEYOND_M * last))
    x_m = np.maximum.accumulate(points[:, 0]) + 1e-12 * np.arange(len(points))
    return lambda x, y: np.interp(x, x_m, points[:, 2]) + 0.0 * y


def substrate_of(case: BeadCase, edges: Edges) -> Substrate:
    """A case's surface for the reference, in the case's frame.

    Planar cases: the plane, with a slot of ``GAP_DEPTH_M`` as the half circle's gap. Seam in a corner: floor
    and a wall of ``WALL_M``. Over a corner and stairs: the profile between the edges, straight across; where
    it slants the mesh makes a flight of single cells of it.

    Args:
        case: The case.
        edges: Its edges.

    Returns:
        The substrate; all of it is carved, so that the mesh's cells are cubes.
    """
    if case.name in ("over_corner", "stairs"):
        return Substrate(carved=_profile(edges))
    if case.name == "corner_seam":
        return Substrate(carved=lambda x, y: np.where(y > 0.0, WALL_M, 0.0) + 0.0 * x)
    return Substrate(carved=_gap(edges, case.gap_m)) if case.gap_m > 0.0 else SUBSTRATES["plane"]


def tcp_path(path: BeadPath) -> TcpPath:
    """A bead path as the reference takes it.

    Args:
        path: The path.

    Returns:
        The same from time 0: both have the tip's x to the right of travel and z back along the nozzle.
    """
    return TcpPath(
        times_s=path.time_s - path.time_s[0],
        positions=path.position_m,
        rotations=path.rotation,
        flows_m3s=path.flow_m3_per_s,
    )


def simulation(substrate: Substrate, path: BeadPath, fan_angle_rad: float, grid: GridCfg) -> LaydownCfg:
    """The whole of a path as one simulation of the reference.

    Args:
        substrate: The case's surface.
        path: In the case's frame.
        fan_angle_rad: theta [rad].
        grid: Mesh and time step.

    Returns:
        The simulation; gravity is along the case's -z.
    """
    nozzle = NozzleCfg(fan_angle_rad=fan_angle_rad)
    return LaydownCfg(path=tcp_path(path), substrate=substrate, nozzle=nozzle, grid=grid)


def roomy(case: BeadCase, cfg: LaydownCfg) -> LaydownCfg:
    """Makes a mesh high enough.

    Args:
        case: Of the simulation.
        cfg: The simulation, or a piece of it.

    Returns:
        See ``run.with_room``, which knows where things land from above only; over walls a fixed clearance.
    """
    if case.name in ("corner_seam", "over_corner", "stairs"):
        return replace(cfg, grid=replace(cfg.grid, clearance_m=_OVER_STEPS_M))
    return with_room(cfg)
