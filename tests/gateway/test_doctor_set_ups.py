"""Wrong set-ups: the doctor names each, and what would do. Real ports and brokers where there can be some."""

from __future__ import annotations

import asyncio
import json
import os
import random
import threading
import time
import tty

import pytest
import yaml

from gateway.contract.messages import ModuleClockState, ModuleState
from gateway.doctor.examination import disk, examine_file, metrics_port
from gateway.doctor.findings import Surroundings, Verdict
from gateway.doctor.running import judge, module_states
from gateway.outputs.settings import MqttSettings
from gateway.settings import LinkSettings, MetricsSettings, RecordingSettings
from tests.typed_here import typed_here

pytestmark = pytest.mark.system


@pytest.fixture(autouse=True)
def _state_of_its_own(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


@pytest.fixture
def examined(tmp_path, unused_port, monkeypatch):
    """``examined(url=…, here=…)``: the findings about a configuration, by subject."""
    # What is asked here is not for relays; a few modules answer within 10 ms, unless the machine is busy.
    monkeypatch.setattr("devices.commands.transactions.BROADCAST_WAITS_S", (0.15, 0.25, 0.4))

    def run(url="tcp://127.0.0.1:1", rig="single", listen_s=0.0, here=None, mqtt=None, **more):
        settings = {
            "gateway": "lab",
            "links": [{"name": "suit", "url": url}],
            "rig": rig,
            "reconstructor": "independent",
            "mqtt": mqtt or {"port": unused_port},
            "recording": {"folder": str(tmp_path)},
        }
        config = tmp_path / "gateway.yaml"
        config.write_text(yaml.safe_dump({**settings, **more}))
        surroundings = here or Surroundings(usual_broker_ports=())
        return {f.subject: f for f in examine_file(config, None, listen_s, surroundings)}

    return run


@pytest.fixture
def pty():
    """(our end, path of the port)."""
    near, far = os.openpty()
    tty.setraw(far)
    yield near, os.ttyname(far)
    os.close(near)
    os.close(far)


@pytest.fixture
def emulated(command, tmp_path):
    """``emulated(*options)``: the port of an emulated suit in a process of its own."""

    def start(*options):
        port = tmp_path / "suit"
        suit = command("emulate", "--on", "pty", "--link", port, *options)
        suit.until(port.exists, f"{port}")
        return str(port)

    return start


def assert_named(finding, verdict, found, remedy):
    assert finding.verdict is verdict, finding
    assert found in finding.found
    assert remedy in finding.remedy


# 1 configuration


def test_a_mistake_in_the_configuration(examined):
    (finding,) = examined(reconstructer="joint").values()
    assert_named(finding, Verdict.BAD, "reconstructer", "config schema")
    (finding,) = examined(rig="suit17").values()
    assert_named(finding, Verdict.BAD, "suit17", "config schema")


# 2 no permission


@pytest.mark.skipif(os.geteuid() != 0, reason="another user's port is needed: run as root")
def test_no_permission(examined, pty):
    os.chmod(pty[1], 0o600)
    assert examined(url=pty[1])["suit: port"].verdict is Verdict.GOOD
    os.seteuid(65534)
    try:
        from gateway.doctor.links import opening  # noqa: PLC0415

        finding = asyncio.run(opening(LinkSettings(name="suit", url=pty[1]), gateway_runs=False))
    finally:
        os.seteuid(0)
    assert_named(finding, Verdict.BAD, "no permission", "group")


# 3 wrong baud rate


def test_a_wrong_baud_rate(examined, pty):
    """What a UART at another rate gives: bytes at random."""
    near, port = pty
    done = threading.Event()

    def babble():
        rng = random.Random(3)
        while not done.is_set():
            os.write(near, rng.randbytes(400))
            time.sleep(0.005)

    thread = threading.Thread(target=babble)
    thread.start()
    try:
        finding = examined(url=port, listen_s=0.5)["suit: data"]
    finally:
        done.set()
        thread.join()
    assert_named(finding, Verdict.BAD, "the baud rate is wrong", "?baud=")


def test_a_port_on_which_nothing_comes(examined, pty):
    assert_named(
        examined(url=pty[1], listen_s=0.5)["suit: data"],
        Verdict.BAD,
        "nothing readable",
        "switch the suit on",
    )


# 4 swapped broker port


def test_a_swapped_broker_port(examined, mosquitto, unused_port):
    here = Surroundings(usual_broker_ports=(mosquitto.port,))
    finding = examined(mqtt={"port": unused_port}, here=here)["broker"]
    assert_named(
        finding, Verdict.BAD, f"no MQTT broker at 127.0.0.1:{unused_port}", f"port: {mosquitto.port}"
    )


def test_a_broker_that_wants_a_password(examined, mosquitto):
    mosquitto.configure("allow_anonymous false")
    mosquitto.restart()
    mosquitto.is_for_gateways_only = False
    finding = examined(mqtt={"port": mosquitto.port})["broker"]
    assert_named(finding, Verdict.BAD, "refuses clients without a name", "set username")


def test_a_broker_without_nodelay(examined, mosquitto):
    quick = examined(mqtt={"port": mosquitto.port})["broker"]
    assert quick.verdict is Verdict.GOOD, quick
    mosquitto.configure("set_tcp_nodelay false")
    mosquitto.restart()
    for _ in range(5):  # a machine that is busy may hide a stall of 40 ms behind its own delays
        slow = examined(mqtt={"port": mosquitto.port})["broker"]
        if "stalls for" in slow.found:
            break
    assert_named(slow, Verdict.WARNING, "stalls for", "set_tcp_nodelay true")


# 5 bus too slow


@pytest.mark.parametrize(
    ("url", "remedy"),
    [
        ("can://socketcan/can9?bitrate=500000", "CAN FD"),
        ("/dev/ttyABSENT?baud=460800", "at least 825,714 baud"),
    ],
)
def test_a_line_that_is_too_slow(examined, url, remedy):
    finding = examined(url=url, rig="suit_17")["suit: capacity"]
    assert_named(finding, Verdict.BAD, "17 modules × 100 Hz take", remedy)


# 6 latency timer


@pytest.fixture
def ftdi(tmp_path):
    """Surroundings with an FTDI adapter as ttyUSB7: ``ftdi(milliseconds)``."""

    def make(milliseconds):
        device = tmp_path / "sys" / "class" / "tty" / "ttyUSB7" / "device"
        device.mkdir(parents=True, exist_ok=True)
        (device / "latency_timer").write_text(f"{milliseconds}\n")
        by_id = tmp_path / "by-id"
        by_id.mkdir(exist_ok=True)
        name = by_id / "usb-FTDI_FT232R_A1-if00-port0"
        if not name.is_symlink():
            name.symlink_to("/dev/ttyUSB7")
        return Surroundings(sysfs=tmp_path / "sys", by_id=by_id, usual_broker_ports=())

    return make


def test_a_latency_timer_of_16_ms(examined, ftdi):
    finding = examined(url="/dev/ttyUSB7", here=ftdi(16))["suit: latency"]
    assert_named(finding, Verdict.WARNING, "latency_timer of ttyUSB7 is 16 ms", "echo 1 | sudo tee")
    assert examined(url="/dev/ttyUSB7", here=ftdi(1))["suit: latency"].verdict is Verdict.GOOD


# 7 a name that changes


def test_a_name_that_changes(examined, ftdi):
    finding = examined(url="/dev/ttyUSB7?baud=921600", here=ftdi(1))["suit: name"]
    assert_named(finding, Verdict.WARNING, "may be another adapter", "usb-FTDI_FT232R_A1-if00-port0")
    nameless = examined(url="/dev/ttyACM3", here=ftdi(1))["suit: name"]
    assert_named(nameless, Verdict.WARNING, "may be another adapter", "udev")
    stays = examined(url="/dev/serial/by-id/usb-FTDI_FT232R_A1-if00-port0")["suit: name"]
    assert stays.verdict is Verdict.GOOD


# 8 no room


@pytest.mark.parametrize(
    ("free_mb", "verdict", "words"),
    [(5000, Verdict.GOOD, ""), (1500, Verdict.WARNING, "delete"), (400, Verdict.BAD, "delete")],
)
def test_a_full_disk(tmp_path, free_mb, verdict, words):
    here = Surroundings(free_bytes=lambda _folder: free_mb * 1_000_000)
    finding = disk(RecordingSettings(folder=str(tmp_path / "new" / "takes")), here)
    assert_named(finding, verdict, f"{free_mb:,} MB free", words)


def test_a_folder_that_cannot_be_written(tmp_path):
    file = tmp_path / "recordings"
    file.write_text("")
    finding = disk(RecordingSettings(folder=str(file)), Surroundings())
    assert_named(finding, Verdict.BAD, "cannot be written", "recording.folder")


# 9, 10 modules: ids in conflict, silent ones


def test_modules_that_share_an_id(examined, emulated):
    port = emulated("--rig", "robot_arm_4", "--id-conflict")
    findings = examined(url=port, rig="robot_arm_4", listen_s=0.5)
    assert_named(findings["modules: ids"], Verdict.BAD, "is shared by 2 devices", "modules assign")
    assert findings["suit: data"].verdict is Verdict.GOOD, findings["suit: data"]


def test_modules_that_are_silent_and_strangers(examined, emulated):
    port = emulated("--rig", "robot_arm_4")
    findings = examined(url=port, rig="suit_17", listen_s=0.5)
    assert_named(findings["modules: heard"], Verdict.BAD, "never heard: ", "switch them on")
    right = examined(url=port, rig="robot_arm_4", listen_s=0.5)
    assert right["modules: heard"].verdict is Verdict.GOOD
    assert "modules: ids" not in right


# CAN


def can_here(tmp_path, flags=0x40081, **info):
    interface = tmp_path / "sys" / "class" / "net" / "can0"
    interface.mkdir(parents=True, exist_ok=True)
    (interface / "flags").write_text(hex(flags))
    told = json.dumps([{"ifname": "can0", "linkinfo": {"info_kind": "can", "info_data": info}}])
    return Surroundings(sysfs=tmp_path / "sys", describe_interface=lambda _name: told, usual_broker_ports=())


@pytest.mark.parametrize(
    ("here", "url", "verdict", "found", "remedy"),
    [
        (
            {"flags": 0x80},
            "",
            Verdict.BAD,
            "can0 is down",
            "sudo ip link set can0 up type can bitrate 1000000",
        ),
        ({"state": "BUS-OFF"}, "", Verdict.BAD, "bus-off", "terminators"),
        ({"state": "ERROR-PASSIVE"}, "", Verdict.WARNING, "error-passive", "terminators"),
        ({"bittiming": {"bitrate": 500_000}}, "?bitrate=1000000", Verdict.BAD, "500,000", "bitrate 1000000"),
        ({"bittiming": {"bitrate": 1_000_000}}, "?fd=1", Verdict.BAD, "without CAN FD", "fd on"),
        ({"bittiming": {"bitrate": 1_000_000}}, "?bitrate=1000000", Verdict.GOOD, "1,000,000", ""),
    ],
)
def test_can_interfaces(examined, tmp_path, here, url, verdict, found, remedy):
    finding = examined(url=f"can://socketcan/can0{url}", here=can_here(tmp_path, **here))["suit: CAN"]
    assert_named(finding, verdict, found, remedy)


def test_an_absent_can_interface(examined, tmp_path):
    here = Surroundings(sysfs=tmp_path, usual_broker_ports=())
    assert_named(
        examined(url="can://socketcan/can0", here=here)["suit: CAN"], Verdict.BAD, "no interface", ""
    )


# a gateway that runs


def state(module, ppm=10.0, residual_us=100.0, **more):
    clock = ModuleClockState(
        state="settled", offset_ns=0, ppm=ppm, residual_us=residual_us, sigma_us=1, bound_us=None, steps=0
    )
    return ModuleState(
        **dict.fromkeys(ModuleState.model_fields)
        | {"t_ns": 1, "module": module, "segment": "pelvis", "availability": "online", "gaps": {}}
        | dict.fromkeys(("duplicates", "late", "resets", "lost"), 0)
        | {"received": 1000, "clock": clock}
        | more
    )


def test_states_of_a_running_gateway():
    fine = {f.subject: f for f in judge("lab", {1: state(1), 2: state(2)})}
    assert {f.verdict for f in fine.values()} == {Verdict.GOOD}
    assert "2 of 2 settled" in fine["clocks"].found
    found = [
        *judge("lab", {1: state(1, residual_us=9000), 2: state(2, availability="offline")}),
        *judge("lab", {6: state(6, doubt="as if module 6 were turned: run 'calibrate body'")}),
        *judge("lab", {3: state(3, ppm=400), 4: state(4, lost=100), 5: state(5, resets=2)}),
    ]
    words = [f.found for f in found if f.verdict is not Verdict.GOOD]
    for expected in (
        "1 9.0 ms",
        "2 (pelvis)",
        "3 +400 ppm",
        "4 (pelvis) 9.1%",
        "5 (pelvis) 2 times",
        "module 6 were turned",
    ):
        assert any(expected in line for line in words), expected
    assert all(f.remedy for f in found if f.verdict is not Verdict.GOOD)


def test_a_running_gateway_is_asked(examined, emulated, command, mosquitto, tmp_path, unused_port):
    port, findings = emulated("--rig", "robot_arm_4"), {}
    options = {
        "url": port,
        "rig": "robot_arm_4",
        "mqtt": {"port": mosquitto.port},
        "metrics": {"port": unused_port},
    }
    assert examined(**options)["metrics"].verdict is Verdict.GOOD  # writes the configuration too
    # One of its own: the doctor's is written anew at each look.
    own = tmp_path / "running.yaml"
    own.write_text((tmp_path / "gateway.yaml").read_text())
    process = command("run", "-c", own)
    asked = MqttSettings(port=mosquitto.port)
    process.until(lambda: len(asyncio.run(module_states(asked, "lab")) or ()) == 5, "states of all modules")

    def is_known():
        findings.clear()
        findings.update(examined(**options))
        # states of modules are retained one by one, as they are heard
        return "clocks" in findings and "with 5 modules" in findings["gateway"].found

    process.until(is_known, "all modules")
    assert "is open in the running gateway" in findings["suit: port"].found
    assert "by the running gateway" in findings["metrics"].found
    assert "modules: heard" not in findings


def test_a_metrics_port_that_is_taken(unused_port):
    import socket  # noqa: PLC0415

    with socket.socket() as other:
        other.bind(("127.0.0.1", unused_port))
        other.listen()
        (finding,) = metrics_port(MetricsSettings(port=unused_port), gateway_runs=False)
    assert_named(finding, Verdict.BAD, "cannot be listened on", "another metrics.port")


def test_the_command_line_has_json_and_an_exit_code(tmp_path, unused_port):
    config = tmp_path / "gateway.yaml"
    config.write_text(
        yaml.safe_dump(
            {
                "links": [{"name": "suit", "url": "/dev/ttyABSENT"}],
                "rig": "single",
                "mqtt": {"port": unused_port},
            }
        )
    )
    code, output, _ = typed_here(["doctor", "-c", config, "--json"])
    assert code == 1
    findings = {f["subject"]: f for f in json.loads(output)}
    assert findings["suit: port"]["verdict"] == "bad"
    assert findings["configuration"]["verdict"] == "good"
    code, _, errors = typed_here(["doctor", "-c", "absent.yaml"])
    assert code == 1
    assert errors.strip() == "mocap-gateway: no configuration file absent.yaml: name yours with -c"
