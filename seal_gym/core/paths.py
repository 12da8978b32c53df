"""Where the data files are: the checkout's ``assets/`` if there is one, else the installed copy."""

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parents[1]


def asset(*parts: str) -> Path:
    """Path of an asset file.

    Args:
        *parts: Path below ``assets/``, e.g. ``"ur5_sealgun", "cell.toml"``.

    Returns:
        The existing path.

    Raises:
        FileNotFoundError: If neither the checkout nor the installed package has it.
    """
    for root in (_PACKAGE.parent / "assets", _PACKAGE / "assets"):
        path = root.joinpath(*parts)
        if path.exists():
            return path
    raise FileNotFoundError(
        f"asset {'/'.join(parts)} not found beside {_PACKAGE}: reinstall seal-gym or run from a full checkout"
    )
