"""What can be made of a recording."""

from __future__ import annotations

from gateway.recording.exporters.formats import FORMATS

REPORT = "report"
SOLVED = "mcap"
KINDS = (*FORMATS, REPORT, SOLVED)
"""Exports, the page, and the recording solved anew."""
