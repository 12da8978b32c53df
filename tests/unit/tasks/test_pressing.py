"""The palette task's score on rollouts made by hand."""

import numpy as np
import pytest

from seal_gym.core.errors import ConfigError
from seal_gym.tasks.pressing import Events, Pressing, PressRewardCfg, PressTaskCfg, reward

DT, CLASSES, STEPS = 1 / 30, 3, 8
TARGETS = np.array([[0.1, 0.0, 0.0], [0.0, 0.2, 0.0]])


def score(**cfg):
    return Pressing(TARGETS, np.zeros(3), CLASSES, DT, PressTaskCfg(**cfg))


def frame(press=(0.0, 0.0), slide=(0.0, 0.0), wrong=(False, False, False), wrong_n=0.0, steps=(3,)):
    """A frame in which something happens in some of its physics steps only."""
    at = np.zeros((STEPS, 1), np.bool_)
    at[list(steps)] = True
    return (
        np.where(at, press, 0.0),
        np.where(at, slide, 0.0),
        at & np.array(wrong),
        np.where(at, wrong_n, 0.0),
    )


def advance(s, tip=(0.0, 0.0, 0.0), command=None, **what):
    tip = np.array(tip)
    return s.advance(*frame(**what), tip, tip if command is None else np.array(command))


@pytest.mark.parametrize(
    ("press", "slide", "home"),
    [(15.0, 0.0055, True), (14.9, 0.006, False), (100.0, 0.0054, False), (0.0, 0.0, False)],
)
def test_home_is_force_and_seat_together(press, slide, home):
    s = score()
    events = advance(s, press=(press, 0.0), slide=(slide, 0.0))
    assert events.home.tolist() == [home, False] and s.home.tolist() == [home, False]
    assert s.force_n == press


def test_force_in_one_step_and_seat_in_another_is_not_home():
    s = score()
    press, slide, wrong, wrong_n = frame()
    press[2, 0], slide[5, 0] = 50.0, 0.006
    assert not s.advance(press, slide, wrong, wrong_n, np.zeros(3), np.zeros(3)).home.any()


def test_a_tie_comes_home_once_and_the_last_completes():
    s = score()
    assert advance(s, press=(20.0, 0), slide=(0.006, 0)).home.tolist() == [True, False]
    again = advance(s, press=(20.0, 0), slide=(0.006, 0))
    assert not again.home.any() and not again.completed
    last = advance(s, press=(0, 20.0), slide=(0.006, 0.006))
    assert last.home.tolist() == [False, True] and last.completed and not last.timeout


def test_a_touch_that_lasts_counts_once_and_a_new_one_again():
    s = score()
    touch = (False, True, False)
    counts = [advance(s, wrong=w).wrong for w in (touch, touch, (False,) * 3, touch, (True, True, False))]
    assert counts == [1, 0, 0, 1, 1]
    assert s.wrong.tolist() == [1, 2, 0] and s.metrics()["wrong_touches"] == 3
    assert s.touched.tolist() == [True, True, False]


def test_too_much_force_on_anything_stops():
    for what in ({"press": (150.0, 0.0)}, {"wrong_n": 150.0}):
        s = score()
        events = advance(s, **what)
        assert events.stopped and not events.completed and s.metrics()["peak_force_n"] == 150.0
    assert not advance(score(), press=(149.0, 0.0)).stopped


def test_the_stop_wins_over_the_last_tie():
    s = score()
    events = advance(s, press=(160.0, 160.0), slide=(0.006, 0.006))
    assert events.stopped and not events.completed


def test_timeout():
    s = score(time_s=0.1, time_each_s=0.05)
    assert s.time_limit == 6
    assert [advance(s).timeout for _ in range(7)] == [False] * 5 + [True] * 2
    assert s.metrics()["time_s"] == pytest.approx(7 * DT)


def test_path_length_of_a_square():
    s = score()
    for corner in ((0.1, 0, 0), (0.1, 0.1, 0), (0, 0.1, 0), (0, 0, 0)):
        advance(s, tip=corner)
    assert s.metrics()["path_mm"] == pytest.approx(400.0)


def test_jerk_of_a_cubic_motion_is_its_third_derivative():
    """x = 2 t^3 and y = -t^3: jerk (12, -6, 0), of the command; third differences of a cubic are exact."""
    s = score()
    for k in range(1, 20):
        t = k * DT
        advance(s, command=(2 * t**3, -(t**3), 0.3 * t))
    assert s.metrics()["peak_jerk_m_s3"] == pytest.approx(np.hypot(12.0, 6.0), rel=1e-9)


def test_no_jerk_before_four_positions_and_none_at_constant_acceleration():
    s = score()
    advance(s, command=(1.0, 0, 0))
    advance(s, command=(-5.0, 0, 0))
    assert s.metrics()["peak_jerk_m_s3"] == 0.0
    s = score()
    for k in range(1, 9):
        advance(s, command=(0.5 * (k * DT) ** 2, 0, 0))
    assert s.metrics()["peak_jerk_m_s3"] == pytest.approx(0.0, abs=1e-9)


def test_coming_nearer_is_measured_to_the_nearest_open_tie():
    s = score()
    assert advance(s, tip=(0.04, 0, 0)).approached_m == pytest.approx(0.04)
    # Its tie home, the other one counts for this frame's way: from (0.04, 0) to (0.1, 0) it is farther.
    events = advance(s, tip=(0.1, 0, 0), press=(20.0, 0), slide=(0.006, 0))
    assert events.approached_m == pytest.approx(np.hypot(0.04, 0.2) - np.hypot(0.1, 0.2))


def events(**changes):
    calm = Events(np.zeros(2, np.bool_), 0, False, False, False, 0.0)
    return calm._replace(**changes)


def test_reward_by_hand():
    cfg = PressRewardCfg()
    assert reward(events(), 0.0, cfg) == pytest.approx(-0.01)
    assert reward(events(home=np.array([True, False])), 0.0, cfg) == pytest.approx(9.99)
    assert reward(events(completed=True), 1.0, cfg) == pytest.approx(20.0 - 0.01 - 0.05)
    assert reward(events(wrong=2, stopped=True), 0.0, cfg) == pytest.approx(-30.01)
    assert reward(events(approached_m=0.05), 0.0, cfg) == pytest.approx(0.99)


@pytest.mark.parametrize(
    "wrong", [{"force_n": 0.0}, {"force_n": 200.0}, {"seat_m": float("nan")}, {"time_s": -1.0}]
)
def test_wrong_task_settings_are_refused(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        PressTaskCfg(**wrong)


def test_wrong_reward_settings_are_refused():
    with pytest.raises(ConfigError, match="approach_m"):
        PressRewardCfg(approach_m=0.0)
    assert PressRewardCfg(wrong=0.0).wrong == 0.0
