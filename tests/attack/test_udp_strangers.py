"""Ten wireless modules on one UDP port, and somebody else who sends there too."""

from __future__ import annotations

import asyncio
import contextlib
import json

import pytest

from devices.emulators import EmulatedSuit, SuitSettings, SuitTraffic
from devices.emulators.transports import UdpTransport
from devices.endpoints import link_from_url
from devices.free_ports import free_port
from devices.link import gateway_time_ns
from gateway.body.rig import load_rig
from gateway.emulation.rig import dress, move
from gateway.modules.journal import Journal
from gateway.modules.session import suit_session
from gateway.outputs.settings import MqttSettings
from gateway.service.service import Service
from gateway.settings import ClockSettings, GatewaySettings
from gateway.sources.link_settings import LinkSettings
from tests.running_suit import running
from tests.typed_here import typed_here

pytestmark = pytest.mark.system

RIG = "wifi_10"
TEN = range(1, 11)


@pytest.fixture(autouse=True)
def _short_looks(monkeypatch):
    """Ten modules that sample 25 times a second are heard, and answer, in a tenth of that."""
    monkeypatch.setattr("gateway.modules.session._LISTENED_S", 0.6)
    monkeypatch.setattr("devices.commands.transactions.BROADCAST_WAITS_S", (0.15, 0.25, 0.4))


def ten_modules(port):
    suit = load_rig(RIG)
    traffic = SuitTraffic(
        move(dress(suit), suit.skeleton.name, seed=1), SuitSettings(sampling_rate_hz=25.0), seed=1
    )
    return EmulatedSuit(traffic, UdpTransport(port)), traffic


@contextlib.asynccontextmanager
async def pestered(stranger, port):
    """One-byte datagrams without a zero, as often as the loop comes round."""

    async def pester():
        while True:
            with contextlib.suppress(OSError):
                stranger.sendto(b"\x07", ("127.0.0.1", port))
            await asyncio.sleep(0.002)

    pestering = asyncio.create_task(pester())
    try:
        yield
    finally:
        pestering.cancel()


async def test_all_ten_are_listed_and_each_is_found_beside_a_stranger(tmp_path, stranger, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    port = free_port()
    suit, traffic = ten_modules(port)
    where = ["--link", f"udp://127.0.0.1:{port}", "--rig", RIG]
    async with running(suit), pestered(stranger, port):
        code, output, errors = await asyncio.to_thread(
            typed_here, ["modules", "list", "--listen", "0.5", "--json", *where]
        )
        assert code == 0, errors
        listed = {module["module"]: module for module in json.loads(output)["modules"]}
        assert set(listed) == set(TEN)
        assert all(module["unique_id"] for module in listed.values())
        code, output, errors = await asyncio.to_thread(
            typed_here, ["modules", "identify", "5", "--seconds", "60", *where]
        )
        assert code == 0, errors
        now_s = suit.motion_time_s(gateway_time_ns())
        assert [number for number in TEN if traffic.device(number).is_blinking(now_s)] == [5]
    with pytest.raises(BlockingIOError):
        stranger.recv(100)  # nothing was ever written to it


async def test_a_command_for_one_goes_to_its_sender_alone(tmp_path, stranger):
    port = free_port()
    suit, _ = ten_modules(port)
    heard = set()
    async with running(suit):
        links = [LinkSettings(name="wifi", url=f"udp://127.0.0.1:{port}")]
        journal = Journal(tmp_path / "journal.json")
        async with suit_session(links, load_rig(RIG), allow_writes=False, journal=journal) as operations:
            await operations.perform("list", {"listen_s": 0.5})
            hand_on = suit.transport.on_receive

            def note(data, device):
                heard.add(device)
                hand_on(data, device)

            suit.transport.listen(note)
            uid = next(uid for uid, module in operations.configurator.roster.ids.items() if module == 5)
            await operations.configurator.identify(uid, 3)
    assert heard == {5}


async def test_a_stranger_costs_no_sample_and_gets_no_time_request(mosquitto, stranger, until):
    port = free_port()
    settings = GatewaySettings(
        links=[LinkSettings(name="wifi", url=f"udp://127.0.0.1:{port}")],
        rig=RIG,
        reconstructor="independent",
        clock=ClockSettings(sync_rate_hz=50),
        mqtt=MqttSettings(port=mosquitto.port),
    )
    service = Service(settings, load_rig(RIG))
    suit, _ = ten_modules(port)
    modules = service.pipeline.stream.modules
    async with running(service), running(suit), pestered(stranger, port):
        await until(lambda: len(modules) == 10 and all(record.received > 50 for record in modules.values()))
        await until(lambda: service.pipeline.stream.sender_statistics()["wifi"]["strange_chunks"] > 50)
        figures = service.statistics()["senders"]["wifi"]
    assert sum(record.lost for record in modules.values()) == 0
    assert len(figures["senders"]) == 10
    assert figures["strangers"] == [f"127.0.0.1:{stranger.getsockname()[1]}"]
    assert all(record.clock.figures().bound_us for record in modules.values())
    with pytest.raises(BlockingIOError):
        stranger.recv(100)


def test_a_port_of_this_machine_alone_unless_another_is_named():
    assert link_from_url("udp://:7000").host == "127.0.0.1"
