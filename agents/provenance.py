"""Where data come from: code, packages, commit."""

import hashlib
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
_PACKAGES = (
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
    digest = hashlib.sha256()
    files = [
        f
        for d in ("seal_gym", "assets")
        for f in (ROOT / d).rglob("*")
        if f.suffix in (".py", ".xml", ".toml")
    ]
    for file in sorted([*files, ROOT / "agents" / "expert.py", ROOT / "agents" / "episodes.py"]):
        digest.update(str(file.relative_to(ROOT)).encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def stack() -> dict[str, str]:
    """Versions of the packages that decide the data.

    Returns:
        Version by package.
    """
    found = {"python": sys.version.split()[0]}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue  # a checkout that is not installed
    return found


def commit() -> str | None:
    """The checkout's commit.

    Returns:
        Its hash; None outside a repository.
    """
    run = subprocess.run(
        ["git", "-C", str(ROOT), "rev-parse", "HEAD"], capture_output=True, text=True, check=False
    )
    return run.stdout.strip() if run.returncode == 0 else None
