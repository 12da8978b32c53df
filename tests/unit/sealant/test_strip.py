"""The columns' volumes against rings and shells, the part's feet against its shape."""

import numpy as np
import pytest

from seal_gym.core.errors import SeamError
from seal_gym.sealant.strip import Strip
from seal_gym.sim.bead_strip import bead_strip
from seal_gym.workpieces import catalogue
from seal_gym.workpieces.workpiece import Workpiece

UP = np.array([0.0, 0.0, 1.0])


def ring(radius, column, rows=721, across=None):
    """A strip round a circle, travelled counter-clockwise: offsets to the right point outwards."""
    arc = np.linspace(0, 2 * np.pi * radius, rows)
    angle = arc / radius
    out = np.column_stack((np.cos(angle), np.sin(angle), 0 * angle))
    along = np.column_stack((-np.sin(angle), np.cos(angle), 0 * angle))
    up = np.tile(UP, (rows, 1))
    direction = up if column == "up" else out
    across = np.linspace(-4e-3, 4e-3, 17) if across is None else across
    flat = np.zeros((rows, len(across)))
    normal = np.broadcast_to(direction[:, None], (*flat.shape, 3))
    return Strip.of(arc, across, (radius * out, along, direction), flat, normal)


def test_columns_over_a_plane_fill_a_ring():
    strip = ring(0.02, "up")
    layer = strip.volume(np.full(strip.area.shape, 1e-3))[:-1].sum()  # the last row repeats the first
    half = strip.across[-1] + 0.25e-3
    assert layer == pytest.approx(1e-3 * np.pi * ((0.02 + half) ** 2 - (0.02 - half) ** 2), rel=1e-4)


def test_columns_on_a_cylinder_fan_out_to_a_shell():
    strip = ring(0.02, "out")
    layer = strip.volume(np.full(strip.area.shape, 3e-3))[:-1].sum()
    width = 17 * 0.5e-3
    assert layer == pytest.approx(width * np.pi * (0.023**2 - 0.02**2), rel=1e-4)


def test_height_is_the_inverse_of_volume():
    strip = ring(0.02, "out")
    height = np.random.default_rng(0).uniform(0, 8e-3, strip.area.shape)
    np.testing.assert_allclose(strip.height(strip.volume(height)), height, rtol=1e-12)
    assert strip.height(np.zeros(strip.area.shape)).max() == 0.0


@pytest.mark.parametrize("name", catalogue.NAMES)
def test_feet_of_a_fillet_make_a_right_angle(name):
    strip = bead_strip(catalogue.get(name), 0.5e-3, 8e-3)
    # Facets and chords of the round parts: 4 um.
    np.testing.assert_allclose(strip.foot, np.broadcast_to(np.abs(strip.across), strip.foot.shape), atol=4e-6)
    np.testing.assert_allclose(strip.slant, np.sqrt(0.5), atol=1e-4)


def test_feet_of_a_groove_make_a_notch():
    line = [[-0.1, 0, 0], [0.1, 0, 0]]
    part = Workpiece.from_polyline(line, [0, 0, 1.0], joint="groove", groove_width=2e-3)
    strip = bead_strip(part, 0.25e-3, 6e-3)
    foot = (strip.foot - strip.foot[:, [0]])[1:-1]  # the first and last row stand on the groove's ends
    inside = np.abs(strip.across) < 0.9e-3
    np.testing.assert_allclose(foot[:, inside], -2e-3, atol=1e-9)
    np.testing.assert_allclose(foot[:, np.abs(strip.across) > 1.1e-3], 0.0, atol=1e-9)


def test_where_the_part_ends_there_are_no_columns():
    part = Workpiece.from_polyline([[-0.05, 0, 0], [0.05, 0, 0]], [0, -np.sqrt(0.5), np.sqrt(0.5)])
    low = part.surface.triangles[..., 1].min()
    strip = bead_strip(part, 0.5e-3, 8e-3)
    assert strip.there.all()
    y = strip.base[..., 1]
    assert low < y.min()
    line = (strip.base[:, 16], strip.along, strip.column)
    height = np.where(y > -1e-3, strip.foot, np.nan)
    bare = Strip.of(strip.arc, strip.across, line, height, np.broadcast_to(UP, strip.base.shape))
    assert not bare.there[:, -1].any()
    assert np.isnan(bare.foot[:, -1]).all()
    assert bare.volume(np.full(bare.area.shape, 1e-3))[:, -1].max() == 0.0


def test_a_part_gives_the_same_strip_again():
    part = catalogue.get("flat")
    assert bead_strip(part, 0.5e-3, 8e-3) is bead_strip(part, 0.5e-3, 8e-3)


def test_uneven_steps_and_wrong_shapes_are_refused():
    strip = ring(0.02, "up", rows=5)
    line = (strip.base[:, 8], strip.along, strip.column)
    normal = np.broadcast_to(UP, strip.base.shape)
    height = np.zeros(strip.area.shape)
    with pytest.raises(SeamError, match="arc must increase in even steps"):
        Strip.of(strip.arc**2, strip.across, line, height, normal)
    with pytest.raises(SeamError, match="have shapes"):
        Strip.of(strip.arc, strip.across, line, height[:, 1:], normal)
