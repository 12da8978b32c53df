"""Two layers of three competing Hopfield units that name the elements of a palette of cables.

Carvajal and Martinez-Garcia, "Robot arm planning and control by tau-Jerk theory and vision-based recurrent
ANN observer", section IV. Layer 1 names a pixel by its three thresholded colour channels (Table I), layer 2
judges what layer 1 says (Table II). The paper trains both by Hebb's rule (Eqs. 43-49), which does not recall
its own tables; ``exact`` gives weights that do.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import require
from seal_gym.core.frames import Array

Signs = NDArray[np.int8]
Numbers = NDArray[np.int8] | Array

UNITS = 3
# All inputs of a layer in the order of the paper's tables: row 4 a + 2 b + c is (a, b, c).
INPUTS = np.array(list(product((0, 1), repeat=UNITS)), dtype=np.int8)


def _answers(active: dict[int, tuple[int, int, int]]) -> Signs:
    rows = np.full((len(INPUTS), UNITS), -1, dtype=np.int8)
    for row, answer in active.items():
        rows[row] = answer
    return rows


# Table I, with row 001 (connector) corrected: as printed two units answer, which layer 2 calls a fault.
TABLE_1 = _answers({0b000: (1, -1, -1), 0b001: (-1, 1, -1), 0b100: (-1, -1, 1)})
TABLE_1_PRINTED = _answers({0b000: (1, -1, -1), 0b001: (-1, 1, 1), 0b100: (-1, -1, 1)})
TABLE_2 = _answers({0b000: (1, 1, 1), 0b001: (-1, -1, 1), 0b010: (-1, 1, -1), 0b100: (1, -1, -1)})
for _table in (INPUTS, TABLE_1, TABLE_1_PRINTED, TABLE_2):
    _table.setflags(write=False)

_REST = -np.ones(UNITS, dtype=np.int8)


@dataclass(frozen=True, kw_only=True, eq=False)
class HopfieldLayer:
    """Units of state -1 or 1 that feed back to one another, driven by inputs that are held.

    Unit i answers ``y_i = sgn(feed_i x + lateral_i y + bias_i)`` with ``sgn(0) = 1`` (Eqs. 47-48).

    Attributes:
        feed: Weights of the inputs, shape (3, 3).
        lateral: Weights of the units' feedback, shape (3, 3), symmetric with no negative diagonal element.
        bias: Shape (3,).
    """

    feed: Array
    lateral: Array
    bias: Array

    def __post_init__(self) -> None:
        """Checks the shapes, and what makes the energy fall."""
        for name, shape in (("feed", (UNITS, UNITS)), ("lateral", (UNITS, UNITS)), ("bias", (UNITS,))):
            value = getattr(self, name)
            require(
                np.shape(value) == shape and bool(np.isfinite(value).all()),
                f"HopfieldLayer.{name}: must be finite, shape {shape}, not {np.shape(value)}",
            )
        require(
            bool(np.array_equal(self.lateral, self.lateral.T) and (np.diag(self.lateral) >= 0).all()),
            f"HopfieldLayer.lateral = {self.lateral.tolist()}: must be symmetric with a diagonal >= 0, or "
            "its units may never come to rest",
        )

    def field(self, x: Numbers, y: Numbers) -> Array:
        """Inner activation s of each unit (Eq. 47).

        Args:
            x: Inputs, 0 or 1, shape (..., 3).
            y: States, shape (..., 3).

        Returns:
            Shape (..., 3).
        """
        return np.asarray(x @ self.feed.T + y @ self.lateral + self.bias, dtype=np.float64)

    def energy(self, x: Numbers, y: Numbers) -> Array:
        """Hopfield's energy ``-y L y / 2 - y (F x + b)``, which no unit's update raises.

        Args:
            x: Inputs, 0 or 1, shape (..., 3).
            y: States, -1 or 1, shape (..., 3).

        Returns:
            Shape (...).
        """
        drive = x @ self.feed.T + self.bias
        return np.asarray(-((0.5 * (y @ self.lateral) + drive) * y).sum(axis=-1), dtype=np.float64)

    def update(self, x: Numbers, y: Signs, unit: int) -> Signs:
        """One unit's asynchronous update.

        Args:
            x: Inputs, 0 or 1, shape (..., 3).
            y: States, shape (..., 3).
            unit: Which.

        Returns:
            New states, shape (..., 3).
        """
        out = y.copy()
        out[..., unit] = np.where(self.field(x, y)[..., unit] >= 0.0, 1, -1)
        return out

    def settle(self, x: Numbers, start: Numbers = _REST) -> Signs:
        """Updates the units in turn until none changes: at most 2^3 states, so it ends.

        Args:
            x: Inputs, 0 or 1, shape (..., 3).
            start: First states, shape (..., 3) or (3,); all -1 by default.

        Returns:
            States of rest, shape (..., 3).
        """
        y = np.array(np.broadcast_to(start, np.shape(x)), dtype=np.int8)
        while True:
            before = y
            for unit in range(UNITS):
                y = self.update(x, y, unit)
            if np.array_equal(y, before):
                return y

    def answers(self) -> Signs:
        """Answers to all inputs.

        Returns:
            Shape (8, 3), rows as in ``INPUTS``.
        """
        return self.settle(INPUTS)


@dataclass(frozen=True, kw_only=True)
class HebbReading:
    """A reading of the paper's training rule, whose text leaves the first four things open.

    Without feedback, bipolar and with a constant unit, Hebb's rule recalls both tables whole.

    Attributes:
        active_only: Trained on the rows in which a unit answers 1 (the text's samples), or on all eight.
        bipolar: Inputs are learnt as -1 and 1 rather than 0 and 1.
        own: Units keep the diagonal that Eq. 46 prints, a feedback to themselves.
        constant: A constant unit of 1 learns a threshold along with them.
        feedback: The units hear one another; the paper's do.
    """

    active_only: bool = False
    bipolar: bool = False
    own: bool = False
    constant: bool = False
    feedback: bool = True


# Sum over all rows of a table; inputs of 0 and 1; a unit hears the three inputs and the two other units.
PRINTED = HebbReading()


def hebbian(table: Signs, reading: HebbReading = PRINTED) -> HopfieldLayer:
    """A layer trained by Hebb's rule: the sum of outer products of inputs and answers (Eqs. 43-46, 49).

    Args:
        table: Answers to ``INPUTS``, -1 or 1, shape (8, 3).
        reading: What the paper leaves open.

    Returns:
        The layer; it takes inputs of 0 and 1 in every reading.

    Raises:
        ConfigError: If the table has another shape or other values.
    """
    require(
        np.shape(table) == INPUTS.shape and bool(np.isin(table, (-1, 1)).all()),
        f"table: must hold -1 or 1, shape {INPUTS.shape}, not {np.shape(table)}",
    )
    rows = (table == 1).any(axis=1) if reading.active_only else np.ones(len(table), dtype=np.bool_)
    y = table[rows].astype(np.float64)
    x = INPUTS[rows].astype(np.float64)
    lateral = y.T @ y if reading.feedback else np.zeros((UNITS, UNITS))
    if not reading.own:
        np.fill_diagonal(lateral, 0.0)
    bias = y.sum(axis=0) if reading.constant else np.zeros(UNITS)
    if reading.bipolar:
        # F (2 x - 1) = 2 F x - F 1: a layer of inputs 0 and 1 again.
        feed = y.T @ (2.0 * x - 1.0)
        return HopfieldLayer(feed=2.0 * feed, lateral=lateral, bias=bias - feed.sum(axis=1))
    return HopfieldLayer(feed=y.T @ x, lateral=lateral, bias=bias)


def exact_layer_1() -> HopfieldLayer:
    """Threshold units that answer as Table I (corrected), each input by a margin of at least 1/2.

    Returns:
        The layer.
    """
    return HopfieldLayer(
        feed=np.array([[-1.0, -1.0, -1.0], [-1.0, -1.0, 1.0], [1.0, -1.0, -1.0]]),
        lateral=np.zeros((UNITS, UNITS)),
        bias=np.array([0.5, -0.5, -0.5]),
    )


def exact_layer_2() -> HopfieldLayer:
    """Threshold units that answer as Table II: each is inhibited by the other two's inputs.

    Returns:
        The layer.
    """
    return HopfieldLayer(
        feed=np.eye(UNITS) - np.ones((UNITS, UNITS)),
        lateral=np.zeros((UNITS, UNITS)),
        bias=np.full(UNITS, 0.5),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class HopfieldNetwork:
    """Both layers.

    Attributes:
        first: Names pixels.
        second: Judges what the first says of a region.
    """

    first: HopfieldLayer
    second: HopfieldLayer


def exact() -> HopfieldNetwork:
    """The network that answers as both tables.

    Returns:
        The network.
    """
    return HopfieldNetwork(first=exact_layer_1(), second=exact_layer_2())


def printed() -> HopfieldNetwork:
    """The network trained as the paper prints it.

    Returns:
        The network.
    """
    return HopfieldNetwork(first=hebbian(TABLE_1), second=hebbian(TABLE_2))


def best_hebbian() -> HopfieldNetwork:
    """The network of Hebb's rule and feedback that recalls most, of all readings.

    Returns:
        The network: five rows of Table I and seven of Table II.
    """
    first = HebbReading(active_only=True, own=True)
    second = HebbReading(active_only=True, bipolar=True, own=True)
    return HopfieldNetwork(first=hebbian(TABLE_1, first), second=hebbian(TABLE_2, second))


def recalled(layer: HopfieldLayer, table: Signs) -> NDArray[np.bool_]:
    """Which rows of a table a layer answers, from rest (all -1).

    Args:
        layer: The layer.
        table: Answers to ``INPUTS``, shape (8, 3).

    Returns:
        Shape (8,).
    """
    return np.asarray((layer.answers() == table).all(axis=1))
