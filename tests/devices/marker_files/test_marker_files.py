"""Marker files: real ones in every byte order, damaged ones, and the message stream."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.link import Chunk
from devices.links.marker_file_link import trial_chunks
from devices.marker_files import MarkerTrial, read_markers
from devices.marker_files.c3d_parameters import DEC, INTEL, MIPS, floats
from devices.marker_messages import MarkerReceiver, encode_markers
from devices.vendor_formats.sheets import FormatError

DATA = Path(os.environ.get("MOCAP_DATA", Path(__file__).parents[4] / "shared" / "data"))
needs_data = pytest.mark.skipif(not (DATA / "c3d_formats").is_dir(), reason="recordings are not here")


@needs_data
def test_all_byte_orders_give_one_result() -> None:
    trials = [read_markers(path) for path in sorted((DATA / "c3d_formats").glob("*.c3d"))]
    assert len(trials) == 6
    for trial in trials[1:]:
        assert trial.labels == trials[0].labels
        assert trial.rate_hz == trials[0].rate_hz
        # integers are rounded to the file's scale, a tenth of a millimetre here
        np.testing.assert_allclose(trial.positions, trials[0].positions, atol=1e-4)
    assert np.nanmax(np.abs(trials[0].positions)) < 10.0


@needs_data
def test_c3d_agrees_with_another_reader() -> None:
    ezc3d = pytest.importorskip("ezc3d")
    path = DATA / "c3d_btk_pig" / "PiG_Motion-FlatFoot-Full.c3d"
    other = ezc3d.c3d(str(path))["data"]["points"][:3].transpose(2, 1, 0) * 1e-3
    np.testing.assert_array_equal(read_markers(path).positions, other)


@needs_data
@pytest.mark.parametrize("share", [0.0, 0.0005, 0.003, 0.006])
@pytest.mark.parametrize("name", ["Eb015pi", "Eb015sr", "Eb015vr"])
def test_a_truncated_c3d_is_one_clear_error(tmp_path: Path, name: str, share: float) -> None:
    content = (DATA / "c3d_formats" / f"{name}.c3d").read_bytes()
    path = tmp_path / "cut.c3d"
    path.write_bytes(content[: int(0.98 * share * len(content))])
    with pytest.raises(FormatError, match=r"cut\.c3d.*(bytes|cut off|byte)") as caught:
        read_markers(path)
    assert "\n" not in str(caught.value)


@needs_data
@pytest.mark.parametrize("name", ["Eb015pi", "Eb015sr", "Eb015vr"])
def test_of_a_c3d_that_is_cut_off_the_whole_frames_are_taken(tmp_path: Path, name: str) -> None:
    whole = DATA / "c3d_formats" / f"{name}.c3d"
    content, path = whole.read_bytes(), tmp_path / "cut.c3d"
    path.write_bytes(content[: len(content) // 2])
    expected, found = read_markers(whole), read_markers(path)
    assert expected.n_frames / 3 < found.n_frames < expected.n_frames
    np.testing.assert_array_equal(found.positions, expected.positions[: found.n_frames])
    assert expected.notes == ()
    (note,) = found.notes
    assert f"{found.n_frames} whole frames of the {expected.n_frames}" in note


@needs_data
def test_a_damaged_c3d_never_raises_anything_else(tmp_path: Path) -> None:
    content = bytearray((DATA / "c3d_formats" / "Eb015pi.c3d").read_bytes())
    generator = np.random.default_rng(0)
    path = tmp_path / "damaged.c3d"
    refused = 0
    for _ in range(60):
        damaged = bytearray(content)
        for at in generator.integers(0, 5000, 8):
            damaged[at] = int(generator.integers(256))
        path.write_bytes(damaged)
        try:
            read_markers(path)
        except FormatError:
            refused += 1
    assert refused > 0


@given(st.lists(st.floats(-1e6, 1e6, width=32), min_size=1, max_size=20))
def test_floats_of_all_processors(values: list[float]) -> None:
    numbers = np.array(values, dtype=np.float32)
    numbers[np.abs(numbers) < 1e-30] = 0.0  # a VAX has no denormal numbers
    halves = (numbers * np.float32(4)).astype("<f4").view("<u2").reshape(-1, 2)[:, ::-1]
    vax = np.ascontiguousarray(halves).tobytes()
    assert floats(numbers.astype("<f4").tobytes(), INTEL).tolist() == numbers.tolist()
    assert floats(numbers.astype(">f4").tobytes(), MIPS).tolist() == numbers.tolist()
    assert floats(vax, DEC).tolist() == numbers.tolist()


@needs_data
def test_trc_gaps_units_and_errors(tmp_path: Path) -> None:
    source = DATA / "trc_opensim" / "marker_trajectories.trc"
    trial = read_markers(source)
    assert (trial.n_frames, len(trial.labels), trial.rate_hz) == (151, 41, 60.0)
    np.testing.assert_allclose(trial.positions[0, 0], [0.617247620, 1.055275020, 0.170781980])
    assert read_markers(DATA / "trc_opensim" / "markers_walk.trc").positions.shape == (238, 41, 3)
    lines = source.read_text().splitlines()
    for edit, message in [
        (lines[:6], "cut off: no frame behind its header"),
        ([*lines[:6], re.sub(r"\d+\.\d+", "wide", lines[6]), *lines[7:]], "line 7: 'wide' and others are no"),
        ([*lines[:6], lines[6] + "\t1", *lines[7:]], "line 7: 125 coordinates where 123 are wanted"),
        ([*lines[:2], lines[2].replace("mm", "ell"), *lines[3:]], "Units is 'ell'"),
        (["nothing", "at all", *lines[2:]], "line 1: not a TRC file"),
    ]:
        path = tmp_path / "t.trc"
        path.write_text("\n".join(edit))
        with pytest.raises(FormatError, match=message):
            read_markers(path)


@needs_data
@pytest.mark.parametrize(
    ("change", "encoding"),
    [
        (lambda lines: [*lines[:5], *[line.replace(".", ",") for line in lines[5:]]], "utf-8"),
        (lambda lines: lines, "utf-16"),
        (lambda lines: lines, "utf-8-sig"),
        (lambda lines: [*lines[:4], *lines[5:]], "utf-8"),
        (lambda lines: [*lines[:5], "", *lines[5:]], "utf-8"),
        (lambda lines: [line + "\r" for line in lines], "utf-8"),
        (lambda lines: [*lines[:3], re.sub(r"\t([LR])\.", r"\tBob:\1.", lines[3]), *lines[4:]], "utf-8"),
        (lambda lines: [*lines[:3], re.sub(r"\t+", r"\t", lines[3]), *lines[4:]], "utf-8"),
        (lambda lines: [*lines[:5], *[re.sub(r"\b(\d)(\d{3}\.)", r"\1,\2", x) for x in lines[5:]]], "utf-8"),
        (lambda lines: [*lines[:2], lines[2].replace("mm", "Millimetres"), *lines[3:]], "utf-8"),
    ],
    ids=[
        "comma",
        "utf-16",
        "mark",
        "no X1 Y1",
        "blank line",
        "crlf",
        "prefix",
        "one tab",
        "thousands",
        "unit",
    ],
)
def test_a_trc_as_other_programs_write_it(tmp_path: Path, change, encoding: str) -> None:
    source = DATA / "trc_opensim" / "marker_trajectories.trc"
    path = tmp_path / "t.trc"
    path.write_text("\n".join(change(source.read_text().splitlines())), encoding=encoding, newline="\n")
    expected, found = read_markers(source), read_markers(path)
    assert found.labels == expected.labels
    np.testing.assert_array_equal(found.positions, expected.positions)


@needs_data
@pytest.mark.parametrize(
    ("change", "n_frames", "note"),
    [
        (lambda lines: lines[:100], 94, "94 frames, of which its header tells 151"),
        (lambda lines: [*lines, "152" + lines[-1][3:]], 152, "152 frames, of which its header tells 151"),
        (lambda lines: [*lines[:-1], lines[-1][:500]], 150, "the last one, is cut off: left out"),
        (lambda lines: [*lines, "# written by a program"], 151, "text and no frames: left out"),
        (
            lambda lines: [*lines[:2], re.sub(r"\b41\b", "44", lines[2]), *lines[3:]], 151,
            "names 41 markers, NumMarkers in line 3 is 44",
        ),
    ],
    ids=["early", "late", "mid line", "text", "miscounted"],
)  # fmt: skip
def test_a_trc_whose_header_does_not_fit_is_taken_and_told(tmp_path: Path, change, n_frames, note) -> None:
    source = DATA / "trc_opensim" / "marker_trajectories.trc"
    path = tmp_path / "t.trc"
    path.write_text("\n".join(change(source.read_text().splitlines())))
    found = read_markers(path)
    assert found.n_frames == n_frames
    assert note in " ".join(found.notes)
    np.testing.assert_array_equal(found.positions[:94], read_markers(source).positions[:94])


def test_what_is_no_marker_file_is_refused_with_what_to_do(tmp_path: Path) -> None:
    table = tmp_path / "walk.xlsx"
    table.write_bytes(b"PK rows")
    with pytest.raises(FormatError, match=r"end in \.c3d, \.trc, .*: have the program .* export"):
        read_markers(table)
    with pytest.raises(FormatError, match="is a folder: name the marker files in it"):
        read_markers(tmp_path)


@needs_data
@pytest.mark.parametrize(
    ("source", "name"),
    [
        ("trc_opensim/marker_trajectories.trc", "walk.c3d"),
        ("trc_opensim/marker_trajectories.trc", "walk.csv"),
        ("c3d_pycgm/Static_trial.c3d", "stand"),
        ("c3d_pycgm/Static_trial.c3d", "stand.trc"),
    ],
)
def test_a_file_counts_for_what_it_holds_whatever_its_name(tmp_path: Path, source: str, name: str) -> None:
    (tmp_path / name).write_bytes((DATA / source).read_bytes())
    np.testing.assert_array_equal(
        read_markers(tmp_path / name).positions, read_markers(DATA / source).positions
    )


@needs_data
@pytest.mark.parametrize("spelt", ["#N/A", "-nan(ind)", "1.#QNAN", "VOID", "?"])
def test_a_coordinate_that_is_text_was_not_seen_and_is_told(tmp_path: Path, spelt: str) -> None:
    lines = (DATA / "trc_opensim" / "marker_trajectories.trc").read_text().splitlines()
    path = tmp_path / "t.trc"
    path.write_text("\n".join([*lines[:6], lines[6].replace("617.247620", spelt), *lines[7:]]))
    found = read_markers(path)
    assert np.isnan(found.positions[0, 0]).all()
    assert f"1 coordinates are no numbers ('{spelt}')" in found.notes[-1]


def _trial() -> MarkerTrial:
    positions = np.random.default_rng(1).normal(size=(5, 3, 3))
    positions[2, 1] = np.nan
    return MarkerTrial("t", ("A", "B", "*7"), 100.0, positions)


def test_messages_carry_a_trial_bit_for_bit() -> None:
    trial = _trial()
    receiver = MarkerReceiver()
    stream = b"".join(chunk.data for chunk in trial_chunks(trial, 1000, "m"))
    got = []
    for at in range(0, len(stream), 17):  # in pieces that end anywhere
        got += receiver.receive(Chunk(stream[at : at + 17], 10**9, "m"))
    assert [message.sequence for message in got] == [0, 1, 2, 3, 4]
    assert got[3].time_ns == 1000 + 30_000_000
    assert got[0].markers["A"] == tuple(trial.positions[0, 0])
    assert "B" not in got[2].markers
    assert got[1].unlabelled == (tuple(trial.positions[1, 2]),)
    assert not receiver.dropped


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b"{", "not_json"),
        (b"[1]", "no_markers"),
        (b'{"markers": {"A": [1, 2]}}', "bad_number"),
        (b'{"markers": {"A": [1, 2, "x"]}}', "bad_number"),
        (b'{"markers": {"A": [1, 2, 1e9]}}', "bad_number"),
        (b'{"markers": {}, "unit": "ell"}', "bad_unit"),
        (b'{"markers": {}, "unlabelled": 3}', "bad_number"),
        (b'{"markers": {}, "time_ns": -4}', "bad_number"),
    ],
)
def test_what_cannot_be_read_is_counted(line: bytes, reason: str) -> None:
    receiver = MarkerReceiver()
    assert receiver.receive(Chunk(line + b"\n", 5, "m")) == []
    assert dict(receiver.dropped) == {reason: 1}


@given(st.binary(max_size=200))
def test_no_bytes_raise(data: bytes) -> None:
    MarkerReceiver().receive(Chunk(data + b"\n", 5, "m"))


def test_a_senders_clock_is_set_by_the_least_delay() -> None:
    receiver = MarkerReceiver()
    arrivals = [(0.00, 5_000_000), (0.01, 11_000_000), (0.02, 25_000_000)]
    got = []
    for time_s, arrived_ns in arrivals:
        line = json.dumps({"time_s": time_s, "markers": {"A": [0, 0, 0]}}).encode()
        got += receiver.receive(Chunk(line, 1000_000_000 + arrived_ns, "m"))
    told = [message.time_ns - 1000_000_000 for message in got]
    assert told == pytest.approx([5_000_000, 11_000_000, 21_000_000], abs=5_000)  # drift is allowed for


def clocked(receiver: MarkerReceiver, time_s: float, arrived_ns: int, **more: int) -> int:
    line = json.dumps({"time_s": time_s, "markers": {"A": [0, 0, 0]}, **more}).encode()
    return receiver.receive(Chunk(line, arrived_ns, "m"))[0].time_ns


def test_a_senders_clock_that_drifts_is_followed_for_an_hour() -> None:
    """By 100 ppm, with a delay of 2 to 12 ms: the instants stay within 2 ms of the instant."""
    receiver, delays = MarkerReceiver(), np.random.default_rng(1).uniform(2e6, 12e6, 36_000)
    for k, delay_ns in enumerate(delays.tolist()):
        told = clocked(receiver, k * 0.1, round(k * 1e8 * 1.0001 + delay_ns))
    assert abs(told - len(delays[1:]) * 1e8 * 1.0001 - 2e6) < 2e6


def test_a_senders_clock_that_counts_from_anew_is_told_from_an_overtaken_datagram() -> None:
    receiver = MarkerReceiver()
    assert clocked(receiver, 50.0, 10_000_000_000, sequence=1) == 10_000_000_000
    assert clocked(receiver, 0.0, 11_000_000_000, sequence=2) == 11_000_000_000
    assert clocked(receiver, 0.1, 11_100_000_000, sequence=3) == pytest.approx(11_100_000_000, abs=30_000)
    assert clocked(receiver, 0.0, 11_200_000_000, sequence=4) == 11_200_000_000  # a fall by 0.1 s
    late = json.dumps({"time_s": -0.01, "markers": {}, "sequence": 3}).encode()
    assert receiver.receive(Chunk(late, 11_210_000_000, "m")) == []
    assert receiver.dropped == {"not_later": 1}


def test_a_message_from_the_past_is_dropped() -> None:
    receiver = MarkerReceiver()
    line = encode_markers(0, 50, ["A"], [[0.0, 0.0, 0.0]])
    assert len(receiver.receive(Chunk(line + line, 60, "m"))) == 1
    assert receiver.dropped["not_later"] == 1


def _trc(*head: str, rows: str = "1\t0.00\t1\t2\t3\n2\t0.02\t4\t5\t6\n") -> str:
    names = "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits"
    return "\n".join([*head, names, "{values}", "Frame#\tTime\tLASI", "\t\tX1\tY1\tZ1", rows])


@pytest.mark.parametrize(
    ("text", "rate_hz", "last", "notes"),
    [
        (_trc("PathFileType").replace("{values}", "50\t50\t2\t1\tmm"), 50.0, 6e-3, 0),
        (_trc("", "# by a program", "pathfiletype").replace("{values}", "50\t50\t2\t1\tmm"), 50.0, 6e-3, 0),
        (_trc().replace("{values}", "50\t50\t2\t1\tm"), 50.0, 6.0, 0),
        (_trc("PathFileType").replace("{values}", "0\t0\t2\t1\tmm"), 50.0, 6e-3, 1),
        (_trc("PathFileType").replace("{values}", "50\t50\t2\t1\t"), 50.0, 6.0, 1),
        (_trc("PathFileType").replace("\tUnits", "").replace("{values}", "50\t50\t2\t1"), 50.0, 6.0, 1),
        (
            _trc("PathFileType", rows="1\t0.00\t1000\t2\t3\n2\t0.02\t4\t5\t6\n")
            .replace("LASI", "LASI\tLASI\tLASI")
            .replace("{values}", "50\t50\t2\t1\t"),
            50.0,
            6e-3,
            0,
        ),
    ],
)
def test_a_header_may_be_incomplete(
    tmp_path: Path, text: str, rate_hz: float, last: float, notes: int
) -> None:
    path = tmp_path / "t.trc"
    path.write_text(text)
    trial = read_markers(path)
    assert (trial.labels, trial.rate_hz, len(trial.notes)) == (("LASI",), pytest.approx(rate_hz), notes)
    assert trial.positions[1, 0, 2] == pytest.approx(last)


def test_a_row_may_end_before_markers_that_were_not_seen(tmp_path: Path) -> None:
    labels = [f"M{n}" for n in range(10)]
    full = "\t".join(str(n) for n in range(30))
    rows = "\n".join([f"1\t0.00\t{full}", "2\t0.02\t" + "\t".join(full.split("\t")[:27]), f"3\t0.04\t{full}"])
    text = _trc("PathFileType", rows=rows).replace("LASI", "\t\t\t".join(labels))
    path = tmp_path / "t.trc"
    path.write_text(text.replace("{values}", "50\t50\t3\t10\tmm"))
    trial = read_markers(path)
    assert np.isfinite(trial.positions[:, :9]).all()
    assert np.isnan(trial.positions[:, 9]).all(axis=1).tolist() == [False, True, False]
