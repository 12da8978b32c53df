"""Tiny simulations with OpenFOAM itself."""

import os
import shutil
import subprocess

import numpy as np
import pytest

from seal_gym.sealant.laydown import case, sections
from seal_gym.sealant.laydown.config import GridCfg
from seal_gym.sealant.laydown.run import simulate
from tests.unit.sealant.laydown.cases import straight

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("interFoam") is None, reason="OpenFOAM is not installed"),
]


@pytest.mark.parametrize("solver", ["interFoam", "interIsoFoam"])
def test_a_bead_has_the_volume_that_was_given_and_lies_under_its_path(tmp_path, solver):
    cfg = straight(length_m=0.04, x_m=2e-3, grid=GridCfg(cell_m=2e-3, solver=solver))
    bead = simulate(cfg, tmp_path / "case", limit_s=300.0)
    assert abs(bead.volume_error) < 2e-3
    assert bead.lid_fraction < 0.01
    assert bead.cpu_s > 0.1
    assert not (tmp_path / "case").exists()
    at = sections.stations(cfg)
    images = sections.cut(bead.mesh, bead.fractions, at.hits, at.tips)[12:30]  # away from both ends
    assert sections.area_m2(images).mean() == pytest.approx(12e-6 / 0.3, rel=0.03)
    # never narrower than the fan (21.8 mm), nor more than a cell and the strip wider at each side
    assert 21.8e-3 < sections.width_m(images).mean() < 27.8e-3
    columns = images.sum((0, 1))
    assert (columns * np.arange(-19.5, 20)).sum() / columns.sum() == pytest.approx(0.0, abs=0.3)


@pytest.mark.parametrize("substrate", ["ridge", "inner_corner", "wave", "ramp"])
def test_a_bead_on_a_slope_has_the_volume_that_was_given(tmp_path, substrate):
    cfg = straight(substrate=substrate, length_m=0.04, grid=GridCfg(cell_m=2e-3, clearance_m=1.2e-2))
    bead = simulate(cfg, tmp_path / "case", limit_s=300.0)
    assert abs(bead.volume_error) < 2e-3 and bead.lid_fraction < 0.01
    at = sections.stations(cfg)
    images = sections.cut(bead.mesh, bead.fractions, at.hits, at.across)[12:30]
    # Whether a window's row lies in a step or above it changes what it holds by some per cent.
    assert sections.area_m2(images).mean() == pytest.approx(at.ideal_m2[12:30].mean(), rel=0.1)


def test_a_bead_below_its_yield_stress_stays_as_it_lies(tmp_path):
    # 1200 kg/m3 x 9.81 m/s2 x 2 mm = 24 Pa, far below the yield stress: waiting must change nothing.
    widths = []
    for settle_s in (0.01, 0.15):
        cfg = straight(length_m=0.02, grid=GridCfg(cell_m=1e-3, settle_s=settle_s))
        bead = simulate(cfg, tmp_path / "case", limit_s=600.0)
        assert abs(bead.volume_error) < 1e-4
        at = sections.stations(cfg)
        images = sections.cut(bead.mesh, bead.fractions, at.hits, at.tips)[8:12]
        widths.append(sections.width_m(images).mean())
    assert widths[1] == pytest.approx(widths[0], abs=0.05e-3)


def test_the_same_simulation_gives_the_same_bead(tmp_path):
    cfg = straight(length_m=0.02, grid=GridCfg(cell_m=2e-3))
    one, two = (simulate(cfg, tmp_path / "case", limit_s=300.0).fractions for _ in range(2))
    np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize("substrate", ["trench", "inner_corner", "wave"])
def test_openfoam_finds_no_fault_with_a_mesh(tmp_path, substrate):
    cfg = straight(substrate=substrate, grid=GridCfg(cell_m=1e-3))
    case.write(cfg, tmp_path / "case")
    check = subprocess.run(
        ["checkMesh", "-case", tmp_path / "case"],
        env={"WM_PROJECT_DIR": "/usr/share/openfoam", **os.environ},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert "Mesh OK." in check.stdout, check.stdout[-2000:]
