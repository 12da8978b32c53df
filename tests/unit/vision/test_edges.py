"""The edge stage against closed forms and against a slow literal reference of the equations."""

import math

import numpy as np
import pytest

from seal_gym.core.errors import ConfigError
from seal_gym.vision.edges import EdgeCfg, EdgeStage, EdgeTables, edge_image, taps, weights

ALL = {"share": 1.0}


def correlation_masks(cfg):
    """Masks Kx, Ky with E = correlate(R, K)."""
    n = cfg.length - 1
    kx, ky = np.zeros((2 * n + 1, 2 * n + 1)), np.zeros((2 * n + 1, 2 * n + 1))
    for dx, dy, wx, wy in taps(cfg):
        for k, w in ((kx, wx), (ky, wy)):
            k[n + int(dy), n + int(dx)] += w
            k[n - int(dy), n - int(dx)] -= w
    return kx, ky


def reference(image, cfg):
    """Formulas.md section 2, pixel by pixel."""
    grey = image.astype(float).mean(axis=-1)
    h, w = grey.shape

    def at(i, j):
        return grey[min(max(i, 0), h - 1), min(max(j, 0), w - 1)]

    ws = weights(cfg.alpha, cfg.length)
    e = np.zeros((h, w, 2))
    for i in range(h):
        for j in range(w):
            for angle in range(0, 180, 45):
                ux, uy = round(math.cos(math.radians(angle))), round(math.sin(math.radians(angle)))
                forward = sum(ws[k] * at(i - k * uy, j - k * ux) for k in range(cfg.length))
                backward = sum(ws[k] * at(i + k * uy, j + k * ux) for k in range(cfg.length))
                step = math.hypot(ux, uy)
                answer = (forward - backward) / 2 / step
                e[i, j] += 0.5 * answer * np.array([ux, uy]) / step
    kappa = np.linalg.norm(e, axis=-1).max()
    e /= kappa
    length = np.linalg.norm(e, axis=-1)

    def block(i, j):
        return [(y, x) for y in range(i - 1, i + 2) for x in range(j - 1, j + 2) if 0 <= y < h and 0 <= x < w]

    mag, turn, out = np.zeros((h, w)), np.zeros((h, w)), np.zeros((h, w))
    for i in range(h):
        for j in range(w):
            near = block(i, j)
            mag[i, j] = np.mean([length[p] for p in near])
            turn[i, j] = 0.5 * math.atan2(
                sum(2 * e[p][0] * e[p][1] for p in near), sum(e[p][0] ** 2 - e[p][1] ** 2 for p in near)
            )
    for i in range(h):
        for j in range(w):
            near = block(i, j)
            mean = np.mean([grey[p] for p in near])
            above = np.array([grey[p] for p in near if grey[p] > mean + 1e-9])
            below = np.array([grey[p] for p in near if grey[p] <= mean + 1e-9])
            c = 0.0
            if len(above):

                def entropy(g):
                    p = g[g > 0] / g.sum()
                    return -(p * np.log(p)).sum()

                f, b = above.mean(), below.mean()
                minus, plus = 256 * (f - b) / (256 - b), f + b - f * b / 256
                c = abs(entropy(above) - entropy(below)) * minus / plus
            terms = []
            for p in near:
                if p != (i, j):
                    d = (turn[i, j] - turn[p] + math.pi / 2) % math.pi - math.pi / 2
                    terms.append(cfg.a * mag[p] + cfg.b * (1 - abs(d) / (math.pi / 2)) + cfg.c * c)
            out[i, j] = max(terms)
    return e, mag, turn, out


def test_weights_in_closed_form():
    np.testing.assert_allclose(weights(0.5, 5), [1, -0.5, -0.125, -0.0625, -0.0390625])
    for alpha in (0.3, 0.7):
        binomial = [1.0]
        for k in range(1, 7):
            binomial.append(binomial[-1] * (alpha - k + 1) / k)
        np.testing.assert_allclose(weights(alpha, 7), [(-1) ** k * b for k, b in enumerate(binomial)])
    np.testing.assert_allclose(weights(1.0, 4), [1, -1, 0, 0], atol=0)


def test_a_horizontal_pair_is_the_kernel_of_the_formulas():
    """[-1, -4, 0, 4, 1] / 16, of which the sum of four directions takes half."""
    row = [t for t in taps(EdgeCfg(alpha=0.5, length=3)) if t[1] == 0]
    np.testing.assert_allclose([2 * t[2] for t in row], [4 / 16, 1 / 16])


def test_order_one_is_the_ordinary_difference():
    cfg = EdgeCfg(alpha=1.0, length=3)
    kx, ky = correlation_masks(cfg)
    expected = np.zeros((5, 5))
    expected[1:4, 1:4] = np.array([[-1, 0, 1], [-2, 0, 2], [-1, 0, 1]]) / 8
    expected[1:4, 1:4] = np.where(
        expected[1:4, 1:4] == 0, 0, np.array([[-1, 0, 1]] * 3) * [[1], [2], [1]] / 8
    )
    np.testing.assert_allclose(kx, expected, atol=1e-15)
    np.testing.assert_allclose(ky, expected.T, atol=1e-15)


@pytest.mark.parametrize("alpha", [0.3, 0.5, 1.0])
@pytest.mark.parametrize("level", [0, 90, 255])
def test_flat_ground_does_not_answer(alpha, level):
    out = EdgeStage(EdgeCfg(alpha=alpha))(np.full((2, 12, 9, 3), level, np.uint8))
    for values in out:
        assert not values.any()


@pytest.mark.parametrize("degrees", [0, 20, 45, 70, 90, -30, -80])
def test_a_ramp_has_the_direction_it_was_given(degrees):
    y, x = np.mgrid[:40, :40] - 19.5
    angle = math.radians(degrees)
    ramp = 128 + 4.0 * (x * math.cos(angle) + y * math.sin(angle))
    out = EdgeStage(EdgeCfg(**ALL))(np.rint(ramp).astype(np.uint8)[None])
    turn = out.orientation[0, 8:-8, 8:-8] - angle
    assert np.abs((turn + np.pi / 2) % np.pi - np.pi / 2).mean() < math.radians(2)


def test_turning_the_image_turns_the_vectors():
    image = np.random.default_rng(0).integers(0, 256, (1, 20, 20), dtype=np.uint8)
    a, b = EdgeStage()(image), EdgeStage()(np.ascontiguousarray(np.rot90(image, axes=(1, 2))))
    back = np.rot90(b.vector, -1, axes=(1, 2))
    np.testing.assert_allclose(a.vector[..., 0], -back[..., 1], atol=1e-12)
    np.testing.assert_allclose(a.vector[..., 1], back[..., 0], atol=1e-12)
    np.testing.assert_allclose(a.magnitude, np.rot90(b.magnitude, -1, axes=(1, 2)), atol=1e-12)


@pytest.mark.parametrize("cfg", [EdgeCfg(**ALL), EdgeCfg(alpha=0.3, length=5, a=0.2, b=0.5, c=0.9, **ALL)])
@pytest.mark.parametrize("dark", [0, 60])
def test_against_the_literal_reference(cfg, dark):
    rng = np.random.default_rng(1)
    image = np.where(np.arange(14)[:, None] + 2 * np.arange(17) > 24, 140, dark)[..., None]
    image = np.clip(image + rng.normal(0, 12, (14, 17, 3)), 0, 255).astype(np.uint8)
    vector, magnitude, orientation, intensity = reference(image, cfg)
    out = EdgeStage(cfg)(image[None])
    np.testing.assert_allclose(out.vector[0], vector, atol=1e-12)
    np.testing.assert_allclose(out.magnitude[0], magnitude, atol=1e-12)
    np.testing.assert_allclose(out.orientation[0], orientation, atol=1e-9)
    np.testing.assert_allclose(out.intensity[0], intensity, atol=1e-9)
    np.testing.assert_array_equal(out.edge[0], out.intensity[0] >= cfg.tau)


def test_the_strongest_quarter_has_the_same_intensity():
    image = np.random.default_rng(2).integers(0, 256, (3, 30, 50, 3), dtype=np.uint8)
    some, every = EdgeStage(EdgeCfg(share=0.25))(image), EdgeStage(EdgeCfg(share=1.0))(image)
    kept = some.intensity > 0
    assert 0.25 <= kept.mean() < 0.3
    np.testing.assert_array_equal(some.intensity[kept], every.intensity[kept])
    for k in range(3):
        assert some.magnitude[k][kept[k]].min() >= some.magnitude[k][~kept[k]].max()


def test_batches_and_grey_images_give_the_same():
    image = np.random.default_rng(3).integers(0, 256, (4, 16, 20), dtype=np.uint8)
    many = EdgeStage()(image)
    colour = EdgeStage()(np.repeat(image[..., None], 3, axis=3))
    for k in range(4):
        for a, b, c in zip(many, EdgeStage()(image[k : k + 1]), colour, strict=True):
            np.testing.assert_array_equal(a[k], b[0])
            np.testing.assert_array_equal(a[k], c[k])


def test_intensity_is_relative_to_what_is_outside_the_mask():
    """A nozzle of any contrast leaves the seam's intensity as it is."""
    tables = EdgeTables.of(EdgeCfg())
    rng = np.random.default_rng(4)
    grey = np.where(np.arange(50) < 20, 300, 400) + rng.integers(-20, 20, (100, 50))
    mask = np.zeros(grey.shape, np.bool_)
    mask[70:, 30:] = True
    shapes = [np.zeros((104, 54)), np.zeros((100, 50)), np.zeros(512, np.int64)]

    def run(image):
        out = [np.zeros((100, 50)) for _ in range(5)] + [np.zeros((100, 50), np.bool_)]
        edge_image(image, mask, *tables, *shapes, *out)
        return out

    plain, nozzle = run(grey), grey.copy()
    nozzle[75:, 35:] = 765
    for a, b in zip(plain, run(nozzle), strict=True):
        np.testing.assert_array_equal(a, b)
    assert not plain[5][mask].any()


def test_the_mask_of_the_stage_is_that_of_the_kernel():
    rng = np.random.default_rng(5)
    images = rng.integers(0, 120, (2, 40, 30, 3), dtype=np.uint8)
    mask = np.zeros((40, 30), np.bool_)
    mask[25:, 15:] = True
    nozzle = images.copy()
    nozzle[:, 29:, 19:] = 255  # further under the mask than the masks reach
    for a, b in zip(EdgeStage()(images, mask), EdgeStage()(nozzle, mask), strict=True):
        np.testing.assert_array_equal(a[:, ~mask], b[:, ~mask])
    out = EdgeStage()(images, mask)
    assert not out.edge[:, mask].any() and out.edge[:, ~mask].any()
    assert not EdgeStage()(images, np.ones_like(mask)).edge.any()


@pytest.mark.parametrize("mask", [np.zeros((9, 8), np.bool_), np.zeros((9, 9), np.uint8)])
def test_a_mask_of_another_size_is_refused(mask):
    with pytest.raises(ConfigError, match="mask"):
        EdgeStage()(np.zeros((1, 9, 9), np.uint8), mask)


@pytest.mark.parametrize(
    "kwargs", [{"alpha": 0.0}, {"alpha": 1.5}, {"length": 1}, {"a": -1.0}, {"tau": np.nan}, {"share": 0.0}]
)
def test_bad_parameters_are_refused(kwargs):
    with pytest.raises(ConfigError, match=next(iter(kwargs))):
        EdgeCfg(**kwargs)


@pytest.mark.parametrize(
    "image", [np.zeros((2, 9, 9)), np.zeros((9, 9), np.uint8), np.zeros((1, 9, 9, 4), np.uint8)]
)
def test_bad_images_are_refused(image):
    with pytest.raises(ConfigError, match="uint8"):
        EdgeStage()(image)
