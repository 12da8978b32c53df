"""Marks are where geometry says, candidates are the seam's, drawing leaves the image alone."""

import numpy as np
import pytest

from seal_gym.core.cell import load_cell
from seal_gym.core.errors import ConfigError
from seal_gym.vision import overlay
from seal_gym.vision.features import RoiFeatures, SeamLines, ViewGeometry, update_features

CELL = load_cell()
VIEWS = ViewGeometry.of(CELL)
SIZES = ((100, 50), (50, 100))
BARE = tuple(np.zeros(size) for size in SIZES)


def plates(u_front=20, v_side=30, bright=170, dark=60):
    """Ideal views: a dark wall left of a column (front) and above a row (side), a bright plate beyond."""
    front = np.full((100, 50, 3), bright, np.uint8)
    side = np.full((50, 100, 3), bright, np.uint8)
    front[:, :u_front] = dark
    side[:v_side] = dark
    return front, side


def lines(points, directions, valid=(True, True)):
    return SeamLines(np.array([points], float), np.array([directions], float), np.array([valid]))


def test_a_line_is_clipped_to_the_roi():
    size = np.array([50.0, 100.0])
    ends = overlay.clip_line(np.array([10.0, 10.0]), np.array([1.0, 1.0]), size)
    np.testing.assert_allclose(ends, [[0, 0], [50, 50]], atol=1e-12)
    ends = overlay.clip_line(np.array([10.0, 200.0]), np.array([0.0, -3.0]), size)
    np.testing.assert_allclose(ends, [[10, 100], [10, 0]], atol=1e-12)
    assert overlay.clip_line(np.array([-1.0, 5.0]), np.array([0.0, 1.0]), size) is None
    assert overlay.clip_line(np.array([-10.0, 5.0]), np.array([-1.0, 20.0]), size) is None
    assert overlay.clip_line(np.array([1.0, 5.0]), np.zeros(2), size) is None


def test_the_attraction_point_is_the_foot():
    """(3, 4) on the line through (0, 0) along (2, 0) or (1, 1): (3, 0) and (3.5, 3.5)."""
    reference = np.array([3.0, 4.0])
    np.testing.assert_allclose(overlay.foot(reference, np.zeros(2), np.array([2.0, 0.0])), [3, 0])
    np.testing.assert_allclose(
        overlay.foot(reference, np.array([9.0, 9.0]), np.array([1.0, 1.0])), [3.5, 3.5]
    )


def test_the_attraction_point_lies_d_px_from_the_stand_off_point():
    seen = lines([[20, 50], [50, 30]], [[0.1, -1], [1, 0.2]])
    features = RoiFeatures.zeros(1)
    update_features(features, seen, VIEWS)
    front, side = overlay.view_marks(seen, VIEWS)
    assert front.attraction[0] - front.stand_off[0] == pytest.approx(features.d_px[0, 0], abs=1e-9)
    assert side.attraction[1] - side.stand_off[1] == pytest.approx(features.d_px[0, 1], abs=1e-9)
    point = np.array([0.0, 0.0, -CELL.process.stand_off_m])
    for camera, marks in zip(CELL.cameras, (front, side), strict=True):
        np.testing.assert_allclose(marks.stand_off, camera.project(point), atol=1e-9)


def test_candidates_and_ransac_find_the_edge_of_both_views():
    stages = overlay.line_stage(*plates(u_front=20, v_side=30), BARE, VIEWS)
    for stage, axis, where in zip(stages, (0, 1), (20.0, 30.0), strict=True):
        assert len(stage.candidates) >= 80  # nearly every row along the seam
        assert np.abs(stage.candidates[:, axis] - where).max() <= 2.5
        assert np.ptp(stage.candidates[:, 1 - axis]) > 90
        point, direction = stage.ransac
        assert point[axis] == pytest.approx(where, abs=0.6)  # unrefined: to a pixel's half
        assert direction[axis] / direction[1 - axis] == pytest.approx(0.0, abs=0.02)


def test_an_inclined_edge_is_drawn_upright():
    """The front view's strip stands on its head: a line leaning right must stay so."""
    front, side = plates()
    u, v = np.meshgrid(np.arange(50) + 0.5, np.arange(100) + 0.5)
    front[...] = np.where(u < 30.0 - 0.2 * (v - 50.0), 60, 170)[..., None]
    u, v = np.meshgrid(np.arange(100) + 0.5, np.arange(50) + 0.5)
    side[...] = np.where(v < 25.0 + 0.1 * (u - 50.0), 60, 170)[..., None]
    (point, direction), (side_point, side_direction) = (
        s.ransac for s in overlay.line_stage(front, side, BARE, VIEWS)
    )
    assert direction[0] / direction[1] == pytest.approx(-0.2, abs=0.02)
    assert point[0] == pytest.approx(30.0 - 0.2 * (point[1] - 50.0), abs=0.5)
    assert side_direction[1] / side_direction[0] == pytest.approx(0.1, abs=0.02)
    assert side_point[1] == pytest.approx(25.0 + 0.1 * (side_point[0] - 50.0), abs=0.5)


def test_an_edge_of_the_wrong_polarity_and_the_nozzle_are_no_candidates():
    front, side = plates(u_front=20)
    front[:, 38:] = 60  # bright to dark: not the foot of a wall on the left
    side[:10] = 220
    nozzle = (np.zeros(SIZES[0]), np.zeros(SIZES[1]))
    nozzle[0][60:80, 15:25] = 1.0
    stages = overlay.line_stage(front, side, nozzle, VIEWS)
    assert stages[0].candidates[:, 0].max() < 25
    assert stages[1].candidates[:, 1].min() > 20
    v = stages[0].candidates[:, 1]
    assert len(v) > 50 and not ((v > 58) & (v < 82)).any()


def test_without_contrast_there_is_nothing():
    flat = np.full((100, 50, 3), 120, np.uint8), np.full((50, 100, 3), 120, np.uint8)
    for stage in overlay.line_stage(*flat, BARE, VIEWS):
        assert len(stage.candidates) == 0 and stage.ransac is None


def test_a_lost_line_has_no_marks_but_the_stand_off_point():
    front, side = overlay.view_marks(lines([[20, 50], [50, 30]], [[0, -1], [1, 0]], (False, True)), VIEWS)
    assert front.line is None and front.attraction is None and front.ransac is None
    assert side.line is not None and side.attraction is not None
    assert np.isfinite(front.stand_off).all()


def near(picture, rgb, tolerance=60):
    """Pixels of about a colour, (row, column)."""
    return np.argwhere(np.abs(picture.astype(int) - rgb).max(axis=-1) < tolerance)


@pytest.mark.parametrize("scale", [3, 5])
def test_marks_are_drawn_where_they_are(scale):
    image = np.full((100, 50, 3), 90, np.uint8)
    image[40, 10] = (250, 0, 0)
    before = image.copy()
    marks = overlay.ViewMarks(
        candidates=np.array([[5.5, 20.5]]),
        ransac=np.array([[40.0, 0.0], [40.0, 100.0]]),
        line=np.array([[25.0, 0.0], [25.0, 100.0]]),
        attraction=np.array([25.0, 60.0]),
        stand_off=np.array([15.0, 60.0]),
    )
    picture = overlay.draw(image, marks, scale)
    np.testing.assert_array_equal(image, before)
    assert picture.shape == (100 * scale, 50 * scale, 3)
    block = picture[40 * scale : 41 * scale, 10 * scale : 11 * scale]
    assert (block == (250, 0, 0)).all()  # a pixel becomes a block
    for rgb, column in ((overlay.LINE_RGB, 25.0), (overlay.RANSAC_RGB, 40.0)):
        found = near(picture, rgb)
        assert found[:, 1].mean() == pytest.approx(column * scale - 0.5, abs=0.6)
        assert np.ptp(found[:, 0]) > 90 * scale
    dot = near(picture[: 30 * scale, : 12 * scale], overlay.CANDIDATE_RGB)
    np.testing.assert_allclose(dot.mean(axis=0) + 0.5, [20.5 * scale, 5.5 * scale], atol=1.0)
    ring = near(picture, overlay.STAND_OFF_RGB)
    assert ring[:, 0].mean() + 0.5 == pytest.approx(60 * scale, abs=1.0)
    assert ring[:, 1].min() + 0.5 == pytest.approx(15 * scale - 8, abs=2.0)
    foot = near(picture, overlay.ATTRACTION_RGB)
    assert foot[:, 1].max() == pytest.approx(25 * scale + 4, abs=2.0)  # disc of 4 px about the foot
    assert foot[:, 1].min() <= 15 * scale + 1  # and the way to it


def test_nothing_to_mark_leaves_the_enlarged_image():
    image = np.random.default_rng(0).integers(0, 255, (50, 100, 3)).astype(np.uint8)
    marks = overlay.ViewMarks(np.empty((0, 2)), None, None, None, np.array([-50.0, -50.0]))
    np.testing.assert_array_equal(overlay.draw(image, marks, 2)[::2, ::2], image)


def test_the_legend_names_only_what_is_drawn():
    vision, oracle = overlay.legend(300, vision=True, columns=1), overlay.legend(300, vision=False, columns=1)
    assert vision.shape == (5 * 23, 300, 3) and oracle.shape == (3 * 23, 300, 3)
    assert len(near(vision, overlay.RANSAC_RGB)) > 20 and len(near(oracle, overlay.RANSAC_RGB)) == 0
    assert len(near(oracle, overlay.STAND_OFF_RGB)) > 20
    assert overlay.legend(600, vision=True).shape == (3 * 23, 600, 3)


def test_the_colours_differ_in_grey_or_for_the_colour_blind():
    """Simulated deuteranopia (Vienot et al. 1999, linear RGB): every two marks stay apart."""
    colours = np.array(
        [overlay.CANDIDATE_RGB, overlay.RANSAC_RGB, overlay.LINE_RGB, overlay.ATTRACTION_RGB,
         overlay.STAND_OFF_RGB]
    )  # fmt: skip
    linear = (colours / 255.0) ** 2.2
    matrix = np.array([[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1.0]])
    seen = np.clip(linear @ matrix.T, 0.0, 1.0) ** (1 / 2.2)
    apart = np.linalg.norm(seen[:, None] - seen[None], axis=-1) + np.eye(len(seen))
    assert apart.min() > 0.2


def test_a_scale_that_is_none_is_refused():
    marks = overlay.ViewMarks(np.empty((0, 2)), None, None, None, np.zeros(2))
    with pytest.raises(ConfigError, match="scale"):
        overlay.draw(np.zeros((4, 4, 3), np.uint8), marks, 0)
