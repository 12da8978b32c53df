"""What disturbances add to the raycaster's pictures: a band of shadow on the part, a ball before it."""

import math
from typing import Any

import numpy as np

from seal_gym.core.frames import Array
from seal_gym.core.jit import kernel
from seal_gym.sim.look import Look
from seal_gym.sim.scene import SKIN_RGB

_SKIN = tuple(255.0 * c for c in SKIN_RGB)
_PENUMBRA_M = 1e-3


@kernel
def cast_shadow(
    near: Array, rotation: Array, position: Array, ray_x: Array, ray_y: Array, band: Array, picture: Array
) -> None:
    """Darkens the part's pixels that lie in a band of shadow, with soft edges.

    Args:
        near: 1 / depth of what each pixel shows, 0 for nothing, shape (height, width), 1/m.
        rotation: ``R_tip_camera``, shape (3, 3).
        position: Optical centre in the tip frame, shape (3,), m.
        ray_x: x of the rays (x, y, 1), shape (width,).
        ray_y: y of the rays, shape (height,).
        band: A row of ``Look.shadow``.
        picture: Grey levels, changed in place, shape (height, 3 width).
    """
    for i in range(len(ray_y)):
        for j in range(len(ray_x)):
            if near[i, j] <= 0.0:
                continue
            along = -band[3]
            for a in range(3):
                ray = rotation[a, 0] * ray_x[j] + rotation[a, 1] * ray_y[i] + rotation[a, 2]
                along += band[a] * (position[a] + ray / near[i, j])
            dark = min(max((band[4] - abs(along)) / _PENUMBRA_M + 0.5, 0.0), 1.0)
            for c in range(3):
                picture[i, 3 * j + c] *= 1.0 - band[5] * dark


@kernel
def draw_ball(tip: Array, view: Any, look: Look, row: int, near: Array, picture: Array) -> None:
    """Draws a ball over what lies behind it; a pixel on its outline is covered in part.

    Args:
        tip: ``T_world_tip``, shape (4, 4), m.
        view: The raycaster's camera.
        look: The looks: ball and light of the row.
        row: Which look.
        near: 1 / depth of the part in each pixel, shape (height, width), 1/m.
        picture: Grey levels, changed in place, shape (height, 3 width).
    """
    ball, lamp = look.ball[row], look.lamp[row]
    centre, light, mouth = np.zeros(3), np.zeros(3), 0.0
    for a in range(3):
        offset = -view.position[a]
        for b in range(3):
            offset += tip[b, a] * (ball[b] - tip[b, 3])
        mouth -= view.rotation[a, 2] * view.position[a]
        for b in range(3):
            centre[b] += view.rotation[a, b] * offset
            light[b] += view.rotation[a, b] * lamp[a]
    radius = ball[3]
    if centre[2] < -radius:
        return
    squared = centre[0] ** 2 + centre[1] ** 2 + centre[2] ** 2
    for i in range(len(view.ray_y)):
        for j in range(len(view.ray_x)):
            x, y = view.ray_x[j], view.ray_y[i]
            length = math.sqrt(x * x + y * y + 1.0)
            along = (x * centre[0] + y * centre[1] + centre[2]) / length
            miss = math.sqrt(max(squared - along * along, 0.0))
            # The size of a pixel at the ball; a camera inside the ball sees nothing else.
            pixel = max(along, radius) / view.focal
            cover = min(max((radius - miss) / pixel + 0.5, 0.0), 1.0)
            reach = along - math.sqrt(max(radius * radius - miss * miss, 0.0))
            if cover <= 0.0 or along + radius <= 0.0:
                continue
            depth = max(reach, 0.0) / length
            # The nozzle reaches from the camera's side down to the mouth.
            if depth * near[i, j] > 1.0 or (view.alpha[i, j] > 0.5 and depth > mouth):
                continue
            cosine = 0.0
            for a in range(3):
                ray = (x, y, 1.0)[a] * reach / length
                cosine += light[a] * (ray - centre[a]) / radius
            bright = look.ambient[row] + look.diffuse[row] * max(cosine, 0.0)
            for c in range(3):
                below = picture[i, 3 * j + c]
                picture[i, 3 * j + c] = below + cover * (bright * _SKIN[c] - below)
