"""Long beads in pieces that overlap.

A bead at rest no longer moves, so that what the nozzle lays far behind or ahead does not matter. Cells times
time steps grow with the square of a path's length; those of its pieces with the length.
"""

from dataclasses import dataclass, replace

import numpy as np

from seal_gym.core.errors import require
from seal_gym.core.frames import Array, normalise
from seal_gym.sealant.laydown.config import LaydownCfg, LaydownError, TcpPath
from seal_gym.sealant.laydown.jet import fly
from seal_gym.sealant.laydown.mesh import Mesh

_TRACE_M = 1e-3
_REACH_M = 0.3  # no useful jet is longer; at 1 m/s
_SAMPLES = 4  # of a cell's edge, along a column


@dataclass(frozen=True)
class Piece:
    """A piece of a simulation.

    Attributes:
        begin_s: From when on it counts, in the whole path's time [s].
        end_s: Until when.
        cfg: Its simulation, longer by the overlap at either end.
    """

    begin_s: float
    end_s: float
    cfg: LaydownCfg


def trace(cfg: LaydownCfg) -> tuple[Array, Array]:
    """Where the nozzle points at.

    Not where the jet lands: a nozzle that swings over an edge throws that far ahead and back again.

    Args:
        cfg: The simulation.

    Returns:
        Arc lengths (n,) and places (n, 3) at the path's times [m].

    Raises:
        LaydownError: If it points past the substrate.
    """
    path = cfg.path
    _, place, _ = fly(
        path.positions, -path.rotations[:, :, 2], np.zeros(3), cfg.part.height, reach_s=_REACH_M
    )
    if np.isnan(place).any():
        raise LaydownError("the nozzle points past the substrate: tilt or drag less")
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(place, axis=0), axis=1))), place


def between(path: TcpPath, begin_s: float, end_s: float) -> TcpPath:
    """A part of a path.

    Args:
        path: The whole.
        begin_s: Its new time 0 [s].
        end_s: Its end [s].

    Returns:
        The part.
    """
    inner = path.times_s[(path.times_s > begin_s + 1e-9) & (path.times_s < end_s - 1e-9)]
    times = np.concatenate(([begin_s], inner, [end_s]))
    positions, rotations, flows = path.at(times)
    return TcpPath(times_s=times - times[0], positions=positions, rotations=rotations, flows_m3s=flows)


def split(cfg: LaydownCfg, piece_m: float, overlap_m: float) -> list[Piece]:
    """Cuts a simulation into pieces, where its bead is about straight.

    Args:
        cfg: The whole.
        piece_m: About their length on the substrate [m].
        overlap_m: By which each is longer at either end, if there is more path [m].

    Returns:
        Pieces whose own times fill the path's.

    Raises:
        LaydownError: If the nozzle points past the substrate.
    """
    require(
        piece_m > 2 * overlap_m > 0, f"piece_m = {piece_m}: must be larger than 2 overlap_m = {overlap_m}"
    )
    arcs, places = trace(cfg)
    length, times = arcs[-1], cfg.path.times_s
    count = max(round(length / piece_m), 1)

    def at(arc: Array) -> Array:
        return np.stack([np.interp(arc, arcs, p) for p in places.T], -1)

    s = np.arange(min(overlap_m, 0.4 * length), length - min(overlap_m, 0.4 * length), _TRACE_M)
    before, after = at(s) - at(s - overlap_m), at(s + overlap_m) - at(s)
    bend = 1.0 - np.sum(normalise(before) * normalise(after), -1)
    cuts = []
    for k in range(1, count):
        off = np.abs(s - k * length / count)
        cuts.append(float(s[np.argmin(np.where(off < piece_m / 4, bend + 1e-3 * off / piece_m, np.inf))]))
    marks = np.array([0.0, *cuts, length])
    when = np.interp(marks, arcs, times)
    begin = np.interp(marks[:-1] - overlap_m, arcs, times)
    end = np.interp(marks[1:] + overlap_m, arcs, times)
    return [
        Piece(float(when[k]), float(when[k + 1]), replace(cfg, path=between(cfg.path, begin[k], end[k])))
        for k in range(count)
    ]


def thickness_m(mesh: Mesh, fractions: Array, feet: Array, columns: Array, reach_m: float) -> Array:
    """How much sealant stands over places of a substrate.

    Args:
        mesh: The mesh.
        fractions: Volume fraction of sealant by cell, shape (cells,).
        feet: Places on the substrate, shape (n, 3) [m].
        columns: Unit vectors along which to look, shape (n, 3).
        reach_m: How far [m].

    Returns:
        The volume fraction's integral, shape (n,) [m].
    """
    step = mesh.cell_m / _SAMPLES
    padded = np.append(np.clip(fractions, 0.0, 1.0), 0.0)  # what index -1 finds
    total = np.zeros(len(feet))
    for k in range(int(np.ceil(reach_m / step))):
        total += padded[mesh.cells_at(feet + (k + 0.5) * step * columns)]
    return total * step
