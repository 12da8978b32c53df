"""The line filter against hand-written matrices and closed forms, and its rules for lost lines."""

import numpy as np
import pytest

from seal_gym.core.cell import load_cell
from seal_gym.core.errors import ConfigError
from seal_gym.estimation.line_kalman import LineKalman, LineKalmanCfg
from seal_gym.vision.endpoints import end_points, image_lines
from seal_gym.vision.features import ViewGeometry

DT = 1 / 30
ROWS = np.array([-20.0, 40.0])
OPEN = {"gate": 1e6}


def to_line(crossings):
    """p and q of the lines with these crossings of ``ROWS``, shape (..., 2)."""
    q = (crossings[..., 1] - crossings[..., 0]) / 60.0
    return np.stack((crossings[..., 0] + 20.0 * q, q), axis=-1)


def to_crossings(line):
    return line[..., :1] + line[..., 1:] * ROWS


def follow(kalman, measured, valid=None):
    """Feeds crossings, shape (frames, N, views, 2); returns filtered crossings and validity."""
    valid = np.ones(measured.shape[:3], np.bool_) if valid is None else valid
    out = [kalman.update(to_line(z), ok) for z, ok in zip(measured, valid, strict=True)]
    return to_crossings(np.array([o.line for o in out])), np.array([o.valid for o in out])


def rms(error):
    return float(np.sqrt((error**2).mean()))


def reference(z, seen, q, r, speed):
    """Textbook matrices for one view: x = (c1, c2, v1, v2); a frame that is not seen is predicted only."""
    f, noise = np.eye(4), np.zeros((4, 4))
    f[0, 2] = f[1, 3] = DT
    for k in range(2):
        noise[k, k] = q * DT**4 / 4
        noise[k, 2 + k] = noise[2 + k, k] = q * DT**3 / 2
        noise[2 + k, 2 + k] = q * DT**2
    h = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0]])
    x, p = np.array([*z[0], 0.0, 0.0]), np.diag([r * r, r * r, speed**2, speed**2])
    out = [x]
    for k in range(1, len(z)):
        x, p = f @ x, f @ p @ f.T + noise
        if seen[k]:
            gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + r * r * np.eye(2))
            x = x + gain @ (z[k] - h @ x)
            left = np.eye(4) - gain @ h
            p = left @ p @ left.T + gain @ gain.T * r * r
        out.append(x)
    return np.array(out)[:, :2]


def test_against_hand_written_matrices():
    rng = np.random.default_rng(0)
    z = np.cumsum(rng.normal(0, 0.5, (120, 3, 2, 2)), axis=0) + 25
    seen = rng.uniform(size=(120, 3, 2)) > 0.2
    seen[0] = True
    cfg = LineKalmanCfg(q=150.0, r=0.7, speed_px_s=33.0, coast_s=3.0, **OPEN)
    found, valid = follow(LineKalman(3, DT, cfg), z, seen)
    assert valid.all()
    for i in range(3):
        for v in range(2):
            expected = reference(z[:, i, v], seen[:, i, v], 150.0, 0.7, 33.0)
            np.testing.assert_allclose(found[:, i, v], expected, atol=1e-12, rtol=1e-12)


def test_a_ten_second_run_improves_as_the_formulas_say():
    """2.5 px of noise on a line that wanders by 8 px in 10 s: about 0.81 px with q = 400, r = 2.5."""
    t = np.arange(300) * DT
    truth = 25 + 8 * np.sin(2 * np.pi * t / 10)[:, None, None, None] * np.ones((300, 20, 2, 2))
    z = truth + np.random.default_rng(1).normal(0, 2.5, truth.shape)
    found, valid = follow(LineKalman(20, DT, LineKalmanCfg(q=400.0, r=2.5, **OPEN)), z)
    assert valid.all()
    assert rms(z - truth) == pytest.approx(2.5, abs=0.05)
    assert rms(found[30:] - truth[30:]) == pytest.approx(0.81, abs=0.05)


def test_steady_state_is_kalatas():
    """Random accelerations of variance q: the error of the optimal filter is r sqrt(alpha) (Kalata 1984)."""
    rng, q, r = np.random.default_rng(2), 400.0, 2.5
    a = rng.normal(0, np.sqrt(q), (400, 20, 2, 2))
    v = np.cumsum(a, axis=0) * DT
    truth = np.cumsum(v * DT - 0.5 * a * DT**2, axis=0)
    z = truth + rng.normal(0, r, truth.shape)
    found, _ = follow(LineKalman(20, DT, LineKalmanCfg(q=q, r=r, **OPEN)), z)
    index = np.sqrt(q) * DT**2 / r
    root = (4 + index - np.sqrt(8 * index + index**2)) / 4
    assert rms(found[100:] - truth[100:]) == pytest.approx(r * np.sqrt(1 - root**2), rel=0.04)


def test_a_line_at_rest_stays_without_added_noise():
    """Algorithm 1 as printed would shake it by W_t."""
    z = np.full((60, 1, 2, 2), 17.0)
    found, _ = follow(LineKalman(1, DT, LineKalmanCfg(q=1e4)), z)
    np.testing.assert_allclose(found, 17.0, atol=1e-9)


def moving(frames, speed=6.0):
    """A line that moves evenly, without noise: the filter knows its speed after a second."""
    t = np.arange(frames) * DT
    return 20 + speed * t[:, None, None, None] * np.ones((frames, 1, 1, 2))


def test_an_outlier_is_not_believed():
    z = moving(45)
    z[40] += 30.0
    found, valid = follow(LineKalman(1, DT, views=1), z)
    assert valid.all()
    np.testing.assert_allclose(found[40], moving(45)[40], atol=0.02)
    believing, _ = follow(LineKalman(1, DT, LineKalmanCfg(**OPEN), views=1), z)
    assert np.abs(believing[40] - moving(45)[40]).min() > 1.0


def test_the_gate_is_a_mahalanobis_distance():
    """One frame after the start: S = (r^2 + dt^2 v^2 + q dt^4/4) + r^2 on each of two crossings."""
    cfg = LineKalmanCfg(q=90.0, r=0.8, gate=3.0, speed_px_s=15.0)
    spread = np.sqrt(2 * 0.8**2 + (15.0 * DT) ** 2 + 90.0 * DT**4 / 4)
    for share, believed in ((0.99, True), (1.01, False)):
        jump = 3.0 * spread * share * np.array([0.6, 0.8])
        found, _ = follow(LineKalman(1, DT, cfg, views=1), np.array([[0.0, 0.0], jump])[:, None, None])
        assert (np.abs(found[1]).max() > 0.1) == believed


def test_a_line_that_insists_is_a_new_start():
    z = moving(60, 0.0)
    z[40:] += 15.0
    found, valid = follow(LineKalman(1, DT, LineKalmanCfg(rejections=4), views=1), z)
    assert valid.all()
    np.testing.assert_allclose(found[40:44], 20.0, atol=0.05)
    np.testing.assert_allclose(found[44], 35.0, atol=1e-9)
    # A single believed line in between starts the count again.
    z[42] -= 15.0
    found, _ = follow(LineKalman(1, DT, LineKalmanCfg(rejections=4), views=1), z)
    np.testing.assert_allclose(found[40:47], 20.0, atol=0.05)
    np.testing.assert_allclose(found[47], 35.0, atol=1e-9)


def test_lost_frames_coast_then_say_so_then_are_found_again():
    z, seen = moving(90), np.ones((90, 1, 1), np.bool_)
    seen[50:70] = False
    lost = z.copy()
    lost[50:70] = np.nan  # what a lost line holds does not matter
    lost[70:] += 40.0
    found, valid = follow(LineKalman(1, DT, LineKalmanCfg(coast_s=0.3), views=1), lost, seen)
    assert valid[:59].all() and not valid[59:70].any() and valid[70:].all()
    np.testing.assert_allclose(found[50:59], z[50:59], atol=0.05)
    np.testing.assert_allclose(found[70], z[70] + 40.0, atol=1e-9)


def test_no_line_yet_is_invalid():
    kalman = LineKalman(1, DT)
    out = kalman.update(np.zeros((1, 2, 2)), np.array([[False, True]]))
    assert out.valid.tolist() == [[False, True]]


def test_a_valid_line_that_is_no_number_counts_as_lost():
    kalman = LineKalman(1, DT, views=1)
    assert not kalman.update(np.full((1, 1, 2), np.nan), np.array([[True]])).valid.any()


def test_reset_forgets_one_row_and_only_chosen_rows_are_updated():
    rng = np.random.default_rng(3)
    z = 20 + rng.normal(0, 0.3, (40, 3, 2, 2))
    kalman, alone = LineKalman(3, DT), LineKalman(1, DT)
    before, _ = follow(kalman, z[:30])
    follow(alone, z[:30, 2:])
    kalman.reset(0)
    everything = np.ones((3, 2), np.bool_)
    out = kalman.update(to_line(z[30]), everything, np.array([False, False, True]))
    assert out.valid.tolist() == [[False] * 2, [True] * 2, [True] * 2]
    np.testing.assert_allclose(to_crossings(out.line[1]), before[-1, 1], atol=1e-12)
    one = alone.update(to_line(z[30, 2:]), everything[:1])
    np.testing.assert_array_equal(out.line[2], one.line[0])
    out = kalman.update(to_line(z[31]), everything)
    np.testing.assert_allclose(to_crossings(out.line[0]), z[31, 0], atol=1e-12)


def test_end_points_neither_jump_nor_swap_where_a_filtered_line_passes_the_rois_corner():
    views = ViewGeometry.of(load_cell())
    p, rng = np.linspace(20, 40, 240), np.random.default_rng(4)
    kalman, ends = LineKalman(1, DT), []
    for k in range(240):
        # At first both lines leave the ROI at its far end, in the end at the side: 80 rows ahead are 24 px.
        line = np.array([[[p[k], 0.3], [p[k], 0.3]]]) + rng.normal(0, [0.5, 0.005], (1, 2, 2))
        out = kalman.update(line, np.ones((1, 2), np.bool_))
        ends.append(end_points(image_lines(out.line, out.valid, views), views.size).ends[0])
    front, side = np.array(ends).transpose(1, 0, 2)
    assert front[0, 3] == pytest.approx(0) and front[-1, 2] == pytest.approx(50)
    assert side[0, 2] == pytest.approx(100) and side[-1, 3] == pytest.approx(50)
    assert (front[:, 1] > front[:, 3]).all() and (side[:, 0] < side[:, 2]).all()
    # An end at the side moves by 1 / 0.3 of what the line does, 0.08 px a frame and the noise that is left.
    assert np.abs(np.diff([front, side], axis=1))[:, 30:].max() < 2.0


@pytest.mark.parametrize(
    "kwargs",
    [{"q": 0.0}, {"r": -1.0}, {"gate": np.nan}, {"rejections": 0}, {"rejections": 2.5}, {"coast_s": np.inf},
     {"speed_px_s": "5"}, {"rows_px": (10.0, 10.0)}, {"rows_px": (np.nan, 10.0)}],
)  # fmt: skip
def test_bad_parameters_are_refused(kwargs):
    with pytest.raises(ConfigError, match=next(iter(kwargs))):
        LineKalmanCfg(**kwargs)
