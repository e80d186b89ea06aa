"""Files of other makers: what is read of good ones, and what is said of bad ones."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from devices.emulators.playback import play
from devices.recorded_tracks import RecordedTracks
from devices.vendor_formats.column_map import ColumnMap, read_mapped_csv
from devices.vendor_formats.movella_dot import read_movella_dot
from devices.vendor_formats.mvnx import read_mvnx
from devices.vendor_formats.sheets import FormatError
from devices.vendor_formats.ximu3 import read_ximu3
from devices.vendor_formats.xsens_text import read_xsens_text
from firmware_protocol import FrameDecoder, FusedSample, InertialSampleFine, PacketDecoder

NWU_TO_ENU = Rotation.from_euler("z", 90, degrees=True)


def xsens_text(counters, *, matrix=False, delimiter="\t", rate=100.0):
    turn = (
        [f"Mat[{r}][{c}]" for c in (1, 2, 3) for r in (1, 2, 3)]
        if matrix
        else [f"Quat_q{i}" for i in range(4)]
    )
    names = ["PacketCounter", "SampleTimeFine", "Acc_X", "Acc_Y", "Acc_Z", "Gyr_X", "Gyr_Y", "Gyr_Z", *turn]
    lines = [f"// Update Rate: {rate}Hz", "// Firmware Version: 4.0.2", delimiter.join(names)]
    for row, counter in enumerate(counters):
        q = Rotation.from_euler("z", row, degrees=True)
        numbers = q.as_matrix().T.ravel() if matrix else q.as_quat(scalar_first=True)
        cells = [f"{counter:05d}", "", "0.1", "0.2", "9.8", "0.01", "0.02", f"{row * 0.5:.3f}"]
        lines.append(delimiter.join([*cells, *(f"{x:.6f}" for x in numbers)]))
    return "\n".join(lines) + "\n"


MOVELLA = "sep=,\nDeviceTag:,Left Thigh\n\nPacketCounter,SampleTimeFine,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z\n"


def movella(start_us, rows, step_us=16667):
    body = (f"{n + 1},{(start_us + n * step_us) % 2**32},0,0,9.81,180,0,-90" for n in rows)
    return MOVELLA + "\n".join(body) + "\n"


def mvnx(frames=4, labels=("Pelvis", "RightUpperLeg")):
    rows = []
    for n in range(frames):
        q = Rotation.from_euler("z", 10 * n, degrees=True).as_quat(scalar_first=True)
        turns = " ".join(f"{x:.6f}" for _ in labels for x in q)
        places = " ".join(f"{x:.3f}" for _ in labels for x in (n * 0.1, 0.0, 0.9))
        rows.append(f'<frame time="{n}" index="{n}" type="normal"><orientation>{turns}</orientation>'
                    f"<position>{places}</position></frame>")  # fmt: skip
    segments = "".join(f'<segment label="{label}" id="{i + 1}"/>' for i, label in enumerate(labels))
    return (
        '<?xml version="1.0"?>\n<mvnx xmlns="http://www.xsens.com/mvn/mvnx" version="4">'
        '<subject label="A" frameRate="60" recDateMSecsSinceEpoch="1600000000000">'
        f"<segments>{segments}</segments><frames>"
        '<frame time="0" index="" type="npose"><orientation>1 0 0 0 1 0 0 0</orientation></frame>\n'
        + "\n".join(rows)
        + "</frames></subject></mvnx>"
    )


def ximu3(folder, quaternion=True):
    folder.mkdir()
    times = [1_000_000 + 20_000 * n for n in range(20) if n not in {5, 6}]
    head = "Timestamp (us),Gyroscope X (deg/s),Gyroscope Y (deg/s),Gyroscope Z (deg/s),"
    head += "Accelerometer X (g),Accelerometer Y (g),Accelerometer Z (g)\n"
    (folder / "Inertial.csv").write_text(head + "".join(f"{t},90,0,0,0,0,1\n" for t in times))
    if quaternion:
        rows = "".join(f"{t},1,0,0,0\n" for t in times)
        (folder / "Quaternion.csv").write_text("Timestamp (us),W,X,Y,Z\n" + rows)
    return folder


def write(path, text):
    path.write_text(text)
    return path


@pytest.mark.parametrize("matrix", [False, True])
@pytest.mark.parametrize("delimiter", ["\t", ";", ","])
def test_xsens_text_in_si_units_and_east_north_up(tmp_path, matrix, delimiter):
    path = write(
        tmp_path / "MT_01_00B42279.txt", xsens_text(range(10, 20), matrix=matrix, delimiter=delimiter)
    )
    recording = read_xsens_text([path])
    assert recording.sampling_rate_hz == 100
    (track,), (fused,) = recording.modules, recording.fused
    np.testing.assert_allclose(track.times, np.arange(10) / 100)
    np.testing.assert_allclose(track.angular_rate[3], [0.01, 0.02, 1.5])
    expected = NWU_TO_ENU * Rotation.from_euler("z", 7, degrees=True)
    assert (Rotation.from_quat(fused.q_es[7], scalar_first=True).inv() * expected).magnitude() < 1e-5


def test_a_gap_in_the_counter_is_loss_and_a_wrap_is_none(tmp_path):
    counters = [65533, 65534, 65535, 0, 1, 4, 5]
    other = [c % 65536 for c in range(65535, 65535 + 8)]
    paths = [
        write(tmp_path / "trial_pelvis.txt", xsens_text(counters)),
        write(tmp_path / "trial_tibia_r.txt", xsens_text(other)),
    ]
    recording = read_xsens_text(paths)
    first, second = recording.modules
    assert (first.name, second.name) == ("pelvis", "tibia_r")
    assert np.isnan(first.specific_force[:, 0]).tolist() == [False] * 5 + [True] * 2 + [False] * 2
    assert second.times[0] == pytest.approx(0.02)
    decoder = PacketDecoder(FrameDecoder())
    packets = [packet for sent in play(recording) for packet in decoder.feed(sent.data)]
    numbers = [p.sequence for p in packets if p.kind == InertialSampleFine.KIND and p.module == 0]
    assert numbers == [0, 1, 2, 3, 4, 7, 8]
    assert sum(p.kind == FusedSample.KIND for p in packets) == 7 + 8


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty"),
        ("no\nheader\n", "none of the first 200 lines names the columns; a line with 'PacketCounter'"),
        (
            xsens_text(range(3)).replace("9.8", "nine"),
            r"line 4, column 'Acc_Z': a number is wanted, not 'nine'",
        ),
        (xsens_text(range(5))[:-60], r"line 8: ends after \d+ of 12 columns.*cut off.*--partial"),
        (xsens_text([1, 2, 2]), "row 3 has the same 'PacketCounter'"),
        (xsens_text([5, 4]), "row 2: 'PacketCounter' goes back"),
        ("PacketCounter\tX\n1\t2\n", "neither Acc_X, Acc_Y, Acc_Z nor an orientation"),
        (xsens_text(range(3)).replace("// Update", "// Other"), "does not tell its rate.*--rate"),
        (xsens_text([]), "no row of numbers below line 3"),
        (xsens_text([0, 1, 30000, 60000, 24464, 54464]), "its counter or its times jump"),
    ],
)
def test_what_is_wrong_with_a_text_file_is_said_with_its_place(tmp_path, text, said):
    with pytest.raises(FormatError, match=said):
        read_xsens_text([write(tmp_path / "a.txt", text)])


def test_partial_takes_what_comes_before_the_damage(tmp_path):
    path = write(tmp_path / "a.txt", xsens_text(range(9)).replace("3.500", "3.5x0"))
    recording = read_xsens_text([path], partial=True)
    assert len(recording.modules[0].times) == 7
    assert "2 after it" not in recording.notes[0]
    assert "this row and 1 after it were left out" in recording.notes[0]


def test_movella_dot_units_tags_loss_and_wrapping_stamps(tmp_path):
    path = write(tmp_path / "x.csv", movella(2**32 - 40000, [0, 1, 2, 5, 6]))
    recording = read_movella_dot([path])
    track = recording.modules[0]
    assert (track.name, recording.sampling_rate_hz) == ("Left Thigh", 60.0)
    np.testing.assert_allclose(track.angular_rate[0], [np.pi, 0, -np.pi / 2])
    assert np.isnan(track.specific_force[:, 0]).sum() == 2
    np.testing.assert_allclose(np.diff(track.times), 0.016667, atol=1e-9)


def test_modules_that_nobody_has_named_are_called_as_their_files_are(tmp_path):
    text = re.sub("DeviceTag:.*", "DeviceTag:,Xsens DOT", movella(0, range(9)))
    assert "Xsens DOT" in text
    paths = [write(tmp_path / f"{name}.csv", text) for name in ("left_thigh", "left_shank")]
    assert [track.name for track in read_movella_dot(paths).modules] == ["left_thigh", "left_shank"]


def test_unsynchronised_modules_are_refused_or_begin_together(tmp_path):
    paths = [
        write(tmp_path / "a.csv", movella(0, range(9))),
        write(tmp_path / "b.csv", movella(10**9, range(9))),
    ]
    paths[1].write_text(paths[1].read_text().replace("Left", "Right"))
    with pytest.raises(FormatError, match="not synchronised; --align start"):
        read_movella_dot(paths)
    assert [track.times[0] for track in read_movella_dot(paths, align="start").modules] == [0, 0]


def test_ximu3_units_gaps_and_orientation(tmp_path):
    ximu3(tmp_path / "Left Foot 64F0EBCE (UDP)")
    recording = read_ximu3([tmp_path])
    (track,), (fused,) = recording.modules, recording.fused
    assert (track.name, recording.sampling_rate_hz) == ("Left Foot", 50.0)
    assert np.isnan(track.specific_force[:, 0]).nonzero()[0].tolist() == [5, 6]
    np.testing.assert_allclose(track.specific_force[0], [0, 0, 9.80665])
    np.testing.assert_allclose(track.angular_rate[0], [np.pi / 2, 0, 0])
    np.testing.assert_allclose(fused.q_es[0], NWU_TO_ENU.as_quat(scalar_first=True))


def test_ximu3_without_files_or_with_unknown_units(tmp_path):
    with pytest.raises(FormatError, match=r"holds no 'Inertial\.csv'"):
        read_ximu3([tmp_path])
    folder = ximu3(tmp_path / "m", quaternion=False)
    inertial = folder / "Inertial.csv"
    inertial.write_text(inertial.read_text().replace("(g)", "(stone)"))
    with pytest.raises(FormatError, match=r"column 'Accelerometer X \(stone\)' is in 'stone'; known: deg/s"):
        read_ximu3([folder])


def test_mvnx_orientations_path_and_date(tmp_path):
    recording = read_mvnx(write(tmp_path / "a.mvnx", mvnx()))
    assert recording.names == {0: "Pelvis", 1: "RightUpperLeg"}
    assert recording.sampling_rate_hz == 60
    assert recording.begun_utc_ns == 1_600_000_000 * 10**9
    turn = Rotation.from_quat(recording.fused[1].q_es[3], scalar_first=True)
    assert (turn.inv() * NWU_TO_ENU * Rotation.from_euler("z", 30, degrees=True)).magnitude() < 1e-5
    np.testing.assert_allclose(recording.local[0].values[2], [0, 0.2, 0.9], atol=1e-12)  # north


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (mvnx()[:-200], r"line \d+, column \d+: not XML from there on.*cut off"),
        (mvnx().replace("0.900 0.", "0.900 x0.", 1), r"frame 0, <position>: could not convert"),
        (mvnx(1), "1 frames have an <orientation>"),
        (mvnx().replace('frameRate="60"', ""), "<subject frameRate> is None; a number is wanted"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><mvnx>&b;</mvnx>', "not XML from there on"),
        (mvnx(labels=("Pelvis", "Pelvis")), "two modules are called 'Pelvis'"),
        (
            mvnx().replace("<frame ", "<frame x='1' ").replace('label="RightUpperLeg"', ""),
            "4 numbers are wanted",
        ),
    ],
)
def test_what_is_wrong_with_an_mvnx_file_is_said(tmp_path, text, said):
    with pytest.raises(FormatError, match=said):
        read_mvnx(write(tmp_path / "a.mvnx", text))


def test_a_mapped_csv_with_units_orders_and_inverses(tmp_path):
    q = Rotation.from_euler("xyz", [10, 20, 30], degrees=True)
    x, y, z, w = q.inv().as_quat()
    rows = "".join(
        f"{n * 10},0;0;1;90;0;0;{x:.7f};{y:.7f};{z:.7f};{w:.7f}\n".replace(",", ";") for n in range(4)
    )
    path = write(tmp_path / "a.csv", "ms;ax;ay;az;gx;gy;gz;x;y;z;w\n" + rows)
    columns = ColumnMap.model_validate(
        {
            "time": {"column": "ms", "unit": "ms"},
            "modules": [
                {
                    "name": "pelvis",
                    "specific_force": {"columns": ["ax", "ay", "az"], "unit": "g"},
                    "angular_rate": {"columns": ["gx", "gy", "gz"], "unit": "deg/s"},
                    "orientation": {"columns": ["x", "y", "z", "w"], "order": "xyzw", "inverse": True},
                }
            ],
        }
    )
    recording = read_mapped_csv(path, columns, tmp_path)
    assert recording.sampling_rate_hz == 100
    np.testing.assert_allclose(recording.modules[0].specific_force[1], [0, 0, 9.80665])
    np.testing.assert_allclose(recording.modules[0].angular_rate[1], [np.pi / 2, 0, 0])
    assert (Rotation.from_quat(recording.fused[0].q_es[1], scalar_first=True).inv() * q).magnitude() < 1e-6


GOOD = {
    "xsens": (xsens_text(range(20)), lambda path, partial: read_xsens_text([path], partial=partial)),
    "movella": (movella(5, range(20)), lambda path, partial: read_movella_dot([path], partial=partial)),
    "mvnx": (mvnx(12), lambda path, partial: read_mvnx(path, partial=partial)),
}


@pytest.mark.parametrize("name", GOOD)
@given(data=st.data())
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_whatever_is_cut_or_changed_gives_a_recording_or_one_clear_line(tmp_path, name, data):
    text, read = GOOD[name]
    content = bytearray(text.encode()[: data.draw(st.integers(0, len(text)), label="length")])
    for _ in range(data.draw(st.integers(0, 3), label="changes")):
        if content:
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path / "a.txt"
    path.write_bytes(content)
    try:
        recording = read(path, data.draw(st.booleans(), label="partial"))
    except FormatError as error:
        assert "\n" not in str(error)  # noqa: PT017 - either outcome is right
    else:
        assert isinstance(recording, RecordedTracks)
        assert list(play(recording))


@pytest.mark.parametrize("rate", ["0", "0.0001", "99999999"])
def test_found_by_fuzzing_a_rate_that_no_module_has(tmp_path, rate):
    """It rounded to 0 Hz, by which others then divided."""
    path = tmp_path / "MT_1.txt"
    path.write_text(xsens_text(range(4)).replace("100.0Hz", f"{rate}Hz"))
    with pytest.raises(FormatError, match=r"samples a second; from 0\.5 to 20000 are read"):
        read_xsens_text([path])


def test_a_rate_with_two_points_is_read_as_far_as_it_is_a_number(tmp_path):
    path = tmp_path / "MT_1.txt"
    path.write_text(xsens_text(range(4)).replace("100.0Hz", "1.2.3Hz"))
    assert read_xsens_text([path]).sampling_rate_hz == 1.2


def test_found_by_fuzzing_samples_half_a_minute_apart(tmp_path):
    path = tmp_path / "dot.csv"
    rows = "\n".join(f"{k},{k * 30_000_000},0,0,9.8" for k in range(4))
    path.write_text(f"DeviceTag:,a\nPacketCounter,SampleTimeFine,Acc_X,Acc_Y,Acc_Z\n{rows}\n")
    with pytest.raises(FormatError, match=r"0\.0333333 samples a second.*another unit"):
        read_movella_dot([path])
