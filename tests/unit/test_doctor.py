import hashlib
import json
import os
import stat
import sys
import tomllib
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

import seal_gym
from seal_gym import doctor

ROOT = Path(__file__).resolve().parents[2]
HERE = {"mujoco": "4.0.0", "numpy": "2.4.6", "numba": "0.68.1", "scipy": "1.17.1", "machine": "x86_64"}


@pytest.mark.parametrize("tested", [">=4.0,<5", ">=0.29.1, <2", "==2.13.0", ">1,<=1.5", ""])
@pytest.mark.parametrize(
    "version",
    ["0.29.0", "0.29.1", "1", "1.0.0", "1.5", "1.5.1", "2.13", "2.13.0+cpu", "4", "4.99.1", "5.0", "5.0.1"],
)
def test_ranges_mean_what_pip_takes_them_for(version, tested):
    assert doctor.within(version, tested) is SpecifierSet(tested).contains(version)


@pytest.mark.parametrize(("version", "tested"), [("5.0rc1", "<5"), ("nightly", ">=1"), ("1.0", "~=1.0")])
def test_what_is_not_understood_is_not_judged(version, tested):
    assert doctor.within(version, tested) is None


def test_every_range_of_the_core_and_the_extras_is_looked_at():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = {k: v for k, v in project["optional-dependencies"].items() if k not in ("all", "test", "dev")}
    lines = [*project["dependencies"], *(line for extra in extras.values() for line in extra)]
    expected = {r.name: r.specifier for r in map(Requirement, lines)}
    found = {name: tested for name, _, tested in doctor.requirements()}
    assert found.pop("python") == project["requires-python"]
    assert {name: SpecifierSet(tested) for name, tested in found.items()} == expected


def test_an_installed_packages_metadata_are_read_where_there_is_no_checkout(monkeypatch, tmp_path):
    lines = [
        "mujoco<5,>=4.0",
        'tqdm>=4.66; extra == "viz"',
        'ruff>=0.1; extra == "dev"',
        'seal-gym[viz]; extra == "all"',
    ]
    monkeypatch.setattr(doctor, "_PACKAGE", tmp_path / "seal_gym")
    monkeypatch.setattr(doctor.metadata, "requires", lambda name: lines)
    monkeypatch.setattr(doctor.metadata, "metadata", lambda name: {"Requires-Python": ">=3.11"})
    assert doctor.requirements() == [
        ("python", "", ">=3.11"),
        ("mujoco", "", "<5,>=4.0"),
        ("tqdm", "viz", ">=4.66"),
    ]


def test_packages_are_judged(monkeypatch):
    wanted = [("a", "", ">=1"), ("b", "", ">=1"), ("c", "viz", ">=1"), ("d", "viz", "<1"), ("e", "", "~=1")]
    versions = {"a": "1.2", "d": "1.0", "e": "1.0"}
    monkeypatch.setattr(doctor, "requirements", lambda: wanted)
    monkeypatch.setattr(doctor, "_version", versions.get)
    assert [p.state for p in doctor.packages()] == ["ok", "missing", "absent", "outside", "unknown"]


# -- OpenGL: whatever the other process does, this one goes on ----------------------------------------------


def program(path, script):
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return str(path)


GOOD = json.dumps({"backend": "osmesa", "driver": "llvmpipe (LLVM 15)", "vendor": "Mesa"})


@pytest.mark.parametrize(
    ("script", "error"),
    [
        ("kill -SEGV $$", "egl: the process ended with status -11"),
        ("echo first >&2; echo 'no display' >&2; exit 1", "egl: no display"),
        ("sleep 5", "egl: no picture within 0.2 s"),
    ],
)
def test_a_broken_driver_is_reported(monkeypatch, tmp_path, script, error):
    monkeypatch.setattr(doctor.sys, "executable", program(tmp_path / "python", script))
    monkeypatch.setattr(doctor, "_GL_SECONDS", 0.2 if "sleep" in script else 60)
    monkeypatch.setenv("MUJOCO_GL", "egl")
    assert doctor.check_gl() == {"works": False, "error": error}


@pytest.mark.skipif(sys.platform != "linux", reason="the backends tried are Linux's")
def test_the_first_backend_that_works_is_taken_and_software_is_named(monkeypatch, tmp_path):
    script = f"[ $MUJOCO_GL = osmesa ] || exit 1; echo '{GOOD}'"
    monkeypatch.setattr(doctor.sys, "executable", program(tmp_path / "python", script))
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    found = doctor.check_gl()
    assert (found["works"], found["backend"], found["software"]) == (True, "osmesa", True)
    monkeypatch.setenv("MUJOCO_GL", "egl")  # chosen by the user: nothing else is tried
    assert not doctor.check_gl()["works"]


@pytest.mark.gl
def test_the_probe_draws_and_shadows_cost_time():
    found = doctor.probe_gl()
    assert found["driver"] and found["vendor"]
    assert all(found[f"{k}_{s}_ms"] > 0 for k in ("picture", "roi") for s in ("plain", "shadows"))


# -- rollouts -----------------------------------------------------------------------------------------------


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(doctor, "_STEPS", 4)
    monkeypatch.setattr(doctor, "_SEEDS", (0, 1))


def test_a_rollout_hashes_what_an_environment_gives(short):
    """Against a loop written here, with the seeds and actions written out."""
    found = doctor.rollout("SealGym/Cylinder-v0", "vision")
    env = gym.make("SealGym/Cylinder-v0", observation="features+images")
    features, images = hashlib.sha256(), hashlib.sha256()

    def take(observation, reward):
        features.update(np.append(observation["features"].astype("<f8"), reward).tobytes())
        images.update(observation["front"].tobytes() + observation["side"].tobytes())

    for seed in (0, 1):
        rng = np.random.default_rng(seed)
        take(env.reset(seed=seed)[0], 0.0)
        for step in range(4):
            action = 0.03 * rng.uniform(-1, 1, 6) + [0, 0.3 * (step == 0), 0, 0, 0, 0]
            observation, reward, *_ = env.step(action.astype(np.float32))
            take(observation, reward)
    assert found["vision"].hash == features.hexdigest()[:16]
    assert found["images"].hash == images.hexdigest()[:16]
    assert found["vision"].steps == found["images"].steps == 10


def test_every_id_runs_in_every_way_and_repeats(short):
    found, errors = doctor.rollouts()
    assert not errors
    assert doctor.rollouts()[0] == found
    assert list(found) == list(seal_gym.ENV_IDS)
    assert all(list(rows) == list(doctor.QUANTITIES) for rows in found.values())
    assert found["SealGym/Seal-v0"] == found["SealGym/Flat-v0"]  # the same part
    hashes = [found[i][q].hash for i in seal_gym.ENV_IDS[:3] for q in doctor.QUANTITIES]
    assert len(set(hashes)) == len(hashes)


def test_an_environment_that_fails_is_named_and_the_others_run(short, monkeypatch):
    real = doctor.rollout

    def rollout(env_id, run):
        if "Flat" in env_id:
            raise RuntimeError("no such thing")
        return real(env_id, run)

    monkeypatch.setattr(doctor, "rollout", rollout)
    found, errors = doctor.rollouts()
    assert errors == {"SealGym/Flat-v0": "RuntimeError: no such thing"}
    assert set(found) == set(seal_gym.ENV_IDS[1:])


def recorded(steps):
    recorder = doctor.Recorder()
    for values in steps:
        recorder.add(values)
    return recorder.result()


@pytest.mark.parametrize("size", [1e-9, 1e-3, 10.0])
def test_the_sketch_tells_the_size_of_a_difference(size):
    """16 random sums estimate a root mean square to 18 % (chi-squared with 16 degrees of freedom)."""
    rng = np.random.default_rng(0)
    values = rng.normal(0.0, 50.0, (300, 36))
    difference = size * rng.standard_normal(values.shape)
    verdict = doctor.compare(recorded(values + difference), recorded(values)._asdict(), "tip")
    assert verdict.rms == pytest.approx(size, rel=0.6)
    assert verdict.verdict == ("last bits" if size < 1e-6 else "different")


def test_the_verdicts():
    values = np.linspace(-1.0, 1.0, 360).reshape(10, 36)
    ours = recorded(values)._asdict()
    assert doctor.compare(recorded(values), ours, "tip") == ("same", 0.0)
    assert doctor.compare(recorded(np.nextafter(values, 2.0)), ours, "tip").verdict == "last bits"
    one_flag = values.copy()
    one_flag[7, 2] += 1.0
    assert doctor.compare(recorded(one_flag), ours, "tip").verdict == "different"
    assert doctor.compare(recorded(values[:-1]), ours, "tip") == ("different", None)
    assert doctor.compare(recorded(values), None, "tip") == ("unknown", None)


def test_a_few_pixels_off_by_a_grey_level_are_rounding():
    images = np.random.default_rng(0).integers(0, 255, (20, 30000), dtype=np.uint8)
    off = images.copy()
    off[::7, 5] += 1
    ours = recorded(images)._asdict()
    assert doctor.compare(recorded(off), ours, "images").verdict == "last bits"
    assert doctor.compare(recorded(images + np.uint8(1)), ours, "images").verdict == "different"


def entry(code="c", **versions):
    rows = {
        env_id: {q: recorded([np.ones(3)])._asdict() for q in doctor.QUANTITIES}
        for env_id in seal_gym.ENV_IDS
    }
    also = {"cpu": "one"}
    return {"stack": HERE | versions, "seal_gym": "0.1.0", "code": code, "also": also, "rollouts": rows}


def test_the_nearest_entry_of_the_same_mujoco_is_the_reference():
    entries = [entry(mujoco="4.1.0"), entry(numpy="2.0.0", numba="0.61.0"), entry(numpy="2.0.0")]
    assert doctor.reference(entries, HERE) is entries[2]
    assert doctor.reference(entries, HERE | {"mujoco": "4.2.0"}) is None


def test_writing_replaces_this_stack_and_drops_what_other_code_made(tmp_path):
    path = tmp_path / "hashes.json"
    assert doctor.shipped(path) == []
    old, other, stale = entry(), entry(mujoco="4.1.0"), entry(code="older", mujoco="4.2.0")
    for e in (stale, old, other):
        doctor.write_hashes(e, path)
    new = entry() | {"seal_gym": "0.2.0"}
    doctor.write_hashes(new, path)
    assert doctor.shipped(path) == json.loads(json.dumps([other, new]))


def test_what_is_shipped_covers_every_id():
    entries = doctor.shipped()
    assert entries
    for e in entries:
        assert set(e["stack"]) == set(HERE)
        assert set(e["rollouts"]) == set(seal_gym.ENV_IDS)
        assert all(set(rows) == set(doctor.QUANTITIES) for rows in e["rollouts"].values())


def test_the_codes_hash_changes_with_code_and_assets(monkeypatch, tmp_path):
    package, assets = tmp_path / "seal_gym", tmp_path / "assets"
    for folder in (package, assets):
        folder.mkdir()
    (package / "a.py").write_text("x = 1")
    (assets / "cell.toml").write_text("y = 1")
    monkeypatch.setattr(doctor, "_PACKAGE", package)
    monkeypatch.setattr(doctor, "asset", lambda name: assets)
    found = [doctor.code_hash()]
    for change in (package / "a.py", assets / "cell.toml"):
        change.write_text("z = 2")
        found.append(doctor.code_hash())
    (package / "notes.txt").write_text("no code")
    assert len(set(found)) == 3
    assert doctor.code_hash() == found[-1]


# -- the command --------------------------------------------------------------------------------------------


@pytest.fixture
def command(monkeypatch, tmp_path, capsys):
    """Runs the command with rollouts, versions and GL made up; gives status and output."""

    monkeypatch.setenv("MUJOCO_GL", os.environ["MUJOCO_GL"])  # put back afterwards

    def call(*arguments, found=None, errors=(), listed=(), here=HERE, gl=None):
        rows = {i: {q: recorded([np.ones(3)]) for q in doctor.QUANTITIES} for i in seal_gym.ENV_IDS}
        monkeypatch.setattr(doctor, "HASHES", tmp_path / "hashes.json")
        monkeypatch.setattr(doctor, "shipped", lambda path=None: [entry(code="older")])
        monkeypatch.setattr(doctor, "rollouts", lambda: (rows if found is None else found, dict(errors)))
        monkeypatch.setattr(doctor, "stack", lambda: here)
        monkeypatch.setattr(doctor, "packages", lambda: list(listed))
        monkeypatch.setattr(doctor, "check_gl", lambda: gl or {"works": False, "error": "egl: no driver"})
        status = doctor.main(list(arguments))
        return status, capsys.readouterr().out

    return call


def test_a_sound_machine_without_opengl(command):
    status, out = command()
    assert status == 0
    assert "OpenGL does not work: egl: no driver" in out and "libegl1" in out
    assert "Verdict: same" in out and doctor.MEANING["same"] in out


def test_another_stack_is_named(command):
    values = {i: {q: recorded([np.full(3, 9.0)]) for q in doctor.QUANTITIES} for i in seal_gym.ENV_IDS}
    status, out = command(found=values, here=HERE | {"numpy": "2.9.0"})
    assert status == 0  # different, not broken
    assert "here instead numpy 2.9.0" in out and "other code or assets" in out
    assert "different (" in out
    assert doctor.MEANING["different"] in out


def test_an_unknown_mujoco(command):
    status, out = command(here=HERE | {"mujoco": "4.7.0"})
    assert status == 0
    assert "shipped for mujoco 4.0.0; here is mujoco 4.7.0" in out and doctor.MEANING["unknown"] in out


def test_what_is_broken_ends_with_status_1(command):
    status, out = command(errors={"SealGym/Flat-v0": "OSError: disk"}.items(), found={})
    assert status == 1 and "BROKEN: OSError: disk" in out
    missing = doctor.Package("numba", "", ">=0.61", None, "missing")
    status, out = command(listed=[missing])
    assert status == 1 and "MISSING" in out


def test_software_opengl_and_the_cost_of_shadows_are_told(command):
    gl = {
        "works": True,
        "software": True,
        "backend": "egl",
        "vendor": "Mesa",
        "driver": "llvmpipe",
        "version": "4.5",
    }
    times = {
        "picture_plain_ms": 10.0,
        "picture_shadows_ms": 25.0,
        "roi_plain_ms": 1.0,
        "roi_shadows_ms": 13.0,
    }
    _, out = command(gl=gl | times)
    assert "SOFTWARE" in out and "shadows cost 2.5 x" in out and "shadows cost 13.0 x" in out


def test_json_says_the_same(command):
    status, out = command("--json")
    report = json.loads(out)
    assert (status, report["verdict"], report["broken"]) == (0, "same", False)
    assert report["rollouts"]["SealGym/Flat-v0"]["vision"] == {"verdict": "same", "rms": 0.0}
    assert report["gl"] == {"works": False, "error": "egl: no driver"}
