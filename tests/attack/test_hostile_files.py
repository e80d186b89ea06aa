"""Recordings that somebody made to do harm: what is bad of them is left out and named, in no time."""

from __future__ import annotations

import json
import resource

import pytest
from mcap.writer import CompressionType, IndexType, Writer
from typer.testing import CliRunner

from devices import recording_format as fmt
from devices.recording_file import LARGEST_CHUNK, MOST_RECORDS_BEFORE, RecordingFile, parse_json
from gateway.cli.main import app

SESSION = {"format": "1", "session": "s", "links": '{"suit": "byte_stream"}', "part": "1", "name": "bad"}
ESCAPE = "\x1b]0;owned\x07\x1b[2J"


def made(path, messages=(), indexed=False, **session):
    """A file with these messages (topic, data) in one chunk."""
    index = IndexType.ALL if indexed else IndexType.NONE
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=LARGEST_CHUNK, compression=CompressionType.ZSTD, index_types=index)
        writer.start(fmt.PROFILE, "attack")
        writer.add_metadata(fmt.SESSION, {**SESSION, **session})
        channels = {}
        for topic, data in messages:
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "bytes", 0, {})
            writer.add_message(channels[topic], 0, data, 0)
        writer.finish()
    return path


def typed(*arguments):
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


@pytest.mark.parametrize("part", ["abc", "", "-1", "0", "1e3", "٣", "9" * 4000, "9" * 200])
def test_a_part_that_is_no_number_is_named_and_the_others_are_listed(tmp_path, part):
    made(tmp_path / "good.mcap")
    made(tmp_path / "bad.mcap", part=part)
    listed = typed("recordings", tmp_path)
    assert listed.exit_code == 0
    assert "good.mcap" in listed.stdout
    assert "bad.mcap" not in listed.stdout
    assert "left out" in listed.stderr
    assert "bad.mcap" in listed.stderr


@pytest.mark.parametrize(
    "session",
    [
        {"links": "[" * 100_000},
        {"links": "[" * 500 + "]" * 500},
        {"begun_utc_ns": "soon"},
        {"begun_ns": "x"},
        {"format": "[/]"},
    ],
)
def test_a_damaged_head_is_named_and_the_others_are_listed(tmp_path, session):
    made(tmp_path / "good.mcap")
    made(tmp_path / "bad.mcap", **session)
    listed = typed("recordings", tmp_path)
    assert listed.exit_code == 0
    assert "good.mcap" in listed.stdout
    assert "left out" in listed.stderr


def test_deeply_nested_events_are_left_out(tmp_path):
    deep = {"time_ns": 1, "name": "deep", "data": {"a": json.loads("[" * 300 + "]" * 300)}}
    good = {"time_ns": 1, "name": "good", "data": {}}
    messages = [
        (fmt.EVENTS, b"[" * 100_000),
        (fmt.EVENTS, json.dumps(deep).encode()),
        (fmt.STATISTICS, b'{"modules":' * 5000),
        (fmt.EVENTS, json.dumps(good).encode()),
    ]
    path = made(tmp_path / "deep.mcap", messages, indexed=True)
    for arguments in ((), ("--json",)):
        shown = typed("info", path, *arguments)
        assert shown.exit_code == 0
        assert "good" in shown.stdout
        assert "deep " not in shown.stdout


@pytest.mark.parametrize("indexed", [False, True])
def test_a_small_file_that_unpacks_to_millions_of_records_is_left_out(tmp_path, indexed):
    def nothing():
        for _ in range(200_000):
            yield fmt.CHUNKS + "suit", b""

    path = made(tmp_path / "bomb.mcap", nothing(), indexed=indexed)
    if not indexed:
        assert path.stat().st_size < 20_000
        file = RecordingFile(path)
        assert list(file.messages()) == []
        assert file.damaged_chunks == 1
        assert "damaged pieces were left out" in file.defect
    else:  # an index takes more of a file than that: it pays for its records
        assert path.stat().st_size > 200_000 * 16


def test_info_of_such_files_takes_little_time_and_memory(tmp_path):
    path = tmp_path / "bombs.mcap"
    with path.open("wb") as file:
        writer = Writer(
            file, chunk_size=1 << 22, compression=CompressionType.ZSTD, index_types=IndexType.NONE
        )
        writer.start(fmt.PROFILE, "attack")
        writer.add_metadata(fmt.SESSION, SESSION)
        channel = writer.register_channel(fmt.CHUNKS + "suit", "bytes", 0, {})
        for _ in range(500_000):
            writer.add_message(channel, 0, b"", 0)
        writer.finish()
    before = resource.getrusage(resource.RUSAGE_SELF)
    shown = typed("info", path)
    after = resource.getrusage(resource.RUSAGE_SELF)
    assert shown.exit_code == 0
    assert "left out" in shown.stdout
    assert after.ru_maxrss - before.ru_maxrss < 100_000  # kB
    assert sum(1 for _ in RecordingFile(path).messages()) <= path.stat().st_size // 8 + MOST_RECORDS_BEFORE


def test_names_in_a_recording_are_neither_obeyed_nor_markup(tmp_path):
    links = json.dumps({f"[/x]{ESCAPE}": "byte_stream"})
    event = {"time_ns": 1, "name": f"[/y]{ESCAPE}", "data": {}}
    path = made(
        tmp_path / "[red].mcap", [(fmt.EVENTS, json.dumps(event).encode())], links=links, indexed=True
    )
    shown = typed("info", path)
    assert "[/x]" in shown.stdout
    assert "[/y]" in shown.stdout
    assert "\x1b]" not in shown.stdout
    assert typed("recordings", tmp_path).exit_code == 0


@pytest.mark.parametrize("levels", [41, 990, 100_000])
def test_json_has_a_depth(levels):
    assert parse_json("[" * 40 + "]" * 40) is not None
    with pytest.raises(ValueError, match=r"40 levels"):
        parse_json("[" * levels + "]" * levels)
