"""Where data come from: code, packages, commit."""

import subprocess
from pathlib import Path

from seal_gym.core.provenance import digest, versions

ROOT = Path(__file__).resolve().parents[1]
_PACKAGES = (
    "python",
    "seal-gym",
    "gymnasium",
    "mujoco",
    "numpy",
    "numba",
    "scipy",
    "opencv-python-headless",
    "filterpy",
)


def code_hash() -> str:
    """Hash of all code and assets that decide the data.

    Returns:
        16 hexadecimal digits.
    """
    files = [
        f
        for d in ("seal_gym", "assets")
        for f in (ROOT / d).rglob("*")
        if f.suffix in (".py", ".xml", ".toml")
    ]
    files += [ROOT / "agents" / "expert.py", ROOT / "agents" / "episodes.py"]
    return digest({str(f.relative_to(ROOT)): f for f in files})


def stack() -> dict[str, str]:
    """Versions of the packages that decide the data.

    Returns:
        Version by package, of those installed.
    """
    return versions(_PACKAGES)


def commit() -> str | None:
    """The checkout's commit.

    Returns:
        Its hash; None outside a repository.
    """
    run = subprocess.run(
        ["git", "-C", str(ROOT), "rev-parse", "HEAD"], capture_output=True, text=True, check=False
    )
    return run.stdout.strip() if run.returncode == 0 else None
