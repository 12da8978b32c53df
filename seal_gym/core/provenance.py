"""Where numbers come from: versions of packages, hashes of files."""

import hashlib
import platform
from collections.abc import Iterable, Mapping
from importlib import metadata
from pathlib import Path


def version(name: str) -> str | None:
    """The installed version of a package.

    Args:
        name: On PyPI, or ``"python"``.

    Returns:
        None if it is not installed.
    """
    if name == "python":
        return platform.python_version()
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def versions(names: Iterable[str]) -> dict[str, str]:
    """The installed ones of some packages.

    Args:
        names: On PyPI, or ``"python"``.

    Returns:
        Version by package, in the given order.
    """
    return {name: found for name in names if (found := version(name)) is not None}


def digest(files: Mapping[str, Path]) -> str:
    """Hash of files and of the names they go by.

    Args:
        files: By name.

    Returns:
        16 hexadecimal digits.
    """
    found = hashlib.sha256()
    for name in sorted(files):
        found.update(name.encode() + b"\0" + files[name].read_bytes() + b"\0")
    return found.hexdigest()[:16]
