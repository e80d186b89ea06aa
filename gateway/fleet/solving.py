"""The recordings of an archive solved again by another method, on Dask: resumable, to the same bytes."""

from __future__ import annotations

import contextlib
import json
import logging
from collections.abc import Callable, Iterator
from concurrent.futures import as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gateway
from devices.extras import how_to_add
from devices.link import LinkError
from gateway.batch.running import connected_client
from gateway.errors import GatewayError
from gateway.fleet.archive import PROVENANCE, Archive, ArchiveError, Partition, columns_of, digest_of, parquet
from gateway.recording import open_recording
from gateway.recording.arrays import arrays_of
from gateway.recording.solving import recorded_setup, solve

_CONNECT_S = 20
_RETRIES = 2
"""Of a recording whose worker died."""


@dataclass(frozen=True)
class Solving:
    """One recording and the method; plain values that travel to other machines, which see the same folder."""

    archive: Path
    recording: Path
    method: str


@dataclass(frozen=True)
class SolvedRecording:
    """What became of it."""

    recording: str
    rows: int = 0
    was_there: bool = False
    error: str | None = None


def jobs_of(archive: Archive, method: str) -> list[Solving]:
    """Return a job for every recording that is kept. Raises ``ArchiveError`` when there is none."""
    jobs = [Solving(archive.folder.resolve(), path.resolve(), method) for path in archive.kept_recordings()]
    if not jobs:
        raise ArchiveError(
            f"{archive.folder} has no recordings to solve: take some in with `fleet archive add`"
        )
    return jobs


def perform(job: Solving) -> SolvedRecording:
    """Solve one recording, unless its result is there already. Runs in a process of a worker."""
    archive = Archive(job.archive)
    site, day, wearer = (folder.split("=", 1)[1] for folder in job.recording.parts[-4:-1])
    name = job.recording.stem
    target = archive.part(Partition(job.method, site, day, wearer), name)
    provenance = {"recording": digest_of(job.recording), "solved": f"again by {job.method}"}
    if _is_made(target, provenance):
        return SolvedRecording(name, was_there=True)
    try:
        recording = open_recording(job.recording)
        setup = recorded_setup(recording)
        setup = replace(setup, settings=setup.settings.model_copy(update={"reconstructor": job.method}))
        arrays = arrays_of(solve(recording, setup), setup.suit.skeleton)
        if arrays is None:
            return SolvedRecording(name, error="no pose comes of it")
        archive.write(target, columns_of(arrays, recording), provenance)
    except (GatewayError, LinkError, OSError, ValueError) as error:
        return SolvedRecording(name, error=str(error).splitlines()[0])
    return SolvedRecording(name, len(arrays.time_ns))


def _is_made(target: Path, provenance: dict[str, str]) -> bool:
    if not target.exists():
        return False
    stored = json.loads((parquet().read_metadata(target).metadata or {}).get(PROVENANCE, b"{}"))
    return bool(stored == {**provenance, "software": gateway.__version__})


def run(
    jobs: list[Solving], done: Callable[[SolvedRecording], None], workers: int = 1, address: str | None = None
) -> None:
    """Perform all; ``done`` is told of each as it ends. A recording whose worker dies is given to another.

    workers: processes on this machine; address: of a Dask scheduler instead. Raises ``GatewayError``.
    """
    with _client(workers, address) as client:
        executor = client.get_executor(pure=False, retries=_RETRIES)
        names = {executor.submit(perform, job): job for job in jobs}
        for future in as_completed(names):
            error = future.exception()
            name = names[future].recording.stem
            done(
                future.result()
                if error is None
                else SolvedRecording(name, error=f"{type(error).__name__}: {error}")
            )


@contextlib.contextmanager
def _client(workers: int, address: str | None) -> Iterator[Any]:
    try:
        from distributed import Client, LocalCluster  # noqa: PLC0415 - an extra
    except ImportError:
        raise ArchiveError(f"solving on Dask needs the extra 'fleet': {how_to_add('fleet')}") from None
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what becomes of a recording is told by us
    if address is None:
        with (
            LocalCluster(  # type: ignore[no-untyped-call]
                n_workers=workers,
                threads_per_worker=1,
                host="127.0.0.1",
                dashboard_address="127.0.0.1:0",
                silence_logs=logging.CRITICAL,
            ) as cluster,
            Client(cluster, set_as_default=False) as client,  # type: ignore[no-untyped-call]
        ):
            yield client
        return
    with connected_client(address, _CONNECT_S) as client:
        yield client
