"""Files of marker trajectories, read into ``MarkerTrial``: C3D, TRC, tables of QTM, Motive and Nexus."""

from pathlib import Path

from devices.marker_files.c3d import MAGIC, read_c3d
from devices.marker_files.tables import is_table, read_table
from devices.marker_files.trc import FIRST_WORD, read_trc
from devices.marker_files.trial import MarkerTrial
from devices.vendor_formats.sheets import FormatError

__all__ = ["SUFFIXES", "MarkerTrial", "holds_markers", "read_c3d", "read_markers", "read_table", "read_trc"]

SUFFIXES = {".c3d": read_c3d, ".trc": read_trc, ".tsv": read_table, ".csv": read_table}
_HEAD_BYTES = 32
_PNG = b"\x89PNG"


def _is_c3d(head: bytes) -> bool:
    # A picture begins so, too.
    return head[1:2] == bytes([MAGIC]) and not head[:2].isalpha() and not head.startswith(_PNG)


def holds_markers(head: bytes) -> bool:
    """Return whether a file's first bytes are those of one of the formats."""
    return _is_c3d(head) or head.startswith(FIRST_WORD.encode()) or is_table(head)


def read_markers(path: Path) -> MarkerTrial:
    """Read a trial, by what the file holds, whatever its name ends in.

    Raises ``FormatError`` for what is none of the formats, with what to do.
    """
    if path.is_dir():
        raise FormatError(f"{path} is a folder: name the marker files in it")
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError as error:
        raise FormatError(f"{path} cannot be read: {error.strerror}") from error
    if _is_c3d(head):
        return read_c3d(path)
    if head.startswith(FIRST_WORD.encode()):
        return read_trc(path)
    reader = read_table if is_table(head) else SUFFIXES.get(path.suffix.lower())
    if reader is None:
        raise FormatError(
            f"{path}: marker files are C3D, TRC, or tables of QTM, Motive and Nexus (their names end in "
            f"{', '.join(SUFFIXES)}): have the program that recorded it export the trial as one of them"
        )
    return reader(path)
