"""Where units of work run: in processes of this machine, or on a Ray cluster.

An engine takes a function and units, and gives each unit with its result as it is done, in any order. Both
engines give the same results: a unit has everything in it that decides what comes of it.
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Protocol, TypeVar

from agents import remote
from agents.processes import pool
from agents.provenance import ROOT
from seal_gym.core.errors import ConfigError, SealGymError, require

Unit = TypeVar("Unit")
Result = TypeVar("Result")

_RETRIES = 10
_NOT_SENT = (
    ".git",
    ".ci",
    ".venv*",
    "out",
    "dist",
    "build",
    "tests",
    "experiments/results",
    "agents/data",
    "**/__pycache__",
)


class Engine(Protocol):
    """Runs units of work."""

    def __call__(
        self, work: Callable[[Unit], Result], units: Sequence[Unit]
    ) -> Iterator[tuple[Unit, Result]]:
        """Runs units.

        Args:
            work: A module's function, or a ``partial`` of one.
            units: Picklable.

        Yields:
            Units with their results as they are done.

        Raises:
            SealGymError: If workers were lost that cannot be replaced.
        """


def local(jobs: int) -> Engine:
    """Runs units in processes of this machine.

    Args:
        jobs: Number of processes; one runs the units in this process.

    Returns:
        The engine.
    """

    def engine(work: Callable[[Unit], Result], units: Sequence[Unit]) -> Iterator[tuple[Unit, Result]]:
        if jobs <= 1 or len(units) <= 1:
            for unit in units:
                yield unit, work(unit)
            return
        with pool(min(jobs, len(units))) as workers:
            running = {workers.submit(work, unit): unit for unit in units}
            try:
                for future in as_completed(running):
                    yield running[future], future.result()
            except BrokenProcessPool:
                raise SealGymError(
                    "a worker process was ended from outside (out of memory?): start the same command again, "
                    "with fewer --jobs if need be; it goes on where it stopped"
                ) from None
            finally:
                workers.shutdown(wait=False, cancel_futures=True)

    return engine


def on_ray(jobs: int, address: str | None, own_code: Callable[[], str], *, send_code: bool = False) -> Engine:
    """Runs units on a Ray cluster; what a lost worker or node was on runs again elsewhere.

    Args:
        jobs: Processors of the cluster that is started on this machine if there is no address.
        address: Of a running cluster.
        own_code: Gives the hash of the code that decides the results; a node on which it gives another is
            refused.
        send_code: Whether the nodes get the code from here, and compile it; else each has this checkout at
            the same path.

    Returns:
        The engine, for one call.

    Raises:
        ConfigError: If Ray is not installed or the cluster not found.
    """
    try:
        import ray
    except ImportError:
        raise ConfigError("--engine ray: Ray is not installed: pip install 'seal-gym[ray]'") from None
    environment: dict[str, Any] = {"env_vars": {"OMP_NUM_THREADS": "1"}}
    if send_code:
        environment |= {"working_dir": str(ROOT), "excludes": list(_NOT_SENT)}
    else:
        environment["env_vars"]["PYTHONPATH"] = str(ROOT)
    start: dict[str, Any] = {} if address is not None else {"num_cpus": jobs, "include_dashboard": False}
    try:
        ray.init(address=address, runtime_env=environment, log_to_driver=False, **start)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise ConfigError(
            f"--address {address}: no Ray cluster there ({error}); start one with ray start --head"
        ) from None

    def engine(work: Callable[[Unit], Result], units: Sequence[Unit]) -> Iterator[tuple[Unit, Result]]:
        task: Any = ray.remote(num_cpus=1, max_retries=_RETRIES)(remote.run_checked)
        code = own_code()
        running = {task.remote(work, unit, own_code, code): unit for unit in units}
        try:
            while running:
                (done,), _ = ray.wait(list(running), num_returns=1)
                yield running.pop(done), ray.get(done)
        except ray.exceptions.RayError as error:
            raise SealGymError(
                f"the Ray cluster failed: {error}\nstart the same command again; it goes on where it stopped"
            ) from None
        finally:
            ray.shutdown()

    return engine


def add_options(parser: argparse.ArgumentParser) -> None:
    """Adds the options that ``of`` reads, beside a ``--jobs`` of the command's own.

    Args:
        parser: The command line.
    """
    parser.add_argument(
        "--engine", choices=("local", "ray"), default="local", help="where to run (default: local)"
    )
    parser.add_argument(
        "--address", help="of a running Ray cluster; without one, --jobs workers on this machine"
    )
    parser.add_argument(
        "--send-code",
        action="store_true",
        help="send the code to the cluster's nodes; else each has this checkout at the same path",
    )


def of(options: argparse.Namespace, own_code: Callable[[], str]) -> Engine:
    """The engine that a command line asks for.

    Args:
        options: With those of ``add_options`` and ``jobs``.
        own_code: See ``on_ray``.

    Returns:
        The engine.

    Raises:
        ConfigError: If the options do not go together, or there is no such cluster.
    """
    require(
        options.engine == "ray" or (options.address is None and not options.send_code),
        "--address and --send-code: only with --engine ray",
    )
    if options.engine == "local":
        return local(options.jobs)
    return on_ray(options.jobs, options.address, own_code, send_code=options.send_code)
