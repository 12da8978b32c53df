"""What a node of a cluster runs; a module of its own, so that nodes import it and are not sent it."""

from functools import lru_cache

from agents import episodes
from agents.episodes import Episode, Work
from agents.provenance import ROOT, code_hash
from seal_gym.core.errors import ConfigError, require

_own_code = lru_cache(maxsize=1)(code_hash)


def run_checked(work: Work, code: str) -> list[Episode]:
    """Runs episodes if this node has the collection's code.

    Args:
        work: Which episodes.
        code: The collection's ``code_hash``.

    Returns:
        As ``episodes.run``.

    Raises:
        ConfigError: If the code here is another.
    """
    require(
        _own_code() == code,
        f"this node's code ({_own_code()} in {ROOT}) is not the collection's ({code}): update it, or "
        "start with --send-code",
        ConfigError,
    )
    return episodes.run(work)
