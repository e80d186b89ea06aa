"""The same suit over a serial port and over CAN gives the same skeleton stream, to the last bit."""

import asyncio

import pytest

from devices.emulators.delivery import Encoding
from devices.emulators.emulated_suit import EmulatedSuit
from devices.emulators.imperfections import Imperfections
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.emulators.transports import (
    CanBusTransport,
    PtyTransport,
    SlcanTransport,
    TcpTransport,
)
from devices.link import Framing
from gateway.body.rig import load_rig
from gateway.emulation.rig import dress, move

pytestmark = pytest.mark.system

SECONDS = 2.5
NOISY = Imperfections(accelerometer_noise=0.03, gyroscope_noise=0.002, magnetometer_noise=0.5)


def media(folder, port):
    """name -> (what the suit speaks on, how it is framed, what the gateway opens)."""
    serial, slcan = folder / "suit", folder / "adapter"
    return {
        "serial": (PtyTransport(serial), Encoding(Framing.BYTE_STREAM), str(serial)),
        "tcp": (TcpTransport(port), Encoding(Framing.BYTE_STREAM), f"tcp://127.0.0.1:{port}"),
        "can": (CanBusTransport("suit-bus"), Encoding(Framing.CAN), "can://virtual/suit-bus"),
        "can_fd": (
            CanBusTransport("fd-bus", fd=True),
            Encoding(Framing.CAN, is_fd=True),
            "can://virtual/fd-bus?fd=1",
        ),
        "slcan": (SlcanTransport(slcan), Encoding(Framing.CAN), f"slcan://{slcan}?bitrate=1000000"),
    }


async def stream_over(medium, gateway_on, folder, port):
    """Everything an app received while the suit spoke on that medium, times against the first."""
    transport, encoding, url = media(folder, port)[medium]
    suit = load_rig("robot_arm_4")
    motion = move(dress(suit), suit.skeleton.name, seed=3)
    traffic = SuitTraffic(motion, SuitSettings(encoding=encoding), NOISY, seed=3)
    emulated = EmulatedSuit(traffic.transmissions(SECONDS), transport, speed=None)
    async with gateway_on(url, "robot_arm_4", "articulated") as running:
        sending = asyncio.create_task(emulated.run()) if medium not in ON_A_BUS else None
        await running.until_link_is_up()
        await (sending or emulated.run())
        await running.until_quiet(emulated.counts.sent_bytes if medium in {"serial", "tcp"} else 0)
        assert not any(running.service.pipeline.dropped()["suit"].values())
    poses = [received.pose for received in running.received]
    return [(p.seq, p.t_ns - poses[0].t_ns, p.segments, p.status) for p in poses]


ON_A_BUS = {"can", "can_fd"}  # a bus has no memory: the listener must be there before the sender


async def test_every_medium_gives_the_same_poses(gateway_on, tmp_path, unused_port):
    streams = {
        medium: await stream_over(medium, gateway_on, tmp_path, unused_port)
        for medium in ("serial", "tcp", "can", "can_fd", "slcan")
    }
    reference = streams.pop("serial")
    assert len(reference) > 100 * SECONDS - 5
    assert [seq for seq, *_ in reference] == list(range(len(reference)))
    settled = reference[50:]
    assert all(set(status.values()) == {"measured"} for *_, status in settled)
    for medium, stream in streams.items():
        assert stream == reference, f"{medium} differs from serial"
