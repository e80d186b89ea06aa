"""Many recordings: solved anew, exported, reported, each as the single commands would do it.

``job`` is the work on one recording; ``manifest`` remembers what is done; ``running`` hands jobs to processes
of this machine or to a Dask cluster.
"""

from __future__ import annotations

from gateway.recording.exporters.formats import FORMATS

REPORT = "report"
SOLVED = "mcap"
KINDS = (*FORMATS, REPORT, SOLVED)
"""What can be made of a recording: exports, the page, and the recording solved anew."""
