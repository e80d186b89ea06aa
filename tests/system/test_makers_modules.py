"""Modules of other makers as their owner meets them: emulated on ports, commands typed as in docs/."""

from __future__ import annotations

import json
import time

import numpy as np
import pytest
import ximu3
import yaml

from devices.link import Chunk, SentChunk
from gateway.body.rig import load_rig
from gateway.doctor.examination import examine_file
from gateway.doctor.findings import Surroundings, Verdict
from gateway.frames import Status
from gateway.recording import open_recording
from gateway.recording.solving import recorded_setup, recording_pipeline
from gateway.settings import GatewaySettings
from tests.patience import PATIENCE_S

pytestmark = pytest.mark.system

RIG = "arm_3"


@pytest.fixture(autouse=True)
def _state_of_its_own(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


@pytest.fixture
def emulated(command, tmp_path, unused_port):
    """``emulated(maker, medium, …)``: the links of emulated modules, for a configuration."""

    def start(maker, medium, *more, rig=RIG):
        where = ["--link", tmp_path / "imu"] if medium in ("pty", "slcan") else ["--port", unused_port]
        process = command("emulate", "--speaks", maker, "--rig", rig, "--on", medium, *where, *more, "--json")
        return json.loads(process.until_said('"links"'))["links"]

    return start


@pytest.fixture
def configured(tmp_path, mosquitto):
    def write(links, **more):
        settings = {"gateway": "lab", "rig": RIG, "mqtt": {"port": mosquitto.port}, **more, "links": links}
        path = tmp_path / "gateway.yaml"
        path.write_text(yaml.safe_dump({**settings, "recording": {"folder": str(tmp_path)}}))
        return path

    return write


def ended(process):
    code = process.wait()
    assert code == 0, process.report()
    return process.output


WAYS = [
    ("ximu3", "pty"),
    ("ximu3", "tcp"),
    ("ximu3", "udp"),
    ("mti", "pty"),
    ("mti_can", "slcan"),
    ("slimevr", "udp"),
    ("witmotion", "pty"),
    ("witmotion", "tcp"),
    ("witmotion_can", "slcan"),
]
SUITS = [
    ("mvn", "tcp", "mvn_17", "joint", []),
    ("mvn", "udp", "mvn_fused_23", "fused", ["--mode", "fused"]),
    ("bno08x_rvc", "pty", "arm_3", "fused_neutral", []),
    ("mocopi", "udp", "mocopi_23", "fused", []),
]
"""Maker, medium, rig, method, and what the emulator must be told: several modules a link, or fused ones."""


def moves(command, port):
    """Whether in the end all modules are heard, and the forearm has moved."""
    watched = command("watch", "--port", port, "--count", 400, "--json", "--timeout", 2 * PATIENCE_S)
    poses = [json.loads(line) for line in ended(watched).splitlines()]
    hands = np.array([pose["segments"]["right_forearm"] for pose in poses[100:]])
    is_heard = not any("missing" in pose["status"].values() for pose in poses[-50:])
    return is_heard and np.abs(np.diff(hands, axis=0)).max() > 1e-3


@pytest.mark.parametrize(("maker", "medium", "rig", "method", "told"), SUITS)
def test_what_the_emulator_prints_is_a_configuration(
    command, tmp_path, unused_port, maker, medium, rig, method, told
):
    where = ["--link", tmp_path / "imu"] if medium == "pty" else ["--port", unused_port]
    process = command("emulate", "--speaks", maker, "--rig", rig, "--on", medium, *where, *told)
    process.until_said(f"module: {9 if medium == 'pty' else 0}")
    printed = yaml.safe_load(process.output)
    written = GatewaySettings.model_validate({**printed, "mqtt": {"broker": "embedded"}})
    assert (written.rig, written.reconstructor) == (rig, method)
    assert {link.carries for link in written.links} == {maker}


@pytest.mark.parametrize(("maker", "medium"), WAYS)
def test_plugged_in_listed_run_recorded_and_verified(
    emulated, configured, command, mosquitto, maker, medium, tmp_path
):
    links = emulated(maker, medium)
    assert len({link["url"] for link in links}) == (1 if maker == "slimevr" else 3)
    config = configured(links)
    assert "is good" in ended(command("config", "check", config))
    # on a busy machine samples come in bursts, and the interval of those without stamps is told later
    listed = json.loads(ended(command("modules", "list", "-c", config, "--listen", 12, "--json")))
    for module in listed["modules"]:
        assert module["rate_hz"] > 60
        if maker != "mti_can":
            assert module["answers"], module
            assert len(module["unique_id"]) == {"slimevr": 12, "witmotion": 24}.get(
                maker.removesuffix("_can"), 8
            )
        if maker in ("ximu3", "slimevr"):
            assert module["battery_percent"] > 90
    gateway = command("record", "-c", config, "--folder", tmp_path, "--name", "walk", "--quiet")
    assert moves(command, mosquitto.port)
    gateway.terminate()
    gateway.wait()
    (recorded,) = tmp_path.glob("*walk.mcap")
    assert set(open_recording(recorded).meta.links.values()) == {maker}
    assert "identical" in ended(command("replay", recorded, "--verify"))


@pytest.mark.parametrize(("maker", "medium", "rig", "method", "more"), SUITS)
def test_suits_and_fused_modules_are_listed_run_recorded_and_verified(
    emulated, configured, command, tmp_path, maker, medium, rig, method, more
):
    links = emulated(maker, medium, *more, rig=rig)
    config = configured(links, rig=rig, reconstructor=method)
    assert "is good" in ended(command("config", "check", config))
    worn = len(load_rig(rig).module_ids)
    listed = json.loads(ended(command("modules", "list", "-c", config, "--json")))
    assert sum(module["segment"] is not None for module in listed["modules"]) == worn
    found = examine_file(config, None, 1.0, Surroundings(usual_broker_ports=()))
    assert {f.verdict for f in found if ": data" in f.subject or ": method" in f.subject} == {Verdict.GOOD}
    ended(command("record", "-c", config, "--folder", tmp_path, "--name", "walk", "--seconds", 12, "--quiet"))
    (recorded,) = tmp_path.glob("*walk.mcap")
    assert set(open_recording(recorded).meta.links.values()) == {maker}
    assert "identical" in ended(command("replay", recorded, "--verify"))
    poses = list(open_recording(recorded).skeleton_frames())[100:]
    assert len(poses) > 100
    status = np.array([pose.status for pose in poses])
    assert (status != Status.MISSING).mean() > 0.8  # a busy machine may stop the emulator for a moment
    assert np.isfinite(np.array([pose.q_wb for pose in poses])[status != Status.MISSING]).all()
    assert np.nanmax(np.abs(np.diff([pose.q_wb[-1] for pose in poses], axis=0))) > 1e-3  # it moves


def test_a_method_that_cannot_use_what_comes_is_told(emulated, configured):
    links = emulated("bno08x_rvc", "pty")
    config = configured(links, reconstructor="joint")
    found = examine_file(config, None, 1.0, Surroundings(usual_broker_ports=()))
    (told,) = {(f.found, f.remedy) for f in found if f.subject.endswith(": method")}
    assert "orientations fused on board, and no raw samples" in told[0]
    assert "reconstructor: fused_neutral" in told[1]


def test_a_witmotion_device_is_told_what_to_send_and_loses_nothing_by_it(emulated, configured, command):
    links = emulated("witmotion", "pty")
    module, config = links[0]["module"], configured(links)
    wanted = ["rate=50", "content=acceleration,angular_rate"]
    said = ended(command("modules", "set", module, *wanted, "-c", config, "--allow-writes"))
    assert "rate 100 → 50" in said
    shown = yaml.safe_load(ended(command("modules", "show", module, "-c", config)))
    assert (shown["rate"], shown["content"], shown["baud"]) == (50, ["acceleration", "angular_rate"], 115200)
    found = examine_file(config, None, 1.0, Surroundings(usual_broker_ports=()))
    warned = {f.found for f in found if f.subject == f"{links[0]['name']}: settings"}
    assert warned == {"sends no field", "sends 50 samples a second for 100 poses"}
    refused = command("modules", "set", module, "rate=77", "-c", config, "--allow-writes")
    assert refused.wait() == 1
    assert "rate=77: can be 0.2, 0.5," in refused.errors


@pytest.mark.parametrize(
    "asked", [["backup", "-"], ["undo", "--allow-writes"], ["assign", "--yes", "--allow-writes"]]
)
def test_what_is_for_modules_of_our_own_alone_says_so(emulated, configured, command, asked):
    config = configured(emulated("witmotion", "pty"))
    refused = command("modules", *asked, "-c", config)
    assert refused.wait() == 1
    assert "modules of other makers" in refused.errors


def test_sensors_of_other_makers_are_calibrated_into_a_rig_file(emulated, configured, command, tmp_path):
    config = configured(emulated("witmotion", "pty", "--tumbling"))
    wanted = ["--only", "gyroscope", "--seconds", 20, "--poor", "-o", tmp_path / "rig.yaml", "--json"]
    found = json.loads(ended(command("calibrate", "sensors", "-c", config, *wanted)))
    assert len(found) == 3
    assert all(np.isfinite(each["gyroscope"]["bias"]).all() for each in found.values())
    assert load_rig(str(tmp_path / "rig.yaml")).calibrations.keys() == set(map(int, found))


def test_settings_are_written_where_that_is_allowed_and_by_the_running_gateway(
    emulated, configured, command, mosquitto, tmp_path
):
    links = emulated("ximu3", "udp")
    module = links[1]["module"]
    config = configured(links)
    wanted = ["set", module, "inertial_message_rate_divisor=2"]
    refused = command("modules", *wanted, "-c", config)
    assert refused.wait() == 1
    assert "allow_device_writes" in refused.errors
    said = ended(command("modules", *wanted, "-c", config, "--allow-writes"))
    assert "inertial_message_rate_divisor 4 → 2" in said
    config = configured(links, allow_device_writes=True)
    gateway = command("record", "-c", config, "--folder", tmp_path, "--name", "asked", "--quiet")
    gateway.until_said("up")
    remote = ["--mqtt", f"127.0.0.1:{mosquitto.port}"]
    shown = yaml.safe_load(ended(command("modules", "show", module, *remote)))
    assert shown["inertial_message_rate_divisor"] == 2
    said = ended(command("modules", "set", module, "inertial_message_rate_divisor=8", *remote))
    assert "inertial_message_rate_divisor 2 → 8" in said
    assert "blinks" in ended(command("modules", "identify", module, *remote))
    absent = command("modules", "identify", 77, *remote)
    assert absent.wait() == 1
    assert "no device '77' answers" in absent.errors
    gateway.terminate()
    gateway.wait()
    (recorded,) = tmp_path.glob("*asked.mcap")
    sent = list(open_recording(recorded).sent())
    assert any(b'{"inertial_message_rate_divisor":8}' in item.data for item in sent)
    assert "identical" in ended(command("replay", recorded, "--verify"))


def test_the_makers_own_library_speaks_with_what_is_emulated(emulated):
    links = emulated("ximu3", "tcp")
    connection = ximu3.Connection(
        ximu3.TcpConnectionConfig("127.0.0.1", int(links[0]["url"].rpartition(":")[2]))
    )
    forces, fields, batteries, errors = [], [], [], []
    connection.add_inertial_callback(lambda message: forces.append(message.accelerometer_z))
    connection.add_magnetometer_callback(lambda message: fields.append(message.x))
    connection.add_battery_callback(lambda message: batteries.append(message.percentage))
    connection.add_receive_error_callback(errors.append)
    connection.open()
    try:
        deadline = time.monotonic() + PATIENCE_S
        while (len(forces) < 200 or not batteries) and time.monotonic() < deadline:
            time.sleep(0.05)
        answered = connection.ping()
    finally:
        connection.close()
    assert (answered.device_name, answered.serial_number) == ("x-IMU3", "65570001")
    assert len(forces) >= 200
    assert 0.1 * len(forces) < len(fields) < 0.3 * len(forces)
    assert batteries[0] > 90
    assert len(errors) <= 1  # what it came into the middle of


def test_an_mti_is_told_what_to_send_and_does_not_blink(emulated, configured, command):
    links = emulated("mti", "pty")
    module, config = links[0]["module"], configured(links)
    said = ended(
        command("modules", "set", module, "status_word=0", "acceleration=50", "-c", config, "--allow-writes")
    )
    assert "acceleration 100 → 50" in said
    shown = yaml.safe_load(ended(command("modules", "show", module, "-c", config)))
    assert (shown["acceleration"], shown["status_word"]) == (50, 0)
    found = examine_file(config, None, 1.0, Surroundings(usual_broker_ports=()))
    warned = {f.found for f in found if f.subject == f"{links[0]['name']}: settings"}
    assert warned == {
        "sends acceleration 50 times a second for 100 poses",
        "does not say when a sensor is clipped",
    }
    dark = command("modules", "identify", module, "-c", config)
    assert dark.wait() == 1
    assert "no light" in dark.errors


def test_devices_in_the_network_are_found_with_the_lines_for_them(emulated, command):
    links = emulated("ximu3", "udp")
    said = ended(command("modules", "discover", "--listen", 2.5))
    found = yaml.safe_load(said)
    # others may be announced meanwhile, by another test
    assert {link["url"].partition("?")[0].rpartition(":")[2] for link in found} >= {
        link["url"].rpartition(":")[2] for link in links
    }
    assert len({link["name"] for link in found}) == len(found)  # as links must be
    assert all(link["carries"] == "ximu3" and "peers=127.0.0.1" in link["url"] for link in found)


def test_the_doctor_says_what_an_owner_would_change(emulated, configured, command):
    links = emulated("ximu3", "tcp")
    module = links[0]["module"]
    config = configured(links)
    for setting in ("inertial_message_rate_divisor=8", "binary_mode_enabled=false"):
        ended(command("modules", "set", module, setting, "-c", config, "--allow-writes"))
    found = list(examine_file(config, None, 1.0, Surroundings(usual_broker_ports=())))
    warned = [f for f in found if f.subject == f"{links[0]['name']}: settings"]
    assert [f.verdict for f in warned] == [Verdict.WARNING] * 2
    assert "50 inertial messages a second for 100 poses" in warned[0].found
    assert warned[0].remedy == (
        f"mocap-gateway modules set {module} inertial_message_rate_divisor=4 --allow-writes"
    )
    assert "text" in warned[1].found
    assert {f.verdict for f in found if f.subject.endswith(": data")} == {Verdict.GOOD}
    assert not any(f.subject.endswith(": capacity") for f in found)


def dropped(recording):
    """Messages that could not be read, of all links."""
    pipeline = recording_pipeline(recording, recorded_setup(recording))
    for item in recording.inputs():
        if isinstance(item, Chunk):
            pipeline.feed(item)
        elif isinstance(item, SentChunk):
            pipeline.sent(item)
    return sum(sum(counts.values()) for counts in pipeline.dropped().values())


FAULTS = {
    "seed": 3,
    "faults": [
        {"kind": "bit_errors", "at": 0, "lasts": 1000, "share": 0.05},
        {"kind": "loss", "at": 0, "lasts": 1000, "share": 0.05},
        {"kind": "noise", "at": 0, "lasts": 1000, "bytes_per_s": 200},
    ],
}


@pytest.mark.parametrize(
    ("maker", "medium", "rig", "method", "more"), [*((*way, RIG, "joint", []) for way in WAYS), *SUITS]
)
def test_a_bad_line_costs_samples_and_nothing_else(
    emulated, configured, command, tmp_path, maker, medium, rig, method, more
):
    faults = tmp_path / "faults.yaml"
    faults.write_text(yaml.safe_dump(FAULTS))
    links = emulated(maker, medium, *more, "--faults", faults, rig=rig)
    config = configured(links, rig=rig, reconstructor=method)
    ended(command("record", "-c", config, "--folder", tmp_path, "--name", "bad", "--seconds", 12, "--quiet"))
    (path,) = tmp_path.glob("*bad.mcap")
    assert "identical" in ended(command("replay", path, "--verify"))
    recording = open_recording(path)
    solved = list(recording.skeleton_frames())
    assert len(solved) > 400
    assert dropped(recording) > 0
    known = np.isfinite([pose.q_wb for pose in solved]).all(axis=(1, 2))
    begun = int(np.argmax(known))  # the interval of those that stamp nothing is learnt first
    assert begun < 300
    assert known[begun:].mean() > 0.8  # a busy machine may stop the emulator for a moment


@pytest.mark.parametrize("name", ["arm", "right_upper_arm"])
def test_where_one_port_is_absent_the_others_are_listed_and_it_is_named(
    emulated, configured, command, tmp_path, name
):
    links = emulated("mti", "pty")
    if name == "arm":  # modules of our own, which are asked together
        links.append({"name": name, "url": str(tmp_path / "nothing")})
    else:
        next(link for link in links if link["name"] == name)["url"] = str(tmp_path / "nothing")
    config = configured(links)
    listing = command("modules", "list", "-c", config)
    assert listing.wait() == 1
    assert f"link '{name}' is not open: {tmp_path / 'nothing'}" in listing.output.replace("\n", " ")
    listing = command("modules", "list", "-c", config, "--json")
    assert listing.wait() == 1
    listed = json.loads(listing.output)
    assert list(listed["absent"]) == [name]
    there = {link["module"] for link in links if link["name"] != name}
    assert {module["module"] for module in listed["modules"] if module["answers"]} == there


def test_where_no_port_is_there_the_listing_says_why(emulated, configured, command, tmp_path):
    links = emulated("mti", "pty")
    config = configured([link | {"url": str(tmp_path / link["name"])} for link in links])
    listing = command("modules", "list", "-c", config)
    assert listing.wait() == 1
    assert listing.output == ""
    assert all(str(tmp_path / link["name"]) in listing.errors for link in links)


@pytest.mark.parametrize(
    ("maker", "medium", "told"),
    [
        ("witmotion_can", "pty", "these speak on CAN: --on slcan"),
        ("witmotion", "slcan", "these do not speak on CAN: --on pty"),
        ("mocopi", "can", "these do not speak on CAN"),
        ("mti_can", "can", "there can be one of these on a bus"),
        ("slimevr", "tcp", "these speak over udp"),
    ],
)
def test_modules_that_do_not_speak_there_say_where_they_do(command, maker, medium, told):
    refused = command("emulate", "--speaks", maker, "--rig", "arm_3", "--on", medium)
    assert refused.wait() == 1
    assert told in refused.errors


def test_modules_that_take_no_commands_say_so(emulated, configured, command):
    config = configured(emulated("bno08x_rvc", "pty"), reconstructor="fused_neutral")
    listed = ended(command("modules", "list", "-c", config))
    assert "take no commands: 1, 8, 9" in listed
    assert "does not answer" not in listed
    refused = command("modules", "identify", 8, "-c", config)
    assert refused.wait() == 1
    assert "module 8 takes no commands, as nothing does that speaks bno08x_rvc" in refused.errors
