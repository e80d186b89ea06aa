"""The commands as a user types them, each in a process of its own where more than its words count."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import typer
import yaml

from gateway.cli.main import app
from tests.patience import PATIENCE_S
from tests.typed_here import typed_here

pytestmark = pytest.mark.system


@pytest.fixture
def gateway(command):
    """``gateway("watch", ...)``: exit code, standard output, standard error."""

    def run_to_the_end(*arguments):
        ended = command(*arguments)
        return ended.wait(), ended.output, ended.errors

    return run_to_the_end


def url_of(emulator):
    """Where an emulated suit is, once it says so."""
    return json.loads(emulator.until_said('"url"'))["url"]


def write_config(folder, port, url, **changes):
    settings = {
        "gateway": "lab",
        "links": [{"name": "suit", "url": str(url)}],
        "rig": "robot_arm_4",
        "reconstructor": "independent",
        "mqtt": {"port": port},
    }
    path = folder / "gateway.yaml"
    path.write_text(yaml.safe_dump(settings | changes))
    return path


def test_the_shipped_configuration_is_good():
    config = Path(__file__).parents[2] / "config" / "gateway.yaml"
    typed = [sys.executable, "-m", "gateway", "config", "check", str(config)]
    done = subprocess.run(typed, capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert "is good" in done.stdout
    assert "17 modules on body 'human_17'" in done.stdout


def test_articulated_is_told_whose_heading_it_does_not_observe_without_gyroscopes(tmp_path):
    def said(rig, reconstructor):
        file = write_config(tmp_path, 1883, "/dev/null", rig=rig, reconstructor=reconstructor)
        code, out, _ = typed_here(["config", "check", file])
        assert code == 0
        assert "is good" in out
        return out

    suit = said("suit_17", "articulated")
    assert "thorax (facing 330° to 30°)" in suit
    assert "head (facing 165° to 210°)" in suit
    assert "thigh" not in suit  # hangs below the hip
    assert "gyroscopes" not in said("pendulum_3", "articulated")  # hang, all of them
    assert "gyroscopes" not in said("suit_17", "joint")


def test_help_tells_the_command_as_it_is_typed():
    """The installed command runs the module, whose name nobody types."""
    for words in ([], ["modules", "list"]):
        typed = [sys.executable, "-m", "gateway", *words, "--help"]
        done = subprocess.run(typed, capture_output=True, text=True, check=True)
        assert " ".join(["Usage: mocap-gateway", *words, "[OPTIONS]"]) in done.stdout


@pytest.mark.parametrize(
    "words", [["body", "show", "human_17"], ["info", "tests/golden/captures/walking.mcap"], ["--help"]]
)
def test_a_terminal_without_a_degree_sign_gets_all_but_that(words):
    """What it has no letter for is a question mark each, so that columns stay below each other."""
    typed = [sys.executable, "-m", "gateway", *words]
    plain = os.environ | {"PYTHONIOENCODING": "ascii", "LC_ALL": "C"}
    done = subprocess.run(typed, capture_output=True, check=False, env=plain)
    assert done.returncode == 0, done.stderr.decode()
    assert done.stdout.isascii()


def test_the_schema_describes_every_setting():
    code, out, _ = typed_here(["config", "schema"])
    schema = json.loads(out)
    assert code == 0
    assert {"gateway", "links", "rig", "reconstructor", "clock", "assembly", "mqtt"} <= set(
        schema["properties"]
    )


def test_help_has_an_example_for_every_command():
    def without(command, words):
        """Yield the commands and groups below one, itself too, whose help has none."""
        if not re.search("Examples?: mocap-gateway", f"{command.epilog} {command.help}"):
            yield " ".join(words)
        looked_at.append(words)
        if hasattr(command, "commands"):
            context = command.context_class(command)
            for name in command.commands:
                yield from without(command.get_command(context, name), [*words, name])

    looked_at = []
    assert list(without(typer.main.get_command(app), ["mocap-gateway"])) == []
    assert ["mocap-gateway", "modules", "card", "list"] in looked_at


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"asembly": {"rate_hz": 100}}, r"unknown setting 'asembly' \(did you mean 'assembly'\?\)"),
        ({"assembly": {"rate": 100}}, r"unknown setting 'assembly\.rate' \(did you mean 'rate_hz'\?\)"),
        ({"assembly": {"rate_hz": 0}}, r"'assembly\.rate_hz' is 0: at least 0.1 is wanted"),
        ({"rig": "suit_71"}, r"'suit_71'.*did you mean 'suit_17'"),
        (
            {"reconstructor": "gyro_free_delayed"},
            r"write 'reconstructor: gyro_free' and 'reconstructor_delay_ms: 500'",
        ),
        (
            {"reconstructor_delay_ms": 100},
            r"'independent' gives its frames at once: a delay is for gyro_free",
        ),
        ({"reconstructor_delay_ms": 1e5}, r"'reconstructor_delay_ms' is 100000.*at most 2000"),
        ({"reconstructor": "articulate"}, r"no such reconstructor \(did you mean 'articulated'\?\)"),
        ({"links": [{"name": "a", "url": "serail:///dev/ttyUSB0"}]}, r"serail.*serial"),
        (
            {"links": [{"name": "a", "url": "/dev/ttyUSB0?boud=9600"}]},
            r"gateway\.yaml: link 'a': url: .*did you mean 'baud'",
        ),
        (
            {"clock": {"mode": "table", "table": "absent.yaml"}},
            r"gateway\.yaml: 'clock\.table' is absent\.yaml: no such file",
        ),
        ({"mqtt": {"password": "hunter2"}}, r"set MOCAP_MQTT_PASSWORD or password_file"),
    ],
)
def test_a_wrong_configuration_is_one_clear_line(tmp_path, changes, said):
    code, out, err = typed_here(["config", "check", write_config(tmp_path, 1883, "/dev/null", **changes)])
    assert code == 1
    assert re.search(said, err), err
    assert len(err.strip().splitlines()) == 1
    assert "hunter2" not in out + err
    assert "Traceback" not in err


def test_a_wrong_link_ends_the_service_before_anything_is_opened(tmp_path, gateway):
    code, _, err = gateway("run", "-c", write_config(tmp_path, 1883, "serail:///dev/ttyUSB0"))
    assert code == 1
    why = "unknown scheme 'serail' (did you mean 'serial'?)"
    assert err == f"mocap-gateway: link 'suit': url: serail:///dev/ttyUSB0: {why}\n"


def test_a_recording_that_is_not_there_ends_the_service_in_one_line(tmp_path, gateway):
    """Of other links the gateway waits for what is away; a trace of the program was the answer here."""
    links = [
        {"name": "suit", "url": "udp://127.0.0.1:0"},
        {"name": "walk", "url": str(tmp_path / "absent.mcap")},
    ]
    code, _, err = gateway("run", "-c", write_config(tmp_path, 1, "/dev/null", links=links))
    assert code == 1
    why = f"recording {tmp_path / 'absent.mcap'} cannot be read: No such file or directory"
    assert err.splitlines()[-1] == f"mocap-gateway: link 'walk': {why}"
    assert "Traceback" not in err


def test_a_rig_with_an_unknown_segment_names_the_nearest(tmp_path):
    rig = tmp_path / "rig.yaml"
    rig.write_text("body: human_17\nmodules:\n  - {id: 0, segment: left_tigh}\n")
    code, _, err = typed_here(["run", "-c", write_config(tmp_path, 1883, "/dev/null", rig=str(rig))])
    assert code == 1
    assert re.search(r"rig\.yaml: module 0 sits on 'left_tigh'.*did you mean 'left_thigh'", err)


def test_absent_port_and_broker_are_said_once_and_awaited(tmp_path, command, unused_port):
    config = write_config(tmp_path, unused_port, "/dev/ttyABSENT")
    process = command("run", "-c", config)
    process.until_said("no MQTT broker at")
    time.sleep(1.0)  # for attempts that are to say nothing; a busy machine makes fewer
    process.terminate()
    assert process.wait() == 0
    said = process.output + process.errors
    assert said.count("/dev/ttyABSENT: no such port; ports present") == 1
    assert said.count("is mosquitto running?") == 1
    assert "Traceback" not in said


def test_a_busy_port_is_named_with_its_holder(tmp_path, command, unused_port):
    emulator = command(
        "emulate", "--rig", "robot_arm_4", "--on", "pty", "--link", tmp_path / "suit", "--json"
    )
    assert url_of(emulator) == str(tmp_path / "suit")
    config = write_config(tmp_path, unused_port, tmp_path / "suit")
    first = command("run", "-c", config)
    first.until_said("suit: up")
    line = command("run", "-c", config).until_said("suit: down")
    assert re.search(rf"(busy|in use|held).*{first.pid}", line), line


@pytest.mark.parametrize("ending", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_an_emulated_suit_takes_its_link_away(tmp_path, command, ending):
    suit = tmp_path / "suit"
    emulator = command("emulate", "--rig", "robot_arm_4", "--on", "pty", "--link", suit, "--json")
    assert url_of(emulator) == str(suit)
    assert suit.is_symlink()
    emulator.send_signal(ending)
    assert (emulator.wait(), emulator.errors) == (0, "")
    assert not suit.is_symlink()


def test_a_busy_broker_port_of_the_embedded_broker_is_one_line(tmp_path, gateway, mosquitto):
    config = write_config(
        tmp_path, mosquitto.port, "/dev/ttyABSENT", mqtt={"broker": "embedded", "port": mosquitto.port}
    )
    code, _, err = gateway("run", "-c", config)
    assert code == 1
    assert re.search(rf"mocap-gateway: .*{mosquitto.port}", err), err
    assert "Traceback" not in err


@pytest.mark.parametrize("medium", ["pty", "slcan", "tcp"])
def test_emulate_run_and_watch_work_together(tmp_path, command, gateway, mosquitto, unused_port, medium):
    where = ["--port", unused_port] if medium == "tcp" else ["--link", tmp_path / "suit"]
    emulate = ["emulate", "--rig", "robot_arm_4", "--on", medium, *where, "--json"]
    url = url_of(command(*emulate))
    command("run", "-c", write_config(tmp_path, mosquitto.port, url))
    code, out, err = gateway(
        "watch", "--port", mosquitto.port, "--count", 20, "--json", "--timeout", 2 * PATIENCE_S
    )
    assert code == 0, err
    poses = [json.loads(line) for line in out.splitlines()]
    assert len(poses) == 20
    assert set(poses[-1]["segments"]) == {"link_1", "link_2", "link_3", "link_4"}
    assert set(poses[-1]["status"].values()) <= {"measured", "interpolated", "held"}


def test_the_demo_prints_poses_and_their_error(gateway, unused_port):
    """In real time: a machine that does not keep up must be told to be the reason of what errs."""
    code, out, err = gateway("demo", "--seconds", 5, "--port", unused_port)
    assert code == 0, err
    is_busy = "this machine was too busy" in out
    assert len(re.findall(r"^pose +\d+ .*latency", out, flags=re.MULTILINE)) >= (1 if is_busy else 2)
    means = re.search(r"mean +│ +([\d.]+) │ +([\d.]+) │ +([\d.]+)", out).groups()
    total, inclination, _ = map(float, means)
    assert (inclination < 3.0 and total < 6.0) or is_busy, out


def test_a_recording_is_played_as_if_modules_sent_it(
    tmp_path, command, gateway, mosquitto, recording_set, unused_port
):
    trial = recording_set("ring_chain5") / "trial1"
    emulate = [
        "emulate",
        "--recording",
        trial,
        "--format",
        "ring_chain5",
        "--on",
        "tcp",
        "--port",
        unused_port,
    ]
    url = url_of(command(*emulate, "--json"))
    config = write_config(
        tmp_path, mosquitto.port, url, rig="chain_5", assembly={"rate_hz": 40}, clock={"mode": "shared"}
    )
    command("run", "-c", config)
    code, out, err = gateway(
        "watch", "--port", mosquitto.port, "--count", 5, "--json", "--timeout", 2 * PATIENCE_S
    )
    assert code == 0, err
    assert len(json.loads(out.splitlines()[-1])["segments"]) == 5


def test_wrong_recordings_are_one_line(tmp_path):
    broken = tmp_path / "broken.mat"
    broken.write_bytes(os.urandom(200))
    almost = tmp_path / "almost.mat"
    almost.write_bytes(bytes(124) + b"\0\1IM" + b"\xff" * 72)  # the head of a MATLAB file, and then none
    for path, kind, said in (
        (almost, "broad", "almost.mat cannot be read as broad: no MATLAB file"),
        (tmp_path / "absent.mat", "broad", "absent.mat cannot be read as broad"),
        (broken, "broad", "broken.mat cannot be read as broad"),
        (broken, "brod", r"--format brod: unknown \(did you mean 'broad'"),
    ):
        code, _, err = typed_here(["emulate", "--recording", path, "--format", kind])
        assert code == 1
        assert re.search(said, err), err
        assert "Traceback" not in err


def test_what_a_file_is_called_is_printed_and_not_obeyed(tmp_path):
    code, _, err = typed_here(["emulate", "--recording", tmp_path / "\x1b[31mred.mat", "--format", "broad"])
    assert code == 1
    assert "[31mred.mat cannot be read as broad" in err
    assert "\x1b" not in err


@pytest.mark.parametrize(
    "words",
    [
        ["modules", "list", "--rig", "single", "--link", "tcp://me:hunter2@lab:7000"],
        ["modules", "list", "--mqtt", "me:hunter2@lab:1883"],
        ["calibrate", "body", "--rig", "single", "--link", "tcp://me:hunter2@lab:7000"],
        ["calibrate", "sensors", "--rig", "single", "--link", "tcp://me:hunter2@lab:7000"],
        ["watch", "--host", "mqtt://me:hunter2@lab"],
        ["watch", "--failover", "me:hunter2@lab:1883"],
    ],
)
def test_a_password_on_the_command_line_is_refused_and_not_repeated(gateway, words):
    code, out, told = gateway(*words)
    assert code != 0
    assert "hunter2" not in out + told
    assert told.count("\n") == 1
    assert "Traceback" not in told
