"""The package as users get it: extras, light import, and a wheel that works on its own."""

import json
import os
import subprocess
import sys
import tomllib
import venv
import zipfile
from importlib import metadata
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

WHEEL_SMOKE = """
import gymnasium as gym, numpy as np
env = gym.make("seal_gym:SealGym/Flat-v0", perception="oracle")
observation, info = env.reset(seed=0)
for _ in range(5):
    observation, reward, terminated, truncated, info = env.step(np.zeros(env.action_space.shape, np.float32))
assert np.isfinite(observation["features"] if isinstance(observation, dict) else observation).all()
env.close()
import seal_gym
print(seal_gym.__file__)
"""


def run(*command: str | Path, cwd: Path, **env: str) -> str:
    """Runs a command and shows all it said if it fails."""
    clean = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "COV_"))}
    result = subprocess.run(
        [str(c) for c in command],
        cwd=cwd,
        env=clean | env,
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )
    assert result.returncode == 0, f"{command}\n{result.stdout}\n{result.stderr}"
    return result.stdout


def test_installed_version_is_the_checkouts() -> None:
    assert metadata.version("seal-gym") == PROJECT["version"]


def test_all_leaves_ray_out_because_its_gymnasium_conflicts_with_imitations() -> None:
    assert PROJECT["optional-dependencies"]["all"] == ["seal-gym[sb3,imitation,planning,viz]"]


def test_next_major_mujoco_is_capped() -> None:
    assert "mujoco>=4.0,<5" in PROJECT["dependencies"]


def test_import_is_light_and_registers_the_ids(tmp_path: Path) -> None:
    code = """
import sys, json, seal_gym, gymnasium
ids = sorted(i for i in gymnasium.registry if i.startswith("SealGym/"))
print(json.dumps([ids, sorted(sys.modules)]))
"""
    ids, modules = json.loads(run(sys.executable, "-c", code, cwd=tmp_path))
    assert {f"SealGym/{n}-v0" for n in ("Flat", "Cylinder", "Rectangular", "Seal")} <= set(ids)
    heavy = {
        "torch",
        "stable_baselines3",
        "imitation",
        "matplotlib",
        "imageio",
        "mujoco.renderer",
        "agents",
        "experiments",
    }
    assert heavy.isdisjoint(modules)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--outdir", out, ROOT, cwd=out)  # the sdist, and the wheel from it
    return next(out.glob("*.whl"))


@pytest.mark.slow
def test_wheel_holds_the_package_and_the_assets_only(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    assets = {
        f"seal_gym/{p.relative_to(ROOT).as_posix()}" for p in (ROOT / "assets").rglob("*") if p.is_file()
    }
    assert assets and assets <= names
    assert "seal_gym/py.typed" in names
    assert {n.split("/")[0] for n in names} == {"seal_gym", f"seal_gym-{PROJECT['version']}.dist-info"}
    assert not [n for n in names if "__pycache__" in n or n.endswith((".nbi", ".nbc", ".pyc"))]


@pytest.mark.slow
def test_wheel_makes_an_environment_in_a_clean_venv(wheel: Path, tmp_path: Path) -> None:
    venv.create(tmp_path / "venv", with_pip=True)
    python = tmp_path / "venv" / "bin" / "python"
    run(python, "-m", "pip", "install", "-qq", "--no-input", wheel, cwd=tmp_path)
    # "disabled": the sensors and the physics need no GL
    where = run(python, "-I", "-c", WHEEL_SMOKE, cwd=tmp_path, MUJOCO_GL="disabled")
    assert Path(where.strip().splitlines()[-1]).is_relative_to(tmp_path / "venv")
