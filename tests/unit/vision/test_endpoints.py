"""Lines from strips to images, and their end points, by hand."""

import numpy as np
import pytest

from seal_gym.core.cell import load_cell
from seal_gym.vision.endpoints import end_points, image_lines, strip_references
from seal_gym.vision.features import SeamLines, ViewGeometry
from seal_gym.vision.seam_line import strips

VIEWS = ViewGeometry.of(load_cell())
SIZE = VIEWS.size  # (50, 100) and (100, 50)


def lines(point, direction, n=1, valid=True):
    """The same line in both views."""
    shape = np.ones((n, 2, 1))
    return SeamLines(shape * point, shape * direction, np.full((n, 2), valid))


def test_a_strips_line_is_where_its_pixels_are_in_the_image():
    """Pixels painted along a strip's line are found on the image's line after the turn back."""
    p, q = np.array([[22.0, 20.0]]), np.array([[0.3, -0.2]])
    reference = strip_references(VIEWS)
    found = image_lines(np.stack((p, q), axis=-1), np.ones((1, 2), np.bool_), VIEWS)
    marks = [np.zeros((1, 100, 50, 3), np.uint8), np.zeros((1, 50, 100, 3), np.uint8)]
    # Views of the images' memory: what is painted into a strip shows in the image.
    painted = [marks[0][:, ::-1], marks[1].transpose(0, 2, 1, 3)]
    for v in range(2):
        for row in range(10, 90):
            o = p[0, v] + q[0, v] * (row + 0.5 - reference[v, 0])
            if 0 <= o < 50:
                painted[v][0, row, int(o)] = 255
        np.testing.assert_array_equal(strips(*marks)[v], painted[v])
        y, x = np.nonzero(marks[v][0, :, :, 0])
        assert len(x) > 60
        d = found.direction[0, v] / np.linalg.norm(found.direction[0, v])
        rel = np.column_stack((x + 0.5, y + 0.5)) - found.point[0, v]
        assert np.abs(rel[:, 0] * d[1] - rel[:, 1] * d[0]).max() <= 0.5 + 1e-9


def test_the_strips_reference_is_the_images():
    at = image_lines(strip_references(VIEWS)[None, :, 1:] * [1.0, 0.0], np.ones((1, 2), np.bool_), VIEWS)
    np.testing.assert_allclose(at.point[0], VIEWS.reference, atol=1e-12)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_end_points_in_closed_form(way):
    # Through (25, 25) at 45 deg, to the right and down. Front (50 x 100): the corner (0, 0) to (50, 50), and
    # travel is up, so the upper left end is ahead. Side (100 x 50): the same ends, travel is to the right.
    out = end_points(lines([25.0, 25.0], [way, way]), SIZE)
    np.testing.assert_allclose(out.ends[0], [[50, 50, 0, 0], [0, 0, 50, 50]], atol=1e-12)
    np.testing.assert_allclose(out.length, np.sqrt(5000), atol=1e-9)
    # Rising by 3 in 10 through (10, 40).
    out = end_points(lines([10.0, 40.0], [10.0 * way, -3.0 * way]), SIZE)
    np.testing.assert_allclose(out.ends[0], [[0, 43, 50, 28], [0, 43, 100, 13]], atol=1e-12)


def test_lines_along_the_axes():
    upright, level = (
        end_points(lines([20.0, 30.0], [0.0, 5.0]), SIZE),
        end_points(lines([20.0, 30.0], [-2.0, 0]), SIZE),
    )
    np.testing.assert_allclose(upright.ends[0, 0], [20, 100, 20, 0])
    np.testing.assert_allclose(level.ends[0, 1], [0, 30, 100, 30])
    np.testing.assert_allclose([upright.length[0, 0], level.length[0, 1]], 100.0)


@pytest.mark.parametrize(
    ("point", "direction", "valid"),
    [([-1.0, 10.0], [0.0, 1.0], True), ([60.0, 0.0], [1.0, 0.4], True), ([20.0, 20.0], [0.0, 0.0], True),
     ([20.0, 20.0], [1.0, 1.0], False), ([-30.0, -0.5], [1.0, 0.0], True)],
)  # fmt: skip
def test_a_line_beside_the_roi_has_none(point, direction, valid):
    out = end_points(lines(point, direction, valid=valid), SIZE)
    assert np.isnan(out.ends[0, 0]).all() and out.length[0, 0] == 0.0


def test_labels_stay_as_the_line_sweeps_over_the_rois_corner():
    turn = np.radians(np.linspace(-75, 75, 3001))
    front = np.stack((np.sin(turn), -np.cos(turn)), axis=-1)
    side = np.stack((np.cos(turn), np.sin(turn)), axis=-1)
    sign = np.where(np.arange(3001) % 2, 1.0, -1.0)[:, None, None]  # a line has no sense
    swept = SeamLines(
        np.broadcast_to(0.5 * SIZE, (3001, 2, 2)),
        sign * np.stack((front, side), axis=1),
        np.ones((3001, 2), np.bool_),
    )
    ends = end_points(swept, SIZE).ends
    assert (ends[:, 0, 1] > ends[:, 0, 3]).all() and (ends[:, 1, 0] < ends[:, 1, 2]).all()
    # All four sides of the ROI are met, and 0.05 deg move an end by 0.2 px at most.
    assert np.ptp(ends[:, 0, 2]) == pytest.approx(50) and (ends[:, 0, 3] > 1).any()
    assert np.abs(np.diff(ends, axis=0)).max() < 0.2
