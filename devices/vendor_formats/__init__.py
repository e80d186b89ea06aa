"""Recordings of other makers' modules, read into ``devices.emulators.recordings.Recording``.

One format a file; each gives SI units, unit quaternions w x y z to east-north-up, and what was lost as NaN
rows. ``sheets`` reads the tables that most of them are; every error names file, line and column.
"""

import importlib
from typing import TYPE_CHECKING, Any

from devices.vendor_formats.sheets import FormatError

if TYPE_CHECKING:
    from devices.vendor_formats.column_map import ColumnMap, read_mapped_csv
    from devices.vendor_formats.movella_dot import read_movella_dot
    from devices.vendor_formats.mvnx import read_mvnx
    from devices.vendor_formats.ximu3 import read_ximu3
    from devices.vendor_formats.xsens_text import read_xsens_text

__all__ = [
    "ColumnMap",
    "FormatError",
    "read_mapped_csv",
    "read_movella_dot",
    "read_mvnx",
    "read_ximu3",
    "read_xsens_text",
]

_MODULES = {
    "ColumnMap": "column_map",
    "read_mapped_csv": "column_map",
    "read_movella_dot": "movella_dot",
    "read_mvnx": "mvnx",
    "read_ximu3": "ximu3",
    "read_xsens_text": "xsens_text",
}


def __getattr__(name: str) -> Any:
    """Readers are imported where they are used: they need scipy, and ``FormatError`` does not."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
