"""The firmware example, compiled for this machine with a stand-in for Arduino, and decoded."""

from __future__ import annotations

import itertools
import shutil
import subprocess
from pathlib import Path

import pytest

from firmware_protocol import (
    DeviceInfo,
    FrameDecoder,
    InertialSample,
    PacketDecoder,
    SyncRequest,
    SyncResponse,
)
from firmware_protocol.framing import WireFrame, encode_frame
from firmware_protocol.packets import encode_packet

REPOSITORY = Path(__file__).parents[2]
SKETCH = REPOSITORY / "examples" / "arduino" / "imu_module"
STUB = Path(__file__).parent / "arduino_stub"


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("g++ is not installed, so the sketch cannot be compiled")
    path = tmp_path_factory.mktemp("sketch") / "module"
    folders = [f"-I{folder}" for folder in (STUB, SKETCH, REPOSITORY / "firmware_protocol" / "c")]
    flags = ["-std=c++11", "-Wall", "-Wextra", "-Werror", "-fsanitize=address,undefined"]
    command = [compiler, *flags, *folders, str(STUB / "main.cpp"), "-o", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stderr
    return path


def test_a_second_of_the_sketch(program):
    request = SyncRequest(token=77, host_time_us=123)
    asked = encode_frame(WireFrame(SyncRequest.KIND, 255, 0, 0, encode_packet(request)))
    noise = bytes(range(256))
    done = subprocess.run([program], input=noise + b"\0" + asked, capture_output=True, timeout=60, check=True)
    decoder = PacketDecoder(FrameDecoder())
    packets = decoder.feed(done.stdout)
    assert not any(decoder.dropped.values())
    assert {packet.module for packet in packets} == {1}
    samples = [packet for packet in packets if isinstance(packet.packet, InertialSample)]
    assert len(samples) > 90
    numbers = [packet.sequence for packet in samples]
    assert numbers[:11] == [0, 1, 2, 3, 4, 5, 6, 7, 8, 10, 11]  # the reading that failed is a gap
    first = samples[0].packet
    assert first.specific_force == pytest.approx((0, 0, 9.80665), abs=0.01)
    assert first.angular_rate == pytest.approx((0.1064, 0, -0.1064), abs=0.002)
    times = [sample.module_time_us for sample in samples[:9]]
    steps = [(later - earlier) % 2**32 for earlier, later in itertools.pairwise(times)]
    assert all(abs(step - 10_000) < 60 for step in steps)
    (info,) = [packet.packet for packet in packets if isinstance(packet.packet, DeviceInfo)]
    assert info.firmware_version == (1, 0, 0)
    (response,) = [packet.packet for packet in packets if isinstance(packet.packet, SyncResponse)]
    assert response.token == 77
    assert 0 <= (response.sent_us - response.received_us) % 2**32 < 1000
