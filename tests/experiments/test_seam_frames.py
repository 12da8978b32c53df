"""Validation frames, their truth, and the errors measured against it."""

import numpy as np
import pytest

from experiments import seam_frames as sf
from seal_gym.core.cell import load_cell
from seal_gym.core.errors import ConfigError
from seal_gym.sim.look import LookCfg
from seal_gym.vision.baselines import SobelEdges
from seal_gym.vision.features import RoiFeatures, SeamLines, ViewGeometry, update_features


@pytest.fixture(scope="module")
def frames():
    return {part: sf.draw(part, 60) for part in ("flat", "cylinder", "rectangular")}


def test_frames_are_all_along_the_seam_corners_included(frames):
    for part, f in frames.items():
        length = {"flat": 0.300, "cylinder": np.pi * 0.07, "rectangular": 0.380}[part]
        assert f.s_m.min() < 0.1 * length and f.s_m.max() > 0.9 * length * 0.98
        assert (f.corner.sum() > 3) == (part == "rectangular")
    # The corners' arcs are 7.9 mm long; with 15 mm on either side, of 380 mm.
    share = 2 * (0.0079 + 0.03) / 0.380
    assert frames["rectangular"].corner.mean() == pytest.approx(share, abs=0.12)


def test_the_sensor_realism_is_on(frames):
    """Grey noise of 8: neighbours in a row of a flat part differ by at least that."""
    strip = frames["flat"].strip[0].astype(float).mean(axis=3)
    rough = np.diff(strip[:, :, 40:], axis=2).std(axis=(1, 2)) / np.sqrt(2)
    assert 7.0 < np.median(rough) < 12.0
    light = strip.mean(axis=(1, 2))
    assert light.std() > 15.0  # brightness and contrast vary
    assert 8.0 < frames["flat"].images.snr_db.mean() < 20.0


def test_the_frame_of_a_seed_is_always_the_same(frames):
    many, one = frames["rectangular"], sf.draw("rectangular", 1, sf.FIRST_SEED + 7)
    np.testing.assert_array_equal(many.strip[0][7], one.strip[0][0])
    np.testing.assert_array_equal(many.strip[1][7], one.strip[1][0])
    np.testing.assert_array_equal(many.truth[7], one.truth[0])
    some = sf.subset(many, np.array([7]))
    np.testing.assert_array_equal(some.strip[1], one.strip[1])
    np.testing.assert_array_equal(some.images.front, one.images.front)


def test_a_tip_on_the_path_has_the_nominal_truth():
    """Straight through the reference in both views, on every part, with the curve's tangent."""
    on_path = sf.FrameCfg(offset_m=0.0, turned_rad=0.0, lean_rad=0.0)
    for part in ("flat", "cylinder", "rectangular"):
        f = sf.draw(part, 20, cfg=on_path)
        for v in range(2):
            assert np.abs(f.truth[:, v, 0] - f.views.reference[v, 1]).max() < 0.02
        assert np.abs(f.truth[:, 0, 1]).max() < 2e-3  # the front view looks along the travel


def test_the_truth_lies_on_the_step_in_the_image():
    """In clean pictures the largest step of a row beside the tip is where the truth says."""
    f = sf.draw("flat", 12, cfg=sf.FrameCfg(look=LookCfg.clean()))
    for v in range(2):
        grey = f.strip[v].astype(float).mean(axis=3)
        for row in (50, 60, 70):
            o = f.truth[:, v, 0] + f.truth[:, v, 1] * (row + 0.5 - f.views.reference[v, 0])
            step = np.diff(grey[:, row], axis=1)
            assert np.abs(np.argmax(step, axis=1) + 1 - o).max() < 1.01


def test_errors_are_those_of_the_features(frames):
    """Against the package's own features of the same lines in the image."""
    f, views = frames["cylinder"], ViewGeometry.of(load_cell())
    rng = np.random.default_rng(0)
    n = len(f.seed)
    line = f.truth + np.stack((rng.normal(0, 2, (n, 2)), rng.normal(0, 0.05, (n, 2))), axis=2)

    def features(strip_lines):
        point, direction = np.empty((n, 2, 2)), np.empty((n, 2, 2))
        ones = np.ones(n)
        for v in range(2):
            p, q, t = strip_lines[:, v, 0], strip_lines[:, v, 1], f.views.reference[v, 0]
            if v == 0:
                point[:, v] = np.column_stack((p, (100.0 - t) * ones))
                direction[:, v] = np.column_stack((q, -ones))
            else:
                point[:, v], direction[:, v] = np.column_stack((t * ones, p)), np.column_stack((ones, q))
        out = RoiFeatures.zeros(n)
        update_features(out, SeamLines(point, direction, np.ones((n, 2), np.bool_)), views)
        return out

    a, b = features(line), features(f.truth)
    for v in range(2):
        e = sf.errors(line[:, v], f.truth[:, v], f.views.reference[v, 1])
        np.testing.assert_allclose(np.abs(e.offset_px), np.abs(a.d_px - b.d_px)[:, v], atol=1e-9)
        turned = np.abs(np.rad2deg(a.theta_px_rad - b.theta_px_rad))[:, v]
        np.testing.assert_allclose(np.abs(e.angle_deg), turned, atol=1e-9)


@pytest.mark.parametrize("level", [20.0, 6.0, -6.0])
def test_noise_is_scaled_to_the_ratio_asked_for(level):
    """By the definition: variance of the picture without noise over that of the noise."""
    f = sf.draw("flat", 8, snr_db=level)
    np.testing.assert_allclose(f.images.snr_db, level, atol=0.02)
    # The mean of many noisy frames would be the picture; the noise itself is seen on the plate.
    grey = f.strip[0].astype(float).mean(axis=3)
    plain = sf.draw("flat", 8, cfg=sf.FrameCfg(look=LookCfg(noise_sigma=0.0))).strip[0].astype(float)
    picture = plain.mean(axis=3).std(axis=(1, 2))
    noise = np.diff(grey[:, 40:, 38:], axis=2).std(axis=(1, 2)) / np.sqrt(2)
    measured = 20 * np.log10(picture / noise)
    # Clipping cuts the noise, exposure the picture: a coarse check, but an independent one.
    assert np.median(measured) == pytest.approx(level, abs=4.0)


def test_accuracy_by_hand():
    e = sf.LineErrors(np.array([0.1, -0.5, 4.0, np.inf]), np.array([1.0, -2.0, 0.5, np.inf]))
    row = sf.accuracy(e)
    assert row["frames"] == 4 and row["failed_pct"] == 50.0
    assert row["offset_px"] == pytest.approx(2.25) and row["angle_deg"] == pytest.approx(1.5)
    by_hand = ((0.1 + 0.5) / 3 + 1 + 1 + (1 + 2 + 0.5) / 10 + 1) / 8
    assert row["loss"] == pytest.approx(by_hand)
    assert row["failed_ci"][0] < 50 < row["failed_ci"][1]
    nothing = sf.accuracy(sf.LineErrors(np.full(3, np.inf), np.full(3, np.inf)))
    assert nothing["offset_px"] is None and nothing["failed_pct"] == 100.0 and nothing["loss"] == 1.0


def test_lines_without_a_find_count_as_lost(frames):
    blind = sf.subset(frames["flat"], np.arange(4))
    dark = blind._replace(strip=tuple(np.full_like(s, 90) for s in blind.strip))
    for v, found in enumerate(sf.lines_of(dark, SobelEdges())):
        for e in sf.stage_errors(found, dark.truth[:, v], dark.views.reference[v, 1]).values():
            assert sf.failed(e).all()


@pytest.mark.parametrize("seed", [499_999, 1_000_000, 999_998])
def test_only_validation_seeds(seed):
    with pytest.raises(ConfigError, match="validation"):
        sf.draw("flat", 3, seed)
