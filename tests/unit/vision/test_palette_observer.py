"""The palette observer on drawn shapes whose places are known, its faults each provoked, and its errors."""

import cv2
import numpy as np
import pytest

from seal_gym.core.cell import OverheadCfg
from seal_gym.core.errors import ConfigError
from seal_gym.vision import hopfield, palette_segments
from seal_gym.vision.palette_observer import PaletteObserverCfg, name_pixels, observe, verdicts
from seal_gym.vision.palette_regions import Fault, PalettePlan, RegionCfg, depth_at
from seal_gym.vision.palette_seen import deproject
from seal_gym.vision.palette_segments import AreaCfg, PaletteClass

WIDTH, HEIGHT, DEPTH = 320, 240, 0.6
CAMERA = OverheadCfg(
    position_mm=(430.0, 20.0, 600.0),
    target_mm=(430.0, 20.0, 0.0),
    up=(1.0, 0.0, 0.0),
    frame_px=(WIDTH, HEIGHT),
    focal_px=1200.0,
)  # half a millimetre a pixel
BOARD, BLACK, BLUE, GREEN = (205, 200, 190), (25, 25, 30), (35, 70, 190), (60, 165, 75)
RED, WHITE, YELLOW = (200, 45, 40), (245, 245, 240), (225, 200, 45)
FINE = 16


class Canvas:
    """Flat shapes with exact area coverage at their edges."""

    def __init__(self):
        self.fine = np.full((FINE * HEIGHT, FINE * WIDTH, 3), BOARD, dtype=np.uint8)
        self.depth = np.full((HEIGHT, WIDTH), DEPTH)

    def inside(self, test):
        x = (np.arange(FINE * WIDTH) + 0.5) / FINE
        y = (np.arange(FINE * HEIGHT) + 0.5) / FINE
        return test(x[None], y[:, None])

    def box(self, colour, left, top, right, bottom):
        self.fine[self.inside(lambda x, y: (left <= x) & (x < right) & (top <= y) & (y < bottom))] = colour
        return self

    def disc(self, colour, x0, y0, radius):
        self.fine[self.inside(lambda x, y: (x - x0) ** 2 + (y - y0) ** 2 < radius**2)] = colour
        return self

    @property
    def rgb(self):
        return cv2.resize(self.fine, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)

    def seen(self, **given):
        return observe(self.rgb, self.depth, CAMERA, **given)


def zone(canvas, *, tie):
    """A target zone under a cable across the picture."""
    canvas.box(RED, 100.0, 80.0, 140.0, 130.0).box(BLACK, 0.0, 98.0, 320.0, 112.0)
    return canvas.box(WHITE, 115.0, 88.0, 125.0, 122.0) if tie else canvas


def kinds(report):
    return [f.kind for f in report.faults]


def world(x_px, y_px, depth=DEPTH):
    """By hand: the camera looks down, up in the picture is x, left is y."""
    scale = depth / 1200.0
    return np.array([0.43 - (y_px - 120.0) * scale, 0.02 - (x_px - 160.0) * scale, 0.6 - depth])


@pytest.mark.parametrize("offset", [0.0, 0.25, 0.5, 0.8])
def test_centroids_of_drawn_shapes_to_a_tenth_of_a_pixel(offset):
    canvas = Canvas().box(BLUE, 30 + offset, 40 + offset, 82 + offset, 72 + offset)
    canvas.disc(GREEN, 200.3 + offset, 60.6, 8.0).box(RED, 60.0, 150 + offset, 100.0, 190 + offset)
    canvas.box(BLACK, 150.0, 160 + offset, 300.0, 174 + offset)
    report = canvas.seen()
    expected = {
        PaletteClass.CONNECTOR: (56 + offset, 56 + offset, 52 * 32),
        PaletteClass.RIVET: (200.3 + offset, 60.6, np.pi * 64),
        PaletteClass.TARGET: (80.0, 170 + offset, 1600),
        PaletteClass.CABLE: (225.0, 167 + offset, 150 * 14),
    }
    assert sorted(report.classes) == sorted(expected)
    for kind, (x, y, area) in expected.items():
        (k,) = report.of(kind)
        np.testing.assert_allclose(report.centroids_px[k], (x, y), atol=0.1)
        assert report.areas_px[k] == pytest.approx(area, rel=0.02)
        assert report.areas_mm2[k] == pytest.approx(0.25 * report.areas_px[k])
        np.testing.assert_allclose(report.positions_m[k], world(x, y), atol=0.05e-3)
        assert (report.labels == k + 1).sum() == pytest.approx(area, rel=0.1)  # whole pixels


def test_a_target_under_cable_and_tie_keeps_its_middle_and_its_area():
    for tie in (False, True):
        report = zone(Canvas(), tie=tie).seen()
        (target,) = report.of(PaletteClass.TARGET)
        np.testing.assert_allclose(report.centroids_px[target], (120.0, 105.0), atol=0.1)
        assert report.areas_px[target] == pytest.approx(2000, rel=0.02)
        (cable,) = report.of(PaletteClass.CABLE)  # not two, in spite of the tie across it
        assert report.centroids_px[cable][1] == pytest.approx(105.0, abs=0.1)


def test_a_tie_is_found_in_its_zone():
    report = zone(Canvas(), tie=True).seen()
    assert report.faults == ()
    (tie,) = report.of(PaletteClass.TIE)
    np.testing.assert_allclose(report.centroids_px[tie], (120.0, 105.0), atol=0.1)
    assert report.open_targets_m.shape == (0, 3)
    assert str(report) == "seen: 1 cable, 1 target, 1 tie; 0 faults"


def test_fault_missing_tie():
    report = zone(Canvas(), tie=False).seen()
    assert kinds(report) == [Fault.MISSING_TIE]
    np.testing.assert_allclose(report.open_targets_m, [world(120.0, 105.0)], atol=0.05e-3)
    assert "missing tie: target zone without one at (437.5, 40.0, 0.0) mm" in str(report)


def test_fault_unknown_pattern():
    report = zone(Canvas(), tie=True).box(YELLOW, 200.0, 180.0, 230.0, 200.0).seen()
    assert kinds(report) == [Fault.UNKNOWN_PATTERN]
    region = report.faults[0].region
    assert report.classes[region] == PaletteClass.UNKNOWN
    np.testing.assert_allclose(report.centroids_px[region], (215.0, 190.0), atol=0.1)


def test_fault_conflict_of_pixels_about_the_threshold():
    # Half of the pixels' blue is above the threshold: connector and cable get half the votes each.
    rgb = Canvas().rgb
    rgb[100:140, 100:160] = (35, 40, 115)
    rgb[100:140, 100:160:2, 2] = 125
    cfg = PaletteObserverCfg(levels=(120, 120, 120))
    report = observe(rgb, np.full((HEIGHT, WIDTH), DEPTH), CAMERA, cfg=cfg)
    assert kinds(report) == [Fault.CONFLICT]
    assert report.classes.tolist() == [PaletteClass.UNKNOWN]
    # With fewer such pixels than the vote asks for, it is a connector.
    rgb[100:140, 100:160, 2] = 125
    rgb[100:140, 100:160:6, 2] = 115
    clear = observe(rgb, np.full((HEIGHT, WIDTH), DEPTH), CAMERA, cfg=cfg)
    assert clear.classes.tolist() == [PaletteClass.CONNECTOR]
    assert clear.faults == ()


def test_faults_wrong_class_and_absent_against_a_plan():
    plan = PalettePlan(
        classes=np.array([PaletteClass.RIVET, PaletteClass.RIVET, PaletteClass.CONNECTOR], dtype=np.int8),
        positions_m=np.stack([world(60, 60), world(200, 60), world(100, 180)]),
    )
    right = Canvas().disc(GREEN, 60, 60, 8).disc(GREEN, 204, 60, 8).box(BLUE, 80, 170, 120, 190)
    assert right.seen(plan=plan).faults == ()
    wrong = Canvas().disc(RED, 60, 60, 8).box(BLUE, 80, 170, 120, 190)
    report = wrong.seen(plan=plan)
    assert kinds(report) == [Fault.MISSING_TIE, Fault.WRONG_CLASS, Fault.ABSENT]
    assert report.classes[report.faults[1].region] == PaletteClass.TARGET
    assert report.faults[1].message == "wrong class: target instead of rivet at (460.0, 70.0, 0.0) mm"
    assert report.faults[2].region is None


def test_fault_no_depth():
    canvas = Canvas().box(BLUE, 80, 170, 120, 190)
    canvas.depth[160:200, 70:130] = 0.0
    report = canvas.seen()
    assert kinds(report) == [Fault.NO_DEPTH]
    assert np.isnan(report.positions_m).all()
    assert np.isfinite(report.centroids_px).all()
    assert "at pixel (100.0, 180.0)" in str(report)


def test_metric_targets_against_projected_points_of_a_tilted_board():
    camera = OverheadCfg(
        position_mm=(300.0, -80.0, 700.0),
        target_mm=(430.0, 20.0, 20.0),
        up=(1.0, 0.2, 0.0),
        frame_px=(WIDTH, HEIGHT),
        focal_px=1200.0,
    )
    middle, normal = np.array([0.43, 0.02, 0.02]), np.array([0.2, -0.1, 1.0])
    across = np.cross(normal, [0.0, 1.0, 0.0])
    along = np.cross(normal, across)
    points = np.array([middle + a * across + b * along for a, b in ((0, 0), (0.03, 0.02), (-0.04, 0.025))])
    T = np.linalg.inv(camera.pose)
    seen = (points @ T[:3, :3].T + T[:3, 3]) @ camera.matrix.T
    pixels = seen[:, :2] / seen[:, 2:]
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack((x, y, np.ones_like(x)), axis=-1) @ np.linalg.inv(camera.matrix).T
    n = camera.pose[:3, :3].T @ normal
    depth = (T[:3, :3] @ middle + T[:3, 3]) @ n / (rays @ n)
    canvas = Canvas()
    for px, py in pixels:
        canvas.box(BLUE, px - 10, py - 8, px + 10, py + 8)
    rng = np.random.default_rng(3)
    depth = depth + rng.normal(0.0, 0.3e-3, depth.shape)
    depth[rng.random(depth.shape) < 0.1] = np.nan
    depth[rng.random(depth.shape) < 0.05] = 0.4  # flying pixels
    report = observe(canvas.rgb, depth, camera)
    assert len(report) == 3
    for point in points:
        assert np.linalg.norm(report.positions_m - point, axis=1).min() < 0.15e-3


def test_depth_of_few_pixels_is_their_median_and_of_none_is_unknown():
    depth, mask = np.full((10, 10), 0.5), np.zeros((10, 10), dtype=np.bool_)
    point = np.array([5.0, 5.0])
    assert np.isnan(depth_at(point, mask, depth))
    mask[5, 4:7], depth[5, 4:7] = True, (0.5, 0.6, 0.9)
    assert depth_at(point, mask, depth) == 0.6


def test_a_point_projects_back_to_itself():
    np.testing.assert_allclose(deproject(np.array([100.0, 40.0]), 0.55, CAMERA), world(100, 40, 0.55))


def test_outside_the_palette_nothing_is_seen():
    canvas = Canvas().box(BLACK, 0, 0, 320, 40).box(BLUE, 80, 170, 120, 190)
    assert sorted(canvas.seen().classes) == [PaletteClass.CABLE, PaletteClass.CONNECTOR]
    inside = np.zeros((HEIGHT, WIDTH), dtype=np.bool_)
    inside[45:] = True
    assert canvas.seen(inside=inside).classes.tolist() == [PaletteClass.CONNECTOR]


def test_the_printed_network_sees_no_cable_connector_or_target():
    canvas = zone(Canvas(), tie=True).box(BLUE, 200.0, 180.0, 230.0, 200.0)
    report = canvas.seen(network=hopfield.printed())
    assert not np.isin(
        report.classes, (PaletteClass.CABLE, PaletteClass.CONNECTOR, PaletteClass.TARGET)
    ).any()
    assert set(canvas.seen().classes) >= {PaletteClass.CABLE, PaletteClass.CONNECTOR, PaletteClass.TARGET}


@pytest.mark.parametrize(
    ("votes", "name", "conflict"),
    [
        ({0b000: 10}, PaletteClass.CABLE, False),
        ({0b001: 8, 0b000: 2}, PaletteClass.CONNECTOR, False),
        ({0b001: 7, 0b000: 3}, PaletteClass.UNKNOWN, True),  # layer 2: 110, a fault
        ({0b001: 4, 0b000: 3, 0b100: 3}, PaletteClass.UNKNOWN, True),  # 111, a fault
        ({0b100: 4, 0b111: 6}, PaletteClass.UNKNOWN, True),  # one unit, but most pixels activate none
        ({0b100: 6, 0b110: 4}, PaletteClass.TARGET, False),
        ({0b010: 6, 0b110: 4}, PaletteClass.RIVET, False),
        ({0b111: 10}, PaletteClass.PALETTE, False),
        ({0b101: 10}, PaletteClass.UNKNOWN, False),
    ],
)
def test_layer_2_judges_the_votes_of_an_area(votes, name, conflict):
    histogram = np.zeros((1, 8), dtype=np.int64)
    for code, count in votes.items():
        histogram[0, code] = count
    classes, disagree = verdicts(histogram, hopfield.exact(), 0.25)
    assert (classes[0], disagree[0]) == (name, conflict)


def test_codes_and_masks_are_rows_of_table_1():
    rgb = np.array([[BLACK, BLUE, GREEN, (0, 200, 200), RED, (200, 0, 200), YELLOW, BOARD]], dtype=np.uint8)
    levels = (120, 120, 120)
    assert palette_segments.codes(rgb, levels)[0].tolist() == list(range(8))
    masks = palette_segments.element_masks(rgb, levels)
    assert {k: np.flatnonzero(m[0]).tolist() for k, m in masks.items()} == {
        PaletteClass.PALETTE: [7],
        PaletteClass.CABLE: [0],
        PaletteClass.CONNECTOR: [1],
        PaletteClass.TARGET: [4],
    }
    printed = palette_segments.element_masks(rgb, levels, printed=True)
    # (not r and not g) or b; r or (not g and not b): cables and board are both.
    assert np.flatnonzero(printed[PaletteClass.CONNECTOR][0]).tolist() == [0, 1, 3, 5, 7]
    assert np.flatnonzero(printed[PaletteClass.TARGET][0]).tolist() == [0, 4, 5, 6, 7]


def test_otsu_follows_the_light():
    rgb = Canvas().box(BLACK, 0, 100, 320, 140).box(BLUE, 20, 20, 90, 80).box(RED, 120, 20, 190, 80).rgb
    for level in (0.3, 0.6, 1.0, 1.2):
        dimmed = np.clip(level * rgb, 0, 255).astype(np.uint8)
        found = palette_segments.codes(dimmed, palette_segments.otsu_levels(dimmed))
        assert [found[120, 160], found[50, 50], found[50, 150], found[200, 160]] == [
            0b000,
            0b001,
            0b100,
            0b111,
        ]


def test_noise_is_measured_beside_edges():
    rng = np.random.default_rng(4)
    rgb = zone(Canvas(), tie=True).rgb * 0.5 + 60.0
    for sigma in (4.0, 12.0):
        noisy = np.clip(rgb + rng.normal(0.0, sigma, rgb.shape), 0, 255).astype(np.uint8)
        assert palette_segments.noise_level(noisy) == pytest.approx(sigma, rel=0.05)


def test_a_picture_of_nothing_but_edges_is_one_area():
    rng = np.random.default_rng(5)
    rgb = rng.choice(np.array([0, 255], dtype=np.uint8), (40, 40, 3))
    area, core = palette_segments.areas(rgb, AreaCfg(median_px=1, noise_factor=0.0))
    assert (area == 0).all()
    assert core.all()


def test_observing_changes_no_input_and_repeats():
    canvas = zone(Canvas(), tie=True)
    rgb, depth = canvas.rgb, canvas.depth
    before = rgb.copy(), depth.copy()
    first, second = (observe(rgb, depth, CAMERA) for _ in range(2))
    np.testing.assert_array_equal(rgb, before[0])
    np.testing.assert_array_equal(depth, before[1])
    np.testing.assert_array_equal(first.centroids_px, second.centroids_px)
    np.testing.assert_array_equal(name_pixels(rgb, hopfield.exact(), PaletteObserverCfg()).conflict, False)


def test_flipped_views_and_single_precision_are_taken():
    canvas = zone(Canvas(), tie=True)
    rgb, depth = canvas.rgb, canvas.depth
    mirrored = observe(rgb[:, ::-1], depth[:, ::-1].astype(np.float32), CAMERA)
    plain = observe(np.ascontiguousarray(rgb[:, ::-1]), depth, CAMERA)
    np.testing.assert_allclose(mirrored.positions_m, plain.positions_m, atol=1e-6)
    (target,) = mirrored.of(PaletteClass.TARGET)
    np.testing.assert_allclose(mirrored.centroids_px[target], (200.0, 105.0), atol=0.1)


RGB, DEPTHS = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8), np.ones((HEIGHT, WIDTH))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"rgb": RGB.astype(np.float64)}, "rgb: must be of uint8"),
        ({"rgb": RGB[..., 0]}, r"rgb: must be of uint8, shape \(H, W, 3\)"),
        ({"rgb": RGB[:4]}, "at least 8 x 8"),
        ({"rgb": RGB[:200]}, r"320 x 200 pixels, but the camera's frame_px is \(320, 240\)"),
        ({"depth_m": DEPTHS[:200]}, r"depth_m: must be floats in m, shape \(240, 320\)"),
        ({"depth_m": DEPTHS.astype(np.int64)}, "not int64"),
        ({"depth_m": 0.0 * DEPTHS}, "no pixel has a depth"),
        ({"inside": DEPTHS}, "inside: must be bool"),
        ({"inside": DEPTHS > 2.0}, "with a pixel set"),
    ],
)
def test_pictures_that_do_not_fit_are_refused(given, message):
    with pytest.raises(ConfigError, match=message):
        observe(**{"rgb": RGB, "depth_m": DEPTHS, "camera": CAMERA, **given})


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PaletteObserverCfg(vote=0.6), r"vote = 0.6: must be within \(0, 0.5\]"),
        (lambda: PaletteObserverCfg(levels=(120, 120, 255)), "3 whole numbers in 1..254"),
        (lambda: AreaCfg(median_px=4), "must be 1, 3 or 5"),
        (lambda: AreaCfg(edge_level=0.0), r"edge_level = 0.0: must be within 1..255"),
        (lambda: RegionCfg(cable_bridge_m=9.0), "cable_bridge_m = 9.0: must be within 0..0.1"),
        (lambda: PalettePlan(classes=np.array([9]), positions_m=np.zeros((1, 3))), "numbers of PaletteClass"),
        (lambda: PalettePlan(classes=np.array([1]), positions_m=np.zeros((2, 3))), r"shape \(1, 3\)"),
        (
            lambda: PalettePlan(classes=np.array([1]), positions_m=np.zeros((1, 3)), tolerance_m=10.0),
            "tolerance_m = 10.0",
        ),
    ],
)
def test_configs_out_of_range_are_refused(make, message):
    with pytest.raises(ConfigError, match=message):
        make()
