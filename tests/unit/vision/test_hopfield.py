"""The Hopfield layers against the paper's tables, hand calculations and the fall of their energy."""

from itertools import product

import numpy as np
import pytest

from seal_gym.core.errors import ConfigError
from seal_gym.vision import hopfield
from seal_gym.vision.hopfield import INPUTS, TABLE_1, TABLE_1_PRINTED, TABLE_2, HebbReading, HopfieldLayer

# Tables I (row 001 corrected) and II, typed from the paper: inputs, answers of layer 1, answers of layer 2.
PAPER = """
000  + - -  + + +
001  - + -  - - +
010  - - -  - + -
011  - - -  - - -
100  - - +  + - -
101  - - -  - - -
110  - - -  - - -
111  - - -  - - -
"""
# By hand, inputs 0 and 1: column j of the feed is the sum of the answers of the rows with x_j = 1, the
# feedback of two units the sum over all rows of their products.
HEBB_FEED_1 = [[-4, -4, -4], [-4, -4, -2], [-2, -4, -4]]
HEBB_LATERAL_1 = [[0, 4, 4], [4, 0, 4], [4, 4, 0]]
HEBB_FEED_2 = [[-2, -4, -4], [-4, -2, -4], [-4, -4, -2]]
HEBB_LATERAL_2 = [[0, 4, 4], [4, 0, 4], [4, 4, 0]]


def rows(column):
    lines = [line.split() for line in PAPER.split("\n") if line]
    return np.array([[1 if sign == "+" else -1 for sign in line[column : column + 3]] for line in lines])


def marks(good):
    return "".join("x" if g else "." for g in good)


def every_layer():
    readings = [
        HebbReading(active_only=a, bipolar=b, own=c, constant=d, feedback=e)
        for a, b, c, d, e in product((False, True), repeat=5)
    ]
    learnt = [hopfield.hebbian(table, r) for table in (TABLE_1, TABLE_1_PRINTED, TABLE_2) for r in readings]
    return [hopfield.exact_layer_1(), hopfield.exact_layer_2(), *learnt]


def test_tables_are_the_paper_s():
    assert [f"{a}{b}{c}" for a, b, c in INPUTS] == [line[:3] for line in PAPER.split("\n") if line]
    np.testing.assert_array_equal(TABLE_1, rows(1))
    np.testing.assert_array_equal(TABLE_2, rows(4))
    assert np.flatnonzero((TABLE_1 != TABLE_1_PRINTED).any(axis=1)).tolist() == [0b001]
    with pytest.raises(ValueError, match="read-only"):
        TABLE_1[0, 0] = 0


def test_the_exact_network_answers_all_rows_of_both_tables_with_margin():
    network = hopfield.exact()
    for layer, table in ((network.first, rows(1)), (network.second, rows(4))):
        np.testing.assert_array_equal(layer.answers(), table)
        assert hopfield.recalled(layer, table).all()
        assert np.abs(layer.field(INPUTS, -np.ones((8, 3)))).min() == 0.5


def test_the_printed_rule_s_weights_and_answers_by_hand():
    network = hopfield.printed()
    np.testing.assert_array_equal(network.first.feed, HEBB_FEED_1)
    np.testing.assert_array_equal(network.first.lateral, HEBB_LATERAL_1)
    np.testing.assert_array_equal(network.second.feed, HEBB_FEED_2)
    np.testing.assert_array_equal(network.second.lateral, HEBB_LATERAL_2)
    # From rest a field is some feeds <= 0 and -4 from each of the two other units: no unit ever answers 1.
    for layer in (network.first, network.second):
        assert (layer.answers() == -1).all()


@pytest.mark.parametrize(
    ("network", "first", "second"),
    [
        (hopfield.printed, "..xx.xxx", "...x.xxx"),
        (hopfield.best_hebbian, ".xx.xx.x", ".xxxxxxx"),
        (hopfield.exact, "xxxxxxxx", "xxxxxxxx"),
    ],
)
def test_recall_of_all_eight_inputs_of_both_layers(network, first, second):
    layers = network()
    assert marks(hopfield.recalled(layers.first, TABLE_1)) == first
    assert marks(hopfield.recalled(layers.second, TABLE_2)) == second


def test_no_reading_with_feedback_recalls_more_than_the_best():
    readings = [
        HebbReading(active_only=a, bipolar=b, own=c, constant=d)
        for a, b, c, d in product((False, True), repeat=4)
    ]
    for table, most in ((TABLE_1, 5), (TABLE_2, 7)):
        counts = [hopfield.recalled(hopfield.hebbian(table, r), table).sum() for r in readings]
        assert max(counts) == most


def test_hebb_s_rule_without_feedback_but_with_a_threshold_recalls_everything():
    reading = HebbReading(bipolar=True, constant=True, feedback=False)
    for table in (TABLE_1, TABLE_2):
        assert hopfield.recalled(hopfield.hebbian(table, reading), table).all()
    # The same weights by the definition: correlations of answers and inputs of -1 and 1.
    layer = hopfield.hebbian(TABLE_1, reading)
    x = 2.0 * INPUTS - 1.0
    np.testing.assert_allclose(
        INPUTS @ layer.feed.T + layer.bias, x @ (TABLE_1.T @ x).T + TABLE_1.sum(axis=0)
    )


def test_no_asynchronous_update_raises_the_energy():
    rng = np.random.default_rng(1)
    layers = every_layer()
    for _ in range(200):
        lateral = rng.normal(size=(3, 3))
        lateral = lateral + lateral.T
        np.fill_diagonal(lateral, np.abs(np.diag(lateral)))
        layers.append(HopfieldLayer(feed=rng.normal(size=(3, 3)), lateral=lateral, bias=rng.normal(size=3)))
    states = np.array(list(product((-1, 1), repeat=3)), dtype=np.int8)
    x, y = (np.repeat(INPUTS, 8, axis=0), np.tile(states, (8, 1)))
    for layer in layers:
        for unit in range(3):
            after = layer.update(x, y, unit)
            assert (layer.energy(x, after) <= layer.energy(x, y) + 1e-12).all()
            np.testing.assert_array_equal(np.delete(after, unit, axis=1), np.delete(y, unit, axis=1))


def test_a_negative_diagonal_would_raise_it_and_is_refused():
    with pytest.raises(ConfigError, match="symmetric with a diagonal >= 0"):
        HopfieldLayer(feed=np.eye(3), lateral=np.diag([0.0, 0.0, -1.0]), bias=np.zeros(3))


def test_energy_by_hand():
    layer = HopfieldLayer(
        feed=np.array([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
        lateral=np.array([[0.0, 2.0, 0.0], [2.0, 0.0, -1.0], [0.0, -1.0, 4.0]]),
        bias=np.array([0.5, 0.0, -1.0]),
    )
    # y L y / 2 = 2 y1 y2 - y2 y3 + 2 y3^2 = -2 - 1 + 2; drive (1 + 3 + 0.5, 0, -1).
    assert layer.energy(np.array([1, 0, 1]), np.array([-1, 1, 1])) == pytest.approx(1.0 + 4.5 + 1.0)


def test_settled_states_are_fixed_points_in_any_batch():
    rng = np.random.default_rng(2)
    for layer in every_layer():
        for start in (None, *rng.choice((-1, 1), (3, 3))):
            given = {} if start is None else {"start": start}
            y = layer.settle(INPUTS, **given)
            for unit in range(3):
                np.testing.assert_array_equal(layer.update(INPUTS, y, unit), y)
            alone = np.stack([layer.settle(x, **given) for x in INPUTS])
            np.testing.assert_array_equal(alone, y)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"feed": np.eye(2)}, r"feed: must be finite, shape \(3, 3\), not \(2, 2\)"),
        ({"bias": np.array([0.0, np.nan, 0.0])}, "bias: must be finite"),
        ({"lateral": np.triu(np.ones((3, 3)))}, "must be symmetric"),
    ],
)
def test_bad_layers_are_refused(change, message):
    good = {"feed": np.eye(3), "lateral": np.zeros((3, 3)), "bias": np.zeros(3)}
    with pytest.raises(ConfigError, match=message):
        HopfieldLayer(**{**good, **change})


def test_bad_tables_are_refused():
    with pytest.raises(ConfigError, match="must hold -1 or 1"):
        hopfield.hebbian(np.zeros((8, 3), dtype=np.int8))
    with pytest.raises(ConfigError, match=r"shape \(8, 3\), not \(7, 3\)"):
        hopfield.hebbian(TABLE_1[:7])
