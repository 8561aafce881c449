"""Many independent tasks through joblib, each kept as it is done, so that a stopped run goes on where it was."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

from joblib import Parallel, delayed, parallel_config
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from magenv.crosstalk.tasks import TASKS, Row
from magenv.files import check_output_dir, digest_of, write_file
from magenv.params import InputError

Engine = Literal["local", "dask", "ray"]

_A_ROUND = 16
"""Tasks a worker computes between two looks at what is done: few enough that little is lost, and many enough that
workers seldom wait for each other."""


class Task(NamedTuple):
    """A point of a sweep: the table that it fills and the arguments of its function in ``tasks.TASKS``."""

    table: str
    arguments: dict[str, Any]

    def key(self) -> str:
        """Return what names the result: arguments and all source code of which it may depend."""
        told = json.dumps([self.table, self.arguments, _sources()], sort_keys=True)
        return f"{self.table}-{hashlib.sha256(told.encode()).hexdigest()[:24]}"


@functools.cache
def _sources() -> str:
    return digest_of(Path(__file__).parent.parent)


def compute(task: Task) -> list[Row]:
    """Return the rows of a task."""
    return TASKS[task.table](**task.arguments)


@contextlib.contextmanager
def _backend(engine: Engine, workers: int) -> Iterator[int]:
    """Let joblib use the processes of this machine, or a cluster; yield how many workers there are.

    Dask's cluster is that of ``DASK_SCHEDULER_ADDRESS``, Ray's that of ``RAY_ADDRESS``; without, one of this machine.
    """
    with contextlib.ExitStack() as stack:
        if engine == "local":
            stack.enter_context(parallel_config(backend="loky", n_jobs=workers, inner_max_num_threads=1))
        elif engine == "dask":
            try:
                from distributed import Client, LocalCluster
            except ImportError as error:
                raise InputError(
                    "Input engine must be one whose package is installed, python -m pip install distributed; "
                    "instead received 'dask'."
                ) from error
            address = os.environ.get("DASK_SCHEDULER_ADDRESS")
            if address is None:
                address = stack.enter_context(
                    LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None)
                )
            workers = sum(stack.enter_context(Client(address)).ncores().values())
            stack.enter_context(parallel_config(backend="dask"))
        else:
            try:
                import ray
                from ray.util.joblib import register_ray
            except ImportError as error:
                raise InputError(
                    "Input engine must be one whose package is installed, python -m pip install ray; "
                    "instead received 'ray'."
                ) from error
            if not ray.is_initialized():
                local = {} if "RAY_ADDRESS" in os.environ else {"num_cpus": workers, "include_dashboard": False}
                ray.init(**local)
                stack.callback(ray.shutdown)
            workers = int(ray.cluster_resources()["CPU"])
            register_ray()
            stack.enter_context(parallel_config(backend="ray", n_jobs=workers))
        yield workers


def _digest_of(rows: list[Row]) -> str:
    return hashlib.sha256(json.dumps(rows).encode()).hexdigest()


def _kept(path: Path) -> list[Row] | None:
    """Return the rows of a finished task, or None where there are none that are as they were written."""
    try:
        point = json.loads(path.read_text(encoding="utf-8"))
        rows: list[Row] = point["rows"]
        return rows if point["sha256"] == _digest_of(rows) else None
    except (OSError, ValueError, TypeError, KeyError):
        return None


def _keep(path: Path, rows: list[Row]) -> None:
    write_file(path, json.dumps({"sha256": _digest_of(rows), "rows": rows}).encode())


def run(tasks: Sequence[Task], folder: Path, *, engine: Engine = "local", workers: int = 2) -> dict[str, list[Row]]:
    """Compute all tasks that ``folder`` does not hold yet; return the rows of each table, in the order of the tasks.

    Parameters
    ----------
    tasks : sequence of Task
        What to compute.
    folder : Path
        Where each task's rows are kept as JSON, under a name made of its arguments and the program's sources.
    engine : {"local", "dask", "ray"}
        Processes of this machine, or a cluster.
    workers : int
        Processes, where the cluster does not know better.
    """
    check_output_dir(folder)
    paths = [folder / f"{task.key()}.json" for task in tasks]
    done = [_kept(path) for path in paths]
    missing = [i for i, rows in enumerate(done) if rows is None]
    bar = Progress(
        TextColumn("[bold]{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=Console(file=sys.stderr),
    )
    with bar:
        shown = bar.add_task("points", total=len(tasks), completed=len(tasks) - len(missing))
        if missing:
            with _backend(engine, workers) as present:
                for first in range(0, len(missing), _A_ROUND * present):
                    some = missing[first : first + _A_ROUND * present]
                    computed = Parallel()(delayed(compute)(tasks[i]) for i in some)
                    for i, rows in zip(some, computed, strict=True):
                        _keep(paths[i], rows)
                        done[i] = rows
                    bar.update(shown, advance=len(some))
    tables: dict[str, list[Row]] = {}
    for task, rows in zip(tasks, done, strict=True):
        tables.setdefault(task.table, []).extend(rows or [])
    return tables
