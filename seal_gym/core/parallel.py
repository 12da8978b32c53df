"""Splits the rows of a batch over threads; kernels without the interpreter's lock then run side by side."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache


@lru_cache(maxsize=4)
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="seal_gym")


# A forked child has none of the parent's threads and would wait for them for ever.
if hasattr(os, "register_at_fork"):  # not on Windows, which does not fork
    os.register_at_fork(after_in_child=_pool.cache_clear)


def split(work: Callable[[int, int], None], n: int, threads: int) -> None:
    """Calls ``work`` for the rows first <= i < last of each part of a batch, and waits for all.

    Args:
        work: Takes first and last; must not touch other rows.
        n: Number of rows.
        threads: Number of parts, as far as there are rows.
    """
    parts = min(threads, n)
    if parts <= 1:
        work(0, n)
        return
    bounds = [n * k // parts for k in range(parts + 1)]
    list(_pool(parts).map(work, bounds[:-1], bounds[1:]))
