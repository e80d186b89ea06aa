"""Jobs on all cores of this machine, or on a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from devices import recording_format as fmt
from devices.extras import how_to_add
from gateway.batch.job import Job, Outcome, Task, perform
from gateway.errors import GatewayError

_LATER_PART = re.compile(r"(.+)_part\d+$")
_CONNECT_S = 10
DIED = "the process that worked on it died (out of memory?)"


def jobs_in(folder: Path, results: Path, task: Task) -> list[Job]:
    """A job for every recording in a folder and those below it, later parts of sessions left to their first.

    Raises ``GatewayError`` when there is none.
    """
    if not folder.is_dir():
        raise GatewayError(f"{folder} is no folder")
    away = results.resolve()
    jobs = []
    for path in sorted(folder.rglob(f"*{fmt.SUFFIX}")):
        part = _LATER_PART.match(path.stem)
        if part and path.with_name(part[1] + path.suffix).exists():
            continue
        if path.is_file() and away not in path.resolve().parents:
            name = path.relative_to(folder)
            jobs.append(Job(str(name), path.resolve(), (results / name.parent).resolve(), task))
    if not jobs:
        raise GatewayError(f"{folder} has no recording (*{fmt.SUFFIX}) in it")
    return jobs


def run_jobs(
    jobs: Sequence[Job],
    done: Callable[[Job, Outcome], None],
    workers: int | None = None,
    dask: str | None = None,
) -> None:
    """Perform all; ``done`` is told of each as it ends, in this process. One that fails stops no other.

    workers: processes; None: as many as cores. dask: address of a scheduler instead. Raises ``GatewayError``
    when that cannot be reached.
    """
    if not jobs:
        return
    if dask is not None:
        _on_dask(jobs, done, dask)
        return
    died = []
    for job, outcome in _performed(_processes(workers or os.cpu_count() or 1), jobs):
        if outcome is None:
            died.append(job)  # one of these did it; the others only shared its pool
        else:
            done(job, outcome)
    for job in died:
        for _, outcome in _performed(_processes(1), [job]):
            done(job, outcome or Outcome(job.name, error=DIED))


def _processes(count: int) -> Executor:
    # Not forked: numerical libraries have threads, which a fork would tear apart.
    return ProcessPoolExecutor(count, mp_context=multiprocessing.get_context("spawn"))


def _performed(
    executor: AbstractContextManager[Executor], jobs: Sequence[Job]
) -> Iterator[tuple[Job, Outcome | None]]:
    """Jobs as they end; None where the process that had it died."""
    with executor as pool:
        try:
            futures: dict[Future[Outcome], Job] = {}
            for job in jobs:
                futures[pool.submit(perform, job)] = job
            for future in as_completed(futures):
                try:
                    yield futures[future], future.result()
                except BrokenProcessPool:
                    yield futures[future], None
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _on_dask(jobs: Sequence[Job], done: Callable[[Job, Outcome], None], address: str) -> None:
    with _client(address) as client:
        executor = client.get_executor(pure=False, retries=1)
        futures = {executor.submit(perform, job): job for job in jobs}
        for future in as_completed(futures):
            job = futures[future]
            try:
                outcome = future.result()
            except Exception as error:  # whatever a cluster raises for a worker that is gone
                outcome = Outcome(job.name, error=f"Dask: {type(error).__name__}: {error}")
            done(job, outcome)


def _client(address: str) -> Any:
    try:
        from distributed import Client  # noqa: PLC0415 - an extra
    except ImportError:
        raise GatewayError(f"a Dask cluster needs the extra 'dask': {how_to_add('dask')}") from None
    try:
        client = Client(address, timeout=_CONNECT_S, set_as_default=False)  # type: ignore[no-untyped-call]
        client.wait_for_workers(1, timeout=_CONNECT_S)
    except (OSError, TimeoutError, ValueError) as error:
        raise GatewayError(
            f"no Dask scheduler with a worker at {address} ({type(error).__name__}): start `dask scheduler` "
            "and `dask worker`, or leave out --dask"
        ) from error
    return client
