"""The usual edge methods on steps whose place and angle are known."""

import numpy as np
import pytest

from seal_gym.core.errors import ConfigError
from seal_gym.vision.baselines import CannyCfg, CannyEdges, LsdCfg, LsdEdges, SobelCfg, SobelEdges
from seal_gym.vision.edges import EdgeStage
from seal_gym.vision.seam_line import find_lines

SIZE = 60
METHODS = {
    "canny": CannyEdges(),
    "canny, no blur": CannyEdges(CannyCfg(sigma_px=0.0, share=0.05)),
    "sobel": SobelEdges(SobelCfg(sigma_px=0.0, share=0.05)),
    "sobel, blurred": SobelEdges(),
    "lsd": LsdEdges(),
    "ours": EdgeStage(),
}
every_method = pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
NO_MASK = np.zeros((SIZE, SIZE), np.bool_)


def step(degrees, offset=0.0, dark=70, bright=130, sigma=0.0, seed=0, n=8):
    """Brighter where (x, y) . (cos, sin) > offset from the middle; exact to a fraction of a grey level."""
    y, x = (np.mgrid[: SIZE * n, : SIZE * n] + 0.5) / n - SIZE / 2
    angle = np.deg2rad(degrees)
    cover = (x * np.cos(angle) + y * np.sin(angle) > offset).reshape(SIZE, n, SIZE, n).mean(axis=(1, 3))
    grey = dark + (bright - dark) * cover + np.random.default_rng(seed).normal(0, sigma, cover.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def distance(degrees, offset):
    """Of the pixels' centres from the step, and whether they are far enough from the border."""
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5 - SIZE / 2
    angle = np.deg2rad(degrees)
    return x * np.cos(angle) + y * np.sin(angle) - offset, (np.abs(x) < SIZE / 2 - 4) & (
        np.abs(y) < SIZE / 2 - 4
    )


@every_method
@pytest.mark.parametrize(("degrees", "offset"), [(0, 0.3), (35, -6.2), (90, 4.0), (180, 2.5), (-120, 7.7)])
def test_a_step_is_found_where_it_is_and_points_to_its_bright_side(method, degrees, offset):
    out = method(step(degrees, offset)[None])
    off, inside = distance(degrees, offset)
    edge = out.edge[0] & inside
    assert edge.sum() >= 0.8 * SIZE - 8  # all along the step
    assert np.abs(off[edge]).max() < 4.0
    votes = out.intensity[0][edge]
    assert (votes > 0).all()
    # Of two pixels beside a step Canny keeps one, half a pixel off.
    half = 0.51 if isinstance(method, CannyEdges) else 0.25
    assert np.average(off[edge], weights=votes) == pytest.approx(0.0, abs=half)
    angle = np.deg2rad(degrees)
    normal = np.array([np.cos(angle), np.sin(angle)])
    vector = out.vector[0][edge]
    assert vector.sum(axis=0) @ normal > 0.99 * np.linalg.norm(vector.sum(axis=0))
    turn = out.orientation[0][edge] - angle
    assert np.abs((turn + np.pi / 2) % np.pi - np.pi / 2).mean() < np.deg2rad(6)
    assert np.linalg.norm(out.vector, axis=-1).max() == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("scale", [0.5, 0.8, 1.0])
@pytest.mark.parametrize("degrees", [0, 70, 160, -90])
def test_segments_have_no_offset(scale, degrees):
    """OpenCV's detector is off by half a pixel of the shrunk image's; ours is not."""
    angle = np.deg2rad(degrees)
    normal = np.array([np.cos(angle), np.sin(angle)])
    for offset in (-3.3, 0.0, 4.6):
        image = np.repeat(step(degrees, offset)[..., None], 3, axis=2)
        (ends,) = LsdEdges(LsdCfg(scale=scale)).segments(image, NO_MASK)
        middle = (ends[:2] + ends[2:]) / 2 - SIZE / 2
        assert middle @ normal == pytest.approx(offset, abs=0.2)
        along = ends[2:] - ends[:2]
        # Turned by 90 deg to the left, as seen with y down, the way points to the bright side.
        assert np.array([along[1], -along[0]]) @ normal == pytest.approx(np.linalg.norm(along), rel=1e-3)


@every_method
@pytest.mark.parametrize("level", [0, 90, 255])
def test_flat_ground_has_no_edges(method, level):
    mask = NO_MASK.copy()
    mask[40:, 30:] = True
    for m in (None, mask, np.ones_like(mask)):
        out = method(np.full((2, SIZE, SIZE, 3), level, np.uint8), m)
        assert not out.edge.any()
        for values in out:
            np.testing.assert_allclose(values, 0.0, atol=1e-9)


@every_method
def test_what_is_deep_under_the_mask_changes_nothing(method):
    """And nothing under it is an edge, however strong."""
    mask = NO_MASK.copy()
    mask[36:, :] = True
    image = np.stack([step(0, 2.0, sigma=6.0, seed=k) for k in range(3)])
    nozzle = image.copy()
    nozzle[:, 39:] = 0
    nozzle[:, 39:, ::2] = 255
    plain, hidden = method(image, mask), method(nozzle, mask)
    assert plain.edge[:, :36].any() and not hidden.edge[:, 36:].any()
    assert not hidden.intensity[:, 36:].any()
    for a, b in zip(plain, hidden, strict=True):
        np.testing.assert_allclose(a[:, ~mask], b[:, ~mask], atol=1e-6)
    assert not method(image, np.ones_like(mask)).edge.any()


@every_method
def test_each_image_by_itself_grey_or_colour(method):
    image = np.stack([step(20 * k, k, sigma=8.0, seed=k) for k in range(4)])
    many, colour = method(image), method(np.repeat(image[..., None], 3, axis=3))
    for k in range(4):
        for a, b, c in zip(many, method(image[k : k + 1]), colour, strict=True):
            np.testing.assert_array_equal(a[k], b[0])
            np.testing.assert_array_equal(a[k], c[k])


@every_method
def test_an_edge_stage_of_any_kind_gives_a_line(method):
    reference = np.array([20.0, 30.0])
    images = np.stack([step(-5.0, 1.5, sigma=8.0, seed=k) for k in range(12)])
    out = find_lines(np.repeat(images[..., None], 3, axis=3), NO_MASK, reference, method)
    # cos(5) x - sin(5) y = 1.5 from the middle.
    q = np.tan(np.deg2rad(5.0))
    p = 30.0 + 1.5 / np.cos(np.deg2rad(5.0)) + q * (20.0 - 30.0)
    assert out.valid.all()
    assert np.median(np.abs(out.line[:, 0] - p)) < 0.2
    assert np.median(np.abs(out.line[:, 1] - q)) < 0.03
    assert np.median(np.abs(out.raw[:, 0] - p)) < 1.0


def test_the_share_of_sobels_edges_is_as_asked():
    noise = np.random.default_rng(1).integers(0, 256, (1, 80, 90), dtype=np.uint8)
    mask = np.zeros((80, 90), np.bool_)
    mask[:40] = True
    for share in (0.05, 0.3):
        edge = SobelEdges(SobelCfg(share=share))(noise, mask).edge[0]
        assert edge[~mask].mean() == pytest.approx(share, abs=1e-3)


def test_hysteresis_keeps_weak_edges_only_beside_strong_ones():
    image = step(0, 0.0).astype(int)  # an edge down the middle ...
    image[: SIZE // 2, SIZE // 2 :] -= 40  # ... a third as high in its upper half,
    image[5:25, 8:] += 15  # and a weak one by itself
    grey = image.astype(np.uint8)[None]
    with_weak = CannyEdges(CannyCfg(sigma_px=0.0, share=0.012, ratio=0.2))(grey).edge[0]
    strong = CannyEdges(CannyCfg(sigma_px=0.0, share=0.012, ratio=1.0))(grey).edge[0]
    middle = slice(SIZE // 2 - 2, SIZE // 2 + 2)
    assert strong[40:55, middle].any(axis=1).all() and not strong[8:20, middle].any()
    assert with_weak[8:20, middle].any(axis=1).all()


def test_short_segments_are_dropped():
    image = np.full((1, SIZE, SIZE), 70, np.uint8)
    image[:, 20:36, 20:36] = 150
    assert LsdEdges(LsdCfg(min_length_px=5.0))(image).edge.any()
    assert not LsdEdges(LsdCfg(min_length_px=20.0))(image).edge.any()


@pytest.mark.parametrize(
    ("cfg", "kwargs"),
    [
        (CannyCfg, {"sigma_px": -1.0}),
        (CannyCfg, {"ratio": 0.0}),
        (CannyCfg, {"share": 1.5}),
        (SobelCfg, {"share": 0.0}),
        (SobelCfg, {"sigma_px": np.nan}),
        (LsdCfg, {"refine": "some"}),
        (LsdCfg, {"scale": 0.0}),
        (LsdCfg, {"angle_deg": 100.0}),
    ],
)
def test_bad_parameters_are_refused(cfg, kwargs):
    with pytest.raises(ConfigError, match=next(iter(kwargs))):
        cfg(**kwargs)


@every_method
@pytest.mark.parametrize("images", [np.zeros((2, 9, 9)), np.zeros((9, 9), np.uint8)])
def test_bad_images_are_refused(method, images):
    with pytest.raises(ConfigError, match="uint8"):
        method(images)
