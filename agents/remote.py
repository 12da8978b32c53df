"""What a node of a cluster runs; a module of its own, so that nodes import it and are not sent it."""

from collections.abc import Callable
from functools import lru_cache
from typing import TypeVar

from agents.provenance import ROOT
from seal_gym.core.errors import ConfigError, require

Unit = TypeVar("Unit")
Result = TypeVar("Result")


@lru_cache(maxsize=4)
def _here(own_code: Callable[[], str]) -> str:
    return own_code()


def run_checked(work: Callable[[Unit], Result], unit: Unit, own_code: Callable[[], str], code: str) -> Result:
    """Runs a unit if this node has the caller's code.

    Args:
        work: What to do.
        unit: With what.
        own_code: Gives the hash of a node's code.
        code: What it gave where the work was handed out.

    Returns:
        As ``work``.

    Raises:
        ConfigError: If the code here is another.
    """
    require(
        _here(own_code) == code,
        f"this node's code ({_here(own_code)} in {ROOT}) is not the caller's ({code}): update it, or start "
        "with --send-code",
        ConfigError,
    )
    return work(unit)
