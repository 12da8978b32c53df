"""Progress, outcomes and metrics of hand-made tip paths along the box's three sides."""

import numpy as np
import pytest

from seal_gym.core.errors import ConfigError
from seal_gym.tasks.progress import Progress, SealTaskCfg
from seal_gym.workpieces import catalogue

STEP = 1e-3
STAND_OFF = 3e-3
LEAN = np.sqrt(0.5) * STAND_OFF  # of the tip path: this far out and up from the seam
# The box's foot, from catalogue.rectangular's docstring: 110 / 144.3 / 110 mm with corners of 5 mm radius.
START, SIDE, HALF, RADIUS = -0.055, 0.060, 0.07715, 5e-3


def box_path():
    """Samples of the desired tip path, 1 mm of seam apart, and their arc length on the seam."""
    quarter = np.pi / 2 * RADIUS
    first, second = SIDE - RADIUS - START, 2 * (HALF - RADIUS)
    length = 2 * first + second + 2 * quarter
    s = np.append(np.arange(0, length, STEP), length)
    points = []
    for value in s:
        t = value
        for leg, origin, along, out in (
            (first, (START, -HALF), (1, 0), (0, -1)),
            (quarter, (SIDE - RADIUS, -HALF + RADIUS), None, -np.pi / 2),
            (second, (SIDE, -HALF + RADIUS), (0, 1), (1, 0)),
            (quarter, (SIDE - RADIUS, HALF - RADIUS), None, 0.0),
            (first, (SIDE - RADIUS, HALF), (-1, 0), (0, 1)),
        ):
            if t <= leg + 1e-12:
                if along is None:
                    angle = out + t / RADIUS
                    xy = np.array(origin) + (RADIUS + LEAN) * np.array([np.cos(angle), np.sin(angle)])
                else:
                    xy = np.array(origin) + t * np.array(along) + LEAN * np.array(out)
                points.append([*xy, LEAN])
                break
            t -= leg
    assert len(points) == len(s)
    return np.array(points), s, length


PATH, ARC, LENGTH = box_path()
OUT = np.array([0.0, 0.0, 1.0])


def follow(points, cfg=None):
    progress = Progress(catalogue.rectangular().seam, STAND_OFF, 1, cfg or SealTaskCfg())
    progress.reset(0, points[0])
    history = [progress.s[0]]
    for p in points[1:]:
        progress.advance(p[None])
        history.append(progress.s[0])
    return progress, np.array(history)


def beyond(points):
    """With a last step a little past the seam's end, on the path's run-out."""
    return np.vstack((points, points[-1] + [-STEP, 0.0, 0.0]))


def test_following_the_path_counts_as_travelled():
    progress, s = follow(beyond(PATH))
    np.testing.assert_allclose(s[:-1], ARC, atol=2e-5)
    assert progress.reached[0] and not progress.lost[0]
    assert progress.share[0] == 1.0
    metrics = progress.metrics(0)
    assert metrics["coverage_pct"] == 100.0
    assert metrics["rmse_mm"] < 1e-3 and metrics["rmse_whole_mm"] < 1e-3


def test_the_end_itself_is_not_passed_before_it():
    progress, _ = follow(PATH[:-1])
    assert not progress.reached[0]
    assert progress.share[0] < 1.0


def test_a_teleported_tip_moves_by_the_window_at_most():
    window = SealTaskCfg().window_m
    jump = np.vstack((PATH[:50], PATH[-30:], np.add(PATH[-1:], [-STEP, 0, 0])))
    progress, s = follow(jump)
    assert np.abs(np.diff(s)).max() <= window + 1e-12
    assert not progress.reached[0]
    assert progress.lost[0]
    assert progress.metrics(0)["coverage_pct"] < 25.0


def test_the_opposite_side_of_a_thin_part_is_not_taken_for_this_one():
    """The global nearest point may be elsewhere; arc length stays local."""
    there = PATH[100] + [0.0, 2 * HALF - 0.01, 0.0]
    progress, s = follow(np.vstack((PATH[:101], there)))
    assert abs(s[-1] - ARC[100]) <= SealTaskCfg().window_m + 1e-12
    assert progress.error_m[0] < progress.off_path_m[0]
    assert progress.lost[0]


def test_cutting_the_corner_is_not_reaching():
    """Straight from 30 mm before the first corner to 30 mm behind it: never lost, but not sealed."""
    corner = SIDE - RADIUS - START + np.pi / 4 * RADIUS
    before, after = np.searchsorted(ARC, [corner - 0.030, corner + 0.030])
    chord = np.linspace(PATH[before], PATH[after], 45)
    progress, s = follow(beyond(np.vstack((PATH[:before], chord, PATH[after:]))))
    assert np.abs(np.diff(s)).max() <= SealTaskCfg().window_m + 1e-12
    assert s[-1] >= LENGTH - 1e-4
    assert not progress.reached[0]
    assert 80.0 < progress.metrics(0)["coverage_pct"] < 95.0


@pytest.mark.parametrize(("skipped", "reached"), [(0.03, True), (0.07, False)])
def test_95_percent_must_be_visited_within_5_mm(skipped, reached):
    away = PATH.copy()
    first = 60
    away[first : first + int(skipped * len(ARC))] += 6e-3 * OUT
    progress, _ = follow(beyond(away))
    assert bool(progress.reached[0]) is reached


def test_the_end_must_be_passed_within_5_mm():
    points = beyond(PATH)
    points[-1] += 6e-3 * OUT
    assert not follow(points)[0].reached[0]
    points[-1] -= 2e-3 * OUT
    assert follow(points)[0].reached[0]


def test_hovering_along_is_not_reaching():
    progress, s = follow(beyond(PATH + 8e-3 * OUT))
    assert s[-1] >= LENGTH - 1e-3
    assert not progress.reached[0]
    assert progress.metrics(0)["coverage_pct"] == 0.0


@pytest.mark.parametrize(("off", "lost"), [(24.9e-3, False), (25.1e-3, True)])
def test_lost_beyond_25_mm(off, lost):
    assert bool(follow(PATH[:20] + off * OUT)[0].lost[0]) is lost


def test_metrics_by_hand():
    """1.5 mm off for the first 60 mm, then on the path: errors, their roots and the covered share."""
    away = PATH.copy()
    away[:61] += 1.5e-3 * OUT
    progress, _ = follow(beyond(away), SealTaskCfg(settle_m=9.5e-3))
    n = len(PATH)  # steps: one for each sample after the first, and the one past the end
    metrics = progress.metrics(0)
    settled = 61 - 10  # from s = 10 mm, the first sample past 9.5 mm, on
    assert metrics["rmse_whole_mm"] == pytest.approx(1.5 * np.sqrt(60 / n), rel=2e-3)
    assert metrics["rmse_mm"] == pytest.approx(1.5 * np.sqrt(settled / (n - 9)), rel=2e-3)
    assert metrics["coverage_pct"] == pytest.approx(100 * (1 - 0.0605 / LENGTH), abs=0.5)


def test_no_rmse_before_it_settles():
    assert np.isnan(follow(PATH[:5])[0].metrics(0)["rmse_mm"])
    empty = Progress(catalogue.rectangular().seam, STAND_OFF, 1, SealTaskCfg())
    assert np.isnan(empty.metrics(0)["rmse_whole_mm"])


def test_error_is_measured_to_segments_not_vertices():
    between = 0.5 * (PATH[20] + PATH[21]) + 0.1e-3 * OUT
    progress, _ = follow(np.vstack((PATH[:21], between)))
    assert progress.error_m[0] == pytest.approx(0.1e-3, rel=1e-6)


def test_rows_do_not_mix():
    seam = catalogue.rectangular().seam
    both = Progress(seam, STAND_OFF, 2, SealTaskCfg())
    both.reset(0, PATH[0])
    both.reset(1, PATH[0] + 3e-3 * OUT)
    for a, b in zip(PATH[1:80], PATH[1:80] + 3e-3 * OUT, strict=True):
        both.advance(np.stack((a, b)))
    alone, _ = follow(PATH[:80])
    assert both.metrics(0) == alone.metrics(0)
    assert both.metrics(1)["rmse_whole_mm"] == pytest.approx(3.0, abs=1e-3)
    both.reset(1, PATH[0])
    assert both.metrics(0) == alone.metrics(0)
    assert both.metrics(1)["coverage_pct"] == 0.0


@pytest.mark.parametrize("name", list(SealTaskCfg.__dataclass_fields__))
def test_config_ranges(name):
    bad = (-1.0, 1.0) if name == "hover_m" else -1.0
    with pytest.raises(ConfigError, match=name):
        SealTaskCfg(**{name: bad})


@pytest.mark.parametrize(
    "kwargs",
    [
        {"visited_share": 0.0},
        {"visited_share": 1.1},
        {"hover_m": (0.02, 0.01)},
        {"window_m": 0.0},
        {"time_factor": 0.0},
        {"lost_m": float("nan")},
    ],
)
def test_config_other_ranges(kwargs):
    with pytest.raises(ConfigError, match=next(iter(kwargs))):
        SealTaskCfg(**kwargs)


def test_going_back_before_10_mm_still_counts():
    """``rmse_mm`` counts from the first time the tip has come 10 mm far."""
    there = PATH[:13]
    back = PATH[12:4:-1] + 2e-3 * OUT
    metrics = follow(np.vstack((there, back)), SealTaskCfg(settle_m=9.5e-3))[0].metrics(0)
    assert metrics["rmse_mm"] == pytest.approx(2.0 * np.sqrt(8 / 11), rel=1e-3)
