"""The chunk log: golden bytes, truncation at every byte, damage, appending."""

from __future__ import annotations

import errno
import os
import resource
import signal
import struct
import subprocess
import sys
import zlib

import pytest

from devices.chunk_log import ChunkLogError, ChunkLogReader, ChunkLogWriter, LoggedLink
from devices.link import Chunk, Framing

LINKS = [LoggedLink("suit", Framing.BYTE_STREAM), LoggedLink("büs", Framing.CAN)]
CHUNKS = [
    Chunk(b"one", 1_700_000_000_000_000_000, "suit"),
    Chunk(b"", -5, "büs"),
    Chunk(bytes(range(0, 256, 8)), 2**62, "suit"),
]


def write_log(path, chunks=CHUNKS, links=LINKS) -> None:
    with ChunkLogWriter(path, links) as log:
        for chunk in chunks:
            log.append(chunk)


def crc(data: bytes) -> bytes:
    return struct.pack("<I", zlib.crc32(data))


def test_layout_is_as_documented(tmp_path):
    path = tmp_path / "log"
    write_log(path, CHUNKS[:1])
    header = b"mocapch\n" + b"\x01\x02" + b"\x01\x04suit" + b"\x02\x04b\xc3\xbcs"
    head = struct.pack("<qBI", 1_700_000_000_000_000_000, 0, 3)
    assert path.read_bytes() == header + crc(header) + head + crc(head + b"one") + b"one"


def test_what_was_written_is_read(tmp_path):
    write_log(tmp_path / "log")
    reader = ChunkLogReader(tmp_path / "log")
    assert reader.links == tuple(LINKS)
    for _ in range(2):  # from the start each time
        assert list(reader) == CHUNKS
    assert reader.defect is None


def test_cut_off_anywhere_all_whole_chunks_are_read_and_the_tail_reported(tmp_path):
    path = tmp_path / "log"
    write_log(path, [])
    ends = [path.stat().st_size]
    for chunk in CHUNKS:
        write_log(path, [chunk])
        ends.append(path.stat().st_size)
    whole = path.read_bytes()
    for size in range(ends[0], len(whole)):
        path.write_bytes(whole[:size])
        reader = ChunkLogReader(path)
        n_whole = sum(end <= size for end in ends) - 1
        assert list(reader) == CHUNKS[:n_whole]
        if size in ends:
            assert reader.defect is None
        else:
            assert "cut off inside the" in reader.defect
            assert f"at byte {ends[n_whole]}; all before that was read" in reader.defect


def test_damaged_byte_stops_reading_there(tmp_path):
    path = tmp_path / "log"
    write_log(path)
    whole = bytearray(path.read_bytes())
    whole[-1] ^= 1
    path.write_bytes(whole)
    reader = ChunkLogReader(path)
    assert list(reader) == CHUNKS[:2]
    assert "damaged" in reader.defect


def test_appending_cuts_off_a_broken_tail_and_goes_on(tmp_path):
    path = tmp_path / "log"
    write_log(path, CHUNKS[:2])
    with path.open("ab") as file:
        file.write(b"half a chu")
    write_log(path, CHUNKS[2:])
    reader = ChunkLogReader(path)
    assert list(reader) == CHUNKS
    assert reader.defect is None


def test_appending_to_a_log_of_other_links_is_refused(tmp_path):
    write_log(tmp_path / "log")
    with pytest.raises(ChunkLogError, match=r"is a log of suit .byte_stream., büs .can., not arm .can."):
        ChunkLogWriter(tmp_path / "log", [LoggedLink("arm", Framing.CAN)])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is not a chunk log"),
        (b"RIFF" * 10, "is not a chunk log"),
        (b"mocapch\n\x02\x00" + bytes(4), "of version 2; this program reads version 1"),
        (b"mocapch\n\x01\x01\x01\x04su", "damaged header"),
        (b"mocapch\n\x01\x00" + bytes(4), "damaged header"),
    ],
)
def test_foreign_file_is_refused(tmp_path, content, message):
    path = tmp_path / "log"
    path.write_bytes(content)
    with pytest.raises(ChunkLogError, match=message):
        ChunkLogReader(path)


def test_killed_writer_loses_nothing_it_had_appended(tmp_path):
    program = """
import os, signal, sys
from devices.chunk_log import ChunkLogWriter, LoggedLink
from devices.link import Chunk, Framing
log = ChunkLogWriter(sys.argv[1], [LoggedLink("suit", Framing.BYTE_STREAM)])
for index in range(1000):
    log.append(Chunk(b"x" * 60, index, "suit"))
os.kill(os.getpid(), signal.SIGKILL)
"""
    root = os.path.dirname(os.path.dirname(os.path.dirname(__file__)))
    finished = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "log")],
        env={**os.environ, "PYTHONPATH": root},
        check=False,
    )
    assert finished.returncode == -signal.SIGKILL
    assert [chunk.arrived_ns for chunk in ChunkLogReader(tmp_path / "log")] == list(range(1000))


def test_full_disk_leaves_the_log_whole(tmp_path):
    path = tmp_path / "log"
    old_limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    old_handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    with ChunkLogWriter(path, LINKS) as log:
        log.append(CHUNKS[0])
        try:
            # The kernel writes up to the limit and then refuses, as a disk does that fills up.
            resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 30, old_limit[1]))
            with pytest.raises(OSError, match=os.strerror(errno.EFBIG)):
                log.append(CHUNKS[2])
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, old_limit)
            signal.signal(signal.SIGXFSZ, old_handler)
        log.append(CHUNKS[1])
    reader = ChunkLogReader(path)
    assert list(reader) == CHUNKS[:2]
    assert reader.defect is None


def test_names_are_checked(tmp_path):
    with pytest.raises(ValueError, match="different names"):
        ChunkLogWriter(tmp_path / "log", [LINKS[0], LINKS[0]])
    write_log(tmp_path / "log")
    with ChunkLogWriter(tmp_path / "log", LINKS) as log, pytest.raises(KeyError):
        log.append(Chunk(b"", 0, "stranger"))
