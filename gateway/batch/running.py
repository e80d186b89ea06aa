"""Jobs on all cores of this machine, or on a Dask cluster."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import re
import shutil
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from devices import recording_format as fmt
from devices.extras import how_to_add
from gateway.batch.job import Job, JobResult, Task, partial_folder, perform
from gateway.errors import GatewayError
from gateway.support.parent import end_with_parent

_LATER_PART = re.compile(r"(.+)_part\d+$")
_CONNECT_S = 10
DIED = "the process that worked on it died (out of memory?)"


def jobs_in(folder: Path, results: Path, task: Task) -> list[Job]:
    """Return a job for every recording in a folder and those below it, later parts of sessions left to their
    first, and what another batch or export has not finished, whose names begin with a dot.

    Raises ``GatewayError`` when there is none.
    """
    if not folder.is_dir():
        raise GatewayError(f"{folder} is no folder")
    away = results.resolve()
    jobs = []
    for path in sorted(folder.rglob(f"*{fmt.SUFFIX}")):
        name = path.relative_to(folder)
        if any(step.startswith(".") for step in name.parts):
            continue
        part = _LATER_PART.match(path.stem)
        # Without its first part a later one is a recording by itself.
        if part and path.with_name(part[1] + path.suffix).exists():
            continue
        if path.is_file() and fmt.is_recording(path) and away not in path.resolve().parents:
            jobs.append(Job(str(name), path.resolve(), (results / name.parent).resolve(), task))
    if not jobs:
        raise GatewayError(f"{folder} has no recording (*{fmt.SUFFIX}) in it")
    return jobs


def run_jobs(
    jobs: Sequence[Job],
    done: Callable[[Job, JobResult], None],
    workers: int | None = None,
    dask: str | None = None,
) -> None:
    """Perform all; ``done`` is called with each as it ends, in this process. One that fails stops no other.

    workers: processes; None: as many as cores. dask: address of a scheduler instead. Raises ``GatewayError``
    when that cannot be reached. Interrupted, the processes are ended, and nothing half made is left.
    """
    if not jobs:
        return
    if dask is not None:
        _on_dask(jobs, done, dask)
        return
    for job in jobs:
        _clear_away(job)
    died = []
    with contextlib.closing(_performed(_processes(workers or os.cpu_count() or 1), jobs)) as performed:
        for job, outcome in performed:
            if outcome is None:
                died.append(job)  # one of these did it; the others only shared its pool
            else:
                done(job, outcome)
    for job in died:
        with contextlib.closing(_performed(_processes(1), [job])) as performed:
            for _, outcome in performed:
                done(job, outcome or JobResult(job.name, error=DIED))


def _processes(count: int) -> Executor:
    # Not forked: numerical libraries have threads, which a fork would tear apart.
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(count, mp_context=context, initializer=end_with_parent)


def _clear_away(job: Job) -> None:
    """Delete what processes that were killed have left of a job."""
    made = re.compile(rf"\.partial-(\d+)-{re.escape(job.source.stem)}")
    for path in job.folder.glob(".partial-*"):
        left = made.fullmatch(path.name)
        if left and not _is_alive(int(left[1])):
            shutil.rmtree(path, ignore_errors=True)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # another user's
        return True
    return True


def _performed(
    executor: AbstractContextManager[Executor], jobs: Sequence[Job]
) -> Generator[tuple[Job, JobResult | None], None, None]:
    """Yield jobs as they end; None in place of an outcome where the process that had it died."""
    # Processes that were there before are not this pool's, and are not ended here.
    others = multiprocessing.active_children()
    with executor as pool:
        try:
            with _interrupts_for_this_process():
                futures = {pool.submit(perform, job): job for job in jobs}
            for future in as_completed(futures):
                try:
                    yield futures[future], future.result()
                except BrokenProcessPool:
                    yield futures[future], None
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            _end([process for process in multiprocessing.active_children() if process not in others], jobs)
            raise


@contextlib.contextmanager
def _interrupts_for_this_process() -> Iterator[None]:
    """Keep Ctrl-C from processes that are started meanwhile, and raise it here at the end.

    A terminal sends it to all of them, but what becomes of them is decided in this process.
    """
    came: list[int] = []
    is_main = threading.current_thread() is threading.main_thread()
    # Blocked for what is started, and kept for later: another thread, such as that of a progress bar, does
    # not block it, and Python then interrupts the main thread in the middle of a start.
    handler = signal.signal(signal.SIGINT, lambda number, _: came.append(number)) if is_main else None
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        if is_main:
            signal.signal(signal.SIGINT, handler)
    if came:
        signal.raise_signal(signal.SIGINT)


def _end(processes: Sequence[BaseProcess], jobs: Sequence[Job]) -> None:
    """Kill them, and delete what they had begun: within compiled code they could not be asked to stop."""
    for process in processes:
        process.kill()
    for process in processes:
        process.join()
        for job in jobs:
            shutil.rmtree(partial_folder(job, process.pid), ignore_errors=True)


def _on_dask(jobs: Sequence[Job], done: Callable[[Job, JobResult], None], address: str) -> None:
    with connected_client(address) as client:
        executor = client.get_executor(pure=False, retries=1)
        futures = {executor.submit(perform, job): job for job in jobs}
        for future in as_completed(futures):
            job = futures[future]
            try:
                outcome = future.result()
            except Exception as error:  # whatever a cluster raises for a worker that is gone
                outcome = JobResult(job.name, error=f"Dask: {type(error).__name__}: {error}")
            done(job, outcome)


def connected_client(address: str, timeout_s: float = _CONNECT_S) -> Any:
    """Return a client of a Dask scheduler that has a worker. Raises ``GatewayError``."""
    try:
        from distributed import Client  # noqa: PLC0415 - an extra
    except ImportError:
        raise GatewayError(f"a Dask cluster needs the extra 'dask': {how_to_add('dask')}") from None
    try:
        client = Client(address, timeout=timeout_s, set_as_default=False)  # type: ignore[no-untyped-call]
        client.wait_for_workers(1, timeout=timeout_s)
    except (OSError, TimeoutError, ValueError) as error:
        raise GatewayError(
            f"no Dask scheduler with a worker at {address} ({type(error).__name__}): start `dask scheduler` "
            "and `dask worker`, or leave out --dask"
        ) from error
    return client
