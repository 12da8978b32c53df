"""A mesh of boxes over a substrate: all cells whose middles lie above it and below a lid that follows it.

Slopes become steps of a cell. A mesh that follows them would be skewed, and there the solvers' explicit part
of the viscous stress diverges in the first steps: sealant is some hundred times too viscous for it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import require
from seal_gym.core.frames import Array
from seal_gym.sealant.laydown.substrates import Substrate

Indices = NDArray[np.integer[Any]]
Near = Callable[[Array, Array], NDArray[np.bool_]]
PATCHES = ("top", "sides", "substrate")
_ABOVE, _ASIDE = -2, -3


@dataclass(frozen=True)
class Mesh:
    """A mesh, its faces in the order that OpenFOAM asks for.

    Attributes:
        origin: Lowest corner, shape (3,) [m].
        cell_m: Edge of a cell [m].
        cell_ids: Number of each cell, -1 where the part is, -2 above the lid, -3 aside, shape (nx, ny, nz).
        points: Shape (p, 3) [m].
        faces: Their points, shape (f, 4): internal faces, then those of each patch.
        owner: Shape (f,).
        neighbour: Of internal faces.
        patches: First face and number of faces of each of ``PATCHES``.
        substrate: What the cells stand on.
        lid_m: Height of the lid over the smooth part [m].
    """

    origin: Array
    cell_m: float
    cell_ids: Indices
    points: Array
    faces: Indices
    owner: Indices
    neighbour: Indices
    patches: dict[str, tuple[int, int]]
    substrate: Substrate
    lid_m: float

    def faces_of(self, patch: str) -> tuple[Array, Array]:
        """The faces of a patch.

        Args:
            patch: Of ``PATCHES``.

        Returns:
            Centres (f, 3) [m] and area vectors (f, 3) [m2], out of the mesh.
        """
        first, count = self.patches[patch]
        corners = self.points[self.faces[first : first + count]]
        area = 0.5 * np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
        return corners.mean(1), area

    def lid_cells(self) -> Indices:
        """The cells under the lid.

        Returns:
            Shape (n,).
        """
        first, count = self.patches["top"]
        return np.asarray(self.owner[first : first + count])

    def cells_at(self, points: Array) -> Indices:
        """Which cells hold some points.

        Args:
            points: Shape (..., 3) [m].

        Returns:
            Shape (...), -1 in the part and outside.
        """
        index = np.floor((points - self.origin) / self.cell_m).astype(int)
        shape = np.array(self.cell_ids.shape)
        inside = ((index >= 0) & (index < shape)).all(-1)
        i, j, k = np.moveaxis(np.clip(index, 0, shape - 1), -1, 0)
        return np.where(inside, np.maximum(self.cell_ids[i, j, k], -1), -1)


def _all_faces(cell_ids: Indices) -> tuple[Indices, Indices, Indices, Indices]:
    """Every face of the box's lattice.

    Args:
        cell_ids: See ``Mesh``.

    Returns:
        Corner points (f, 4) as numbers in the lattice, anticlockwise seen from the far side; the cells before
        and behind (f,), -1 for none; the patch that a face is on if it is on one (f,).
    """
    lattice = [n + 1 for n in cell_ids.shape]
    quads, lows, highs, kinds = [], [], [], []
    point = np.arange(np.prod(lattice)).reshape(lattice)
    for axis in range(3):
        pad = [(0, 0)] * 3
        pad[axis] = (1, 1)
        padded = np.pad(cell_ids, pad, constant_values=-1)
        below = np.delete(padded, -1, axis)
        above = np.delete(padded, 0, axis)
        b, c = [(a + axis) % 3 for a in (1, 2)]
        corner = []
        for db, dc in ((0, 0), (1, 0), (1, 1), (0, 1)):  # seen from the far side: anticlockwise
            cut: list[slice] = [slice(None)] * 3
            cut[b] = slice(db, point.shape[b] - 1 + db)
            cut[c] = slice(dc, point.shape[c] - 1 + dc)
            corner.append(point[tuple(cut)])
        wall = np.full(below.shape, 2)  # substrate ...
        ends: list[slice] = [slice(None)] * 3
        for end in (0, -1):  # ... except at the ends of the box
            ends[axis] = slice(end, None) if end else slice(0, 1)
            if axis < 2:
                wall[tuple(ends)] = 1
            elif end:
                wall[tuple(ends)] = 0
        wall[(below == _ABOVE) | (above == _ABOVE)] = 0
        wall[(below == _ASIDE) | (above == _ASIDE)] = 1
        quads.append(np.stack(corner, -1).reshape(-1, 4))
        lows.append(below.reshape(-1))
        highs.append(above.reshape(-1))
        kinds.append(wall.reshape(-1))
    quad, low, high, kind = (np.concatenate(parts) for parts in (quads, lows, highs, kinds))
    return quad, low, high, kind


def build(
    substrate: Substrate, low: Array, high: Array, clearance_m: float, cell_m: float, near: Near | None = None
) -> Mesh:
    """Meshes the room above a substrate.

    Args:
        substrate: The part.
        low: Smallest (x, y) to cover, shape (2,) [m].
        high: Largest.
        clearance_m: Height above the carved part's highest place [m].
        cell_m: Edge of a cell [m].
        near: Which columns of cells are wanted, by (x, y) of their middles [m]; all by default.

    Returns:
        The mesh; its edges are whole multiples of ``cell_m``.

    Raises:
        ConfigError: If the box is empty.
    """
    require(bool((np.asarray(high) > low).all()), f"low = {low}, high = {high}: high must be larger")
    i0, i1 = np.floor(np.asarray(low) / cell_m + 1e-9), np.ceil(np.asarray(high) / cell_m - 1e-9)
    nx, ny = (i1 - i0).astype(int)
    x, y = ((i0[a] + np.arange(n + 1)) * cell_m for a, n in enumerate((nx, ny)))
    centres = np.meshgrid(x[:-1] + 0.5 * cell_m, y[:-1] + 0.5 * cell_m, indexing="ij")
    surface, smooth = substrate.height(*centres), substrate.smooth(*centres)
    lid_m = cell_m * np.ceil((substrate.carved(*centres).max() + clearance_m) / cell_m - 1e-9)
    k0 = np.floor(surface.min() / cell_m + 1e-9)
    nz = int(np.ceil((lid_m + smooth.max()) / cell_m - 1e-9) - k0)
    origin = np.array([x[0], y[0], k0 * cell_m])
    middle = origin[2] + (np.arange(nz) + 0.5) * cell_m
    above = middle > (lid_m + smooth)[:, :, None]
    aside = np.zeros(surface.shape, np.bool_) if near is None else ~near(*centres)
    kept = (middle > surface[:, :, None]) & ~above & ~aside[:, :, None]
    cell_ids = np.where(aside[:, :, None], _ASIDE, np.where(above, _ABOVE, -1))
    cell_ids[kept] = np.arange(kept.sum())

    gx, gy, gz = np.meshgrid(x, y, origin[2] + np.arange(nz + 1) * cell_m, indexing="ij")
    points = np.stack((gx, gy, gz), -1).reshape(-1, 3)
    quad, a, b_, kind = _all_faces(cell_ids)
    inner = (a >= 0) & (b_ >= 0)
    order = np.flatnonzero(inner)[np.lexsort((b_[inner], a[inner]))]
    faces, owner, neighbour = [quad[order]], [a[order]], b_[order]
    patches = {}
    start = len(order)
    for number, name in enumerate(PATCHES):
        chosen = np.flatnonzero(((a >= 0) != (b_ >= 0)) & (kind == number))
        chosen = chosen[np.argsort(np.maximum(a[chosen], b_[chosen]), kind="stable")]
        flip = a[chosen] < 0
        faces.append(np.where(flip[:, None], quad[chosen][:, ::-1], quad[chosen]))
        owner.append(np.maximum(a[chosen], b_[chosen]))
        patches[name] = (start, len(chosen))
        start += len(chosen)
    face = np.concatenate(faces)
    used, compact = np.unique(face, return_inverse=True)
    return Mesh(
        origin,
        cell_m,
        cell_ids,
        points[used],
        compact.reshape(face.shape),
        np.concatenate(owner),
        neighbour,
        patches,
        substrate,
        float(lid_m),
    )
