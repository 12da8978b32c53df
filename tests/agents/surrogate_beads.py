"""Beads for tests of the surrogate that no simulation has made."""

import numpy as np

from agents.surrogate_data import Bead
from seal_gym.sealant.fan_section import fan_sections


def bead(path="plane_s", draw=0, n=24, seed=0):
    """A bead over a plane whose section is the fast tier's, moved up by a millimetre and thinned."""
    rng = np.random.default_rng([seed, draw, *path.encode()])
    linear = np.tile([rng.uniform(-0.2, 0.2), rng.uniform(0.2, 0.5), 0.0], (n, 1))
    angular = np.zeros((n, 3))
    slope = rng.uniform(-0.3, 0.3)
    heights = np.tile(rng.uniform(25e-3, 35e-3) - slope * (np.arange(41) - 20) * 1e-3, (n, 1))
    images = 0.8 * np.roll(fan_sections(linear, angular, heights), 1, axis=1)
    gravity = np.tile([0.0, 0.0, -9.81], (n, 1))
    return Bead(path, draw, 1e-3 * np.arange(n), linear, angular, gravity, heights, images)


def write(folder, beads):
    """Stores beads as ``experiments.laydown runs`` does."""
    for name in {b.path for b in beads}:
        mine = [b for b in beads if b.path == name]
        arrays = {
            "draw": np.concatenate([np.full(len(b.arcs_m), b.draw, np.int32) for b in mine]),
            "image": np.concatenate([np.round(255 * b.images).astype(np.uint8) for b in mine]),
            "arc_m": np.concatenate([b.arcs_m for b in mine]).astype(np.float32),
        }
        for key in ("linear_mps", "angular_radps", "gravity_mps2", "heights_m"):
            arrays[key] = np.concatenate([getattr(b, key) for b in mine]).astype(np.float32)
        np.savez_compressed(folder / f"{name}.npz", **arrays)
