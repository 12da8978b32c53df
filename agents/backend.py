"""Chooses MuJoCo's OpenGL backend; import this before anything that imports mujoco."""

import os
import subprocess
import sys
from pathlib import Path

_PROBE = Path(__file__).resolve().parents[1] / "tools" / "gl_probe.py"


def choose() -> str:
    """Sets ``MUJOCO_GL`` to a backend that renders here, unless the user has set it.

    Returns:
        The backend; ``"disabled"`` where no picture can be made.
    """
    if "MUJOCO_GL" not in os.environ:
        # In a process of its own: a backend that fails would take the import of mujoco with it.
        probe = subprocess.run([sys.executable, str(_PROBE)], capture_output=True, text=True, check=False)
        os.environ["MUJOCO_GL"] = probe.stdout.strip() if probe.returncode == 0 else "disabled"
    return os.environ["MUJOCO_GL"]
