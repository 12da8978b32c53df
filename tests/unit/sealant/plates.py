"""Plain strips for the tests."""

import numpy as np

from seal_gym.sealant.strip import Strip


def plate(length=0.06, half=10e-3, spacing=0.5e-3, tilt_rad=0.0):
    """A flat strip that rises to the right of travel by ``tilt_rad``; columns stand on it."""
    arc = np.linspace(0, length, round(length / spacing) + 1)
    n = round(half / spacing)
    across = spacing * np.arange(-n, n + 1)
    c, s = np.cos(tilt_rad), np.sin(tilt_rad)
    right, normal = np.array([c, 0.0, s]), np.array([-s, 0.0, c])
    rows = len(arc)
    line = (
        np.column_stack((0 * arc, arc, 0 * arc)),
        np.tile([0.0, 1.0, 0.0], (rows, 1)),
        np.tile(normal, (rows, 1)),
    )
    assert np.allclose(np.cross(line[1][0], line[2][0]), right)
    flat = np.zeros((rows, len(across)))
    return Strip.of(arc, across, line, flat, np.broadcast_to(normal, (*flat.shape, 3)))
