"""The policies that tables compare: what they are, and the weights of those that learned."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import agents
from agents.policies import KINDS, read_card
from experiments.trials import Trial
from seal_gym.core.errors import ConfigError, require

METHODS = {
    "adaptive": "classical: a laser profile ahead of the tip, mapped, replanned and followed",
    "rmp_expert": "the teacher: RMPs with gains set by hand",
    "neural_rmp": "learned f and A, with the fixed leaves",
    "neural_control": "direct control: the learned tip acceleration as given",
    "neural_rmp_identity": "learned f and A = I, with the fixed leaves",
    "neural_rmp_dagger": "neural_rmp after DAgger",
    "neural_control_dagger": "neural_control after DAgger",
    "pid_servo": "a PID visual servo on the same features",
}
BASE = "neural_rmp"
"""The policy that the others are compared with."""
_DAGGER = "_dagger"


class Weights(NamedTuple):
    """The weights of a learned policy.

    Attributes:
        method: Name of the policy.
        training_seed: From the card.
        file: ``NAME.safetensors``.
        sha256: Of the file, from the card.
    """

    method: str
    training_seed: int
    file: Path
    sha256: str


def is_learned(method: str) -> bool:
    """Whether a policy has weights.

    Args:
        method: Its name.

    Returns:
        Whether it does.
    """
    return method.removesuffix(_DAGGER) in KINDS


def how_to_train(method: str) -> str:
    """The commands that make a policy's weights.

    Args:
        method: Its name.

    Returns:
        For a shell.
    """
    kind = method.removesuffix(_DAGGER)
    dagger = " --dagger 3 --dagger-episodes 50 --dagger-epochs 6" if method.endswith(_DAGGER) else ""
    return (
        "python -m agents.collect --episodes 2400 --jobs 2 --out DATA; "
        f"python -m agents.train_bc --policy {kind}{dagger} --seed S --data DATA --out RUN --validate 20"
    )


def find_weights(folder: Path, method: str, training_seeds: Sequence[int]) -> tuple[list[Weights], list[str]]:
    """The shipped weights of a method, then those of its training seeds.

    Args:
        folder: With ``METHOD.safetensors`` and ``METHOD-seedS.safetensors``.
        method: Its name.
        training_seeds: That must be there; of what DAgger trained, those that are there are enough.

    Returns:
        The weights, the shipped first and each seed once; and the names of files that are missing.

    Raises:
        PolicyFileError: If a card is damaged.
        ConfigError: If the shipped weights are not those of the seed on their card.
    """
    shipped, missing = folder / f"{method}.safetensors", []
    files = [folder / f"{method}-seed{seed}.safetensors" for seed in training_seeds]
    if method.endswith(_DAGGER):
        files = [file for file in files if file.is_file()]
    missing = [file.name for file in (shipped, *files) if not file.is_file()]
    if missing:
        return [], missing
    found: list[Weights] = []
    for file in (shipped, *files):
        card = read_card(file)
        new = Weights(method, int(card["seed"]), file, str(card["sha256"]))
        if found and new.training_seed == found[0].training_seed:
            require(
                new.sha256 == found[0].sha256,
                f"{shipped.name} and {file.name} are both of training seed {new.training_seed}, but differ: "
                "copy them again with agents.ship",
            )
            continue
        found.append(new)
    return found, []


def check_methods(methods: Sequence[str], folder: Path, training_seeds: Sequence[int]) -> list[Weights]:
    """Finds the weights of all methods before anything runs.

    Args:
        methods: Names of the policies.
        folder: With the weights.
        training_seeds: That each kind of ``KINDS`` must have.

    Returns:
        Weights of the learned ones.

    Raises:
        ConfigError: If a policy is unknown or has no weights: what to do about each.
    """
    weights: list[Weights] = []
    unknown = [m for m in methods if m not in agents.POLICIES]
    problems = [f"{m}: no policy of that name, agents has {sorted(agents.POLICIES)}" for m in unknown]
    untrained = []
    for method in methods:
        if method not in unknown and is_learned(method):
            found, missing = find_weights(folder, method, training_seeds)
            weights += found
            if missing:
                untrained.append(f"{method}: {', '.join(missing)} missing; train: {how_to_train(method)}")
    if untrained:
        untrained.append("then agents.ship copies the seeds")
        problems += [f"in {folder}:", *untrained]
    if problems:
        problems.append("or name the methods to run with --method (and their --training-seeds)")
        raise ConfigError("methods are missing:\n  " + "\n  ".join(problems))
    return weights


def shipped(methods: Sequence[str], weights: Sequence[Weights]) -> dict[str, Weights | None]:
    """The weights each method runs with.

    Args:
        methods: Names of the policies.
        weights: From ``check_methods``.

    Returns:
        The shipped ones, by method; None for one that has none.
    """
    return {m: next((w for w in weights if w.method == m), None) for m in methods}


def cell(
    method: str, part: str, seeds: Sequence[int], env: dict[str, Any], weights: Weights | None
) -> list[Trial]:
    """Trials that differ in their seed alone.

    Args:
        method: Name of the policy.
        part: Name of a nominal part or a shape.
        seeds: Of the environment.
        env: Further keyword arguments of the environment.
        weights: Of a learned policy.

    Returns:
        One trial a seed.
    """
    file, training_seed = (str(weights.file), weights.training_seed) if weights else (None, None)
    return [
        Trial(method=method, workpiece=part, seed=s, env=env, weights=file, training_seed=training_seed)
        for s in seeds
    ]


def record(weights: Sequence[Weights]) -> list[dict[str, Any]]:
    """The weights as a table's JSON has them.

    Args:
        weights: From ``check_methods``.

    Returns:
        One entry a file, by its name.
    """
    return [{**w._asdict(), "file": w.file.name} for w in weights]
