"""Filters between direct control and the arm."""

from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest

from agents.expert import RmpExpert
from agents.filters import FILTERS, Brake, BrakeThenCbf, Cbf, CbfCfg, Filtered, least_change
from seal_gym.core.errors import ConfigError
from seal_gym.envs.config import SealCfg
from seal_gym.envs.core import SealCore
from seal_gym.rmp import Clearances, LetPassCfg

Y = 1


def one_body(distance, rate=0.0, normal=(0.0, -1.0, 0.0), drift=0.0):
    """A body straight ahead, unless told otherwise; its lever is zero."""
    gradient = np.concatenate((normal, np.zeros(3)))[None, None]
    scalars = (np.full((1, 1), v) for v in (distance, rate, drift))
    distance, rate, drift = scalars
    return Clearances(distance, rate, gradient, drift, np.zeros((1, 1, 3)))


def test_the_programme_against_every_set_of_active_rows():
    """In closed form: of the solutions on each set of rows, the cheapest that fulfils them all."""
    rng = np.random.default_rng(0)
    active = 0
    for _ in range(50):
        wanted, rows, least = rng.normal(size=6), rng.normal(size=(3, 6)), rng.normal(size=3)
        inverse = 1.0 / rng.uniform(0.5, 20.0, 6)
        best, cost = None, np.inf
        for size in range(4):
            for chosen in map(list, combinations(range(3), size)):
                r = rows[chosen]
                u = wanted + inverse * (r.T @ np.linalg.solve(r * inverse @ r.T, least[chosen] - r @ wanted))
                price = ((u - wanted) ** 2 / inverse).sum()
                if (rows @ u >= least - 1e-9).all() and price < cost:
                    best, cost, count = u, price, size
        active += count
        np.testing.assert_allclose(
            least_change(wanted[None], rows[None], least[None], inverse)[0], best, atol=1e-5
        )
    assert active > 50  # many cases with two and more


@pytest.mark.parametrize("name", FILTERS)
def test_far_from_everything_nothing_changes(name):
    wanted = np.array([[0.1, 0.3, -0.2, 1.0, -2.0, 3.0]])
    twist = np.array([[0.0, 0.01, 0.0, 0.0, 0.0, 0.0]])
    got = FILTERS[name]()(wanted, twist, one_body(0.2, -0.01))
    np.testing.assert_array_equal(got, wanted)


@pytest.mark.parametrize(
    ("keep_off", "room"),
    [(Brake(), LetPassCfg().room), (Cbf(CbfCfg(room_m=0.01)), 0.01), (BrakeThenCbf(), LetPassCfg().room)],
)
def test_a_point_that_pushes_on_stops_short(keep_off, room):
    """Straight at a wall 60 mm off, whatever it wants: it comes to the room it keeps, and stops there."""
    position, speed, dt = 0.0, 0.02, 1 / 120
    for _ in range(2400):
        near = one_body(0.06 - position, -speed)
        wanted = np.array([[0.0, 0.3, 0.0, 0.0, 0.0, 0.0]])
        twist = np.array([[0.0, speed, 0.0, 0.0, 0.0, 0.0]])
        accel = keep_off(wanted, twist, near)[0, Y]
        position, speed = position + speed * dt + 0.5 * accel * dt**2, speed + accel * dt
        assert position < 0.06 - room + 0.003
    assert abs(speed) < 1e-3
    assert position > 0.06 - room - 0.002


def test_it_brakes_rather_than_leave_the_seam():
    diagonal = np.array([0.5, -np.sqrt(0.75), 0.0])
    got = Cbf(CbfCfg(cross_cost=100.0))(np.zeros((1, 6)), np.zeros((1, 6)), one_body(0.0, 0.0, diagonal))[0]
    assert got[Y] < 0.0 < got[0] < 0.01 * abs(got[Y])


def test_it_acts_in_physical_units_and_for_direct_control_alone():
    core = SealCore(SealCfg.of(workpiece="flat", control="tip", perception="oracle"), 1)
    asked = np.full((1, 6), 0.5, np.float32)
    policy = SimpleNamespace(control="tip", predict=lambda *_: (asked, "memory"))
    core.reset(0, np.random.default_rng(0))
    action, state = Filtered(policy, core, Brake()).predict(None)
    np.testing.assert_array_equal(action, asked)  # there is no obstacle
    assert state == "memory"
    with pytest.raises(ConfigError, match="must be 'tip'"):
        Filtered(RmpExpert(), core, Brake())


@pytest.mark.parametrize("wrong", [{"room_m": 0.0}, {"omega_n": -1.0}, {"cross_cost": np.inf}])
def test_wrong_gains_are_refused(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        CbfCfg(**wrong)
