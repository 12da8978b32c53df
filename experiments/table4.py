"""Table 4: the adaptive baseline, direct control, neural RMP and the expert on parts that move.

    python -m experiments.table4 --trials 100 --seed 1000000 --jobs 2 --out experiments/results

Flat, cylinder and the unseen rectangular part in the dynamic regime (protocol.md) at severity 1, for every
method and training seed; paths and errors are those on the moving part. ``control_table`` says what is
written. Batches are logged as they end: the same command goes on where it was stopped.
"""

import sys

from experiments import control_table
from experiments.control_table import TableCfg
from seal_gym.wrappers import dynamic_regime

TABLE = TableCfg(
    name="table4",
    number="Table 4",
    title="sealing parts that move",
    about="The part moves and turns under the gun, at random and smoothly: up to 20 mm and 10 mm/s (the "
    "gun's own speed along the seam), 10 deg and 3 deg/s. The light changes with time. No method is told of "
    "either; errors are those against the seam where it is at that instant.",
    methods=("adaptive", "neural_control", "neural_rmp", "rmp_expert"),
    regime="dynamic",
    env={"disturbances": dynamic_regime(1.0)},
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
