"""The default sensor renderer: both ROI images by exact ray casting on the CPU, without GL.

Triangles are tested against the rays of the pixels in their boxes (no search tree: the ROIs see a few
square centimetres). Pixels where the picture has an edge are sampled with 16 rays. Only ``+ - * / sqrt``
and integers are used, without fast-math, so the same poses give the same bytes on every machine.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.cell import CameraCfg, CellCfg
from seal_gym.core.errors import RenderError, require
from seal_gym.core.frames import Array, cross
from seal_gym.core.jit import kernel
from seal_gym.core.parallel import split
from seal_gym.sim import texture
from seal_gym.sim.look import MAX_BLUR_PX, Look
from seal_gym.sim.raycast_bead import BeadView, draw_bead
from seal_gym.sim.raycast_extras import cast_shadow, draw_ball
from seal_gym.workpieces.surface import MATERIALS, Surface

Ints = NDArray[np.int32]
Bytes = NDArray[np.uint8]
Counters = NDArray[np.uint64]

BACKGROUND = 18.0  # grey level where no ray hits the part
NOZZLE_RGB = (0.95, 0.80, 0.35)
SNR_LIMIT_DB = 99.0

_NEAR_M = 1e-3
_EDGE_COS = 0.990  # faces that meet at more than 8 deg make an edge
_DEPTH_JUMP = 0.004  # relative
_SAMPLES = 16
# Rays in an edge pixel: each of the 16 columns and rows once, so that the coverage of edges along the pixel
# grid (a seam at its nominal place) has 16 steps instead of 4; point-symmetric, so edges are not displaced.
_LATTICE = np.array([[i + 0.5, (7 * i + 3) % 16 + 0.5] for i in range(_SAMPLES)]) / 16 - 0.5
_TOOL_SAMPLES = 16
_BINS = 512
_CLIP_SIGMAS = 3.0
_MAX_CLIP_MARGIN = 48.0
_TAPS = int(MAX_BLUR_PX / 2 + 1)
_TEXELS_PER_M = 1.0 / texture.TEXEL_M
_TEXEL_MASK = texture.SIZE - 1

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_S8, _S27, _S30, _S31, _S48 = (np.uint64(k) for k in (8, 27, 30, 31, 48))
_TWO = np.uint64(2)
_EVEN_BYTES = np.uint64(0x00FF00FF00FF00FF)
_ADD_LANES = np.uint64(0x0001000100010001)
# Sum of 8 uniform bytes: mean 8 * 255 / 2, variance 8 * (256^2 - 1) / 12.
_BYTES_MEAN = 1020.0
_PER_BYTES_SIGMA = 1.0 / math.sqrt(43690.0)
_THIRD = 1.0 / 3.0
_NO_BEAD = BeadView.none()


class Images(NamedTuple):
    """The ROI images of N simulations.

    Attributes:
        front: Shape (N, height, width, 3).
        side: Shape (N, height, width, 3).
        snr_db: Signal-to-noise ratio of either view, 10 log10(var(noise-free ROI) / var(noise)), within
            +-``SNR_LIMIT_DB``, shape (N, 2), dB.
    """

    front: Bytes
    side: Bytes
    snr_db: Array


class _Mesh(NamedTuple):
    """The part's triangles, in its own frame."""

    corner: Array  # (n, 3, 3)
    plane: Array  # (n, 4): outward normal, and its product with a corner
    sphere: Array  # (n, 4): centre and radius of a sphere around the triangle
    uv: Array  # (n, 3, 2), texels
    material: Ints  # (n,)
    albedo: Array  # (materials, 4): colour in grey levels, amplitude of the texture
    grain: Array  # (512, 512)


class _View(NamedTuple):
    """A camera's geometry and the nozzle in front of it."""

    number: int  # 0 front, 1 side
    rotation: Array  # R_tip_camera, (3, 3)
    position: Array  # in the tip frame, (3,)
    ray_x: Array  # x of the rays (x, y, 1) through the pixels' centres, (width,)
    ray_y: Array  # (height,)
    focal: float
    lattice: Array  # of an edge pixel's rays, relative to the centre's, (16, 2)
    axis: Array  # of a cone around all rays, in the camera's frame, (3,)
    cone_cos: float
    cone_sin: float
    alpha: Array  # nozzle's coverage, (height, width)
    tool_normal: Array  # its mean normal in the tip frame, (height, width, 3)
    tool_albedo: Array  # (3,), grey levels


class _Shown(NamedTuple):
    """Triangles that may be in the picture, as linear functions of the ray (x, y, 1) in the camera's frame.

    Flat tables, and no slices of them: a view made per pixel would cost more than what is done with it.
    """

    edge: Array  # (n, 9): three functions, all >= 0 where the ray hits
    face: Array  # (n, 13): functions 1 / z, u / z, v / z; colour without texture; texture's amplitude
    box: Ints  # (n, 4): first and last + 1 column, first and last + 1 row
    which: Ints  # (n,): index into the mesh


class _Buffers(NamedTuple):
    """Scratch of one frame."""

    near: Array  # largest 1 / z, (height, width)
    owner: Ints  # index into _Shown, -1 for none, (height, width)
    slot: Ints  # index among the edge pixels, -1 for none, (height, width)
    ends: Ints  # first and last + 1 column with an edge, (height, 2)
    sub_near: Array  # (pixels, 16)
    sub_owner: Ints  # (pixels, 16)
    picture: Array  # (height, 3 width)
    work: Array  # (height, 3 width)
    bins: NDArray[np.int64]  # (2, 512)


@kernel
def _part_to_camera(
    tip: Array, part: Array, view: _View, lamp: Array, rot: Array, eye: Array, lamp_part: Array
) -> None:
    """Camera pose and lamp direction in the part's frame; scalar, as BLAS sums differently elsewhere."""
    turn, place = view.rotation, view.position
    world = np.empty((3, 3))
    shift = np.empty(3)
    for i in range(3):
        for j in range(3):
            world[i, j] = tip[i, 0] * turn[0, j] + tip[i, 1] * turn[1, j] + tip[i, 2] * turn[2, j]
        moved = tip[i, 0] * place[0] + tip[i, 1] * place[1] + tip[i, 2] * place[2]
        shift[i] = (tip[i, 3] - part[i, 3]) + moved
    light = np.empty(3)
    for i in range(3):
        light[i] = tip[i, 0] * lamp[0] + tip[i, 1] * lamp[1] + tip[i, 2] * lamp[2]
    for i in range(3):
        for j in range(3):
            rot[i, j] = part[0, i] * world[0, j] + part[1, i] * world[1, j] + part[2, i] * world[2, j]
        eye[i] = part[0, i] * shift[0] + part[1, i] * shift[1] + part[2, i] * shift[2]
        lamp_part[i] = part[0, i] * light[0] + part[1, i] * light[1] + part[2, i] * light[2]


@kernel
def _hidden(
    k: int, plane: Array, sphere: Array, axis: Array, eye: Array, cone_cos: float, cone_sin: float
) -> bool:
    """Whether a triangle shows its back or lies outside the cone around the ROI's rays."""
    facing = plane[k, 0] * eye[0] + plane[k, 1] * eye[1] + plane[k, 2] * eye[2]
    if facing <= plane[k, 3]:
        return True
    x, y, z = sphere[k, 0] - eye[0], sphere[k, 1] - eye[1], sphere[k, 2] - eye[2]
    along = x * axis[0] + y * axis[1] + z * axis[2]
    across = math.sqrt(max(0.0, x * x + y * y + z * z - along * along))
    reach = sphere[k, 3]
    return bool(along < -reach or across * cone_cos - along * cone_sin > reach)


@kernel
def _pixel_box(p: Array, ray_x: Array, ray_y: Array, focal: float, box: Ints, m: int) -> bool:
    """Pixels that a triangle (camera frame) may touch; the whole ROI if a corner is beside the camera."""
    width, height = len(ray_x), len(ray_y)
    box[m, 0], box[m, 1], box[m, 2], box[m, 3] = 0, width, 0, height
    if min(p[0, 2], min(p[1, 2], p[2, 2])) < _NEAR_M:  # noqa: PLW3301 - numba inlines two arguments
        return True
    xa, xb, xc = p[0, 0] / p[0, 2], p[1, 0] / p[1, 2], p[2, 0] / p[2, 2]
    ya, yb, yc = p[0, 1] / p[0, 2], p[1, 1] / p[1, 2], p[2, 1] / p[2, 2]
    left, top = ray_x[0], ray_y[0]
    # Clamped before the conversion to integers, which must not overflow.
    box[m, 0] = int(min(max((min(xa, min(xb, xc)) - left) * focal - 0.5, 0.0), width + 0.0))  # noqa: PLW3301
    box[m, 1] = int(min(max((max(xa, max(xb, xc)) - left) * focal + 2.5, 0.0), width + 0.0))  # noqa: PLW3301
    box[m, 2] = int(min(max((min(ya, min(yb, yc)) - top) * focal - 0.5, 0.0), height + 0.0))  # noqa: PLW3301
    box[m, 3] = int(min(max((max(ya, max(yb, yc)) - top) * focal + 2.5, 0.0), height + 0.0))  # noqa: PLW3301
    return bool(box[m, 0] < box[m, 1] and box[m, 2] < box[m, 3])


@kernel
def _planes(p: Array, uv: Array, k: int, edge: Array, face: Array, m: int) -> bool:
    """Where the ray hits, as linear functions; exact opposites on a shared edge, so there are no cracks."""
    for n in range(3):
        a, b = (n + 2) % 3, (n + 1) % 3
        edge[m, 3 * n] = p[a, 1] * p[b, 2] - p[a, 2] * p[b, 1]
        edge[m, 3 * n + 1] = p[a, 2] * p[b, 0] - p[a, 0] * p[b, 2]
        edge[m, 3 * n + 2] = p[a, 0] * p[b, 1] - p[a, 1] * p[b, 0]
    volume = p[0, 0] * edge[m, 0] + p[0, 1] * edge[m, 1] + p[0, 2] * edge[m, 2]
    if volume <= 0.0:
        return False
    share = 1.0 / volume
    for i in range(3):
        e0, e1, e2 = edge[m, i] * share, edge[m, 3 + i] * share, edge[m, 6 + i] * share
        face[m, i] = e0 + e1 + e2
        face[m, 3 + i] = uv[k, 0, 0] * e0 + uv[k, 1, 0] * e1 + uv[k, 2, 0] * e2
        face[m, 6 + i] = uv[k, 0, 1] * e0 + uv[k, 1, 1] * e1 + uv[k, 2, 1] * e2
    return True


@kernel
def _select(
    mesh: _Mesh, view: _View, look: Look, row: int, rot: Array, eye: Array, lamp: Array, shown: _Shown
) -> int:
    """Fills ``shown`` with the triangles that may be in the picture; returns how many."""
    axis = np.empty(3)
    for i in range(3):
        axis[i] = rot[i, 0] * view.axis[0] + rot[i, 1] * view.axis[1] + rot[i, 2] * view.axis[2]
    corner, plane, sphere, uv = mesh.corner, mesh.plane, mesh.sphere, mesh.uv
    edge, face, box, which = shown.edge, shown.face, shown.box, shown.which
    albedo, material = mesh.albedo, mesh.material
    ray_x, ray_y, focal, cone_cos, cone_sin = view.ray_x, view.ray_y, view.focal, view.cone_cos, view.cone_sin
    ambient, diffuse, strength = look.ambient[row], look.diffuse[row], look.texture[row]
    points = np.empty((3, 3))
    m = 0
    for k in range(len(corner)):
        if _hidden(k, plane, sphere, axis, eye, cone_cos, cone_sin):
            continue
        for v in range(3):
            x, y, z = corner[k, v, 0] - eye[0], corner[k, v, 1] - eye[1], corner[k, v, 2] - eye[2]
            for i in range(3):
                points[v, i] = rot[0, i] * x + rot[1, i] * y + rot[2, i] * z
        if not _pixel_box(points, ray_x, ray_y, focal, box, m):
            continue
        if not _planes(points, uv, k, edge, face, m):
            continue
        which[m] = k
        cosine = plane[k, 0] * lamp[0] + plane[k, 1] * lamp[1] + plane[k, 2] * lamp[2]
        light = ambient + diffuse * max(0.0, cosine)
        for i in range(3):
            face[m, 9 + i] = albedo[material[k], i] * light
        face[m, 12] = albedo[material[k], 3] * strength
        m += 1
    return m


@kernel
def _at(table: Array, k: int, first: int, x: float, y: float) -> float:
    """A linear function of the ray, from a table."""
    return float(table[k, first] * x + (table[k, first + 1] * y + table[k, first + 2]))


@kernel
def _per_slope(a: float, focal: float) -> float:
    """Columns per unit of a linear function; 0 for one that does not change along a row."""
    return focal / a if abs(a) > 1e-30 else 0.0


@kernel
def _narrow(per: float, c: float, origin: float, first: int, last: int) -> tuple[int, int]:
    """Columns among first..last - 1 where a x + c can be >= 0, with one to spare for rounding."""
    # Clamped before the conversion to integers, which must not overflow.
    zero = min(max(-c * per - origin, -4.0), last + 4.0)
    if per > 0.0:
        return max(first, int(zero) - 1), last
    if per < 0.0:
        return first, min(last, int(zero) + 3)
    return first, last


@kernel
def _rasterise(
    edge: Array,
    face: Array,
    box: Ints,
    count: int,
    ray_x: Array,
    ray_y: Array,
    focal: float,
    near: Array,
    owner: Ints,
) -> None:
    """Nearest triangle of each ray in the grid ray_x, ray_y."""
    near[:] = 0.0
    owner[:] = -1
    origin = ray_x[0] * focal
    for k in range(count):
        ax, bx, cx, wx = edge[k, 0], edge[k, 3], edge[k, 6], face[k, 0]
        a_per, b_per, c_per = _per_slope(ax, focal), _per_slope(bx, focal), _per_slope(cx, focal)
        for i in range(box[k, 2], box[k, 3]):
            y = ray_y[i]
            a0 = edge[k, 1] * y + edge[k, 2]
            b0 = edge[k, 4] * y + edge[k, 5]
            c0 = edge[k, 7] * y + edge[k, 8]
            w0 = face[k, 1] * y + face[k, 2]
            # A long thin triangle fills little of its box.
            first, last = _narrow(a_per, a0, origin, box[k, 0], box[k, 1])
            first, last = _narrow(b_per, b0, origin, first, last)
            first, last = _narrow(c_per, c0, origin, first, last)
            for j in range(first, last):
                x = ray_x[j]
                if ax * x + a0 >= 0.0 and bx * x + b0 >= 0.0 and cx * x + c0 >= 0.0:
                    w = wx * x + w0
                    if w > near[i, j]:
                        near[i, j] = w
                        owner[i, j] = k


@kernel
def _folded(a: int, b: int, plane: Array, material: Ints) -> bool:
    """Whether two of the mesh's triangles differ in material or direction."""
    if material[a] != material[b]:
        return True
    cosine = plane[a, 0] * plane[b, 0] + plane[a, 1] * plane[b, 1] + plane[a, 2] * plane[b, 2]
    return bool(cosine < _EDGE_COS)


@kernel
def _torn(p: int, q: int, face: Array, xp: float, yp: float, xq: float, yq: float) -> bool:
    """Whether neither face's plane reaches the other's point: one stands in front of the other."""
    near_p, near_q = _at(face, p, 0, xp, yp), _at(face, q, 0, xq, yq)
    gap_p = abs(_at(face, q, 0, xp, yp) - near_p)
    gap_q = abs(_at(face, p, 0, xq, yq) - near_q)
    torn: bool = min(gap_p, gap_q) > _DEPTH_JUMP * max(near_p, near_q)
    return torn


@kernel
def _mark_edges(mesh: _Mesh, shown: _Shown, ray_x: Array, ray_y: Array, owner: Ints, slot: Ints) -> None:
    """Marks the pixels on either side of an edge with -2.

    An edge that cuts a pixel has the centre of one of its four neighbours on its other side, unless it ends
    there.
    """
    plane, material, face, which = mesh.plane, mesh.material, shown.face, shown.which
    height, width = owner.shape
    slot[:] = -1
    for step in range(2):
        for i in range(height - step):
            for j in range(width - 1 + step):
                r, c = i + step, j + 1 - step
                p, q = owner[i, j], owner[r, c]
                if p != q and (
                    p < 0
                    or q < 0
                    or _folded(which[p], which[q], plane, material)
                    or _torn(p, q, face, ray_x[j], ray_y[i], ray_x[c], ray_y[r])
                ):
                    slot[i, j] = -2
                    slot[r, c] = -2


@kernel
def _number_edges(alpha: Array, slot: Ints, ends: Ints) -> int:
    """Numbers the marked pixels and their neighbours, where edges may end; returns how many."""
    height, width = slot.shape
    for i in range(height):
        for j in range(width):
            if slot[i, j] == -2:
                for r, c in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)):
                    if 0 <= r < height and 0 <= c < width and slot[r, c] == -1:
                        slot[r, c] = -3
    count = 0
    for i in range(height):
        ends[i, 0], ends[i, 1] = width, 0
        for j in range(width):
            if slot[i, j] < -1:
                slot[i, j] = -1
                if alpha[i, j] < 1.0:
                    slot[i, j] = count
                    count += 1
                    ends[i, 0], ends[i, 1] = min(ends[i, 0], j), j + 1
    return count


@kernel
def _resample_pixel(
    k: int, edge: Array, face: Array, x0: float, y0: float, lattice: Array, e: int, near: Array, owner: Ints
) -> None:
    for s in range(_SAMPLES):
        x, y = x0 + lattice[s, 0], y0 + lattice[s, 1]
        if _at(edge, k, 0, x, y) >= 0.0 and _at(edge, k, 3, x, y) >= 0.0 and _at(edge, k, 6, x, y) >= 0.0:
            w = _at(face, k, 0, x, y)
            if w > near[e, s]:
                near[e, s] = w
                owner[e, s] = k


@kernel
def _cover_pixel(
    k: int, face: Array, x0: float, y0: float, lattice: Array, e: int, near: Array, owner: Ints
) -> None:
    """As ``_resample_pixel`` for a pixel that lies inside the triangle."""
    for s in range(_SAMPLES):
        w = _at(face, k, 0, x0 + lattice[s, 0], y0 + lattice[s, 1])
        if w > near[e, s]:
            near[e, s] = w
            owner[e, s] = k


@kernel
def _resample(
    shown: _Shown,
    count: int,
    ray_x: Array,
    ray_y: Array,
    focal: float,
    lattice: Array,
    slot: Ints,
    ends: Ints,
    near: Array,
    owner: Ints,
    edges: int,
) -> None:
    """Sixteen rays through each edge pixel, against the triangles that may touch it."""
    edge, face, box = shown.edge, shown.face, shown.box
    near[:edges] = 0.0
    owner[:edges] = -1
    origin, half = ray_x[0] * focal, 0.5 / focal
    per, slack = np.empty(3), np.empty(3)
    for k in range(count):
        for n in range(3):
            per[n] = _per_slope(edge[k, 3 * n], focal)
            # The largest value in a pixel counts, not that at its centre.
            slack[n] = (abs(edge[k, 3 * n]) + abs(edge[k, 3 * n + 1])) * half
        for i in range(box[k, 2], box[k, 3]):
            first, last = max(box[k, 0], ends[i, 0]), min(box[k, 1], ends[i, 1])
            if first >= last:
                continue
            y = ray_y[i]
            for n in range(3):
                c = edge[k, 3 * n + 1] * y + edge[k, 3 * n + 2] + slack[n]
                first, last = _narrow(per[n], c, origin, first, last)
            for j in range(first, last):
                e, x = slot[i, j], ray_x[j]
                if e < 0:
                    continue
                if (
                    _at(edge, k, 0, x, y) > slack[0]
                    and _at(edge, k, 3, x, y) > slack[1]
                    and _at(edge, k, 6, x, y) > slack[2]
                ):
                    _cover_pixel(k, face, x, y, lattice, e, near, owner)
                else:
                    _resample_pixel(k, edge, face, x, y, lattice, e, near, owner)


@kernel
def _texel(grain: Array, u: float, v: float) -> float:
    """Bilinear look-up; u, v in texels, texel centres at halves."""
    u -= 0.5
    v -= 0.5
    left, top = math.floor(u), math.floor(v)
    fu, fv = u - left, v - top
    c0, r0 = left & _TEXEL_MASK, top & _TEXEL_MASK
    c1, r1 = (c0 + 1) & _TEXEL_MASK, (r0 + 1) & _TEXEL_MASK
    upper = grain[r0, c0] + fu * (grain[r0, c1] - grain[r0, c0])
    lower = grain[r1, c0] + fu * (grain[r1, c1] - grain[r1, c0])
    return float(upper + fv * (lower - upper))


@kernel
def _tint(k: int, x: float, y: float, face: Array, grain: Array, shift_u: float, shift_v: float) -> float:
    """Factor by which the texture changes triangle k's colour along the ray (x, y, 1)."""
    strength = float(face[k, 12])
    if strength == 0.0:
        return 1.0
    z = 1.0 / _at(face, k, 0, x, y)
    u, v = _at(face, k, 3, x, y) * z + shift_u, _at(face, k, 6, x, y) * z + shift_v
    tint: float = 1.0 + strength * _texel(grain, u, v)
    return tint


@kernel
def _edge_colour(
    e: int,
    owner: Ints,
    x: float,
    y: float,
    lattice: Array,
    face: Array,
    grain: Array,
    shift_u: float,
    shift_v: float,
) -> tuple[float, float, float]:
    """Colour of an edge pixel: each triangle in it once, at the mean of the rays that hit it."""
    red, green, blue = 0.0, 0.0, 0.0
    for s in range(_SAMPLES):
        k = owner[e, s]
        if k < -1:
            continue
        hits, dx, dy = 0, 0.0, 0.0
        for t in range(s, _SAMPLES):
            if owner[e, t] == k:
                hits += 1
                dx += lattice[t, 0]
                dy += lattice[t, 1]
                owner[e, t] = -2
        share = hits / _SAMPLES
        if k < 0:
            red, green, blue = red + share * BACKGROUND, green + share * BACKGROUND, blue + share * BACKGROUND
            continue
        share *= _tint(k, x + dx / hits, y + dy / hits, face, grain, shift_u, shift_v)
        red += share * face[k, 9]
        green += share * face[k, 10]
        blue += share * face[k, 11]
    return red, green, blue


@kernel
def _paint(grain: Array, view: _View, face: Array, look: Look, row: int, buffers: _Buffers) -> None:
    """Colours of the part in all pixels that the nozzle does not cover."""
    picture, slot, owner, sub_owner = buffers.picture, buffers.slot, buffers.owner, buffers.sub_owner
    ray_x, ray_y, lattice, alpha = view.ray_x, view.ray_y, view.lattice, view.alpha
    shift_u = look.texture_offset[row, 0] * _TEXELS_PER_M
    shift_v = look.texture_offset[row, 1] * _TEXELS_PER_M
    for i in range(len(ray_y)):
        y = ray_y[i]
        for j in range(len(ray_x)):
            red, green, blue = BACKGROUND, BACKGROUND, BACKGROUND
            x, e, k = ray_x[j], slot[i, j], owner[i, j]
            if e >= 0:
                red, green, blue = _edge_colour(e, sub_owner, x, y, lattice, face, grain, shift_u, shift_v)
            elif k >= 0 and alpha[i, j] < 1.0:
                factor = _tint(k, x, y, face, grain, shift_u, shift_v)
                red, green, blue = factor * face[k, 9], factor * face[k, 10], factor * face[k, 11]
            picture[i, 3 * j] = red
            picture[i, 3 * j + 1] = green
            picture[i, 3 * j + 2] = blue


@kernel
def _paint_nozzle(alpha: Array, normal: Array, albedo: Array, look: Look, row: int, picture: Array) -> None:
    """Puts the nozzle on top: nothing comes between it and its cameras."""
    lx, ly, lz = look.lamp[row, 0], look.lamp[row, 1], look.lamp[row, 2]
    ambient, diffuse = look.ambient[row], look.diffuse[row]
    height, width = alpha.shape
    for i in range(height):
        for j in range(width):
            a = alpha[i, j]
            if a <= 0.0:
                continue
            cosine = normal[i, j, 0] * lx + normal[i, j, 1] * ly + normal[i, j, 2] * lz
            light = ambient + diffuse * max(0.0, cosine)
            for c in range(3):
                below = picture[i, 3 * j + c]
                picture[i, 3 * j + c] = below + a * (albedo[c] * light - below)


@kernel
def _below(t: float) -> float:
    """Integral of the triangle function max(0, 1 - |x|) up to t."""
    if t <= -1.0:
        return 0.0
    if t >= 1.0:
        return 1.0
    return 0.5 + t - 0.5 * t * abs(t)


@kernel
def _blur(picture: Array, out: Array, length: float, vertical: bool) -> None:
    """Mean over a stretch of ``length`` px of the linearly interpolated picture; its border is repeated."""
    height, width = picture.shape
    half = 0.5 * length
    taps = min(_TAPS, math.ceil(half))
    middle = 2.0 * (_below(half) - 0.5) / length if length > 0.0 else 1.0
    for i in range(height):
        for m in range(width):
            out[i, m] = middle * picture[i, m]
        for k in range(1, taps + 1):
            weight = (_below(half - k) - _below(-half - k)) / length
            if vertical:
                r, q = max(i - k, 0), min(i + k, height - 1)
                for m in range(width):
                    out[i, m] += weight * (picture[r, m] + picture[q, m])
            else:
                inset = min(3 * k, width // 2)
                for m in range(inset, width - inset):
                    out[i, m] += weight * (picture[i, m - 3 * k] + picture[i, m + 3 * k])
                for m in range(inset):
                    out[i, m] += weight * (picture[i, m % 3] + picture[i, m + 3 * k])
                    n = width - 1 - m
                    out[i, n] += weight * (picture[i, n - 3 * k] + picture[i, width - 3 + n % 3])


@kernel
def _levels(picture: Array, allowed: float, bins: NDArray[np.int64]) -> tuple[float, float]:
    """Grey levels that at most ``allowed`` pixels are below (darkest channel) and above (brightest)."""
    bins[:] = 0
    height, width = picture.shape
    for i in range(height):
        for m in range(0, width, 3):
            r, g, b = picture[i, m], picture[i, m + 1], picture[i, m + 2]
            darkest = max(min(r, min(g, b)), 0.0)  # noqa: PLW3301 - two arguments are what numba inlines
            brightest = max(r, max(g, b))  # noqa: PLW3301
            bins[0, int(min(darkest, _BINS - 1.0))] += 1
            bins[1, int(min(max(brightest, 0.0), _BINS - 1.0))] += 1
    low, high = 0, _BINS - 1
    seen = bins[0, 0]
    while seen <= allowed and low < _BINS - 1:
        low += 1
        seen += bins[0, low]
    seen = bins[1, _BINS - 1]
    while seen <= allowed and high > 0:
        high -= 1
        seen += bins[1, high]
    return low + 0.0, high + 1.0


@kernel
def _expose(picture: Array, look: Look, row: int, bins: NDArray[np.int64]) -> tuple[float, float]:
    """Gain and offset: contrast and brightness, less what would clip more than the allowed pixels.

    Two fifths of these may lie beyond either end before noise; the last fifth is for the noise's tails.
    """
    gain = 1.0 + look.contrast[row]
    offset = 127.5 * (1.0 - gain) + 255.0 * look.brightness[row]
    if look.clip_fraction[row] >= 1.0:
        return gain, offset
    margin = min(_CLIP_SIGMAS * look.noise_sigma[row], _MAX_CLIP_MARGIN)
    pixels = picture.size / 3.0
    low, high = _levels(picture, 0.4 * look.clip_fraction[row] * pixels, bins)
    space = 255.0 - 2.0 * margin
    if gain * (high - low) > space:
        smaller = space / (high - low)
        offset += (gain - smaller) * 127.5
        gain = smaller
    offset = min(offset, 255.0 - margin - gain * high)
    return gain, max(offset, margin - gain * low)


@kernel
def _mix(z: np.uint64) -> np.uint64:
    """Splitmix64's finaliser: every bit of the result depends on every bit of z."""
    z = (z ^ (z >> _S30)) * _MIX_1
    z = (z ^ (z >> _S27)) * _MIX_2
    return z ^ (z >> _S31)


@kernel
def _gauss(word: np.uint64) -> float:
    """Nearly Gaussian number of mean 0 and variance 1: the sum of a random word's eight bytes."""
    pairs = (word & _EVEN_BYTES) + ((word >> _S8) & _EVEN_BYTES)
    total = (pairs * _ADD_LANES) >> _S48
    return (np.float64(np.int64(total)) - _BYTES_MEAN) * _PER_BYTES_SIGMA


@kernel
def _sense(
    picture: Array,
    work: Array,
    bins: NDArray[np.int64],
    look: Look,
    row: int,
    view: int,
    frame: np.uint64,
    out: Bytes,
) -> float:
    """Blur, exposure, noise and rounding of one image; returns the noise-free picture's variance."""
    _blur(picture, work, look.blur_px[row], view == 0)
    gain, offset = _expose(work, look, row, bins)
    word = _mix(_mix(look.seed[row] + _GOLDEN) ^ (_TWO * frame + np.uint64(view)))
    sigma = look.noise_sigma[row]
    height, width = work.shape[0], work.shape[1] // 3
    total, squares = 0.0, 0.0
    for i in range(height):
        for j in range(width):
            r, g, b = gain * work[i, 3 * j], gain * work[i, 3 * j + 1], gain * work[i, 3 * j + 2]
            grey = (r + g + b) * _THIRD
            total += grey
            squares += grey * grey
            word += _GOLDEN
            # Truncation rounds to nearest here, as negative values are clipped.
            noise = offset + sigma * _gauss(_mix(word)) + 0.5
            out[i, j, 0] = np.uint8(np.int64(min(max(r + noise, 0.0), 255.0)))
            out[i, j, 1] = np.uint8(np.int64(min(max(g + noise, 0.0), 255.0)))
            out[i, j, 2] = np.uint8(np.int64(min(max(b + noise, 0.0), 255.0)))
    mean = total / (height * width)
    return float(max(0.0, squares / (height * width) - mean * mean))


@kernel
def _sense_batch(
    pictures: Array, look: Look, view: int, frame: Counters, out: Bytes, variance: Array
) -> None:
    work = np.empty(pictures.shape[1:])
    bins = np.empty((2, _BINS), np.int64)
    for n in range(len(pictures)):
        variance[n] = _sense(pictures[n], work, bins, look, n, view, frame[n], out[n])


@kernel
def _render_batch(
    mesh: _Mesh,
    view: _View,
    look: Look,
    frame: Counters,
    tip: Array,
    part: Array,
    first: int,
    last: int,
    bead: BeadView,
    shown: _Shown,
    b: _Buffers,
    out: Bytes,
    variance: Array,
) -> None:
    """Frames first..last - 1 of one view."""
    ray_x, ray_y = view.ray_x, view.ray_y
    rot, eye, lamp = np.empty((3, 3)), np.empty(3), np.empty(3)
    for row in range(first, last):
        _part_to_camera(tip[row], part[row], view, look.lamp[row], rot, eye, lamp)
        count = _select(mesh, view, look, row, rot, eye, lamp, shown)
        _rasterise(shown.edge, shown.face, shown.box, count, ray_x, ray_y, view.focal, b.near, b.owner)
        _mark_edges(mesh, shown, ray_x, ray_y, b.owner, b.slot)
        edges = _number_edges(view.alpha, b.slot, b.ends)
        _resample(
            shown,
            count,
            ray_x,
            ray_y,
            view.focal,
            view.lattice,
            b.slot,
            b.ends,
            b.sub_near,
            b.sub_owner,
            edges,
        )
        _paint(mesh.grain, view, shown.face, look, row, b)
        if len(bead.height) > 0:
            draw_bead(bead, row, rot, eye, lamp, view, look, b.near, b.picture)
        if look.shadow[row, 5] > 0.0:
            cast_shadow(b.near, view.rotation, view.position, ray_x, ray_y, look.shadow[row], b.picture)
        _paint_nozzle(view.alpha, view.tool_normal, view.tool_albedo, look, row, b.picture)
        if look.ball[row, 3] > 0.0:
            draw_ball(tip[row], view, look, row, b.near, b.picture)
        variance[row] = _sense(b.picture, b.work, b.bins, look, row, view.number, frame[row], out[row])


def _room(triangles: int, height: int, width: int) -> tuple[_Shown, _Buffers]:
    """Scratch for a mesh and a ROI."""
    shown = _Shown(
        edge=np.empty((triangles, 9)),
        face=np.empty((triangles, 13)),
        box=np.empty((triangles, 4), np.int32),
        which=np.empty(triangles, np.int32),
    )
    buffers = _Buffers(
        near=np.empty((height, width)),
        owner=np.empty((height, width), np.int32),
        slot=np.empty((height, width), np.int32),
        ends=np.empty((height, 2), np.int32),
        sub_near=np.empty((height * width, _SAMPLES)),
        sub_owner=np.empty((height * width, _SAMPLES), np.int32),
        picture=np.empty((height, 3 * width)),
        work=np.empty((height, 3 * width)),
        bins=np.empty((2, _BINS), np.int64),
    )
    return shown, buffers


def _snr_db(variance: Array, sigma: Array) -> Array:
    """Large but finite without noise, and very negative without a picture."""
    ratio = (variance + 1e-12) / (sigma[:, None] ** 2 + 1e-12)
    return np.clip(10.0 * np.log10(ratio), -SNR_LIMIT_DB, SNR_LIMIT_DB)


def apply_sensor(
    front: NDArray[np.generic], side: NDArray[np.generic], look: Look, frame: Counters
) -> Images:
    """What the sensor makes of ideal pictures, whoever drew them: blur, exposure, noise and rounding.

    Args:
        front: Front view, grey levels 0..255 of any type, shape (N, height, width, 3).
        side: Side view, likewise.
        look: The looks; lamp and texture are the renderer's business.
        frame: Frame counters, shape (N,): the noise is a function of seed, frame, view and pixel.

    Returns:
        The sensor's images.

    Raises:
        RenderError: If the shapes do not fit together.
    """
    out, variance = [], np.empty((2, len(front)))
    for index, raw in enumerate((front, side)):
        require(
            raw.ndim == 4
            and min(raw.shape[1:3]) >= 8
            and raw.shape[0] == len(look.seed) == len(frame)
            and raw.shape[3] == 3,
            f"image has shape {raw.shape}: must be ({len(look.seed)}, height, width, 3), at least 8 px",
            RenderError,
        )
        pictures = np.ascontiguousarray(raw, dtype=np.float64).reshape(*raw.shape[:2], -1)
        image = np.empty(raw.shape, np.uint8)
        _sense_batch(pictures, look, index, np.ascontiguousarray(frame, np.uint64), image, variance[index])
        out.append(image)
    return Images(out[0], out[1], _snr_db(np.ascontiguousarray(variance.T), look.noise_sigma))


def _grid(x: Array) -> Array:
    """Rounds to 2^-34 (0.06 nm), which hides what sine, cosine and BLAS differ by between machines."""
    return np.ascontiguousarray(np.rint(np.asarray(x, dtype=np.float64) * 2.0**34) / 2.0**34)


def _mesh_of(surface: Surface) -> _Mesh:
    corner = _grid(surface.triangles)
    snapped = Surface(triangles=corner, material=surface.material)
    low, high = corner.min(axis=1), corner.max(axis=1)
    centre = 0.5 * (low + high)
    radius = np.sqrt(np.sum((corner - centre[:, None]) ** 2, axis=2).max(axis=1)) + 1e-9
    normal = _grid(snapped.normals)
    albedo = [(*(255.0 * c for c in m.rgb), m.texture) for m in MATERIALS]
    return _Mesh(
        corner=corner,
        plane=np.column_stack((normal, np.sum(normal * corner[:, 0], axis=1))),
        sphere=np.column_stack((centre, radius)),
        uv=np.ascontiguousarray(snapped.uv_m * _TEXELS_PER_M),
        material=np.ascontiguousarray(surface.material, dtype=np.int32),
        albedo=np.array(albedo),
        grain=np.ascontiguousarray(texture.modulation()),
    )


def _facing(corner: Array) -> tuple[Array, Array, NDArray[np.intp]]:
    """Tables as in ``_Shown`` of the triangles (camera frame) that face the camera, and which these are."""
    a, b, c = corner[:, 0], corner[:, 1], corner[:, 2]
    edge = np.stack((cross(c, b), cross(a, c), cross(b, a)), axis=1)
    volume = np.sum(a * edge[:, 0], axis=1)
    front = np.flatnonzero(volume > 0)
    face = np.zeros((len(front), 13))
    face[:, :3] = edge[front].sum(axis=1) / volume[front, None]
    return np.ascontiguousarray(edge[front].reshape(-1, 9)), face, front


def _tool_layer(
    tool: Array, camera: CameraCfg, rotation: Array, position: Array, rays: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Coverage and mean normal of the nozzle in each pixel: rigid in the camera, hence drawn once."""
    offset = tool - position
    local = sum(offset[..., k, None] * rotation[k] for k in range(3))
    require(
        len(tool) == 0 or float(np.min(local[..., 2])) > _NEAR_M,
        f"the tool reaches behind the {camera.name} camera: give the nozzle's triangles only",
        RenderError,
    )
    edge, face, front = _facing(np.asarray(local))
    n = _TOOL_SAMPLES
    step = ((np.arange(n) + 0.5) / n - 0.5) / camera.focal_px
    fine_x, fine_y = ((r[:, None] + step).ravel() for r in rays)
    box = np.tile(np.array([0, len(fine_x), 0, len(fine_y)], np.int32), (len(front), 1))
    near, owner = np.empty((len(fine_y), len(fine_x))), np.empty((len(fine_y), len(fine_x)), np.int32)
    _rasterise(edge, face, box, len(front), fine_x, fine_y, n * float(camera.focal_px), near, owner)
    edge_1, edge_2 = tool[:, 1] - tool[:, 0], tool[:, 2] - tool[:, 0]
    normal = cross(edge_1, edge_2)
    length = np.sqrt(np.sum(normal * normal, axis=1, keepdims=True))
    normal = np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)
    table = np.concatenate((normal[front], np.zeros((1, 3))))  # owner -1 is the last row
    height, width = camera.height, camera.width
    hit = (owner >= 0).reshape(height, n, width, n).sum(axis=(1, 3))
    total = table[owner].reshape(height, n, width, n, 3).sum(axis=(1, 3))
    return hit / n**2, _grid(total / np.maximum(hit, 1)[..., None])


def _view_of(number: int, camera: CameraCfg, tool: Array) -> _View:
    rotation, position, centre = _grid(camera.rotation), _grid(camera.position_m), _grid(camera.centre_px)
    focal = float(camera.focal_px)
    ray_x = (np.arange(camera.width) + 0.5 - centre[0]) / focal
    ray_y = (np.arange(camera.height) + 0.5 - centre[1]) / focal
    sides = [
        np.array([x, y, 1.0])
        for x in ((0.0 - centre[0]) / focal, (camera.width - centre[0]) / focal)
        for y in ((0.0 - centre[1]) / focal, (camera.height - centre[1]) / focal)
    ]
    sides = [s / np.sqrt(np.sum(s * s)) for s in sides]
    axis = sum(sides, np.zeros(3))
    axis /= np.sqrt(np.sum(axis * axis))
    cosine = float(min(np.sum(axis * s) for s in sides))
    alpha, normal = _tool_layer(tool, camera, rotation, position, (ray_x, ray_y))
    return _View(
        number=number,
        rotation=rotation,
        position=position,
        ray_x=ray_x,
        ray_y=ray_y,
        focal=focal,
        lattice=_LATTICE / focal,
        axis=axis,
        cone_cos=cosine,
        cone_sin=math.sqrt(max(0.0, 1.0 - cosine * cosine)),
        alpha=alpha,
        tool_normal=normal,
        tool_albedo=255.0 * np.array(NOZZLE_RGB),
    )


class Raycaster:
    """Draws the ROI images of one part for any number of simulations.

    The nozzle is rigid in the cameras and always in front of the part, so it is drawn once and put on top.

    Args:
        surface: The part.
        cell: The cell's cameras.
        tool: The nozzle's triangles in the tip frame, shape (m, 3, 3), m; m may be 0.
    """

    def __init__(self, surface: Surface, cell: CellCfg, tool: Array) -> None:
        tool = _grid(tool)
        require(
            tool.ndim == 3 and tool.shape[1:] == (3, 3),
            f"tool has shape {tool.shape}: must be (m, 3, 3)",
            RenderError,
        )
        self._mesh = _mesh_of(surface)
        self._views = tuple(_view_of(k, camera, tool) for k, camera in enumerate(cell.cameras))
        # Fresh memory costs more than half of what is done in it: one set for each thread that ever drew.
        self._rooms: list[list[tuple[_Shown, _Buffers]]] = []

    def _take_rooms(self) -> list[tuple[_Shown, _Buffers]]:
        try:
            return self._rooms.pop()  # atomic, unlike asking for the length first
        except IndexError:
            n = len(self._mesh.corner)
            return [_room(n, len(v.ray_y), len(v.ray_x)) for v in self._views]

    @property
    def nozzle_alpha(self) -> tuple[Array, Array]:
        """The nozzle's coverage of each pixel, 0..1, front and side, shape (height, width)."""
        return self._views[0].alpha.copy(), self._views[1].alpha.copy()

    def render(
        self,
        tip_pose: Array,
        part_pose: Array,
        look: Look,
        frame: Counters,
        threads: int = 1,
        bead: BeadView | None = None,
    ) -> Images:
        """Draws both views of N simulations.

        Args:
            tip_pose: ``T_world_tip``, shape (N, 4, 4), m.
            part_pose: ``T_world_part``, shape (N, 4, 4), m.
            look: Lamp, exposure, noise and texture of each simulation.
            frame: Frame counters, shape (N,): the noise is a function of seed, frame, view and pixel.
            threads: Splits the batch; the images are the same for any number.
            bead: Sealant on the parts; by default none.

        Returns:
            The images and their signal-to-noise ratios.

        Raises:
            RenderError: If the shapes do not fit together or a pose is not finite.
        """
        n = len(look.seed)
        require(
            tip_pose.shape == part_pose.shape == (n, 4, 4) and np.shape(frame) == (n,) and threads >= 1,
            f"tip_pose {tip_pose.shape}, part_pose {part_pose.shape}, frame {np.shape(frame)}, "
            f"threads = {threads}: must be ({n}, 4, 4), ({n}, 4, 4), ({n},) and at least 1, as the look "
            f"has {n} rows",
            RenderError,
        )
        tip = np.ascontiguousarray(tip_pose, dtype=np.float64)
        part = np.ascontiguousarray(part_pose, dtype=np.float64)
        require(bool(np.isfinite(tip).all() and np.isfinite(part).all()), "a pose is not finite", RenderError)
        counters = np.ascontiguousarray(frame, dtype=np.uint64)
        images = [np.empty((n, len(v.ray_y), len(v.ray_x), 3), np.uint8) for v in self._views]
        variance = np.empty((2, n))
        beads = _NO_BEAD if bead is None else bead

        def draw(first: int, last: int) -> None:
            rooms = self._take_rooms()
            for view, room, image, var in zip(self._views, rooms, images, variance, strict=True):
                _render_batch(
                    self._mesh, view, look, counters, tip, part, first, last, beads, *room, image, var
                )
            self._rooms.append(rooms)

        split(draw, n, threads)
        return Images(images[0], images[1], _snr_db(np.ascontiguousarray(variance.T), look.noise_sigma))
