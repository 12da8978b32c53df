"""Chooses MuJoCo's GL backend before anything imports mujoco, and skips `gl` tests where none works."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

_REASON = "SEAL_GYM_TEST_NO_GL"  # why there is no GL, empty if there is; set once, workers inherit it


def _why_no_gl() -> str:
    """Renders in a process of its own: a broken driver may crash, and the import below must not fail."""
    probe = Path(__file__).resolve().parents[1] / "tools" / "gl_probe.py"
    try:
        run = subprocess.run(
            [sys.executable, str(probe)], capture_output=True, text=True, timeout=120, check=False
        )
    except subprocess.TimeoutExpired:
        return "the GL probe hung"
    if run.returncode == 0:
        return ""
    return (run.stderr.strip().splitlines() or [f"the GL probe ended with status {run.returncode}"])[-1]


os.environ.setdefault("MUJOCO_GL", "egl")
if _REASON not in os.environ:
    os.environ[_REASON] = _why_no_gl()
if os.environ[_REASON]:
    os.environ["MUJOCO_GL"] = "disabled"  # with egl and no libEGL, `import mujoco` itself fails


def pytest_report_header() -> str:
    why = os.environ[_REASON]
    return f"GL: none ({why})" if why else f"GL: {os.environ['MUJOCO_GL']}"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if why := os.environ[_REASON]:
        for item in items:
            if item.get_closest_marker("gl"):
                item.add_marker(pytest.mark.skip(reason=f"no OpenGL context: {why}"))
