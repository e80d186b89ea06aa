"""What a fleet has measured, as Parquet files by method, site, day and wearer, for DuckDB and anything else.

::

    .lock                                                  who changes the archive at the moment
    .key                                                   what pseudonyms are made with; for its owner alone
    recordings/site=…/day=…/wearer=…/<digest>.mcap         raw bytes: what can be solved again
    poses/method=…/site=…/day=…/wearer=…/<name>.parquet    a row a pose; the file tells where it came from
    catalogue.parquet                                      a row a file, made of all these

A wearer is a pseudonym everywhere: a keyed digest of the name, which is stored nowhere. The files are the
truth: the catalogue is made of them anew after every change.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import itertools
import json
import logging
import os
import re
import secrets
import shutil
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

import gateway
from devices.extras import how_to_add
from gateway.body.joint_angles import joint_angles
from gateway.errors import GatewayError
from gateway.recording import Recording
from gateway.recording.arrays import SkeletonArrays, arrays_of
from gateway.support.file_lock import file_lock
from gateway.support.whole_files import replacing, write_whole

if TYPE_CHECKING:
    import pyarrow as pa

_log = logging.getLogger(__name__)

PROVENANCE = b"mocap"
"""Key of what a file tells of itself: a JSON object."""
_NAME = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_DIGITS = 16
_COLLECTING = ".collecting_"
"""Beginning of the names of files by which a site is collected for once at a time."""
_ROWS = 1000
"""Of an answer, fetched at a time."""
_KEY_BYTES = 32
_SHORTEST_SOUGHT = 4
_BEGIN_S = 20.0
"""Longest wait for another command that makes the same archive."""


class ArchiveError(GatewayError):
    """An archive that cannot be used as asked."""


@dataclass(frozen=True)
class Partition:
    """Which folder rows belong to."""

    method: str
    site: str
    day: str
    """YYYY-MM-DD, UTC."""
    wearer: str
    """Pseudonym."""

    def __post_init__(self) -> None:
        """Raise ``ArchiveError`` for a name that would lead out of the archive: methods and days are those of
        recordings and gateways, whoever made them."""
        for what in ("method", "site", "day", "wearer"):
            checked_name(what, getattr(self, what))

    @property
    def folder(self) -> Path:
        """Below ``poses``."""
        return Path(f"method={self.method}", *_folders(self.site, self.day, self.wearer))


class Added(NamedTuple):
    """What became of a recording that was taken in."""

    kept: Path
    rows: int
    """Poses that were written."""
    is_new: bool
    """Whether its bytes were not there yet."""


def _folders(site: str, day: str, wearer: str) -> tuple[str, str, str]:
    return f"site={site}", f"day={day}", f"wearer={wearer}"


def day_of(utc_ns: int) -> str:
    """Return the day of an instant, UTC."""
    return datetime.fromtimestamp(utc_ns * 1e-9, UTC).strftime("%Y-%m-%d")


def checked_name(what: str, name: str) -> str:
    """Return a name that can stand in a path. Raises ``ArchiveError``."""
    if not _NAME.fullmatch(name) or name.startswith("."):
        raise ArchiveError(f"{what} '{name}': letters, digits, _ . and - are possible, 64 at most")
    return name


def parquet() -> Any:
    """Return the Parquet library. Raises ``ArchiveError`` with the command that installs it."""
    try:
        import pyarrow.parquet  # noqa: PLC0415 - an extra
    except ImportError:
        raise ArchiveError(f"an archive needs the extra 'fleet': {how_to_add('fleet')}") from None
    return pyarrow.parquet


class Archive:
    """An archive in a folder."""

    def __init__(self, folder: Path, *, is_new: bool = False) -> None:
        """Open the archive in a folder. is_new: make it where there is none. Raises ``ArchiveError``."""
        parquet()
        self.folder = folder
        self.poses = folder / "poses"
        self.recordings = folder / "recordings"
        self._key_file = folder / ".key"
        if not self._key_file.exists():
            if not is_new:
                raise ArchiveError(f"{folder} is no archive: make one with `fleet archive add` or `collect`")
            self._begin()
        self._key = self._read_key()

    def _begin(self) -> None:
        """Make the folder and the key; where two do so at once, the key of one is both's."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except FileExistsError:
            raise ArchiveError(f"{self.folder} is a file: name a folder for the archive") from None
        with self.locked("begin", _BEGIN_S):
            if not self._key_file.exists():
                write_whole(self._key_file, secrets.token_hex(_KEY_BYTES).encode(), 0o600)
                self.renew_catalogue()

    def _read_key(self) -> bytes:
        try:
            key = bytes.fromhex(self._key_file.read_text().strip())
        except ValueError:
            key = b""
        if len(key) != _KEY_BYTES:
            raise ArchiveError(
                f"{self._key_file} holds no key, and pseudonyms are made with it: put it back from a copy, "
                "or begin another archive"
            )
        return key

    def pseudonym(self, wearer: str) -> str:
        """Return the id of a wearer: always the same in this archive, and in no other, however the letters
        of the name are composed. Raises ``ArchiveError`` for an empty name."""
        name = _composed(wearer)
        if not name:
            raise ArchiveError("the name of a wearer is empty: name who wore the suit")
        return hmac.new(self._key, name.encode(), hashlib.sha256).hexdigest()[:_DIGITS]

    @contextlib.contextmanager
    def locked(self, what: str, patience_s: float = 0.0) -> Iterator[None]:
        """Keep others from changing the archive meanwhile.

        what: command that does so. patience_s: how long another one is waited for. Raises
        ``ArchiveError`` that names it.
        """
        with self._held(self.folder / ".lock", what, patience_s):
            yield

    @contextlib.contextmanager
    def collecting(self, site: str) -> Iterator[None]:
        """Be the one that collects for a site: two would keep each pose twice. Raises ``ArchiveError``."""
        with self._held(self.folder / f"{_COLLECTING}{site}", f"collect --site {site}", 0.0):
            yield

    @contextlib.contextmanager
    def nobody_collects(self) -> Iterator[None]:
        """Keep everybody from collecting: they hold poses that are not in a file yet. Raises
        ``ArchiveError`` where somebody does."""
        with contextlib.ExitStack() as stack:
            for path in sorted(self.folder.glob(f"{_COLLECTING}*")):
                site = path.name.removeprefix(_COLLECTING)
                stack.enter_context(self._held(path, f"collect --site {site}", 0.0))
            yield

    @contextlib.contextmanager
    def _held(self, path: Path, what: str, patience_s: float) -> Iterator[None]:
        lock = file_lock(path, patience_s, f"`fleet archive {what}` (process {os.getpid()})")
        try:
            lock.__enter__()
        except BlockingIOError:
            raise ArchiveError(
                f"{path.read_text() or 'another command'} works on {self.folder}: wait for it, or end it"
            ) from None
        except OSError as error:
            raise ArchiveError(f"{path} cannot be written: {error.strerror}") from None
        with contextlib.ExitStack() as stack:
            stack.push(lock.__exit__)
            yield

    def part(self, partition: Partition, name: str) -> Path:
        """Return where a file of rows lies, or would."""
        return self.poses / partition.folder / f"{name}.parquet"

    def write(self, path: Path, columns: Mapping[str, Any], provenance: Mapping[str, object]) -> None:
        """Write a file of rows: it is there whole, or not at all. The same rows give the same bytes."""
        import pyarrow as pa  # noqa: PLC0415 - an extra

        metadata = json.dumps({**provenance, "software": gateway.__version__}, sort_keys=True)
        table = pa.table(dict(columns)).replace_schema_metadata({PROVENANCE: metadata.encode()})
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as partial:
            parquet().write_table(table, partial, compression="zstd")

    def kept_recordings(self) -> list[Path]:
        """Return the files of all recordings."""
        return [path for path in sorted(self.recordings.rglob("*.mcap")) if not path.name.startswith(".")]

    def add(self, recording: Recording, source: Path, site: str, wearer: str) -> Added:
        """Take in a finished recording: its bytes, and the poses that it holds, if any.

        What is there already is left as it is. Raises ``ArchiveError``.
        """
        site, who = checked_name("site", site), self.pseudonym(wearer)
        digest = digest_of(source)
        day = day_of(recording.meta.begun_utc_ns)
        kept = self.recordings.joinpath(*_folders(site, day, who)) / f"{digest[:_DIGITS]}.mcap"
        is_new = not kept.exists()
        if is_new:
            kept.parent.mkdir(parents=True, exist_ok=True)
            with replacing(kept) as partial:
                shutil.copyfile(source, partial)
        method = recording.meta.settings.reconstructor
        part = self.part(Partition(method, site, day, who), digest[:_DIGITS])
        if part.exists():
            return Added(kept, 0, is_new)
        arrays = arrays_of(recording.skeleton_frames(), recording.meta.skeleton)
        if arrays is None:
            return Added(kept, 0, is_new)
        self.write(part, columns_of(arrays, recording), {"recording": digest, "solved": "as recorded"})
        return Added(kept, len(arrays.time_ns), is_new)

    def entries(self) -> Iterator[dict[str, object]]:
        """Yield what every file of rows says of itself; one that cannot be read is told in the log."""
        for path in sorted(self.poses.rglob("*.parquet")):
            metadata = _metadata_of(path)
            folders = path.relative_to(self.poses).parts[:-1]
            if metadata is None or not all("=" in folder for folder in folders):
                _log.warning("%s is no file of rows of an archive, and left out: delete it", path)
                continue
            provenance = json.loads((metadata.metadata or {}).get(PROVENANCE, b"{}"))
            yield {
                "file": str(path.relative_to(self.folder)),
                **dict(folder.split("=", 1) for folder in folders),
                "rows": metadata.num_rows,
                "bytes": path.stat().st_size,
                "recording": str(provenance.get("recording", "")),
                "solved": str(provenance.get("solved", "")),
                "software": str(provenance.get("software", "")),
            }

    def renew_catalogue(self) -> int:
        """Write ``catalogue.parquet`` anew. Returns how many files there are."""
        import pyarrow as pa  # noqa: PLC0415 - an extra

        entries = list(self.entries())
        target = self.folder / "catalogue.parquet"
        names = (
            "file",
            "method",
            "site",
            "day",
            "wearer",
            "rows",
            "bytes",
            "recording",
            "solved",
            "software",
        )
        types = [pa.int64() if name in ("rows", "bytes") else pa.string() for name in names]
        schema = pa.schema(list(zip(names, types, strict=True)))
        with replacing(target) as partial:
            parquet().write_table(pa.Table.from_pylist(entries, schema), partial)
        return len(entries)

    def folders_of(self, wearer: str) -> list[Path]:
        """Return all folders with files of a wearer, by name."""
        return sorted(self.folder.rglob(f"wearer={self.pseudonym(wearer)}"))

    def forget(self, wearer: str) -> tuple[int, int]:
        """Delete all that is kept of a wearer, by name. Returns how many files, and how many still name them.

        The second is 0, unless a file that belongs to somebody else holds the name or the pseudonym.
        """
        files = self._delete(self.folders_of(wearer))
        return files, sum(1 for _ in self.traces(wearer))

    def expire(self, before: str) -> int:
        """Delete all of the days before one (YYYY-MM-DD). Returns how many files."""
        days = self.folder.rglob("day=*")
        return self._delete([day for day in days if day.name.removeprefix("day=") < before])

    def traces(self, wearer: str) -> Iterator[Path]:
        """Yield every file of the archive whose path or bytes hold the name of a wearer, or the pseudonym.

        A name of less than ``_SHORTEST_SOUGHT`` bytes is not sought: it would be found anywhere, by chance.
        """
        names = {wearer.strip().encode(), _composed(wearer).encode()}
        sought = [self.pseudonym(wearer).encode(), *(each for each in names if len(each) >= _SHORTEST_SOUGHT)]
        for path in sorted(self.folder.rglob("*")):
            if not path.is_file() or path == self._key_file:
                continue
            name, content = str(path.relative_to(self.folder)).encode(), path.read_bytes()
            if any(text in name or text in content for text in sought):
                yield path

    def _delete(self, folders: Sequence[Path]) -> int:
        """Delete folders, those that are empty then, and what a command that was killed has left half
        written. Returns how many files were in the folders."""
        files = 0
        for path in (*self.folder.rglob(".*.parquet.*"), *self.folder.rglob(".*.mcap.*")):
            path.unlink()
        for folder in folders:
            files += sum(path.is_file() for path in folder.rglob("*"))
            shutil.rmtree(folder)
        self._remove_empty_folders()
        self.renew_catalogue()
        return files

    def _remove_empty_folders(self) -> None:
        for folder in sorted((path for path in self.folder.rglob("*") if path.is_dir()), reverse=True):
            if not any(folder.iterdir()):
                folder.rmdir()

    def seen(self, gateway_name: str, instance: str) -> set[int]:
        """Return the numbers of the poses of a running gateway that are kept already."""
        pq, found = parquet(), set[int]()
        for path in self.poses.rglob("stream_*.parquet"):
            about = _metadata_of(path)
            provenance = json.loads(((about and about.metadata) or {}).get(PROVENANCE, b"{}"))
            if provenance.get("gateway") == gateway_name and instance in provenance.get("instances", []):
                table = pq.read_table(path, columns=["instance", "seq"], partitioning=None)
                pairs = zip(table["instance"].to_pylist(), table["seq"].to_pylist(), strict=True)
                found.update(seq for one, seq in pairs if one == instance)
        return found

    def query(self, sql: str) -> tuple[list[str], Iterator[tuple[object, ...]]]:
        """Ask DuckDB, for which ``poses`` and ``catalogue`` are tables. Returns names of columns, and rows.

        Raises ``ArchiveError`` without the extra, or for what it cannot answer.
        """
        try:
            import duckdb  # noqa: PLC0415 - an extra
        except ImportError:
            raise ArchiveError(f"a query needs the extra 'fleet': {how_to_add('fleet')}") from None
        connection = duckdb.connect()
        if _metadata_of(self.folder / "catalogue.parquet") is None:
            with self.locked("query"):  # it is made of the files, which are the truth
                self.renew_catalogue()
        files = str(self.poses / "**" / "*.parquet").replace("'", "''")
        catalogue = str(self.folder / "catalogue.parquet").replace("'", "''")
        types = "{'day': DATE, 'wearer': VARCHAR, 'site': VARCHAR, 'method': VARCHAR}"
        try:
            if any(self.poses.rglob("*.parquet")):
                connection.execute(
                    f"CREATE VIEW poses AS SELECT * FROM read_parquet('{files}', union_by_name=true, "
                    f"hive_partitioning=true, hive_types={types})"
                )
            connection.execute(f"CREATE VIEW catalogue AS SELECT * FROM read_parquet('{catalogue}')")
            connection.execute(sql)
            names = [column[0] for column in connection.description or ()]
            return names, itertools.chain.from_iterable(iter(lambda: connection.fetchmany(_ROWS), []))
        except duckdb.Error as error:
            raise ArchiveError(f"DuckDB: {str(error).splitlines()[0]}{self._hint(str(error))}") from None

    def _hint(self, error: str) -> str:
        """Return what would help, after an answer of DuckDB."""
        if str(self.poses) in error:
            return ": that file is damaged, delete it"
        if "poses does not exist" in error:
            return " There are no poses in this archive yet."
        return ""


def _composed(name: str) -> str:
    """Return a name in the one form that its letters and accents have when they are composed."""
    return unicodedata.normalize("NFC", name.strip())


def _metadata_of(path: Path) -> Any:
    """Return the metadata of a Parquet file; None for what is none, such as half of one."""
    import pyarrow as pa  # noqa: PLC0415 - an extra

    try:
        return parquet().read_metadata(path)
    except (pa.ArrowInvalid, FileNotFoundError):
        return None


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def columns_of(arrays: SkeletonArrays, recording: Recording) -> dict[str, pa.Array]:
    """Return the rows of poses as columns: instants, orientations and joint angles (degrees)."""
    utc_ns = recording.meta.begun_utc_ns - recording.meta.begun_ns
    skeleton = arrays.skeleton
    columns: dict[str, Any] = {
        "utc_ns": arrays.time_ns + utc_ns,
        "seq": arrays.sequence,
        "late": np.zeros(len(arrays.time_ns), np.bool_),
    }
    columns |= orientation_columns(skeleton.segment_names, arrays.q_wb)
    if skeleton.joints:
        degrees = np.degrees(joint_angles(skeleton, arrays.q_wb)).astype(np.float32)
        for j, joint in enumerate(skeleton.joints):
            for a, angle in enumerate(joint.angles):
                columns[f"{joint.name}_{angle.name}_deg"] = degrees[:, j, a]
    return columns


def orientation_columns(names: Sequence[str], q_wb: Any) -> dict[str, Any]:
    """Return orientations (rows, segments, 4) as columns of single precision; NaN where not known."""
    single = np.asarray(q_wb, np.float32)
    return {
        f"{name}_orientation_{axis}": np.ascontiguousarray(single[:, s, i])
        for s, name in enumerate(names)
        for i, axis in enumerate("wxyz")
    }
