"""OpenFOAM's text format, read back by a reader of its own, and what is said when a solver fails."""

import os
import re

import numpy as np
import pytest

from seal_gym.core.errors import ConfigError
from seal_gym.sealant.laydown import case, foam
from seal_gym.sealant.laydown.config import FluidCfg, GridCfg, LaydownError, NozzleCfg
from seal_gym.sealant.laydown.run import simulate
from seal_gym.sealant.pneumatics import SEALANTS
from tests.unit.sealant.laydown.cases import straight

TOKEN = re.compile(r'"[^"]*"|[{};]|[^\s{};"]+')


def parse(text):
    """Keywords and values of a dictionary in OpenFOAM's notation; brackets stay as they are."""
    tokens = TOKEN.findall(text)

    def block(i, depth):
        entries, words = {}, []
        while i < len(tokens):
            token, i = tokens[i], i + 1
            if token == "}":
                assert depth > 0 and not words
                return entries, i
            if token == "{":
                (key,), words = words, []
                entries[key], i = block(i, depth + 1)
            elif token == ";":
                entries[words[0]], words = " ".join(words[1:]), []
            else:
                words.append(token)
        assert depth == 0 and not words
        return entries, i

    return block(0, 0)[0]


@pytest.fixture
def solver(tmp_path, monkeypatch):
    """Puts a shell script in interFoam's place."""

    def install(script):
        folder = tmp_path / "bin"
        folder.mkdir()
        (folder / "interFoam").write_text(f"#!/bin/sh\n{script}\n")
        (folder / "interFoam").chmod(0o755)
        monkeypatch.setenv("PATH", str(folder), prepend=":")
        (tmp_path / "case").mkdir()
        return tmp_path / "case"

    return install


def test_a_dictionary_reads_back():
    entries = {"a": 1, "b": 0.1, "c": {"d": "(x y)", '"e.*"': {"f": 1e-12}}}
    assert parse(foam.dictionary(entries)) == {
        "a": "1",
        "b": "0.1",
        "c": {"d": "(x y)", '"e.*"': {"f": "1e-12"}},
    }


@pytest.mark.parametrize("name", ["interFoam", "interIsoFoam"])
def test_a_case_says_what_was_asked(tmp_path, name):
    folder = tmp_path / "case"
    cfg = straight(
        grid=GridCfg(cell_m=2e-3, solver=name, courant=0.25, settle_s=0.02), gravity_mps2=(9.81, 0.0, 0.0)
    )
    _, flow, end_s = case.write(cfg, folder)
    read = {f.name: parse(f.read_text()) for f in folder.glob("*/*") if f.is_file()}
    assert read["controlDict"]["application"] == name
    assert float(read["controlDict"]["endTime"]) == end_s == pytest.approx(flow.times_s[-1] + 0.02)
    assert float(read["controlDict"]["maxCo"]) == 0.25
    assert read["g"]["value"] == "(9.81 0 0)"
    fluid, silicone = read["transportProperties"]["sealant"], SEALANTS["neutral_silicone"]
    model = {key: float(value) for key, value in fluid["HerschelBulkleyCoeffs"].items()}
    assert float(fluid["rho"]) == silicone.density_kg_m3
    assert model["tau0"] * silicone.density_kg_m3 == pytest.approx(silicone.yield_stress_pa)
    assert model["k"] * silicone.density_kg_m3 == pytest.approx(silicone.consistency_pa_sn)
    assert model["nu0"] * silicone.density_kg_m3 == pytest.approx(1000.0)
    assert model["n"] == silicone.flow_index
    assert read["U"]["boundaryField"]["substrate"]["type"] == "timeVaryingMappedFixedValue"
    assert set(read["alpha.sealant"]["boundaryField"]) == {"top", "sides", "substrate"}
    assert read["U"]["FoamFile"]["class"] == "volVectorField"


def test_fields_are_read(tmp_path):
    file = tmp_path / "f"
    head = foam.header("volScalarField", "f")
    file.write_text(head + "internalField nonuniform List<scalar> \n3\n(\n1\n0.5\n-2e-3\n)\n;\n")
    np.testing.assert_array_equal(foam.read_field(file, 3), [1.0, 0.5, -2e-3])
    with pytest.raises(LaydownError, match="3 numbers for 4 cells of 1: of another mesh"):
        foam.read_field(file, 4)
    file.write_text(head + "internalField nonuniform List<vector> 2((1 2 3)\n(4 5 6)\n)\n;\n")
    np.testing.assert_array_equal(foam.read_field(file, 2), [[1, 2, 3], [4, 5, 6]])
    file.write_text(head + "internalField uniform 0.25;\n")
    np.testing.assert_array_equal(foam.read_field(file, 2), [0.25, 0.25])
    file.write_text(head + "internalField uniform (1 2 3);\n")
    np.testing.assert_array_equal(foam.read_field(file, 2), [[1, 2, 3]] * 2)
    file.write_text(head)
    with pytest.raises(LaydownError, match="holds no ASCII list"):
        foam.read_field(file, 2)
    with pytest.raises(LaydownError, match="not written; the solver did not come to its end"):
        foam.read_field(tmp_path / "none", 2)


def test_values_read_back():
    array = np.array([[0.0, 0.0, 0.0], [1.5, -2e-7, 3e4]])
    rows = re.findall(r"^\(([^()]+)\)$", foam.values(array), re.M)
    np.testing.assert_allclose([[float(v) for v in row.split()] for row in rows], array)
    assert foam.values(np.array([0.0, 0.25])) == "2\n(\n0\n0.25\n)\n"


def test_without_openfoam_it_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(LaydownError, match=r"interFoam is not installed.*apt-get install openfoam"):
        simulate(straight(), tmp_path / "case")
    assert not (tmp_path / "case").exists()


def test_a_solver_that_fails_is_quoted(solver):
    folder = solver("echo starting; echo FOAM FATAL ERROR: no such patch; exit 3")
    with pytest.raises(LaydownError, match=r"(?s)status 3.*log\.interFoam.*FATAL ERROR: no such patch"):
        foam.run("interFoam", folder, limit_s=10.0)
    assert "starting" in (folder / "log.interFoam").read_text()


def test_a_solver_that_takes_too_long_is_stopped(solver):
    folder = solver('echo $$ > "$2/pid"; exec sleep 60')
    with pytest.raises(LaydownError, match=r"took more than 1 s"):
        foam.run("interFoam", folder, limit_s=1.0)
    with pytest.raises(ProcessLookupError):
        os.kill(int((folder / "pid").read_text()), 0)


def test_a_solver_is_told_where_openfoam_lies(solver):
    folder = solver('echo "$1 $2 $WM_PROJECT_DIR"')
    assert foam.run("interFoam", folder, limit_s=10.0) >= 0.0
    option, where, project = (folder / "log.interFoam").read_text().split()
    assert (option, where) == ("-case", str(folder))
    assert project


@pytest.mark.parametrize(
    ("cls", "values", "message"),
    [
        (GridCfg, {"cell_m": 0.0}, r"cell_m = 0\.0: must be a number in \[0\.0001, 0\.005\] m"),
        (GridCfg, {"solver": "simpleFoam"}, "must be one of interFoam, interIsoFoam"),
        (NozzleCfg, {"kind": "flat"}, "must be 'fan' or 'round'"),
        (NozzleCfg, {"jet_speed_mps": float("nan")}, "jet_speed_mps = nan"),
        (FluidCfg, {"sealant": "silicone"}, "must be a Sealant"),
    ],
)
def test_wrong_values_are_named(cls, values, message):
    with pytest.raises(ConfigError, match=message):
        cls(**values)
