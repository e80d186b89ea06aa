"""Commands reach modules, and answers come back, over every kind of CAN link and over TCP."""

import asyncio

import pytest

from devices.commands.command_client import CommandClient
from devices.commands.configure import Configurator
from devices.emulators.delivery import Encoding
from devices.emulators.transports import CanBusTransport, SlcanTransport, TcpTransport
from devices.endpoints import link_from_url
from devices.link import Framing

CLASSIC, FD = Encoding(Framing.CAN), Encoding(Framing.CAN, is_fd=True)


def media(folder, port):
    """name -> (what the suit speaks on, how it is framed, what the host opens)."""
    adapter = folder / "adapter"
    return {
        "can": (CanBusTransport("commands"), CLASSIC, "can://virtual/commands"),
        "can_fd": (CanBusTransport("commands-fd", fd=True), FD, "can://virtual/commands-fd?fd=1"),
        "slcan": (SlcanTransport(adapter), CLASSIC, f"slcan://{adapter}?bitrate=1000000"),
        "tcp": (TcpTransport(port), Encoding(), f"tcp://127.0.0.1:{port}"),
    }


@pytest.mark.parametrize("medium", ["can", "can_fd", "slcan", "tcp"])
async def test_settings_are_written_and_read_back(commanded_suit, tmp_path, unused_port, medium):
    transport, encoding, url = media(tmp_path, unused_port)[medium]
    async with commanded_suit(transport=transport, encoding=encoding) as suit:
        link = link_from_url(url, name="suit")
        client = CommandClient([link], allow_writes=True)
        async with asyncio.timeout(20), client.reading():
            configurator = Configurator(client)
            roster = await configurator.discover()
            assert [device.module for device in roster.devices] == [0, 1, 2, 3]
            target = suit.unique_id(2)
            calibration = [k / 8 for k in range(30)]  # 120 bytes: more than one CAN frame of any kind holds
            change = await configurator.write(target, {"label": "left hand", "calibration": calibration})
            read = await configurator.read_all(target)
    assert change.after["label"] == read["label"] == "left hand"
    assert list(read["calibration"]) == calibration
