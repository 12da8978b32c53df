"""The renderer against independent truths: the projection, exact areas, statistics of the noise."""

import hashlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from seal_gym.core.cell import load_cell
from seal_gym.core.errors import ConfigError, RenderError
from seal_gym.core.frames import axis_angle, normalise, tip_rotation, transform
from seal_gym.sim import raycast
from seal_gym.sim.look import Look, LookCfg
from seal_gym.sim.raycast import BACKGROUND, Images, Raycaster, apply_sensor
from seal_gym.workpieces import catalogue
from seal_gym.workpieces.surface import PLATE, WALL, Surface

CELL = load_cell()
NO_TOOL = np.empty((0, 3, 3))
CLEAN = LookCfg.clean()


def looks(n: int, cfg: LookCfg, seed: int = 0) -> Look:
    out, rng = Look.empty(n), np.random.default_rng(seed)
    for i in range(n):
        out.draw(i, rng, cfg)
    return out


def nozzle() -> np.ndarray:
    """A cone of 24 sides from the mouth upwards."""
    a = np.linspace(0, 2 * np.pi, 25)
    ring = np.column_stack((np.cos(a), np.sin(a), 0 * a))
    low, high = 1.5e-3 * ring, 6e-3 * ring + [0, 0, 0.05]
    sides = [[low[:-1], low[1:], high[1:]], [low[:-1], high[1:], high[:-1]]]
    cap = [[np.zeros((24, 3)), low[1:], low[:-1]]]
    return np.concatenate([np.stack(t, axis=1) for t in sides + cap])


def poses(name: str, n: int, seed: int, spread: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Tip poses near the nominal ones, and the part's."""
    part, rng = catalogue.get(name), np.random.default_rng(seed)
    tip = np.empty((n, 4, 4))
    for k in range(n):
        position, tangent, approach = part.seam.at(rng.uniform(0.02, part.seam.length - 0.03))
        turn = axis_angle(normalise(rng.normal(size=3)), spread * np.deg2rad(rng.uniform(0, 3)))
        origin = position + CELL.process.stand_off_m * approach + spread * rng.uniform(-1e-3, 1e-3, 3)
        tip[k] = part.pose @ transform(turn @ tip_rotation(tangent, approach), origin)
    return tip, np.tile(part.pose, (n, 1, 1))


def draw(
    surface: Surface,
    tip: np.ndarray,
    part: np.ndarray,
    look: Look,
    tool: np.ndarray = NO_TOOL,
    **options: Any,
) -> Images:
    frame = np.arange(len(tip), dtype=np.uint64)
    return Raycaster(surface, CELL, tool).render(tip, part, look, frame, **options)


def before_camera(index: int, depth: float = 0.1) -> tuple[np.ndarray, Any]:
    """Pose of a part whose frame is the camera's, and a map from pixels to points on a plane there."""
    camera = CELL.cameras[index]

    def points(px: Any, z: float = depth) -> np.ndarray:
        xy = (np.asarray(px, dtype=float) - camera.centre_px) / camera.focal_px
        return np.concatenate((xy * z, np.full((*xy.shape[:-1], 1), z)), axis=-1)

    return transform(camera.rotation, camera.position_m)[None], points


def facing(*triangles: np.ndarray, material: int = PLATE) -> Surface:
    """Triangles in the camera's frame, wound so that the camera sees them."""
    fixed = [t if np.linalg.det(t) < 0 else t[::-1] for t in triangles]
    return Surface(triangles=np.array(fixed), material=np.full(len(fixed), material, np.int32))


def step_places(rows: np.ndarray) -> np.ndarray:
    """Sub-pixel place of the one step in each row, by area; nan where there is none."""
    out = np.full(len(rows), np.nan)
    for i, row in enumerate(rows):
        k = int(np.argmax(np.abs(row[6:] - row[:-6]))) + 3
        if 6 <= k < len(row) - 6:
            window = row[k - 6 : k + 7]
            left, right = window[:3].mean(), window[-3:].mean()
            out[i] = k - 6 + np.sum((window - right) / (left - right))
    return out


@pytest.mark.parametrize("name", ["flat", "cylinder"])
@pytest.mark.parametrize("index", [0, 1])
def test_seam_is_where_the_camera_model_projects_it(name: str, index: int) -> None:
    part, camera, n = catalogue.get(name), CELL.cameras[index], 12
    for spread in (0.0, 1.0):
        tip, pose = poses(name, n, seed=3, spread=spread)
        images = draw(part.surface, tip, pose, looks(n, CLEAN))
        seam = np.c_[part.seam.position, np.ones(len(part.seam.position))]
        dense = np.linspace(0, len(seam) - 1, 40 * len(seam))
        seam = np.stack([np.interp(dense, np.arange(len(seam)), c) for c in seam.T], axis=1)
        for k in range(n):
            grey = images[index][k].astype(float).mean(axis=2)
            grey = grey if index == 0 else grey.T
            local = (seam @ (np.linalg.inv(tip[k]) @ pose[k]).T)[:, :3]
            ahead = np.linalg.norm(local, axis=1) < 0.05  # not the cylinder's far side
            px = camera.project(local[ahead])
            across, along = (px[:, 0], px[:, 1]) if index == 0 else (px[:, 1], px[:, 0])
            order = np.argsort(along)
            centres = np.arange(len(grey)) + 0.5
            truth = np.interp(centres, along[order], across[order])
            # Steep stretches at the ROI's ends meet the window's borders.
            found = step_places(grey)
            good = np.isfinite(found) & (np.abs(np.gradient(truth)) < 0.35)
            assert good.sum() > 30
            error = (found - truth)[good]
            fit = np.polyval(np.polyfit(centres[good], error, 2), centres[good])
            assert np.abs(fit).max() < 0.05
            assert np.sqrt(np.mean(error**2)) < 0.05


def clipped_area(polygon: np.ndarray, column: int, row: int) -> float:
    """Area of a convex polygon inside a pixel (Sutherland-Hodgman)."""
    points = [tuple(p) for p in polygon]
    for axis, limit, sign in ((0, column, 1), (0, column + 1, -1), (1, row, 1), (1, row + 1, -1)):
        out: list[tuple[float, ...]] = []
        for p, q in zip(points, points[1:] + points[:1], strict=True):
            a, b = sign * (p[axis] - limit), sign * (q[axis] - limit)
            if a >= 0:
                out.append(p)
            if a * b < 0:
                t = a / (a - b)
                out.append(tuple(np.add(p, t * np.subtract(q, p))))
        points = out
    if len(points) < 3:
        return 0.0
    x, y = np.array(points).T
    return 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def test_edge_pixels_mix_by_area() -> None:
    pose, points = before_camera(0)
    polygon = np.array([[10.3, 12.7], [41.2, 30.1], [17.9, 88.8]])
    image = draw(facing(points(polygon)), np.eye(4)[None], pose, looks(1, CLEAN)).front[0].astype(float)
    full = image[30, 22]
    coverage = (image.mean(axis=2) - BACKGROUND) / (full.mean() - BACKGROUND)
    exact = np.array([[clipped_area(polygon, j, i) for j in range(50)] for i in range(100)])
    partial = (exact > 0.02) & (exact < 0.98)
    assert partial.sum() > 100
    error = (coverage - exact)[partial]
    assert np.abs(error).max() < 0.11  # at the corners; a sixteenth or so along the edges
    assert np.percentile(np.abs(error), 95) < 0.07
    assert abs(error.mean()) < 0.01
    assert np.abs((coverage - exact)[~partial]).max() < 0.07


def test_axis_parallel_edges_have_sixteen_steps() -> None:
    pose, points = before_camera(0)
    look = looks(1, CLEAN)
    found = []
    for u in 20.0 + np.arange(0, 1, 1 / 16):
        a, b, c, d = points([[-9, -9], [u, -9], [u, 109], [-9, 109]])
        image = draw(facing(np.stack((a, b, c)), np.stack((a, c, d))), np.eye(4)[None], pose, look).front[0]
        row = image[50, :, 0].astype(float)
        found.append(np.sum((row - row[-1]) / (row[0] - row[-1])) - u)
    assert np.abs(found).max() < 0.05


def test_same_bytes_for_any_batch_and_any_threads() -> None:
    part, n = catalogue.get("cylinder"), 8
    tip, pose = poses("cylinder", n, seed=1)
    look, caster = looks(n, LookCfg()), Raycaster(part.surface, CELL, nozzle())
    frame = np.arange(n, dtype=np.uint64) + 5
    whole = caster.render(tip, pose, look, frame)
    for again in (caster.render(tip, pose, look, frame, threads=k) for k in (1, 2, 3, 16)):
        for a, b in zip(whole, again, strict=True):
            np.testing.assert_array_equal(a, b)
    for k in range(n):
        row = Look(*(v[k : k + 1] for v in look))
        single = caster.render(tip[k : k + 1], pose[k : k + 1], row, frame[k : k + 1])
        for a, b in zip(whole, single, strict=True):
            np.testing.assert_array_equal(a[k], b[0])


def test_golden_images() -> None:
    """Fails if one bit of a noisy, textured image changes: then every published number does."""
    part = catalogue.get("rectangular")
    # Poses of exact binary fractions, as sines and BLAS may differ in the last bit.
    tip, pose = (np.round(p * 2.0**20) / 2.0**20 for p in poses("rectangular", 4, seed=9))
    look = looks(4, LookCfg())
    tool = np.round(nozzle() * 2.0**24) / 2.0**24
    images = draw(part.surface, tip, pose, look, tool)
    digest = hashlib.sha256(images.front.tobytes() + images.side.tobytes()).hexdigest()
    assert digest == "eddcb1bb3e9cbf9ca1cc0136a53a1895b76c1515444a4b817a8b7ce1cec924ac"


def test_noise_has_the_given_sigma_and_depends_on_frame_view_and_seed() -> None:
    n = 40
    look = looks(n, replace(CLEAN, noise_sigma=8.0))
    flat = np.full((n, 100, 50, 3), 128.0), np.full((n, 50, 100, 3), 128.0)
    images = apply_sensor(*flat, look, np.zeros(n, np.uint64))
    for image in images[:2]:
        np.testing.assert_array_equal(image[..., 0], image[..., 1])
        np.testing.assert_array_equal(image[..., 0], image[..., 2])
        noise = image[..., 0].astype(float) - 128.0
        assert abs(noise.mean()) < 4 * 8 / np.sqrt(noise.size)
        assert noise.std() == pytest.approx(np.sqrt(64 + 1 / 12), rel=0.01)
        assert abs(np.mean(noise[:, 1:] * noise[:, :-1])) < 0.01 * 64
        assert abs(np.mean(noise[:, :, 1:] * noise[:, :, :-1])) < 0.01 * 64
        kurtosis = np.mean(noise**4) / noise.var() ** 2
        assert 2.7 < kurtosis < 3.05
    same = Look(*(np.repeat(v[:1], n, axis=0) for v in look))
    frames = apply_sensor(*flat, same, np.arange(n, dtype=np.uint64))
    sets = [frames.front, frames.side, images.front[1:]]
    streams = np.concatenate([s[..., 0].reshape(len(s), -1) for s in sets])
    correlation = np.corrcoef(streams.astype(float))
    assert np.abs(correlation - np.eye(len(correlation))).max() < 0.1


def test_at_most_two_percent_clip() -> None:
    n = 60
    for name in ("flat", "rectangular"):
        tip, pose = poses(name, n, seed=5)
        images = draw(catalogue.get(name).surface, tip, pose, looks(n, LookCfg()), nozzle())
        for image in images[:2]:
            clipped = ((image == 0) | (image == 255)).any(axis=3).mean(axis=(1, 2))
            assert clipped.max() <= 0.02


def test_contrast_and_brightness_move_the_levels() -> None:
    ramp = np.broadcast_to(np.linspace(100, 150, 50)[:, None], (1, 100, 50, 3)), np.full((1, 50, 100, 3), 128)
    look = looks(1, replace(CLEAN, contrast=(0.3, 0.3), brightness=(-0.1, -0.1)))
    image = apply_sensor(*ramp, look, np.zeros(1, np.uint64)).front[0, :, :, 0]
    np.testing.assert_allclose(image[0], 127.5 + 1.3 * (ramp[0][0, 0, :, 0] - 127.5) - 25.5, atol=0.5)


def test_plate_and_wall_differ_whatever_the_lamp() -> None:
    n, cfg = 200, replace(LookCfg(), contrast=(0, 0), brightness=(0, 0), noise_sigma=0.0, texture=(0, 0))
    tip, pose = poses("flat", n, seed=2, spread=0.0)
    images = draw(catalogue.get("flat").surface, tip, pose, looks(n, cfg))
    front, side = (image.astype(float).mean(axis=3) for image in images[:2])
    assert (front[:, :, 32:40].mean(axis=(1, 2)) - front[:, :, 10:18].mean(axis=(1, 2))).min() > 25
    assert (side[:, 32:40].mean(axis=(1, 2)) - side[:, 10:18].mean(axis=(1, 2))).min() > 25


def test_snr() -> None:
    tip, pose = poses("flat", 1, seed=2)
    surface = catalogue.get("flat").surface
    clean = draw(surface, tip, pose, looks(1, CLEAN))
    noisy = draw(surface, tip, pose, looks(1, replace(CLEAN, noise_sigma=8.0)))
    for k in range(2):
        variance = clean[k].astype(float).mean(axis=3).var()
        assert noisy.snr_db[0, k] == pytest.approx(10 * np.log10(variance / 64), abs=0.05)
    np.testing.assert_array_equal(clean.snr_db, 99.0)
    blank = apply_sensor(
        np.zeros((1, 100, 50, 3)), np.zeros((1, 50, 100, 3)), looks(1, LookCfg()), np.zeros(1, np.uint64)
    )
    assert np.isfinite(blank.snr_db).all()


@pytest.mark.parametrize(("length", "weights"), [(1.0, [0.125, 0.75, 0.125]), (0.0, [0, 1, 0])])
def test_blur_runs_along_the_travel(length: float, weights: list[float]) -> None:
    front, side = np.full((1, 100, 50, 3), 20.0), np.full((1, 50, 100, 3), 20.0)
    front[0, 50, 25] = side[0, 25, 50] = 220.0
    look = looks(1, replace(CLEAN, blur_px=length))
    images = apply_sensor(front, side, look, np.zeros(1, np.uint64))
    expected = 20 + 200 * np.array(weights)
    np.testing.assert_allclose(images.front[0, 49:52, 25, 0], expected, atol=0.5)
    np.testing.assert_allclose(images.side[0, 25, 49:52, 0], expected, atol=0.5)
    assert images.front[0, 50, 24, 0] == images.side[0, 24, 50, 0] == 20


def test_long_blur_keeps_the_mean_and_the_border() -> None:
    front, side = np.full((1, 100, 50, 3), 20.0), np.full((1, 50, 100, 3), 77.0)
    front[0, 50] = 220.0
    look = looks(1, replace(CLEAN, blur_px=5.3))
    images = apply_sensor(front, side, look, np.zeros(1, np.uint64))
    assert (images.front[0, :, 0, 0].astype(float) - 20).sum() == pytest.approx(200, abs=4)
    np.testing.assert_array_equal(images.side, 77)


@pytest.mark.parametrize("index", [0, 1])
def test_mouth_is_at_the_tip_pixel(index: int) -> None:
    camera = CELL.cameras[index]
    alpha = Raycaster(catalogue.get("flat").surface, CELL, nozzle()).nozzle_alpha[index]
    a = np.linspace(0, 2 * np.pi, 25)
    mouth = camera.project(1.5e-3 * np.column_stack((np.cos(a), np.sin(a), 0 * a)))
    u, v = camera.tip_px
    assert alpha[int(v), int(u)] == 1.0
    # The nozzle ends where the projected mouth does: at the top of the front view, the bottom of the side.
    column = alpha[:, int(mouth[np.argmin(mouth[:, 1]) if index == 0 else np.argmax(mouth[:, 1]), 0])]
    end = 100 - column.sum() if index == 0 else column.sum()
    assert end == pytest.approx(mouth[:, 1].min() if index == 0 else mouth[:, 1].max(), abs=0.15)


def test_nozzle_is_drawn_over_the_part_and_shaded() -> None:
    tip, pose = poses("flat", 2, seed=2)
    surface, look = catalogue.get("flat").surface, looks(2, CLEAN)
    look.lamp[1] = [0.6, 0.0, 0.8]
    caster = Raycaster(surface, CELL, nozzle())
    images = caster.render(np.repeat(tip[:1], 2, 0), pose, look, np.zeros(2, np.uint64))
    inside = caster.nozzle_alpha[0] == 1.0
    r, b = (images.front[0, inside, k].astype(float) for k in (0, 2))
    assert (r > 1.5 * b).all()
    assert np.abs(images.front[0, inside].astype(float) - images.front[1, inside]).max() > 20


def test_triangles_behind_the_camera_do_not_appear() -> None:
    pose, points = before_camera(1)
    mirrored = -points([[20.0, 10.0], [80.0, 20.0], [50.0, 45.0]])
    for triangle in (mirrored, mirrored[::-1]):
        surface = Surface(triangles=triangle[None], material=np.zeros(1, np.int32))
        image = draw(surface, np.eye(4)[None], pose, looks(1, CLEAN)).side
        np.testing.assert_array_equal(image, int(BACKGROUND))


def test_nearer_triangles_hide_farther_ones_in_any_order() -> None:
    pose, points = before_camera(0)
    far = points([[-60, -60], [160, -60], [25, 260]], 0.12)
    near = points([[10.2, 20.0], [40.0, 30.4], [20.0, 80.0]], 0.08)
    images = []
    for order in ((far, near), (near, far)):
        surface = facing(*order)
        surface = replace(surface, material=np.array([PLATE if o is far else WALL for o in order], np.int32))
        images.append(draw(surface, np.eye(4)[None], pose, looks(1, CLEAN)).front[0])
    np.testing.assert_array_equal(*images)
    assert images[0][40, 22].mean() < images[0][5, 45].mean() - 20


def test_backs_of_faces_are_not_drawn() -> None:
    pose, points = before_camera(0)
    surface = facing(points([[10.0, 20.0], [40.0, 30.0], [20.0, 80.0]]))
    turned = replace(surface, triangles=surface.triangles[:, ::-1])
    image = draw(turned, np.eye(4)[None], pose, looks(1, CLEAN)).front
    np.testing.assert_array_equal(image, int(BACKGROUND))


def test_a_tessellated_plane_looks_like_two_triangles() -> None:
    """No cracks, no edges inside; the two triangles reach behind the camera, the small ones do not."""
    n = 80
    grid = np.linspace(-0.4, 0.4, n + 1)
    x, y = np.meshgrid(grid, grid, indexing="ij")
    p = np.stack((x, y, 0 * x), axis=-1)
    fine = np.concatenate(
        [
            np.stack((p[:-1, :-1], p[1:, :-1], p[1:, 1:]), axis=2).reshape(-1, 3, 3),
            np.stack((p[:-1, :-1], p[1:, 1:], p[:-1, 1:]), axis=2).reshape(-1, 3, 3),
        ]
    )
    a, b, c, d = p[0, 0], p[-1, 0], p[-1, -1], p[0, -1]
    coarse = np.array([[a, b, c], [a, c, d]])
    tip, pose = poses("flat", 6, seed=8)
    look = looks(6, replace(CLEAN, texture=(1.0, 1.0)))
    first, second = (
        draw(Surface(triangles=t, material=np.zeros(len(t), np.int32)), tip, pose, look)
        for t in (fine, coarse)
    )
    for k in range(2):
        assert np.abs(first[k].astype(int) - second[k]).max() <= 1
        assert first[k].min() > 2 * BACKGROUND
        assert first[k].std() > 3  # there is a texture


def test_texture_moves_with_its_offset_and_the_part() -> None:
    tip, pose = poses("flat", 2, seed=2)
    tip[1], cfg = tip[0], replace(CLEAN, texture=(1.0, 1.0))
    look = looks(2, cfg)
    images = draw(catalogue.get("flat").surface, tip, pose, look)
    assert (images.front[0] != images.front[1]).mean() > 0.5
    move = transform(axis_angle(np.array([0.0, 0.6, 0.8]), 0.7), np.array([0.3, -0.1, 0.2]))
    moved = draw(catalogue.get("flat").surface, move @ tip, move @ pose, look)
    assert np.abs(images.front.astype(int) - moved.front).max() <= 1


def test_each_kernel_is_compiled_once() -> None:
    tip, pose = poses("flat", 2, seed=2)
    draw(catalogue.get("flat").surface, tip.copy(order="F"), pose[::-1], looks(2, LookCfg()), nozzle())
    apply_sensor(
        np.zeros((2, 100, 50, 3), np.uint8),
        np.zeros((2, 50, 100, 3), np.float32),
        looks(2, CLEAN),
        np.zeros(2, np.int64),
    )
    for entry in (raycast._render_batch, raycast._sense_batch, raycast._rasterise):
        assert len(entry.signatures) == 1
    for inner in (raycast._sense, raycast._select, raycast._paint):  # 0 if loaded as part of an entry
        assert len(inner.signatures) <= 1


def test_wrong_input_is_refused() -> None:
    tip, pose = poses("flat", 2, seed=2)
    caster, look = Raycaster(catalogue.get("flat").surface, CELL, NO_TOOL), looks(2, CLEAN)
    frame = np.zeros(2, np.uint64)
    for arguments in (
        (tip[:1], pose, look, frame),
        (tip, pose, look, frame[:1]),
        (tip * np.nan, pose, look, frame),
    ):
        with pytest.raises(RenderError):
            caster.render(*arguments)
    with pytest.raises(RenderError, match="shape"):
        apply_sensor(np.zeros((1, 100, 50, 3)), np.zeros((1, 50, 100, 3)), look, frame)
    with pytest.raises(RenderError, match="tool"):
        Raycaster(catalogue.get("flat").surface, CELL, np.zeros((3, 3)))
    with pytest.raises(RenderError, match="behind"):
        Raycaster(catalogue.get("flat").surface, CELL, nozzle() * 10)


def test_draws_are_as_many_for_any_configuration() -> None:
    states = []
    for cfg in (CLEAN, LookCfg(), LookCfg(noise_sigma=0.0)):
        rng = np.random.default_rng(4)
        look = Look.empty(3)
        look.draw(1, rng, cfg)
        states.append(rng.random())
        assert np.linalg.norm(look.lamp[1]) == pytest.approx(1.0)
        assert look.seed[0] == look.seed[2] == 0 != look.seed[1]
    assert len(set(states)) == 1


@pytest.mark.parametrize(
    "wrong",
    [
        {"contrast": (0.3, -0.3)},
        {"brightness": (-2.0, 0.0)},
        {"lamp_x": (0.0, np.nan)},
        {"texture": (1.0,)},
        {"noise_sigma": -1.0},
        {"blur_px": 9.0},
        {"clip_fraction": np.inf},
    ],
)
def test_bad_look_is_named(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        LookCfg(**wrong)
