"""The scene: parts collide where they look to be, concave meshes too, and move with their body."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from seal_gym.core.cell import load_cell
from seal_gym.sim.arm import ArmBatch
from seal_gym.sim.reach import check_reach
from seal_gym.sim.scene import GROUP_COLLISION, GROUP_PART, Scene, build_scene, cached_scene
from seal_gym.workpieces import catalogue
from seal_gym.workpieces.workpiece import Workpiece

Array = NDArray[np.float64]
R = np.sqrt(0.5)
SEAM, APPROACH = [[-0.15, 0.0, 0.0], [0.15, 0.0, 0.0]], [0.0, -R, R]
# A plate 400 x 98 x 20 mm with a wall 8 mm thick and 30 mm high at its edge, in one piece: corners (y, z) in
# mm, counter-clockwise seen from +x, from the fillet, which sees all the others.
PROFILE = [(0, 0), (-90, 0), (-90, -20), (8, -20), (8, 30), (0, 30)]


def l_part() -> Array:
    """Triangles of the L, shape (n, 3, 3), mm."""
    low, high = (np.array([(x, y, z) for y, z in PROFILE], float) for x in (-200, 200))
    k = np.arange(6)
    after, fan = (k + 1) % 6, np.array([[0, j, j + 1] for j in range(1, 5)])
    sides = np.stack((low[k], low[after], high[after]), 1), np.stack((low[k], high[after], high[k]), 1)
    return np.concatenate((high[fan], low[fan[:, ::-1]], *sides))


def write_stl(path: Path) -> Path:
    rows = np.zeros(len(l_part()), [("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")])
    rows["v"] = l_part()
    path.write_bytes(b" " * 80 + np.uint32(len(rows)).tobytes() + rows.tobytes())
    return path


def write_obj(path: Path) -> Path:
    corners = l_part().reshape(-1, 3)
    lines = ["v {} {} {}".format(*corner) for corner in corners]
    lines += [f"f {k + 1} {k + 2} {k + 3}" for k in range(0, len(corners), 3)]
    path.write_text("\n".join(lines), encoding="ascii")
    return path


@pytest.fixture(params=["stl", "obj"])
def l_scene(request: pytest.FixtureRequest, tmp_path: Path) -> Scene:
    path = tmp_path / f"L.{request.param}"
    (write_stl if request.param == "stl" else write_obj)(path)
    part = Workpiece.from_mesh(path, SEAM, APPROACH, scale=1e-3, pose=(0.35, 0.0, -0.05, np.pi / 2))
    return build_scene(part, load_cell())


def test_concave_mesh_leaves_the_fillet_free_and_stops_the_gun(l_scene: Scene) -> None:
    part = l_scene.workpiece
    q = check_reach(l_scene, 0.02, np.deg2rad(15.0)).start_q
    # The nozzle is 3 mm from the seam and 1.06 mm from wall and plate; the part moves towards it.
    cases = {
        (0.0, 0.0, 0.0): False,
        (0.0, -0.9e-3, 0.0): False,
        (0.0, -1.3e-3, 0.0): True,
        (0.0, 0.0, 0.9e-3): False,
        (0.0, 0.0, 1.3e-3): True,
        (0.0, 5e-3, -5e-3): False,
        # Deep inside the wall, the plate and the fillet's corner.
        (0.0, -6e-3, 0.0): True,
        (0.0, 0.0, 8e-3): True,
        (0.0, -5e-3, 5e-3): True,
    }
    arm = ArmBatch(l_scene, len(cases), 2)
    for i, shift in enumerate(cases):
        pose = part.pose.copy()
        pose[:3, 3] += pose[:3, :3] @ shift
        arm.reset(i, q, pose)
    touched = arm.step(np.zeros((len(cases), 6)))
    assert dict(zip(cases, touched.tolist(), strict=True)) == cases
    names = {name for pair in arm.contacts(2) for name in pair}
    assert "gun/col_nozzle" in names
    assert any(name.startswith("col_part_") for name in names)


def test_mesh_part_costs_a_step_little(l_scene: Scene) -> None:
    pieces = [g for g in range(l_scene.model.ngeom) if l_scene.model.geom(g).name.startswith("col_part_")]
    assert 2 <= len(pieces) <= 6
    assert l_scene.model.nflex == 0


@pytest.mark.parametrize("name", catalogue.NAMES)
def test_part_is_a_mocap_body_that_is_seen_and_felt(name: str) -> None:
    model = build_scene(catalogue.get(name), load_cell()).model
    part = model.body("part")
    assert int(part.mocapid[0]) == 0
    geoms = [model.geom(g) for g in range(model.ngeom) if model.geom_bodyid[g] == part.id]
    seen = [g for g in geoms if g.name.startswith("look_")]
    felt = [g for g in geoms if g.name.startswith("col_part_")]
    assert len(geoms) == len(seen) + len(felt)
    assert {int(g.group[0]) for g in seen} == {GROUP_PART}
    assert {int(g.group[0]) for g in felt} == {GROUP_COLLISION}
    assert all((g.contype[0], g.conaffinity[0]) == (0, 0) for g in seen)
    assert all((g.contype[0], g.conaffinity[0]) == (2, 1) for g in felt)


@pytest.mark.parametrize("name", catalogue.NAMES)
def test_picture_shows_the_surface_where_it_is(name: str) -> None:
    part = catalogue.get(name)
    model = build_scene(part, load_cell()).model
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    corners = []
    for g in range(model.ngeom):
        if not model.geom(g).name.startswith("look_"):
            continue
        mesh = int(model.geom_dataid[g])
        first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
        points = model.mesh_vert[first : first + count].astype(float)
        corners.append(points @ data.geom_xmat[g].reshape(3, 3).T + data.geom_xpos[g])
    seen = np.concatenate(corners)
    expected = part.surface.triangles.reshape(-1, 3) @ part.pose[:3, :3].T + part.pose[:3, 3]
    np.testing.assert_allclose(seen.min(axis=0), expected.min(axis=0), atol=1e-6)
    np.testing.assert_allclose(seen.max(axis=0), expected.max(axis=0), atol=1e-6)


def test_scene_is_compiled_once_for_a_part_and_cell() -> None:
    part, cell = catalogue.flat(), load_cell()
    assert cached_scene(part, cell) is cached_scene(part, cell)
