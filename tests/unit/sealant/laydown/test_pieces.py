"""Pieces of long simulations, and thicknesses of synthetic volume fractions, by hand."""

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from seal_gym.core.errors import SealGymError
from seal_gym.sealant.laydown import jet
from seal_gym.sealant.laydown import mesh as meshes
from seal_gym.sealant.laydown.config import LaydownCfg, LaydownError, TcpPath
from seal_gym.sealant.laydown.pieces import between, split, thickness_m, trace
from seal_gym.sealant.laydown.substrates import SUBSTRATES, Substrate
from tests.unit.sealant.laydown.cases import FLOW_M3S, straight


def bent(leg_m=0.06, speed_mps=0.3, height_m=0.03):
    """Along y, then along x."""
    y = np.linspace(0.0, leg_m, 31)
    corner = np.column_stack((np.zeros(31), y, np.full(31, height_m)))
    after = np.column_stack((y[1:], np.full(30, leg_m), np.full(30, height_m)))
    places = np.vstack((corner, after))
    turn = np.tile(np.eye(3), (61, 1, 1))
    right = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # x to -y, y to x
    turn[31:] = right
    path = TcpPath(
        times_s=np.arange(61) * leg_m / 30 / speed_mps,
        positions=places,
        rotations=turn,
        flows_m3s=np.full(61, FLOW_M3S),
    )
    return LaydownCfg(path=path)


def test_the_trace_is_where_the_nozzle_points_at():
    turn = Rotation.from_euler("X", 20.0, degrees=True).as_matrix()
    arcs, places = trace(straight(rotation=turn, gravity_mps2=(0.0, 9.81, 0.0)))
    ahead = 0.03 * np.tan(np.radians(20.0))
    np.testing.assert_allclose(places, [[0.0, ahead, 0.0], [0.0, 0.03 + ahead, 0.0]], atol=1e-8)
    np.testing.assert_allclose(arcs, [0.0, 0.03], atol=1e-8)


def test_a_part_of_a_path_is_the_path():
    path = bent().path
    part = between(path, 0.05, 0.31)
    assert part.times_s[0] == 0.0
    assert part.times_s[-1] == pytest.approx(0.26)
    for t in (0.0, 0.017, 0.1, 0.26):
        for mine, whole in zip(part.at(np.array([t])), path.at(np.array([t + 0.05])), strict=True):
            np.testing.assert_allclose(mine, whole, atol=1e-12)
    assert part.volume_m3() == pytest.approx(0.26 * FLOW_M3S)


def test_pieces_fill_the_path_and_overlap():
    cfg = bent()
    pieces = split(cfg, 40e-3, 10e-3)
    assert len(pieces) == 3
    assert pieces[0].begin_s == 0.0
    assert pieces[-1].end_s == pytest.approx(cfg.path.times_s[-1])
    for before, after in itertools.pairwise(pieces):
        assert before.end_s == after.begin_s
    # 10 mm at 0.3 m/s to either side, none beyond the path's ends
    own = [piece.end_s - piece.begin_s for piece in pieces]
    longer = [piece.cfg.path.times_s[-1] - mine for piece, mine in zip(pieces, own, strict=True)]
    np.testing.assert_allclose(longer, np.array([1, 2, 1]) * 10e-3 / 0.3, rtol=0.05)


def test_no_cut_is_in_a_corner():
    cfg = bent()  # its corner is half way: where the cut would be
    first, second = split(cfg, 60e-3, 10e-3)
    arcs, _ = trace(cfg)
    assert abs(np.interp(first.end_s, cfg.path.times_s, arcs) - 0.06) > 9e-3
    assert second.begin_s == first.end_s


def test_a_short_path_is_one_piece():
    (piece,) = split(straight(), 60e-3, 12e-3)
    assert piece.cfg.path.times_s[-1] == pytest.approx(0.1)
    with pytest.raises(SealGymError, match="must be larger than 2 overlap_m"):
        split(straight(), 20e-3, 12e-3)


def test_a_jet_past_the_part_is_refused():
    up = np.diag([1.0, -1.0, -1.0])
    with pytest.raises(LaydownError, match="points past the substrate"):
        split(straight(rotation=up, gravity_mps2=(0.0, 0.0, 0.0)), 60e-3, 12e-3)


def slab(part, full):
    """A mesh over a part and a field that is full where a function of the cells' middles says so."""
    mesh = meshes.build(part, np.array([-12e-3, -12e-3]), np.array([12e-3, 12e-3]), 10e-3, 1e-3)
    index = np.argwhere(mesh.cell_ids >= 0)
    middle = mesh.origin + (index + 0.5) * mesh.cell_m
    return mesh, np.asarray(full(*middle.T), dtype=float)


def test_a_layer_is_as_thick_as_it_is_high():
    mesh, fractions = slab(
        SUBSTRATES["plane"], lambda x, y, z: np.where(z < 3e-3, 0.5, 0.0) + (z < 1e-3) * 0.5
    )
    feet = np.array([[0.2e-3, 0.3e-3, 0.0], [5.5e-3, -7.5e-3, 0.0]])
    up = np.tile([0.0, 0.0, 1.0], (2, 1))
    np.testing.assert_allclose(thickness_m(mesh, fractions, feet, up, 8e-3), 2e-3, rtol=1e-12)
    slanted = np.tile([np.sqrt(0.5), 0.0, np.sqrt(0.5)], (1, 1))
    expected = 2e-3 * np.sqrt(2.0)
    assert thickness_m(mesh, fractions, feet[:1], slanted, 8e-3)[0] == pytest.approx(expected, abs=0.25e-3)


def test_a_layer_on_a_wall_is_seen_along_the_walls_normal():
    wall = Substrate(carved=lambda x, y: np.where(y > 0.0, 8e-3, 0.0) + 0.0 * x)
    mesh, fractions = slab(wall, lambda x, y, z: (y > -2e-3) & (z < 8e-3))
    feet, away = np.array([[1.5e-3, 0.0, 4.5e-3]]), np.array([[0.0, -1.0, 0.0]])
    np.testing.assert_allclose(thickness_m(mesh, fractions, feet, away, 6e-3), 2e-3, rtol=1e-12)


def test_a_part_of_ones_own_is_laid_on():
    pit = Substrate(carved=lambda x, y: -0.5 + 0.0 * x)
    cfg = LaydownCfg(path=straight().path, substrate=pit)
    assert cfg.part is pit
    _, _, place = jet.landings(cfg)
    np.testing.assert_allclose(place[:, 2], -0.5, atol=1e-6)
    with pytest.raises(SealGymError, match="must be a Substrate or one of"):
        LaydownCfg(path=straight().path, substrate="pit")
