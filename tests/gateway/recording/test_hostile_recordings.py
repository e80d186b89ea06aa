"""Recordings that somebody made to do harm, or that were damaged so."""

from __future__ import annotations

import json
import resource
import struct
from datetime import UTC, datetime

import numpy as np
import pytest
import zstandard
from mcap.records import Chunk
from pydantic import ValidationError

from devices.link import Chunk as LinkChunk
from devices.link import Framing
from devices.recording_file import DAMAGE, LARGEST_CHUNK, RecordingError, chunk_records
from devices.recording_writer import RecordingWriter, session_record
from gateway.body.rig import load_rig
from gateway.errors import SettingsError
from gateway.recording import open_recording
from gateway.recording.files import Contents, SessionFiles
from gateway.recording.snapshot import decode_suit, encode_suit
from gateway.settings import RecordingSettings

MOST = 100
"""Records in a chunk that are read."""


def chunk_of(data, compression="zstd", declared=None):
    packed = zstandard.ZstdCompressor().compress(data) if compression == "zstd" else data
    return Chunk(
        compression=compression,
        data=packed,
        message_end_time=0,
        message_start_time=0,
        uncompressed_crc=0,
        uncompressed_size=len(data) if declared is None else declared,
    )


def unknown_record(n):
    return struct.pack("<BQ", 0x81, n) + bytes(n)


def test_an_honest_chunk_is_read_packed_or_not():
    for compression in ("zstd", ""):
        assert chunk_records(chunk_of(unknown_record(1000), compression), MOST) == []


@pytest.mark.parametrize(
    "bomb",
    [
        chunk_of(bytes(LARGEST_CHUNK + 1)),
        chunk_of(bytes(LARGEST_CHUNK + 1), declared=1000),
        chunk_of(bytes(1 << 20), declared=100),
        chunk_of(unknown_record(100), declared=1 << 60),
        chunk_of(unknown_record(100), declared=50),
        chunk_of(unknown_record(100), compression="lz4"),
        chunk_of(unknown_record(100), compression="", declared=5),
    ],
    ids=["too large", "lies, too large", "lies", "says too much", "says too little", "lz4", "plain lies"],
)
def test_a_chunk_that_unpacks_to_more_than_it_says_is_damaged(bomb):
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(DAMAGE):
        chunk_records(bomb, MOST)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb < 2 * LARGEST_CHUNK / 1024


SUIT = json.loads(encode_suit(load_rig("single_placed")))


def array(dtype, values=(0.0, 0.0, -9.8), shape=(3,)):
    return {"dtype": dtype, "shape": list(shape), "values": list(values)}


@pytest.mark.parametrize(
    "gravity",
    [
        array("3*(f8,i4"),
        array("O"),
        array("V1000000000"),
        array("U9"),
        array("(1000000,1000000)f8"),
        array(["f8"]),
        array("<f8", shape=(1 << 40,)),
        array("<f8", shape=("x",)),
        array("<i8", values=(1e300, 0, 0)),
        3,
    ],
    ids=lambda gravity: str(gravity)[:40],
)
def test_found_by_fuzzing_a_type_of_numbers_that_is_an_expression(gravity):
    """numpy read it as one: SyntaxError came out of ``decode_suit``."""
    text = json.dumps({**SUIT, "gravity": gravity}).encode()
    try:
        suit = decode_suit(text)
    except SettingsError:
        return
    assert not isinstance(suit.gravity, np.ndarray)


def test_json_that_nests_as_deep_as_the_stack():
    with pytest.raises(SettingsError):
        decode_suit(b"[" * 200_000)


def recording_of(folder, attachments=None, **session):
    path = folder / "made.mcap"
    keys = session_record({"suit": Framing.BYTE_STREAM}, session="s", **session)
    with RecordingWriter(path, keys, attachments or {}, 0):
        pass
    return open_recording(path)


def test_found_by_fuzzing_texts_that_are_none(tmp_path):
    """They were decoded without looking: UnicodeDecodeError."""
    damaged = dict.fromkeys(("rig.yaml", "body.yaml", "clock_table.yaml", "host.json"), b"a: \x89")
    meta = recording_of(tmp_path, damaged).meta
    for name in ("rig", "body", "clock_table"):
        with pytest.raises(SettingsError, match=f"'{name}.yaml' is damaged"):
            getattr(meta, name)
    assert meta.host == {}


@pytest.mark.parametrize("length", [1 << 40, 1 << 63, (1 << 64) - 1])
def test_found_by_fuzzing_a_length_beyond_any_memory(tmp_path, length):
    """The library asked for so many bytes: OverflowError."""
    path = tmp_path / "made.mcap"
    keys = session_record({"suit": Framing.BYTE_STREAM}, session="s")
    with RecordingWriter(path, keys, {}, 0) as writer:
        writer.add_chunk(LinkChunk(b"abc", 5, "suit"), Framing.BYTE_STREAM)
    data = bytearray(path.read_bytes())
    place = data.index(b"zstd") + len(b"zstd")  # of a chunk, how long its packed records are
    packed = int.from_bytes(data[place : place + 8], "little")
    assert packed < 1000
    data[place : place + 8] = length.to_bytes(8, "little")
    path.write_bytes(data)
    recording = open_recording(path)
    assert list(recording.items()) == []
    assert "read up to byte" in recording.defect


def test_a_beginning_that_is_no_number_is_refused(tmp_path):
    with pytest.raises(SettingsError, match="'begun_utc_ns' is no number"):
        assert recording_of(tmp_path, begun_utc_ns="yesterday").meta


NAMES = (
    "../x",
    "..",
    "/etc/passwd",
    "a/b",
    "a\\b",
    "a\0b",
    "a\n",
    "",
    " ",
    "-rf",
    "_x",
    ".hidden",
    "x" * 65,
    "naïve",
    "ａ",
    "a\u2215b",
    "a\u202eb",
    "con:",
    "~root",
    "$HOME",
    "*",
)


@pytest.mark.parametrize("name", NAMES, ids=repr)
def test_a_name_that_could_mean_another_place_is_refused(name, tmp_path):
    contents = Contents({}, {}, "0", True)
    with pytest.raises(RecordingError, match="is no name for a recording"):
        SessionFiles(RecordingSettings(folder=str(tmp_path / "in")), contents, name)
    with pytest.raises(ValidationError):
        RecordingSettings(name=name)
    assert list(tmp_path.iterdir()) == []


def test_a_file_or_a_link_that_stands_there_is_never_written_to(tmp_path, monkeypatch):
    """A link laid where the next recording would go must not lead it elsewhere."""
    now = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
    monkeypatch.setattr("gateway.recording.files.datetime", type("Fixed", (), {"now": lambda _zone: now}))
    target = tmp_path / "precious"
    target.write_text("untouched")
    folder = tmp_path / "in"
    folder.mkdir()
    (folder / "20260102T030405Z_walk.mcap").symlink_to(target)
    (folder / "20260102T030405Z_walk_2.mcap").write_text("another")
    (folder / "20260102T030405Z_walk_3.mcap").symlink_to(tmp_path / "nowhere")
    settings = RecordingSettings(folder=str(folder), min_free_mb=0, warn_free_mb=0)
    files = SessionFiles(settings, Contents({}, {}, "0", True), "walk")
    files.close()
    assert files.path.name == "20260102T030405Z_walk_4.mcap"
    assert (target.read_text(), (folder / "20260102T030405Z_walk_2.mcap").read_text()) == (
        "untouched",
        "another",
    )
    assert not (tmp_path / "nowhere").exists()
