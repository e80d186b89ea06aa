"""The commands on recordings, as typed."""

from __future__ import annotations

import json
import resource
import signal
import sys

import pytest
import yaml
from mcap.reader import make_reader
from typer.testing import CliRunner

from devices import recording_format as fmt
from devices.link import Framing
from devices.recording_writer import RecordingWriter, session_record
from gateway.cli.main import app, main
from gateway.recording import open_recording
from tests.typed_here import typed_here


def typed(*arguments):
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout


def test_verify_says_identical_or_what_differs(record):
    path = record()
    code, output = typed("replay", path, "--verify")
    assert (code, output.startswith("identical: ")) == (0, True)
    late = record(name="late", from_start=False)
    assert typed("replay", late, "--verify", "--json")[0] == 0
    with late.open("r+b") as file:
        file.truncate(late.stat().st_size * 2 // 3)
    code, output = typed("replay", late, "--verify")
    assert (code, "identical" in output) == (0, True)


def test_a_difference_after_a_damaged_piece_is_put_down_to_that(record):
    path = record()
    data = bytearray(path.read_bytes())
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    samples = {i for i, channel in summary.channels.items() if channel.topic.startswith(fmt.CHUNKS)}
    piece = next(index for index in summary.chunk_indexes if samples & index.message_index_offsets.keys())
    data[piece.chunk_start_offset + piece.chunk_length // 2] ^= 0xFF
    path.write_bytes(data)
    code, output = typed("replay", path, "--verify")
    assert code == 1
    assert "damaged pieces of the recording are missing, 1 up to there" in output


def test_a_difference_is_said_with_its_likely_reasons(record, monkeypatch):
    monkeypatch.setattr("gateway.recording.snapshot.platform.python_version", lambda: "3.99")
    path = record(from_start=False)
    monkeypatch.undo()
    # other arithmetic: the method of another version stands in for it
    from gateway.pipeline import Pipeline  # noqa: PLC0415

    original = Pipeline.feed

    def feed(self, chunk):
        frames = original(self, chunk)
        for frame in frames:
            frame.q_wb[:] = frame.q_wb * (1 + 1e-15)
        return frames

    monkeypatch.setattr(Pipeline, "feed", feed)
    code, output = typed("replay", path, "--verify")
    assert code == 1
    assert output.startswith("different: frame ")
    assert "began while the gateway was running" in output
    assert "recorded with python 3.99, now 3." in output


def test_solve_again_diff_and_list(record, tmp_path):
    path = record(name="walk")
    code, output = typed("replay", path, "--offline", "--json")
    assert (code, json.loads(output)["poses"] > 150) == (0, True)
    code, output = typed("replay", path, "--reconstructor", "articulated")
    solved = path.with_name(f"{path.stem}_articulated.mcap")
    assert (code, str(solved) in output) == (0, True)
    code, output = typed("info", path, "--extract", tmp_path / "out")
    assert "bit-identical" in output
    assert "recording_ended" in output
    rig = yaml.safe_load((tmp_path / "out" / "rig.yaml").read_text())
    rig["modules"][1]["sensor_to_segment"] = [0.7071, 0.7071, 0, 0]
    (tmp_path / "out" / "mine.yaml").write_text(yaml.safe_dump(rig))
    target = tmp_path / "mine.mcap"
    assert typed("replay", path, "--with", tmp_path / "out" / "mine.yaml", "--output", target)[0] == 0
    code, output = typed("compare", path, target, "--same-session", "--json")
    figures = json.loads(output)["segments"]
    assert sorted(round(each["max_deg"]) for each in figures)[-1] == 90
    assert "mean °" in typed("compare", path, target, "--same-session")[1]
    code, output = typed("recordings", path.parent, "--json")
    assert [entry["name"] for entry in json.loads(output)] == ["walk", solved.stem]
    assert "loss" in typed("recordings", path.parent)[1]
    assert json.loads(typed("info", path, "--json")[1])["from_start"] is True


def test_poses_of_a_method_that_can_wait_come_as_much_later_as_asked(record):
    path = record()
    times = {}
    for delay_ms in (0, 100):
        options = ("--reconstructor", "gyro_free", "--delay-ms", delay_ms)
        assert typed("replay", path, *options)[0] == 0
        solved = open_recording(path.with_name(f"{path.stem}_gyro_free_{delay_ms}ms.mcap"))
        assert solved.meta.settings.reconstructor_delay_ms == delay_ms
        times[delay_ms] = [frame.time_ns for frame in solved.skeleton_frames()]
    assert [now_ns - then_ns for now_ns, then_ns in zip(times[0], times[100], strict=True)] == [10**8] * len(
        times[0]
    )
    assert "gyro_free, 100 ms late" in typed("info", solved.meta.path)[1]
    assert typed("replay", solved.meta.path, "--reconstructor", "independent")[0] == 0
    other = open_recording(solved.meta.path.with_name(f"{solved.meta.path.stem}_independent.mcap"))
    assert other.meta.settings.reconstructor_delay_ms == 0


def test_recover_beside_and_in_place(record):
    path = record()
    with path.open("r+b") as file:
        file.truncate(path.stat().st_size - 3000)
    code, output = typed("recover", path)
    beside = path.with_name(f"{path.stem}.recovered.mcap")
    assert (code, "was not closed" in output, open_recording(beside).defect) == (0, True, None)
    assert "mocap-gateway recover" in typed("info", path)[1]
    assert "mocap-gateway recover" not in output  # it has just been done
    assert typed("recover", path, "--in-place")[0] == 0
    assert "nothing was wrong with it" in typed("recover", path, "--in-place")[1]


def test_full_speed_replay_publishes_every_pose(record, tmp_path, mosquitto):
    path = record()
    config = tmp_path / "mine.yaml"
    config.write_text(
        yaml.safe_dump(
            {
                "gateway": "again",
                "links": [{"name": "suit", "url": "/dev/null"}],
                "rig": "robot_arm_4",
                "mqtt": {"port": mosquitto.port},
            }
        )
    )
    code, output = typed("replay", path, "--speed", "max", "--json", "-c", config)
    played = json.loads(output)
    assert (code, played["published"], played["dropped"]) == (0, played["poses"], 0)
    assert played["poses"] == len(list(open_recording(path).skeleton_frames()))


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (("replay", "absent.mcap"), "recording absent.mcap cannot be read: No such file"),
        (("info", __file__), "is no recording of mocap-gateway"),
        (("analyse", __file__), "is no recording of mocap-gateway"),
        (("analyse", "{path}"), "does not tell what the person weighs"),
        *(((words, "{cut}"), "was cut off at byte 2000, before its first") for words in ("info", "recover")),
        (("recover", "absent.mcap"), "cannot be read"),
        (("recover", "x.mcap", "--in-place", "--output", "y.mcap"), "not both"),
        (("recordings", "absent"), "there is no folder absent"),
        (("compare", "absent.mcap", "absent.mcap", "--same-session"), "cannot be read"),
        (("replay", "{card}"), "tells no suit"),
        (("replay", "{path}", "--speed", "fast"), "a number above 0, or max, is needed"),
        (("replay", "{path}", "--reconstructor", "articulate"), "did you mean 'articulated'"),
        (("replay", "{path}", "--reconstructor", "gyro_free_delayed"), "gyro_free --delay-ms 500"),
        (("replay", "{path}", "--delay-ms", "100"), "gives its frames at once: a delay is for gyro_free"),
        (("replay", "{path}", "--verify", "--delay-ms", "0"), "leave out --with"),
        (("replay", "{path}", "--with", "nothing"), "there is no file 'nothing'"),
        (("replay", "{path}", "--verify", "--with", "single"), "leave out --with"),
        (("replay", "{path}", "--output", "{path}"), "exists already"),
        (("compare", "{path}", "{path}", "--same-session", "--plot", "plot.gif"), "a plot is written as"),
        (
            ("replay", "{path}", "--offline", "--with", "{others}"),
            "gives no pose: has it samples of the rig's mod",
        ),
        (("export", "{path}", "--to", "csv", "--force", "-o", "{path}"), "is itself what is read"),
        (
            ("export", "{path}", "--to", "csv", "-o", "x.bvh"),
            "name it x.csv, the ending of csv",
        ),
        (
            ("export", "{path}", "--to", "gltf", "-o", "x.gltf"),
            "name it x.glb, the ending of gltf",
        ),
        (
            ("report", "{path}", "--force", "-o", "{path}"),
            "is itself what is read: name another file with --ou",
        ),
        (("calibrate", "history", "absent.yaml"), "absent.yaml cannot be read: no such file"),
        (("emulate", "--rig", "single", "--on", "udp", "--host", 64 * "x"), "correct --host"),
        (("replay", "{path}", "--verify", "--output", "x.mcap"), "--smooth, --output"),
        (("replay", "{path}", "--output", "none/x.mcap"), "none: No such file or directory: name a place"),
    ],
)
def test_what_cannot_be_is_said_in_a_line(
    arguments, error, record, tmp_path, arm_chunks, monkeypatch, capsys
):
    path, card = record(chunks=arm_chunks[:60]), tmp_path / "card.mcap"
    with RecordingWriter(card, session_record({"card": Framing.BYTE_STREAM}), {}, 0):
        pass
    others = tmp_path / "others.yaml"
    others.write_text("body: robot_arm_4\nmodules: [{id: 20, segment: link_1}, {id: 21, segment: link_2}]\n")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(path.read_bytes()[:2000])  # within what it says of itself
    monkeypatch.chdir(tmp_path)
    given = [argument.format(path=path, card=card, cut=cut, others=others) for argument in arguments]
    monkeypatch.setattr(sys, "argv", ["mocap-gateway", *given])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert error in lines[-1]
    assert len(lines) == 1


@pytest.mark.parametrize(
    "arguments",
    [
        ("export", "{file}", "--to", "bvh", "-o", "absent/walk.bvh"),
        ("export", "{file}", "--to", "csv", "-o", "a_file/walk.csv"),
        ("replay", "{file}", "--reconstructor", "independent", "--output", "absent/solved.mcap"),
    ],
)
def test_an_output_that_cannot_be_written_is_one_line_with_a_remedy(record, tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a_file").touch()
    file = record()
    code, _, errors = typed_here([argument.format(file=file) for argument in arguments])
    (line,) = [line for line in errors.splitlines() if line.startswith("mocap-gateway: ")]
    assert code == 1
    assert "Traceback" not in errors
    assert arguments[-1].partition("/")[0] in line
    assert "folder" in line or "another place" in line


def test_a_new_recording_that_finds_no_room_is_said_with_the_place(record, tmp_path):
    """The answer was "a file: No space left on device"."""
    path, target = record(), tmp_path / "elsewhere" / "again.mcap"
    target.parent.mkdir()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size // 2, before[1]))
    try:
        code, _, errors = typed_here(["replay", path, "--reconstructor", "independent", "--output", target])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert code == 1
    assert errors.splitlines()[-1].startswith(
        f"mocap-gateway: {target.parent}: File too large: no file of that"
    )
    assert list(target.parent.iterdir()) == []


def test_an_output_without_ending_is_a_folder(record, tmp_path):
    file = record()
    code, _, _ = typed_here(["export", file, "--to", "bvh", "-o", tmp_path / "new" / "folder"])
    assert code == 0
    assert (tmp_path / "new" / "folder" / f"{file.stem}.bvh").is_file()


def test_files_that_were_written_are_named_whole_on_80_columns(record, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    arguments = ["export", record(), "--to", "bvh", "--to", "csv", "-o", tmp_path / "a_rather_long_name"]
    arguments[1] = arguments[1].rename(tmp_path / "20261123T062415Z_walk.mcap")
    code, output, _ = typed_here(arguments)
    cells = [line.split("│")[1].strip() for line in output.splitlines() if line.count("│") > 2]
    assert code == 0
    assert "".join(cells) == "20261123T062415Z_walk.bvh20261123T062415Z_walk.csv"


def test_compare_says_how_far_two_sources_agree(record, tmp_path):
    path, target, page = record(), tmp_path / "other.mcap", tmp_path / "agreement.html"
    assert typed("replay", path, "--reconstructor", "articulated", "--output", target)[0] == 0
    code, output = typed("compare", path, target, "--json")
    said = json.loads(output)
    assert code == 0
    assert abs(said["time"]["lag_s"]) < 0.01
    assert [segment["segment"] for segment in said["segments"]] == [f"link_{i}" for i in (1, 2, 3, 4)]
    assert all(segment["rms_deg"] < 30 for segment in said["segments"])
    output = typed("compare", path, target, "--plot", page)[1]
    assert "correlation" in output
    assert "data:image/png;base64," in page.read_text()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--pair", "base"), "write first=second"),
        (("--pair", "link_1=pelvis"), "no segment 'pelvis'"),
        (("--plot", "plot.gif"), "a plot is written as"),
        (("--same-session", "--own-headings"), "--own-headings says nothing with --same-session"),
        (("--live", "--span", "1:2"), "--span says nothing with --live"),
    ],
)
def test_compare_refuses_in_one_line(record, monkeypatch, capsys, options, said):
    path = str(record())
    monkeypatch.setattr(sys, "argv", ["mocap-gateway", "compare", path, path, *options])
    with pytest.raises(SystemExit):
        main()
    assert said in capsys.readouterr().err
