"""The line stage on drawn strips whose line is known."""

import numpy as np
import pytest

from seal_gym.core.errors import ConfigError
from seal_gym.vision.edges import EdgeMap, EdgeStage
from seal_gym.vision.seam_line import LineCfg, dilated, find_lines, fit_curve, strips

HEIGHT, WIDTH = 100, 50
REFERENCE = np.array([25.4, 25.0])
EDGES = EdgeStage()
NO_MASK = np.zeros((HEIGHT, WIDTH), np.bool_)
FREE = (0.0, 0.0, 0.0)


def draw(o, dark=70.0, bright=110.0, sigma=8.0, seed=0, oversample=8):
    """A strip with an edge at o(t), dark on its left, exact to a fraction of a pixel."""
    n = oversample
    t = (np.arange(HEIGHT * n) + 0.5) / n
    c = (np.arange(WIDTH * n) + 0.5) / n
    fine = (c[None] > o(t - REFERENCE[0])[:, None]).reshape(HEIGHT, n, WIDTH, n).mean(axis=(1, 3))
    noise = np.random.default_rng(seed).normal(0, sigma, (HEIGHT, WIDTH))
    grey = np.clip(np.rint(dark + (bright - dark) * fine + noise), 0, 255)
    return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)


def find(*images, mask=NO_MASK, **kwargs):
    return find_lines(np.stack(images), mask, REFERENCE, EDGES, LineCfg(**kwargs))


@pytest.mark.parametrize("p", [14.0, 25.3, 33.7])
@pytest.mark.parametrize("q", [-0.2, 0.0, 0.13])
def test_a_straight_line_without_noise(p, q):
    out = find(draw(lambda t: p + q * t, sigma=0.0))
    assert out.valid.all()
    assert out.line[0, 0] == pytest.approx(p, abs=0.06)
    assert out.line[0, 1] == pytest.approx(q, abs=0.005)
    assert out.confidence[0] == pytest.approx(40.0, abs=3.0)


def test_noise_of_the_protocol_leaves_a_fifth_of_a_pixel():
    rng = np.random.default_rng(1)
    truth = np.column_stack((rng.uniform(15, 35, 60), rng.uniform(-0.15, 0.15, 60)))
    images = [draw(lambda t, p=p, q=q: p + q * t, seed=k) for k, (p, q) in enumerate(truth)]
    out = find(*images)
    assert out.valid.all()
    error = out.line[:, :2] - truth
    raw = out.raw - truth
    assert np.sqrt(np.mean(error[:, 0] ** 2)) < 0.2
    assert np.sqrt(np.mean(error[:, 0] ** 2)) < 0.5 * np.sqrt(np.mean(raw[:, 0] ** 2))


def test_the_tangent_of_a_bent_seam_is_taken_nearest_the_reference():
    out = find(draw(lambda t: 25.0 + 1.0 - 0.004 * t**2, sigma=0.0))
    assert out.valid[0]
    # Nearest to (0, 25): by symmetry at t = 0, where the tangent is vertical.
    assert out.line[0, 0] == pytest.approx(26.0, abs=0.2)
    assert out.line[0, 1] == pytest.approx(0.0, abs=0.02)


def test_an_edge_of_the_wrong_polarity_is_not_a_seam():
    wrong = draw(lambda t: 25.0 + 0 * t, dark=110.0, bright=70.0)
    assert not find(wrong).valid[0]
    assert find(wrong, bright_side=-1).valid[0]
    # The wall's top edge beside the seam: brighter on the left, and of higher contrast.
    both = draw(lambda t: 30.0 + 0.05 * t).astype(int)
    both[:, :12] += 60
    out = find(np.clip(both, 0, 255).astype(np.uint8))
    assert out.valid[0] and out.line[0, 0] == pytest.approx(30.0, abs=0.5)


@pytest.mark.parametrize("seed", range(10))
def test_without_contrast_there_is_no_line(seed):
    assert not find(draw(lambda t: 25.0 + 0 * t, dark=100.0, bright=100.0, seed=seed)).valid[0]
    nothing = find(np.full((HEIGHT, WIDTH, 3), 255, np.uint8))
    assert not nothing.valid[0] and np.isnan(nothing.raw).all()


def test_what_the_mask_hides_is_not_seen():
    image = draw(lambda t: 20.0 + 0 * t).copy()
    image[:22, 22:44] = 20  # a nozzle with a strong dark edge of its own
    image[:22, 32:44] = 250
    mask = NO_MASK.copy()
    mask[:24, 16:46] = True
    out = find(image, mask=mask)
    assert out.valid[0] and out.line[0, 0] == pytest.approx(20.0, abs=0.5)
    assert not find(image, mask=np.ones_like(mask)).valid[0]


def test_any_detector_will_do():
    """One that is told where the edge is: the line goes through its pixels and nowhere else."""

    def told(images, mask=None):
        shape = images.shape[:3]
        edge = np.zeros(shape, np.bool_)
        edge[:, 5:95, 18] = True
        vector = np.zeros((*shape, 2))
        vector[..., 0] = edge
        return EdgeMap(vector, vector[..., 0], np.zeros(shape), edge.astype(float), edge)

    # A weaker edge at 18.5, where the detector points; a stronger one at 35.
    image = draw(lambda t: 18.5 + 0 * t, bright=90.0).astype(int)
    image[:, 35:] += 60
    out = find_lines(image.astype(np.uint8)[None], NO_MASK, REFERENCE, told)
    assert out.raw[0] == pytest.approx([18.5, 0.0], abs=1e-9)
    assert out.valid[0] and out.line[0, 0] == pytest.approx(18.5, abs=0.5)


def test_each_strip_by_itself_and_the_same_every_time():
    images = [draw(lambda t, p=p: p + 0.1 * t, seed=int(p)) for p in (15.0, 22.0, 31.0)]
    many = find(*images)
    for k, image in enumerate(images):
        for a, b in zip(many, find(image), strict=True):
            np.testing.assert_array_equal(a[k], b[0])


def test_strips_have_travel_down_and_the_plate_to_the_right():
    front = np.arange(2 * 100 * 50 * 3).reshape(2, 100, 50, 3).astype(np.uint8)
    side = np.arange(2 * 50 * 100 * 3).reshape(2, 50, 100, 3).astype(np.uint8)
    a, b = strips(front, side)
    np.testing.assert_array_equal(a[1, 7, 9], front[1, 92, 9])
    np.testing.assert_array_equal(b[1, 7, 9], side[1, 9, 7])


def test_the_mask_is_wider_than_the_nozzle_by_its_margin():
    alpha = np.zeros((100, 50)), np.zeros((50, 100))
    alpha[0][90, 20] = 1.0
    alpha[1][5, 30] = 0.3
    front, side = dilated(alpha, 2)
    assert np.argwhere(front).min(axis=0).tolist() == [7, 18] and front.sum() == 25
    assert np.argwhere(side).max(axis=0).tolist() == [32, 7] and side.sum() == 25


def test_the_curve_is_least_squares_and_robust():
    rng = np.random.default_rng(2)
    y, w, out = rng.uniform(-1, 1, 40), rng.uniform(0.5, 2, 40), np.zeros(3)
    x = 0.3 - 0.2 * y + 0.7 * y**2 + rng.normal(0, 0.01, 40)
    fit_curve(y, x, w, 40, FREE, 1e9, out)
    basis = np.column_stack((np.ones(40), y, y**2)) * np.sqrt(w)[:, None]
    np.testing.assert_allclose(out, np.linalg.lstsq(basis, x * np.sqrt(w), rcond=None)[0], atol=1e-10)
    held = np.zeros(3)
    fit_curve(y, x, w, 40, (3.0, 50.0, 7.0), 1e9, held)
    normal = basis.T @ basis + np.diag([3.0, 50.0, 7.0])
    np.testing.assert_allclose(held, np.linalg.solve(normal, basis.T @ (x * np.sqrt(w))), atol=1e-10)
    x[3] += 50.0
    fit_curve(y, x, w, 40, FREE, 0.05, out)
    plain = np.zeros(3)
    fit_curve(y, x, w, 40, FREE, 1e9, plain)
    assert np.abs(out - [0.3, -0.2, 0.7]).max() < 0.1 * np.abs(plain - [0.3, -0.2, 0.7]).max()
    assert fit_curve(np.ones(40), x, w, 40, FREE, 1.0, out) == 0.0
    assert fit_curve(y, x, np.zeros(40), 40, FREE, 1.0, out) == 0.0


@pytest.mark.parametrize(
    "kwargs", [{"bright_side": 0}, {"hypotheses": 0}, {"inlier_px": 0.0}, {"min_points": 2.5}]
)
def test_bad_parameters_are_refused(kwargs):
    with pytest.raises(ConfigError, match=next(iter(kwargs))):
        LineCfg(**kwargs)
