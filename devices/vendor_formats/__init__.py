"""Recordings of other makers' modules, read into ``devices.emulators.recordings.Recording``.

One format a file; each gives SI units, unit quaternions w x y z to east-north-up, and what was lost as NaN
rows. ``sheets`` reads the tables that most of them are; every error names file, line and column.
"""

from devices.vendor_formats.column_map import ColumnMap, read_mapped_csv
from devices.vendor_formats.movella_dot import read_movella_dot
from devices.vendor_formats.mvnx import read_mvnx
from devices.vendor_formats.sheets import FormatError
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
