"""Files of marker trajectories, read into ``MarkerTrial``: C3D and TRC."""

from pathlib import Path

from devices.marker_files.c3d import MAGIC, read_c3d
from devices.marker_files.trc import FIRST_WORD, read_trc
from devices.marker_files.trial import MarkerTrial
from devices.vendor_formats.sheets import FormatError

__all__ = ["SUFFIXES", "MarkerTrial", "read_c3d", "read_markers", "read_trc"]

SUFFIXES = {".c3d": read_c3d, ".trc": read_trc}


def read_markers(path: Path) -> MarkerTrial:
    """Read a trial, by what the file holds, whatever its name ends in.

    Raises ``FormatError`` for what is neither format, with what to do.
    """
    if path.is_dir():
        raise FormatError(f"{path} is a folder: name the marker files in it")
    try:
        with path.open("rb") as file:
            head = file.read(len(FIRST_WORD))
    except OSError as error:
        raise FormatError(f"{path} cannot be read: {error.strerror}") from error
    if head[1:2] == bytes([MAGIC]) and not head[:2].isalpha():
        return read_c3d(path)
    reader = read_trc if head == FIRST_WORD.encode() else SUFFIXES.get(path.suffix.lower())
    if reader is None:
        raise FormatError(
            f"{path}: marker files are C3D or TRC (their names end in {' or '.join(SUFFIXES)}): have the "
            "program that recorded it export the trial as one of them"
        )
    return reader(path)
