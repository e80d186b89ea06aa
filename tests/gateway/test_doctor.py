"""The doctor names what will not work, with the remedy."""

import pytest

from devices.endpoints import CanRate, UartRate, line_rate
from gateway.doctor.examination import examine
from gateway.doctor.findings import Verdict
from gateway.doctor.links import capacity
from gateway.settings import GatewaySettings


@pytest.mark.parametrize(
    ("url", "rate"),
    [
        ("/dev/ttyUSB0", UartRate(1_000_000)),
        ("serial:///dev/ttyUSB0?baud=460800", UartRate(460_800)),
        ("rfc2217://host:2000?baud=115200", UartRate(115_200)),
        ("can://socketcan/can0", CanRate(1_000_000, None)),
        ("can://socketcan/can0?fd=1&bitrate=500000", CanRate(500_000, 2_000_000)),
        ("slcan:///dev/ttyACM0?bitrate=250000", CanRate(250_000, None)),
        ("tcp://127.0.0.1:7000", None),
        ("udp://127.0.0.1:7000", None),
        ("recording:///tmp/x.mcap", None),
    ],
)
def test_line_rates_of_endpoints(url, rate):
    assert line_rate(url) == rate


@pytest.mark.parametrize(
    ("url", "modules", "verdict"),
    [
        ("/dev/ttyUSB0", 17, Verdict.GOOD),
        ("/dev/ttyUSB0?baud=460800", 17, Verdict.BAD),
        ("/dev/ttyUSB0?baud=750000", 17, Verdict.WARNING),
        ("can://socketcan/can0", 17, Verdict.BAD),
        ("can://socketcan/can0", 10, Verdict.GOOD),
        ("can://socketcan/can0?fd=1", 17, Verdict.GOOD),
        ("can://socketcan/can0?bitrate=500000", 17, Verdict.BAD),
    ],
)
def test_capacity_is_judged(url, modules, verdict):
    (finding,) = capacity("suit", url, modules, 100.0)
    assert finding.verdict is verdict, finding
    assert bool(finding.remedy) == (verdict is not Verdict.GOOD)


def test_everything_absent_is_named(tmp_path, unused_port):
    settings = GatewaySettings(
        links=[{"name": "suit", "url": "/dev/ttyABSENT?baud=115200"}],
        rig="suit_17",
        mqtt={"port": unused_port},
    )
    findings = {f.subject: f for f in examine(settings, tmp_path / "gateway.yaml", 100.0)}
    assert findings["rig"].verdict is Verdict.GOOD
    for subject, found in (
        ("suit: port", "no such port"),
        ("suit: capacity", "115,200 baud"),
        ("broker", f"no MQTT broker at 127.0.0.1:{unused_port}"),
    ):
        assert findings[subject].verdict is Verdict.BAD
        assert found in findings[subject].found
        assert findings[subject].remedy
