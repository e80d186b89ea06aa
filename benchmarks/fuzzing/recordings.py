"""Checks of recordings."""

from __future__ import annotations

from benchmarks.fuzzing.files import in_a_file, refused_or_read
from gateway.recording.pose_encoding import decode_skeleton_frame, encode_skeleton_frame
from gateway.recording.reading import open_recording
from gateway.recording.snapshot import decode_suit, encode_suit
from gateway.recording.summary import summarise


def recording(data: bytes) -> None:
    """Everything in a file that calls itself a recording."""
    path = in_a_file("recording.mcap", data)

    def read() -> None:
        opened = open_recording(path)
        for _ in opened.items():
            pass

    refused_or_read(read)
    refused_or_read(lambda: summarise(open_recording(path)))
    refused_or_read(lambda: open_recording(path).meta.settings)
    refused_or_read(lambda: open_recording(path).meta.suit)
    refused_or_read(lambda: open_recording(path).meta.rig)
    refused_or_read(lambda: open_recording(path).meta.clock_table)
    refused_or_read(lambda: open_recording(path).meta.host)


def recorded_suit(data: bytes) -> None:
    """What is read is what would be written."""

    def read() -> None:
        suit = decode_suit(data)
        assert encode_suit(decode_suit(encode_suit(suit))) == encode_suit(suit)

    refused_or_read(read)


def recorded_frame(data: bytes) -> None:
    """A frame, or ``ValueError``."""
    try:
        frame = decode_skeleton_frame(data)
    except ValueError:
        return
    encode_skeleton_frame(frame)
