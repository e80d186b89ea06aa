"""Recordings: everything that came and was made of it, in one MCAP file a session.

``devices.recording_format`` says what is in a file. ``recorder`` writes one while the gateway runs;
``reading`` opens one for whatever is to be made of it; ``solving`` recomputes its poses.
"""

from gateway.recording.arrays import SkeletonArrays
from gateway.recording.reading import (
    RecordedStatistics,
    Recording,
    RecordingMeta,
    open_recording,
)

__all__ = [
    "RecordedStatistics",
    "Recording",
    "RecordingMeta",
    "SkeletonArrays",
    "open_recording",
]
