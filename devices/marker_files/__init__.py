"""Files of marker trajectories, read into ``MarkerTrial``: C3D and TRC."""

from pathlib import Path

from devices.marker_files.c3d import read_c3d
from devices.marker_files.trc import read_trc
from devices.marker_files.trial import MarkerTrial
from devices.vendor_formats.sheets import FormatError

__all__ = ["SUFFIXES", "MarkerTrial", "read_c3d", "read_markers", "read_trc"]

SUFFIXES = {".c3d": read_c3d, ".trc": read_trc}


def read_markers(path: Path) -> MarkerTrial:
    """Read a trial by the suffix of its file. Raises ``FormatError``."""
    reader = SUFFIXES.get(path.suffix.lower())
    if reader is None:
        raise FormatError(f"{path}: marker files end in {' or '.join(SUFFIXES)}")
    return reader(path)
