"""Tables as loggers and spreadsheets leave them: rounded times, rows twice or late, quotes, a slower or dead
magnetometer."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from devices.emulators.playback import play
from devices.vendor_formats.column_map import ColumnMap, read_mapped_csv
from devices.vendor_formats.gaps import index_of_times, rate_of
from devices.vendor_formats.mvnx import read_mvnx
from devices.vendor_formats.sheets import FormatError
from devices.vendor_formats.tracks import labels_of
from firmware_protocol import FrameDecoder, InertialSampleFine, PacketDecoder
from gateway.imports.formats import ReadOptions, detected

MODULE = {
    "name": "pelvis",
    "specific_force": {"columns": ["ax", "ay", "az"]},
    "angular_rate": {"columns": ["gx", "gy", "gz"]},
    "magnetic_field": {"columns": ["mx", "my", "mz"]},
}
HEAD = "t,ax,ay,az,gx,gy,gz,mx,my,mz"


def rows_of(count, field="0.3,0,-0.9"):
    return [f"{k * 0.01:.2f},0,0,9.81,0,0,{k * 0.001:.3f},{field}" for k in range(count)]


def read(tmp_path, rows, head=HEAD):
    path = tmp_path / "a.csv"
    path.write_text("\n".join([head, *rows]) + "\n")
    return read_mapped_csv(
        path, ColumnMap.model_validate({"time": {"column": "t"}, "modules": [MODULE]}), tmp_path
    )


def samples_of(recording):
    decoder = PacketDecoder(FrameDecoder())
    packets = [packet for sent in play(recording) for packet in decoder.feed(sent.data)]
    return [packet.packet for packet in packets if packet.kind == InertialSampleFine.KIND]


@pytest.mark.parametrize("rate_hz", [40, 60, 256, 300, 400, 450, 600, 700, 1000])
def test_whole_milliseconds_show_the_rate_and_no_loss(rate_hz, tmp_path):
    times = np.floor(np.arange(2000) * 1e3 / rate_hz + 1e-6) * 1e-3
    assert index_of_times(times)[-1] == 1999
    assert rate_of(np.diff(times), tmp_path) == pytest.approx(rate_hz, rel=2e-3)


@pytest.mark.parametrize("share", [0.02, 0.1, 0.2])
@pytest.mark.parametrize("rate_hz", [50, 100, 1000])
def test_what_was_lost_of_exact_times_is_counted(rate_hz, share, tmp_path):
    kept = np.flatnonzero(np.random.default_rng(1).random(5000) > share)
    times = np.round(kept / rate_hz, 3)
    assert rate_of(np.diff(times), tmp_path) == rate_hz
    np.testing.assert_array_equal(index_of_times(times), kept - kept[0])


def test_rows_that_are_there_twice_or_late_are_put_right_and_noted(tmp_path):
    rows = rows_of(200)
    slips = [*rows[:50], rows[49], *rows[50:120], rows[121], rows[120], *rows[122:]]
    recording = read(tmp_path, slips)
    np.testing.assert_allclose(recording.modules[0].angular_rate[:, 2], np.arange(200) * 0.001)
    (note,) = recording.notes
    assert "1 rows were there twice and left out, 1 that came late were put in their place" in note


def test_two_captures_in_one_file_are_refused_with_what_to_do(tmp_path):
    with pytest.raises(FormatError, match=r"row 301: 't' goes back \(1 of 600 rows.*split a file"):
        read(tmp_path, rows_of(300) + rows_of(300))


def test_times_that_stand_still_are_refused_with_what_to_do(tmp_path):
    with pytest.raises(FormatError, match=r"row 2 has the same 't' .*read by its rate_hz"):
        read(tmp_path, [row for row in rows_of(100) for _ in range(2)])


def test_a_slower_magnetometer_costs_no_sample(tmp_path):
    rows = [row if k % 10 == 0 else row.rsplit(",", 3)[0] + ",,," for k, row in enumerate(rows_of(100))]
    sent = samples_of(read(tmp_path, rows))
    assert len(sent) == 100
    assert [sample.magnetic_field is not None for sample in sent] == [k % 10 == 0 for k in range(100)]


def test_a_magnetometer_that_gives_zeros_is_none(tmp_path):
    sent = samples_of(read(tmp_path, rows_of(20, field="0,0,0")))
    assert len(sent) == 20
    assert all(sample.magnetic_field is None for sample in sent)


@pytest.mark.parametrize("wild", ["inf", "1e9", "nan"])
def test_a_wild_reading_of_the_field_leaves_the_others_as_they_are(wild, tmp_path):
    rows = rows_of(50)
    rows[20] = rows[20].rsplit(",", 1)[0] + f",{wild}"
    sent = samples_of(read(tmp_path, rows))
    assert len(sent) == 50
    assert np.linalg.norm(sent[3].magnetic_field) == pytest.approx(50, rel=1e-3)


def test_quotes_around_names_and_numbers(tmp_path):
    quoted = ['"' + row.replace(",", '","') + '"' for row in rows_of(20)]
    recording = read(tmp_path, quoted, head='"' + HEAD.replace(",", '","') + '"')
    assert recording.sampling_rate_hz == 100
    assert len(recording.modules[0].times) == 20


def test_what_no_sensor_reads_counts_as_lost_and_is_noted(tmp_path):
    rows = rows_of(60)
    rows[10] = rows[10].replace("9.81", "1e300")
    rows[20] = "0.20,0,0,9.81,9999,0,0,0.3,0,-0.9"
    recording = read(tmp_path, rows)
    assert len(samples_of(recording)) == 58
    assert "2 rows beyond 4000 m/s² or 350 rad/s" in recording.notes[0]


def test_units_that_cannot_be_right_are_doubted(tmp_path):
    (note,) = read(tmp_path, [row.replace("9.81", "1.00") for row in rows_of(60)]).notes
    assert "the specific force of 'pelvis' is usually 1 m/s² long, and should be 9.8 at rest" in note
    (note,) = read(tmp_path, [f"{k * 0.01:.2f},0,0,9.81,90,0,0,0.3,0,-0.9" for k in range(60)]).notes
    assert "the angular rate of 'pelvis' is usually 90 rad/s: is its unit 'rad/s'?" in note
    assert not read(tmp_path, rows_of(60)).notes


def test_a_line_of_units_below_the_names_is_passed_over_and_noted(tmp_path):
    rows = rows_of(20)
    found = read(tmp_path, ["s,m/(s^2),m/(s^2),m/(s^2),deg/s,deg/s,deg/s,local,local,local", *rows])
    assert len(found.modules[0].times) == 20
    assert "line 2: holds no number" in found.notes[0]
    with pytest.raises(FormatError, match=r"line 5, column 'ax'"):
        read(tmp_path, [HEAD, *rows[:2], rows[2].replace(",0,", ",x,", 1)])


@pytest.mark.parametrize("time", ["2021-03-01 10:11:05.01", "10:11:05.01"])
def test_times_of_a_clock_are_refused_with_what_to_do(time, tmp_path):
    rows = [f"{time},{row.partition(',')[2]}" for row in rows_of(5)]
    with pytest.raises(FormatError, match=r"line 2, column 't': times are numbers of s.*rate_hz"):
        read(tmp_path, rows)


def test_thousandths_of_gravity(tmp_path):
    module = {**MODULE, "specific_force": {"columns": ["ax", "ay", "az"], "unit": "mg"}}
    path = tmp_path / "a.csv"
    path.write_text("\n".join([HEAD, *(row.replace("9.81", "1000") for row in rows_of(5))]))
    columns = ColumnMap.model_validate({"time": {"column": "t"}, "modules": [module]})
    force = read_mapped_csv(path, columns, tmp_path).modules[0].specific_force
    np.testing.assert_allclose(force, np.tile([0, 0, 9.80665], (5, 1)))


@pytest.mark.parametrize(
    ("stems", "labels"),
    [
        (("left thigh", "left shank"), ["left thigh", "left shank"]),
        (("walk_left_thigh", "walk_left_shank"), ["left_thigh", "left_shank"]),
        (("walk_pelvis", "walk_thorax"), ["pelvis", "thorax"]),
        (("MT-001_00B4", "MT-001_00B5"), ["00B4", "00B5"]),
    ],
)
def test_names_of_files_keep_the_side_that_they_share(stems, labels):
    assert labels_of([Path(f"{stem}.csv") for stem in stems]) == labels


def test_commas_that_part_cells_and_decimals_alike_are_refused(tmp_path):
    """All columns after the first would be others, without a word."""
    rows = [row.replace(".", ",") for row in rows_of(50)]
    columns = ColumnMap.model_validate({"rate_hz": 100, "modules": [MODULE]})
    path = tmp_path / "odd.csv"
    path.write_text("\n".join([HEAD, *rows]))
    with pytest.raises(FormatError, match=r"line 2: has \d+ cells for 10 columns: .*semicolons"):
        read_mapped_csv(path, columns, tmp_path)
    rows = [row.replace(",", ";").replace(".", ",") for row in rows_of(50)]
    path.write_text("\n".join([HEAD.replace(",", ";"), *rows]))
    assert len(samples_of(read_mapped_csv(path, columns, tmp_path))) == 50


def test_a_thousands_separator_is_no_end_of_a_cell(tmp_path):
    rows = rows_of(50)
    rows[10] = rows[10].replace("9.81", '"1,009.81"')
    with pytest.raises(FormatError, match=r"line 12, column 'az': a number is wanted, not '1,009\.81'"):
        read(tmp_path, rows)


def test_a_column_that_is_there_twice_is_not_chosen_from(tmp_path):
    with pytest.raises(FormatError, match="column 'ax' is there twice"):
        read(tmp_path, [f"{row},0" for row in rows_of(50)], f"{HEAD},ax")


@pytest.mark.parametrize("rate_hz", [1e-300, 1e300, float("nan")])
def test_a_rate_that_no_module_samples_at_is_refused_in_a_map(rate_hz):
    with pytest.raises(ValidationError, match="rate_hz"):
        ColumnMap.model_validate({"rate_hz": rate_hz, "modules": [MODULE]})


@pytest.mark.parametrize("kind", ["device", "pipe"])
def test_what_may_have_no_end_is_refused(kind, tmp_path):
    """A map that named /dev/zero filled the memory; a pipe that nobody fills was waited for."""
    endless = Path("/dev/zero")
    if kind == "pipe":
        endless = tmp_path / "pipe"
        os.mkfifo(endless)
    module = MODULE | {"file": str(endless)}
    columns = ColumnMap.model_validate({"time": {"column": "t"}, "modules": [module]})
    with pytest.raises(FormatError, match="is a pipe or a device"):
        read_mapped_csv(None, columns, tmp_path)
    with pytest.raises(FormatError, match="is a pipe or a device"):
        read_mvnx(endless)
    with pytest.raises(FormatError, match="is a pipe or a device"):
        detected([endless], ReadOptions())
