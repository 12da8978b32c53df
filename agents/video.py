"""Videos that every browser plays."""

from pathlib import Path
from typing import Any


def open_video(path: Path) -> Any:
    """Opens an MP4 (H.264, 30 pictures a second) for writing.

    Args:
        path: The file; its folder is made if need be.

    Returns:
        A context manager with ``append_data(picture)`` and ``close()``.
    """
    import imageio.v2 as imageio  # of the extra `viz`: only when a video is made

    path.parent.mkdir(parents=True, exist_ok=True)
    return imageio.get_writer(
        path, fps=30, codec="libx264", quality=7, macro_block_size=8, pixelformat="yuv420p"
    )
