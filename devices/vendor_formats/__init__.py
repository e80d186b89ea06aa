"""Recordings of other makers' modules, read into ``devices.recorded_tracks``.

One format a file; each gives SI units, unit quaternions w x y z to east-north-up, and what was lost as NaN
rows. ``sheets`` reads the tables that most of them are; every error names file, line and column. ``gaps``
finds missing and misplaced rows, ``tracks`` makes tracks of rows. A new format is a file here and its line in
``FORMATS`` of ``gateway/imports/formats.py``.
The package itself imports none of them: who only reads markers needs ``sheets`` alone.
"""
