"""Runs a laydown simulation and checks what came of it."""

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import ndimage

from seal_gym.core.frames import Array
from seal_gym.sealant.laydown import case, foam, jet
from seal_gym.sealant.laydown.config import LaydownCfg
from seal_gym.sealant.laydown.mesh import Mesh

_PILE_M = 3e-3
_ROOM_M, _ROOM_PEAKS, _MOST_ROOM_M = 3e-3, 1.6, 5e-2


@dataclass(frozen=True)
class Laydown:
    """A laid bead.

    Attributes:
        mesh: The mesh.
        fractions: Volume fraction of sealant by cell, shape (cells,).
        commanded_m3: What the nozzle gave.
        volume_m3: What lies in the mesh.
        lid_fraction: Largest volume fraction in the mesh's highest layer; at 1 the bead is cut off there.
        cpu_s: Processor time of the solver.
    """

    mesh: Mesh
    fractions: Array
    commanded_m3: float
    volume_m3: float
    lid_fraction: float
    cpu_s: float

    @property
    def volume_error(self) -> float:
        """Relative error of the volume."""
        return self.volume_m3 / self.commanded_m3 - 1.0


def expected_peak_m(cfg: LaydownCfg) -> float:
    """How high the fluid would stand if it stayed where it lands.

    Args:
        cfg: The simulation.

    Returns:
        The largest mean height over 3 x 3 mm [m].
    """
    jets, _, place = jet.landings(cfg)
    cell = 1e-3
    low = np.floor(place[:, :2].min(0) / cell) - 3
    i, j = (np.floor(place[:, :2] / cell) - low).astype(int).T
    pile = np.zeros((i.max() + 4, j.max() + 4))
    np.add.at(pile, (i, j), jets.volumes_m3 / cell**2)
    return float(ndimage.uniform_filter(pile, round(_PILE_M / cell)).max())


def with_room(cfg: LaydownCfg) -> LaydownCfg:
    """Makes a simulation's mesh high enough for its bead.

    Args:
        cfg: The simulation.

    Returns:
        The same with a clearance of at least 1.6 times the expected peak and 3 mm, at most 5 cm.
    """
    room = min(_ROOM_M + _ROOM_PEAKS * expected_peak_m(cfg), _MOST_ROOM_M)
    return replace(cfg, grid=replace(cfg.grid, clearance_m=max(cfg.grid.clearance_m, room)))


def simulate(cfg: LaydownCfg, folder: Path, *, limit_s: float = 3600.0, keep: bool = False) -> Laydown:
    """Lays a bead with OpenFOAM.

    Args:
        cfg: The simulation.
        folder: For the case; what it held is deleted.
        limit_s: Wall-clock time after which the solver is stopped [s].
        keep: Whether to keep the case folder.

    Returns:
        The bead at rest.

    Raises:
        LaydownError: If OpenFOAM is not installed or fails, or the jet misses the substrate.
    """
    foam.find(cfg.grid.solver)
    shutil.rmtree(folder, ignore_errors=True)
    mesh, _, end_s = case.write(cfg, folder)
    cpu_s = foam.run(cfg.grid.solver, folder, limit_s=limit_s)
    cells = int(mesh.cell_ids.max()) + 1
    fractions = foam.read_field(folder / f"{end_s:.9g}" / f"alpha.{case.FLUID}", cells)
    if not keep:
        shutil.rmtree(folder)
    return Laydown(
        mesh,
        fractions,
        cfg.path.volume_m3(),
        float(fractions.sum() * mesh.cell_m**3),
        float(fractions[mesh.lid_cells()].max()),
        cpu_s,
    )
