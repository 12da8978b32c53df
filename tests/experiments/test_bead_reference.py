"""Bead cases as the reference takes them, and evaluators against closed forms."""

import shutil

import numpy as np
import pytest

from experiments import bead_reference, bead_refine
from experiments.bead_evaluators import Ballistic, FastTier, Sections, evaluator, place_points, scaled
from experiments.bead_laydown import centre_line, places, strip_of
from experiments.bead_substrates import GAP_DEPTH_M, WALL_M, roomy, simulation, substrate_of, tcp_path
from seal_gym.core.errors import ConfigError
from seal_gym.planning import bead_cases
from seal_gym.planning.bead_cases import BeadCase
from seal_gym.planning.bead_config import BeadCfg
from seal_gym.planning.bead_path import naive_path
from seal_gym.sealant.laydown import jet
from seal_gym.sealant.laydown.config import GridCfg

CFG = BeadCfg()
THETA, FLOW = CFG.nozzle.fan_angle_rad, CFG.nozzle.flow_m3_per_s
HALF, LENGTH, DURATION = 7.5e-3, 0.12, 0.4
DISTANCE = HALF / np.tan(THETA / 2)
SPEED = LENGTH / DURATION


def straight_case():
    x = np.array([0.0, LENGTH])
    zero = np.zeros(2)
    return BeadCase(
        name="straight",
        title="straight",
        left=np.column_stack((x, zero + HALF, zero)),
        right=np.column_stack((x, zero - HALF, zero)),
        spread_m=5e-3,
        duration_s=DURATION,
    )


def fan_height(x):
    """Of a fan with even flow by angle that passes straight over a plane: Q / (theta v) dphi/dx."""
    return FLOW / (THETA * SPEED) * DISTANCE / (DISTANCE**2 + x**2)


@pytest.fixture(scope="module")
def straight():
    case = straight_case()
    edges = case.edges()
    strip = strip_of(case, edges)
    return case, edges, strip, places(edges, strip), naive_path(edges, DURATION, CFG, 401)


@pytest.mark.parametrize("name", bead_cases.CASES)
def test_the_strip_lies_on_the_substrate(name):
    case = bead_cases.get(name)
    edges = case.edges()
    strip, part = strip_of(case, edges), substrate_of(case, edges)
    feet = strip.base[strip.there][::7]
    # a little out of the part and a little into it, along the surface's normal
    normal = np.broadcast_to(strip.column[:, None], strip.base.shape)[strip.there][::7]
    if name == "corner_seam":
        wall = np.abs(feet[:, 1]) < 1e-9
        normal = np.where(wall[:, None], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0])
    near = 0.1e-3 * normal
    out, into = feet + near, feet - near
    assert (part.height(out[:, 0], out[:, 1]) < out[:, 2]).all()
    assert (part.height(into[:, 0], into[:, 1]) > into[:, 2]).mean() > 0.99


def test_the_gap_is_a_slot():
    case = bead_cases.get("half_circle")
    part = substrate_of(case, case.edges())
    x, y = np.meshgrid(
        *(np.arange(k) * 0.2e-3 + 0.1e-3 - low for k, low in ((700, 0.06), (800, 0.08))), indexing="ij"
    )
    deep = part.height(x, y)
    assert set(np.unique(deep)) == {-GAP_DEPTH_M, 0.0}
    length = centre_line(case.edges()).length_m
    assert (deep < 0).sum() * 0.2e-3**2 == pytest.approx(2e-3 * length + np.pi * 1e-6, rel=0.02)


@pytest.mark.parametrize("name", ["zig_zag", "stairs", "over_corner"])
def test_a_path_keeps_its_kinematics(name):
    case = bead_cases.get(name)
    path = naive_path(case.edges(), case.duration_s, CFG, 1201)
    tcp = tcp_path(path)
    middle = 0.5 * (path.time_s[1:] + path.time_s[:-1])
    rate = np.diff(path.position_m, axis=0) / np.diff(path.time_s)[:, None]
    np.testing.assert_allclose(tcp.velocities(middle), rate, atol=1e-9)
    ahead = np.sum(tcp.at(middle)[1][:, :, 1] * rate, axis=1)
    moves = np.linalg.norm(rate, axis=1)
    # the naive nozzle travels along its own y axis, back where a hollow corner turns it over
    np.testing.assert_allclose(np.abs(ahead), moves, rtol=2e-3)
    assert tcp.volume_m3() == pytest.approx(FLOW * case.duration_s)


@pytest.mark.parametrize("name", bead_cases.CASES)
def test_all_of_a_naive_jet_lands_near_the_bead(name):
    case = bead_cases.get(name)
    edges = case.edges()
    path = naive_path(edges, case.duration_s, CFG, 201)
    cfg = simulation(substrate_of(case, edges), path, THETA, GridCfg(inlet_dt_s=1e-2))
    _, _, place = jet.landings(cfg)
    points = np.concatenate((case.left, case.right))
    near = ((place > points.min(0) - 8e-3) & (place < points.max(0) + 8e-3)).all(axis=1)
    # A nozzle that swings over the top of the stairs throws a thousandth far over the last tread.
    assert near.mean() > (0.998 if name == "stairs" else 1.0 - 1e-12)
    assert roomy(case, cfg).grid.clearance_m <= 0.02


def test_a_wall_is_higher_than_the_bead():
    part = substrate_of(bead_cases.get("corner_seam"), None)
    assert part.height(np.zeros(2), np.array([-1e-3, 1e-3])).tolist() == [0.0, WALL_M]


def test_a_straight_pass_has_the_fans_closed_form(straight):
    _, _, strip, at, path = straight
    ballistic = Ballistic(
        left=place_points(strip, at.left), right=place_points(strip, at.right), fan_angle_rad=THETA
    )
    fast = FastTier(strip=strip, places=at, fan_angle_rad=THETA)
    away = HALF - 2e-3
    assert np.abs(place_points(strip, at.left)[:, 1] - away).max() < 1e-9
    steady = slice(6, -6)
    for name, evaluate, most in (("ballistic", ballistic, 0.03), ("fast", fast, 0.01)):
        heights = evaluate([path, path])
        assert heights.shape == (2, 2, len(at.along_m))
        np.testing.assert_allclose(heights[0, :, steady], fan_height(away), rtol=most, err_msg=name)


def test_sections_give_heights_at_their_places(straight):
    _, _, strip, at, path = straight
    across = np.arange(40) - 19.5

    def predict(stations):
        """As high as 2 mm and a twentieth of the offset to the right."""
        height = np.tile(2.0 + 0.05 * across, (len(stations.arcs_m), 1))
        rows = np.arange(20)[None, :, None] - 8
        return np.clip(height[:, None] - rows, 0.0, 1.0) * (rows >= 0)

    left, right = place_points(strip, at.left), place_points(strip, at.right)
    heights = Sections(predict=predict, left=left, right=right, fan_angle_rad=THETA)([path])[0]
    away = 1e3 * HALF - 2.0
    np.testing.assert_allclose(heights[0], 1e-3 * (2.0 - 0.05 * away), rtol=0.01)
    np.testing.assert_allclose(heights[1], 1e-3 * (2.0 + 0.05 * away), rtol=0.01)


def test_an_evaluator_is_set_right_where_a_better_one_was_asked(straight):
    case, _, strip, at, path = straight
    simple = evaluator("ballistic", case, strip, at, THETA)
    asked = simple([path])[0]
    right = scaled(simple, path, 1.1 * asked)
    np.testing.assert_allclose(right([path])[0], 1.1 * asked, rtol=1e-9)


def test_what_evaluators_cannot_carry_is_refused():
    case = bead_cases.get("stairs")
    with pytest.raises(ConfigError, match="does not lie in a plane"):
        evaluator("ballistic", case, None, None, THETA)


def test_unevenness_by_hand():
    heights = np.array([[1e-3, 3e-3], [2e-3, 2e-3]])
    row = bead_refine.unevenness(heights, np.array([False, True]))
    assert row["mean_mm"] == pytest.approx(2.0)
    assert row["sd_pct"] == pytest.approx(100 * np.sqrt(0.5) / 2)
    assert row["range_pct"] == pytest.approx(100.0)
    assert row["difference_mm"] == pytest.approx(1.0)
    assert row["corner_mm"] == pytest.approx(1.0)


def test_a_surrogate_needs_its_weights(straight, capsys):
    case, _, strip, at, _ = straight
    with pytest.raises(ConfigError, match="needs a file of weights"):
        evaluator("surrogate", case, strip, at, THETA)
    with pytest.raises(SystemExit):
        bead_refine.parse(["--evaluator", "surrogate"])
    assert "needs --weights" in capsys.readouterr().err
    assert bead_refine.title("ballistic") == "bead_refine"
    assert bead_refine.title("surrogate") == "bead_refine_surrogate"


@pytest.mark.parametrize("module", [bead_reference, bead_refine])
def test_without_openfoam_there_is_a_word(module, monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert module.main(["--out", str(tmp_path / "out")]) == 2
    assert "interFoam is not installed" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("interFoam") is None, reason="OpenFOAM is not installed")
def test_the_reference_lays_a_straight_bead_in_pieces_as_in_one(straight):
    case, edges, strip, at, path = straight
    one, row = bead_reference.lay(case, edges, strip, path, 2e-3, piece_m=0.2)
    two, pieces = bead_reference.lay(case, edges, strip, path, 2e-3, piece_m=0.06)
    assert (row["pieces"], pieces["pieces"]) == (1, 2)
    for laid in (one, two):
        assert laid.volume.sum() == pytest.approx(FLOW * DURATION, rel=5e-3)
    steady = (strip.arc > 25e-3) & (strip.arc < 115e-3)
    middle = np.abs(strip.across - strip.across.mean()) < 3e-3
    np.testing.assert_allclose(
        two.height[np.ix_(steady, middle)], one.height[np.ix_(steady, middle)], atol=0.1e-3
    )
    assert one.height[np.ix_(steady, middle)].mean() == pytest.approx(fan_height(1.5e-3), rel=0.03)
    assert bead_reference.dimensions(edges, strip, one, at)["area_mm2"] == pytest.approx(
        1e6 * FLOW / SPEED, rel=0.01
    )
