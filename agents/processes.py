"""Worker processes that each compute on one thread and end with their parent."""

import multiprocessing
import multiprocessing.connection
import os
import threading
from concurrent.futures import ProcessPoolExecutor


def pool(jobs: int, tasks_each: int | None = None) -> ProcessPoolExecutor:
    """A pool of fresh processes: forked ones would share threads and OpenGL contexts with this one.

    Args:
        jobs: Their number.
        tasks_each: After which a process ends and another takes its place; by default none does.

    Returns:
        The pool; ``with`` ends it.
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # read by the workers as they start
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(
        jobs, mp_context=context, initializer=_end_with_parent, max_tasks_per_child=tasks_each
    )


def _end_with_parent() -> None:
    """A worker whose parent was killed would wait for work for ever."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return
    sentinel = parent.sentinel

    def watch() -> None:
        multiprocessing.connection.wait([sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
