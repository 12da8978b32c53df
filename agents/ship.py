"""Ships trained weights: the training seeds of one policy, and the best of them under the policy's name.

python -m agents.ship out/bc/*/neural_rmp-seed?.safetensors
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from agents import WEIGHTS
from agents.policies import LearnedPolicy, load, save
from seal_gym.core.errors import SealGymError, require


def name_of(policy: LearnedPolicy) -> str:
    """The name under which ``agents.load_policy`` finds a policy.

    Args:
        policy: From ``agents.train_bc``.

    Returns:
        Its kind, with ``_dagger`` if it went through rounds of DAgger.
    """
    rounds = policy.card.get("dagger", {}).get("rounds", 0)
    return policy.cfg.kind + ("_dagger" if rounds else "")


def best_of(cards: Sequence[dict[str, Any]]) -> int:
    """Which of several training seeds to ship.

    Args:
        cards: With the ``validation`` that ``--validate`` adds.

    Returns:
        Index of the one that reached most often; among equals of the one with the smallest mean RMSE.

    Raises:
        ConfigError: If a card has no such scores.
    """

    def rank(card: dict[str, Any]) -> tuple[float, float]:
        scores = list(card.get("validation", {}).values())
        require(bool(scores), "a card has no validation scores: train with --validate TRIALS")
        errors = [s["rmse_mm"] for s in scores]
        reached = sum(s["reached"] / s["trials"] for s in scores)
        return -reached, np.inf if None in errors else float(np.mean(errors))

    return min(range(len(cards)), key=lambda k: rank(cards[k]))


def ship(trained: Sequence[Path], folder: Path) -> Path:
    """Copies the training seeds of one kind, and the chosen one under the kind's name.

    Args:
        trained: Files of ``main``, one a training seed.
        folder: ``agents.WEIGHTS``.

    Returns:
        The chosen one, where ``agents.load_policy`` finds it.

    Raises:
        ConfigError: If kinds, data or options differ, or a card has no validation scores.
        PolicyFileError: If a file is missing or damaged.
    """
    found = [load(path) for path in trained]
    cards = [policy.card for policy in found]
    alike = ("config", "data_sha256", "dagger", "validation_perception")
    for card in cards[1:]:
        other = [k for k in alike if card.get(k) != cards[0].get(k)]
        require(not other, f"seeds {cards[0]['seed']} and {card['seed']} differ in {other}: train them alike")
    best = found[best_of(cards)]
    for policy in found:
        save(policy, folder / f"{name_of(policy)}-seed{policy.card['seed']}.safetensors", policy.card)
    path = folder / f"{name_of(best)}.safetensors"
    save(best, path, best.card)
    return path


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line.

    Args:
        arguments: Of the command, by default the process's.

    Returns:
        The exit status.
    """
    parser = argparse.ArgumentParser(
        prog="python -m agents.ship",
        description="Copies the training seeds of one policy, and the best of them under the policy's name.",
    )
    parser.add_argument(
        "trained", nargs="+", type=Path, help="NAME-seedS.safetensors of agents.train_bc, one a seed"
    )
    parser.add_argument("--out", type=Path, default=WEIGHTS, help="folder (default: agents/weights)")
    options = parser.parse_args(arguments)
    try:
        path = ship(options.trained, options.out)
    except SealGymError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    print(f"{path.name}: seed {load(path).card['seed']} of {len(options.trained)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
