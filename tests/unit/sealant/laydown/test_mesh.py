"""The mesh: closed cells of known volume, numbered as OpenFOAM asks."""

import numpy as np
import pytest

from seal_gym.core.errors import ConfigError
from seal_gym.sealant.laydown import mesh as meshes
from seal_gym.sealant.laydown.substrates import SUBSTRATES

CELL = 2e-3


def built(name):
    return meshes.build(SUBSTRATES[name], np.array([-16e-3, -10e-3]), np.array([18e-3, 12e-3]), 8e-3, CELL)


def face_geometry(mesh):
    corners = mesh.points[mesh.faces]
    centre = corners.mean(1)
    area = np.zeros((len(corners), 3))
    for k in range(4):  # four triangles around the middle
        area += 0.5 * np.cross(corners[:, k] - centre, corners[:, (k + 1) % 4] - centre)
    return centre, area


@pytest.mark.parametrize("name", ["plane", "step", "gap", "inner_corner", "wave"])
def test_cells_are_closed_and_of_equal_volume(name):
    mesh = built(name)
    cells = mesh.cell_ids.max() + 1
    centre, area = face_geometry(mesh)
    total, volume = np.zeros((cells, 3)), np.zeros(cells)
    inner = len(mesh.neighbour)
    for ids, sign, part in ((mesh.owner, 1, slice(None)), (mesh.neighbour, -1, slice(0, inner))):
        np.add.at(total, ids, sign * area[part])
        np.add.at(volume, ids, sign * (centre[part] * area[part]).sum(1) / 3)  # Gauss's theorem
    np.testing.assert_allclose(total, 0.0, atol=1e-14)
    np.testing.assert_allclose(volume, CELL**3, rtol=1e-9)
    assert (np.count_nonzero(np.abs(area) > 1e-12, axis=1) == 1).all()  # along an axis: nothing is skewed


@pytest.mark.parametrize("name", ["step", "ridge"])
def test_faces_are_in_openfoams_order(name):
    mesh = built(name)
    inner = len(mesh.neighbour)
    pairs = np.stack((mesh.owner[:inner], mesh.neighbour), -1)
    assert (pairs[:, 0] < pairs[:, 1]).all()
    assert (pairs == np.array(sorted(map(tuple, pairs)))).all()
    first, total = inner, 0
    for patch in meshes.PATCHES:
        assert mesh.patches[patch][0] == first + total
        total += mesh.patches[patch][1]
    assert inner + total == len(mesh.faces)


def test_a_steps_substrate_is_floor_ledge_and_wall():
    mesh = built("step")
    centres, areas = mesh.faces_of("substrate")
    wall = np.abs(areas[:, 0]) > 0
    assert areas[wall, 0].sum() == pytest.approx(4e-3 * 22e-3)  # out of the mesh: to the right
    np.testing.assert_allclose(centres[wall, 0], 0.0, atol=1e-12)
    floor = centres[:, 0] < -1e-6
    np.testing.assert_allclose(centres[floor, 2], 0.0, atol=1e-12)
    assert -areas[:, 2].sum() == pytest.approx(34e-3 * 22e-3)


@pytest.mark.parametrize("name", ["inner_corner", "ridge", "wave"])
def test_cells_fill_the_room_between_a_slope_and_the_lid(name):
    mesh = built(name)
    part = SUBSTRATES[name]
    rng = np.random.default_rng(0)
    x, y = rng.uniform([[-16e-3], [-10e-3]], [[18e-3], [12e-3]], (2, 4000))
    for height, inside in ((CELL + 1e-4, True), (8e-3 - CELL - 1e-4, True), (-CELL - 1e-4, False)):
        # slopes up to 45 deg move a cell's middle by at most a cell
        points = np.stack((x, y, part.height(x, y) + height), -1)
        assert ((mesh.cells_at(points) >= 0) == inside).all(), height
    assert (mesh.cells_at(np.stack((x, y, part.height(x, y) + 8e-3 + 2 * CELL), -1)) == -1).all()
    centres, areas = mesh.faces_of("top")
    lid = mesh.lid_m + part.smooth(*centres[:, :2].T)
    np.testing.assert_allclose(centres[:, 2], lid, atol=1.5 * CELL)
    assert areas[:, 2].sum() == pytest.approx(34e-3 * 22e-3) and areas[:, 2].min() >= 0.0
    assert set(mesh.lid_cells()) <= set(mesh.owner)


def test_a_point_is_found_in_its_cell():
    mesh = built("ridge")
    inner = len(mesh.neighbour)
    centre, _ = face_geometry(mesh)
    cells = mesh.cell_ids.max() + 1
    total, count = np.zeros((cells, 3)), np.zeros(cells)
    for ids, part in ((mesh.owner, slice(None)), (mesh.neighbour, slice(0, inner))):
        np.add.at(total, ids, centre[part])
        np.add.at(count, ids, 1)
    assert (count == 6).all()
    np.testing.assert_array_equal(mesh.cells_at(total / 6), np.arange(cells))
    assert mesh.cells_at(np.array([0.0, 0.0, 5e-3])) == -1  # the ridge is 6 mm high there
    assert mesh.cells_at(np.array([0.0, 0.0, 50e-3])) == -1


def test_an_empty_box_is_refused():
    with pytest.raises(ConfigError, match="high must be larger"):
        meshes.build(SUBSTRATES["plane"], np.zeros(2), np.array([0.01, 0.0]), 1e-2, CELL)
