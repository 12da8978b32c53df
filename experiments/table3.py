"""Table 3: direct control, neural RMP and what they are measured against, on parts that stand still.

    python -m experiments.table3 --trials 100 --seed 1000000 --jobs 2 --out experiments/results

Flat, cylinder and the unseen rectangular part for every method and training seed; then seams of other shape.
``control_table`` says what is written. Batches are logged as they end: the same command goes on where it was
stopped.
"""

import sys

from experiments import control_table, shapes
from experiments.control_table import TableCfg

TABLE = TableCfg(
    name="table3",
    number="Table 3",
    title="sealing parts that stand still",
    about="The part is displaced and lit anew in each trial, and stands still.",
    methods=(
        "rmp_expert",
        "neural_rmp",
        "neural_control",
        "neural_rmp_identity",
        "neural_rmp_dagger",
        "neural_control_dagger",
        "pid_servo",
    ),
    regime="static",
    shapes=shapes.NAMES,
)


def main(arguments: list[str] | None = None) -> int:
    """Makes the table.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status: 0 if it ran to the end.
    """
    return control_table.main(TABLE, arguments)


if __name__ == "__main__":
    sys.exit(main())
