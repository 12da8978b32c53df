"""The groove's fit on profiles drawn with a known middle, and its section against projected points."""

import numpy as np
import pytest

from seal_gym.core.cell import load_cell
from seal_gym.core.errors import ConfigError
from seal_gym.vision.edges import EdgeStage
from seal_gym.vision.features import ViewGeometry
from seal_gym.vision.groove import (
    CUTS,
    NO_GROOVE,
    NO_SECTION,
    SECTION,
    GrooveCfg,
    band_centre,
    coarse_centre,
    cuts_at,
    section_of,
)
from seal_gym.vision.seam_line import LineCfg, follow, groove_line, row_edge
from seal_gym.vision.strip_geometry import plate_axes, to_strip

VIEWS = ViewGeometry.of(load_cell())
COUNT, FINE = 40, 200


def section_across(c, width, corner, levels, count=COUNT):
    """Plate, wall, floor, plate, each pixel the mean of 200 samples; the corner as a share of the width."""
    x = (np.arange(count * FINE) + 0.5) / FINE
    cuts = c + width * np.array([-0.5, corner - 0.5, 0.5])
    return np.asarray(levels, float)[np.searchsorted(cuts, x)].reshape(count, FINE).mean(axis=1)


def cut_of(width, corner, ratio=0.45):
    return np.append(width * np.array([-0.5, corner - 0.5, 0.5]), ratio)


def centres(width, corner, levels, sigma, n=200):
    """Errors of the fit where the middle is expected up to 1.5 px off."""
    rng, found, out = np.random.default_rng(1), np.empty(2), []
    for _ in range(n):
        c = 20.0 + rng.uniform(-0.5, 0.5)
        profile = section_across(c, width, corner, levels) + rng.normal(0.0, sigma, COUNT)
        assert band_centre(profile, COUNT, c + rng.uniform(-1.5, 1.5), 3.0, cut_of(width, corner), found)
        out.append(found[0] - c)
    return np.array(out)


@pytest.mark.parametrize("width", [1.5, 3.5, 6.0, 11.0])
@pytest.mark.parametrize("corner", [0.0, 1.0])
def test_the_middle_of_one_band_is_exact(width, corner):
    assert np.abs(centres(width, corner, (150, 60, 60, 150), 0.0)).max() < 0.01


@pytest.mark.parametrize("width", [6.0, 11.0])
@pytest.mark.parametrize("corner", [0.36, 0.62])
def test_a_dark_wall_beside_the_floor_does_not_pull(width, corner):
    """The darkness's centroid is 0.06 of the width off."""
    levels = (150, 40, 100, 152)
    assert np.abs(centres(width, corner, levels, 0.0)).max() < 0.01
    assert np.abs(centres(width, 1.0 - corner, (150, 100, 40, 152), 0.0)).max() < 0.01


@pytest.mark.parametrize("width", [1.5, 1.8, 2.5, 3.5])
def test_narrow_grooves_are_placed_to_a_fifth_of_a_pixel(width):
    error = centres(width, 0.62, (150, 40, 100, 150), 2.5)
    assert abs(error.mean()) < 0.15 and error.std() < 0.2


@pytest.mark.parametrize("width", [3.5, 6.0, 11.0])
def test_noise_leaves_what_the_step_says(width):
    """An edge of the step found has a standard deviation of noise over step."""
    sigma, found = 2.5, np.empty(2)
    error = centres(width, 0.62, (150, 40, 100, 150), sigma)
    band_centre(
        section_across(20.0, width, 0.62, (150, 40, 100, 150)), COUNT, 20.0, 3.0, cut_of(width, 0.62), found
    )
    assert abs(error.mean()) < 0.02
    assert error.std() == pytest.approx(sigma / found[1], rel=0.7)


def test_one_bank_out_of_the_picture_is_enough():
    found = np.empty(2)
    for c in (38.0, 1.6):
        profile = section_across(c, 6.0, 1.0, (150, 60, 60, 150))
        assert band_centre(profile, COUNT, c + 0.6, 3.0, cut_of(6.0, 1.0), found)
        assert found[0] == pytest.approx(c, abs=0.03)


@pytest.mark.parametrize("width", [5.4, 6.6])
def test_a_wrong_width_leaves_the_middle_where_it_is(width):
    """By symmetry; a place in a pixel may be a fifth of one off, their mean is not."""
    found, error = np.empty(2), []
    for c in np.linspace(19.5, 20.5, 21):
        profile = section_across(c, 6.0, 1.0, (150, 60, 60, 150))
        assert band_centre(profile, COUNT, 20.0, 3.0, cut_of(width, 1.0), found)
        error.append(found[0] - c)
    assert abs(np.mean(error)) < 0.02 and np.abs(error).max() < 0.25


def test_a_ridge_or_nothing_is_no_groove():
    found, cut = np.empty(2), cut_of(6.0, 1.0)
    assert not coarse_centre(np.full(COUNT, 99.0), COUNT, 20.0, 3.0, cut, found)
    ridge = section_across(20.0, 6.0, 1.0, (60, 150, 150, 60))
    assert not band_centre(ridge, COUNT, 20.0, 1.0, cut, found)


def section(view, lean_deg, heading_deg, width, depth):
    """A groove under a leaning gun: its section, and true images of points of banks and floor corners."""
    lean, turn = np.deg2rad(lean_deg), np.deg2rad(heading_deg)
    normal = np.array([-np.sin(lean), 0.0, np.cos(lean)])
    right = np.array([np.cos(lean), 0.0, np.sin(lean)])
    d = np.cos(turn) * np.array([0.0, 1.0, 0.0]) + np.sin(turn) * right
    n, m, p, out = np.empty(3), np.empty(3), np.array([1e-4, 0.0, -3e-3]), np.empty(SECTION)
    plate_axes(d, tuple(normal), n, m)
    assert section_of(p, d, n, m, view, VIEWS, (width, depth, 0.45), out)
    return p, d, n, m, out


def at_row(p, d, view, t):
    """Where the image of a line crosses a row, by bisection."""
    low, high, a = -0.05, 0.05, np.empty(2)
    for _ in range(60):
        middle = 0.5 * (low + high)
        assert to_strip(p + middle * d, view, VIEWS, a)
        low, high = (middle, high) if a[0] < t else (low, middle)
    return a[1]


@pytest.mark.parametrize("view", [0, 1])
@pytest.mark.parametrize("lean", [-20.0, 0.0, 20.0])
@pytest.mark.parametrize("heading", [-20.0, 0.0, 15.0])
def test_the_cuts_are_the_projected_banks_and_the_visible_corner(view, lean, heading):
    width, depth = 2e-3, 2e-3
    p, d, n, m, out = section(view, lean, heading, width, depth)
    a, b, cut = np.empty(2), np.empty(2), np.empty(CUTS)
    to_strip(p, view, VIEWS, a)
    to_strip(p + 1e-5 * d, view, VIEWS, b)
    cuts_at(out, (b[1] - a[1]) / (b[0] - a[0]), cut)
    lines = [
        p - width / 2 * m,
        p + width / 2 * m,
        p - width / 2 * m - depth * n,
        p + width / 2 * m - depth * n,
    ]
    left, right, low_left, low_right = (at_row(x, d, view, a[0]) - a[1] for x in lines)
    assert cut[[0, 2]] == pytest.approx([left, right], abs=0.15)
    # Of the two walls the camera sees the one whose foot is inside the opening, by more than perspective.
    if low_left > left + 0.3:
        assert cut[1] == pytest.approx(min(low_left, right), abs=0.2) and cut[3] == 0.45
    elif low_right < right - 0.3:
        assert cut[1] == pytest.approx(max(low_right, left), abs=0.2) and cut[3] == 1 / 0.45
    else:
        assert min(abs(cut[1] - left), abs(cut[1] - right)) < 0.3


def test_on_a_bend_the_banks_are_parallel_to_the_local_direction():
    """The section of one direction gives another direction's cuts."""
    for view in (0, 1):
        p, _, _, _, straight = section(view, 0.0, 0.0, 2e-3, 2e-3)
        _, d, _, _, turned = section(view, 0.0, 25.0, 2e-3, 2e-3)
        a, b, one, other = np.empty(2), np.empty(2), np.empty(CUTS), np.empty(CUTS)
        to_strip(p, view, VIEWS, a)
        to_strip(p + 1e-5 * d, view, VIEWS, b)
        q = (b[1] - a[1]) / (b[0] - a[0])
        cuts_at(straight, q, one)
        cuts_at(turned, q, other)
        assert one == pytest.approx(other, abs=0.02)


HEIGHT, WIDTH, T_REF = 100, 50, 25.4
PLAIN_SECTION = np.array([1e-3, 0.0, 3000.0, 0.0, 0.0, 3000.0, 0.0, 0.0, 0.45])  # 6 px wide
LINE = LineCfg().numbers


def strip(middle, seed, plate=120.0, floor=80.0, width=6.0, sigma=8.0):
    """A strip with a groove along middle(t), its edges and no nozzle."""
    t = np.arange(HEIGHT) + 0.5 - T_REF
    slope = np.gradient(middle(t))
    rows = [
        section_across(c, width * np.hypot(1.0, q), 1.0, (plate, floor, floor, plate), WIDTH)
        for c, q in zip(middle(t), slope, strict=True)
    ]
    noise = np.random.default_rng(seed).normal(0.0, sigma, (HEIGHT, WIDTH, 3))
    image = np.clip(np.rint(np.array(rows)[..., None] + noise), 0, 255).astype(np.uint8)
    mask = np.zeros((HEIGHT, WIDTH), np.bool_)
    return image.sum(axis=2).astype(np.int64), mask, EdgeStage()(image[None], mask).edge[0]


@pytest.mark.parametrize("seed", range(4))
def test_a_groove_is_found_without_knowing_where(seed):
    p, q = 12.0 + 7.0 * seed, 0.1 - 0.05 * seed
    line = np.empty(2)
    assert groove_line(*strip(lambda t: p + q * t, seed), T_REF, PLAIN_SECTION, LINE, np.empty(64), line)
    assert line == pytest.approx([p, q], abs=0.4)


def test_a_step_or_a_blank_is_no_groove():
    line = np.empty(2)
    blank = strip(lambda t: 25.0 + 0 * t, 3, floor=120.0)
    assert not groove_line(*blank, T_REF, PLAIN_SECTION, LINE, np.empty(64), line)


@pytest.mark.parametrize("bend", [0.0, 0.012])
def test_a_groove_is_followed_round_a_bend(bend):
    """A bend of 42 px is 12 mm in the front view."""

    def middle(t):
        return 22.0 + bend * t**2

    points = np.empty((200, 3))
    n = follow(*strip(middle, 0), T_REF, 22.0, 0.0, 30.0, 20.0, PLAIN_SECTION, LINE, np.empty(64), points)
    error = points[:n, 1] - middle(points[:n, 0])
    assert n > 40
    assert abs(error.mean()) < 0.06 and error.std() < 0.25


def test_the_nozzle_may_hide_a_bank_but_not_the_middle():
    grey, mask, edge = strip(lambda t: 25.2 + 0 * t, 1)
    grey[:, 29:] = 60  # darker than the floor
    mask[:, 25:] = True  # with its margin and more
    found = np.empty(2)
    assert not row_edge(grey, mask, edge, 40, 25.2, 0.0, 3.0, PLAIN_SECTION, LINE, np.empty(64), found)
    mask[:, 25:27] = False
    for row in range(10, 90, 7):
        assert row_edge(grey, mask, edge, row, 25.0, 0.0, 3.0, PLAIN_SECTION, LINE, np.empty(64), found)
        assert found[0] == pytest.approx(25.2, abs=0.5)


def test_a_seam_without_a_groove_has_no_section():
    p, d, n, m, out = *(np.zeros(3) for _ in range(4)), np.ones(SECTION)
    assert section_of(p, d, n, m, 0, VIEWS, NO_GROOVE, out)
    np.testing.assert_array_equal(out, NO_SECTION)


@pytest.mark.parametrize("name", ["width_m", "depth_m"])
def test_sizes_that_are_none_are_refused(name):
    with pytest.raises(ConfigError, match=name):
        GrooveCfg(**{"width_m": 2e-3, "depth_m": 2e-3, name: 0.0})
