"""The jet: where it lands, by hand, and how much it brings."""

import math
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from seal_gym.sealant.laydown import case, jet
from seal_gym.sealant.laydown.config import GridCfg, LaydownError, NozzleCfg
from tests.unit.sealant.laydown.cases import FLOW_M3S, straight

WEIGHTLESS = (0.0, 0.0, 0.0)
OUTER = math.radians(20.0) * (1.0 - 1.0 / 120)  # the outermost of 120 rays of a fan of 40 deg


def test_a_fan_lands_as_wide_as_its_angle_says():
    cfg = straight(gravity_mps2=WEIGHTLESS)
    _, arrival, place = jet.landings(cfg)
    half = 0.03 * math.tan(OUTER)
    assert (place[:, 0].min(), place[:, 0].max()) == pytest.approx((-half, half), abs=1e-8)
    np.testing.assert_allclose(place[:, 2], 0.0, atol=1e-9)
    assert arrival.min() == pytest.approx(0.125e-3 + 0.01 / math.cos(math.radians(1 / 6)), abs=1e-7)


def test_the_fluid_keeps_the_tips_velocity():
    cfg = straight(gravity_mps2=WEIGHTLESS)
    parcels, arrival, place = jet.landings(cfg)
    carried = 0.3 * (arrival - parcels.times_s)
    np.testing.assert_allclose(place[:, 1], parcels.positions[:, 1] + carried, atol=1e-9)


def test_it_falls_with_gravity():
    cfg = straight(nozzle=NozzleCfg(jet_speed_mps=0.5), gravity_mps2=(0.0, 3.0, -9.0))
    parcels, arrival, place = jet.landings(cfg)
    t = arrival - parcels.times_s
    down = -parcels.velocities[:, 2]
    np.testing.assert_allclose(t, (-down + np.sqrt(down**2 + 2 * 9.0 * 0.03)) / 9.0, atol=1e-9)
    np.testing.assert_allclose(place[:, 1], parcels.positions[:, 1] + 0.3 * t + 1.5 * t**2, atol=1e-9)


@pytest.mark.parametrize("tilt_deg", [-25.0, 10.0])
def test_a_tilted_fan_lands_beside(tilt_deg):
    turn = Rotation.from_euler("Y", tilt_deg, degrees=True).as_matrix()
    _, _, place = jet.landings(straight(rotation=turn, gravity_mps2=WEIGHTLESS))
    centre = -math.radians(tilt_deg)  # turned to the right about y, the nozzle points to the left
    edges = (0.03 * math.tan(centre - OUTER), 0.03 * math.tan(centre + OUTER))
    assert (place[:, 0].min(), place[:, 0].max()) == pytest.approx(edges, abs=1e-8)


def test_a_round_jet_lands_as_a_disc():
    cfg = straight(nozzle=NozzleCfg(kind="round", radius_m=3e-3), gravity_mps2=WEIGHTLESS)
    parcels, _, place = jet.landings(cfg)
    first = parcels.times_s == parcels.times_s[0]
    off = place[first, :2] - [0.0, parcels.times_s[0] * 0.3 + 0.3 * 0.01]
    radius = np.linalg.norm(off, axis=1)
    assert radius.max() <= 3e-3
    assert (radius**2).mean() == pytest.approx(0.5 * 3e-3**2, rel=1e-3)  # of a disc: R^2 / 2
    np.testing.assert_allclose(off.mean(0), 0.0, atol=3e-5)


def test_on_a_step_the_jet_stops_where_it_meets_it():
    cfg = straight(substrate="step", gravity_mps2=WEIGHTLESS)
    _, _, place = jet.landings(cfg)
    right = place[:, 0] > 1e-6
    np.testing.assert_allclose(place[right, 2], 4e-3, atol=1e-8)
    assert place[right, 0].max() == pytest.approx(0.026 * math.tan(OUTER), abs=1e-8)
    assert place[:, 0].min() == pytest.approx(-0.03 * math.tan(OUTER), abs=1e-8)


@pytest.mark.parametrize("substrate", ["plane", "step", "ridge"])
@pytest.mark.parametrize("kind", ["fan", "round"])
def test_what_flows_in_is_the_integral_of_the_flow(substrate, kind):
    cfg = straight(substrate=substrate, nozzle=NozzleCfg(kind=kind), flows_m3s=(0.0, 2 * FLOW_M3S), x_m=1e-3)
    flow = jet.inflow(cfg, case.build_mesh(cfg))
    ramp = 0.5 * 0.1 * 2 * FLOW_M3S  # a triangle of 0.1 s
    assert flow.volume_m3() == pytest.approx(ramp, rel=1e-12)
    assert flow.flows_m3s.min() >= 0.0
    assert flow.flows_m3s[[0, -1]].sum() == 0.0


def test_the_inflow_follows_the_flow_in_time():
    cfg = straight(flows_m3s=(0.0, 2 * FLOW_M3S), gravity_mps2=WEIGHTLESS)
    flow = jet.inflow(cfg, case.build_mesh(cfg))
    # inlet data begin one sample later than the jet's landing, so that nothing flows at first
    late = flow.times_s - 1e-3 - 0.01
    steady = (late > 2e-3) & (late < 0.098)
    ramp = 2 * FLOW_M3S * late[steady] / 0.1
    np.testing.assert_allclose(flow.flows_m3s.sum(1)[steady], ramp, atol=0.01 * FLOW_M3S)


def test_the_written_inlet_data_carry_the_same_volume(tmp_path):
    cfg = straight(substrate="step", grid=GridCfg(cell_m=2e-3))
    mesh, _, _ = case.write(cfg, tmp_path / "case")
    folder = tmp_path / "case" / "constant" / "boundaryData" / "substrate"
    numbers = re.compile(r"\(([^()]*)\)")

    def vectors(file):
        return np.array([[float(v) for v in row.split()] for row in numbers.findall(file.read_text())])

    centres, areas = mesh.faces_of("substrate")
    np.testing.assert_allclose(vectors(folder / "points"), centres, atol=1e-11)
    times = sorted((float(at.name), at) for at in folder.iterdir() if at.is_dir())
    flow = [-(vectors(at / "U") * areas).sum() for _, at in times]
    volume = np.trapezoid(flow, [time for time, _ in times])
    assert volume == pytest.approx(FLOW_M3S * 0.1, rel=1e-7)


def test_a_jet_past_the_substrate_is_refused():
    turn = Rotation.from_euler("Y", 80.0, degrees=True).as_matrix()
    with pytest.raises(LaydownError, match="does not come down on the substrate: tilt or drag less"):
        jet.landings(straight(rotation=turn))
