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


def fillet(length=0.06, half=8e-3, spacing=0.25e-3):
    """A straight right angle between a wall on the left and a plate on the right; columns on the bisector."""
    arc = np.linspace(0, length, round(length / spacing) + 1)
    n = round(half / spacing)
    across = spacing * np.arange(-n, n + 1)
    rows = len(arc)
    line = (
        np.column_stack((0 * arc, arc, 0 * arc)),
        np.tile([0.0, 1.0, 0.0], (rows, 1)),
        np.tile([0.0, 0.0, 1.0], (rows, 1)),
    )
    height = np.tile(np.abs(across), (rows, 1))
    lean = np.where(across < 0, 1.0, -1.0)
    normal = np.stack((lean, 0 * lean, 0 * lean + 1.0), axis=1) / np.sqrt(2)
    up = np.array([1.0, 0.0, 1.0]) / np.sqrt(2)
    return Strip.of(arc, across, line, height, np.broadcast_to(normal, (rows, *normal.shape)), up)
