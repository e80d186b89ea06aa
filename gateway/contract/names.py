"""What names may look like that come from outside."""

from __future__ import annotations

RECORDING_NAME = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$"
"""Nothing that could mean another folder."""

KEPT_FILE = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,127}$"
"""Of a file in the folder of the recordings: nothing that could mean another folder, nothing hidden."""
