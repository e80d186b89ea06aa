"""Somebody who reaches the port of a signed link, knows its senders and records what they send."""

from __future__ import annotations

import asyncio
import contextlib
import socket

import pytest

from devices.emulators import EmulatedSuit, SuitSettings, SuitTraffic
from devices.emulators.transports import SignedUdpTransport
from devices.free_ports import free_port
from devices.link import gateway_time_ns
from devices.links.signed_link import read_key, time_count, write_key
from firmware_protocol import Command, Defect, InertialSample, Verb, encode_frame, wire_frame
from firmware_protocol.commands import encode_arguments
from firmware_protocol.messages import ANYONE
from firmware_protocol.signing import SignedFrames
from gateway.body.rig import load_rig
from gateway.doctor.links import listen
from gateway.emulation.rig import dress, move
from gateway.outputs.settings import MqttSettings
from gateway.service.service import Service
from gateway.settings import ClockSettings, GatewaySettings
from gateway.sources.link_settings import LinkSettings
from tests.patience import PATIENCE_S
from tests.running_suit import running

pytestmark = pytest.mark.system

RIG = "wifi_10"


@pytest.fixture
def key_file(tmp_path):
    path = tmp_path / "key"
    write_key(path)
    return path


@pytest.fixture
def port():
    return free_port()


class Overheard(SignedUdpTransport):
    """Keeps what is sent, as somebody does who listens to the radio."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.datagrams = []

    def offer_from(self, device, data):
        signed = self._ends.of(device).sign(data)
        self.datagrams.append(signed)
        return super(SignedUdpTransport, self).offer_from(device, signed)


@contextlib.contextmanager
def ten_modules(key_file, port):
    suit = load_rig(RIG)
    traffic = SuitTraffic(
        move(dress(suit), suit.skeleton.name, seed=1), SuitSettings(sampling_rate_hz=25.0), seed=1
    )
    yield EmulatedSuit(traffic, Overheard(key_file, port)), traffic


@contextlib.asynccontextmanager
async def serving(key_file, port, mosquitto):
    settings = GatewaySettings(
        links=[LinkSettings(name="wifi", url=f"udp://127.0.0.1:{port}?key_file={key_file}")],
        rig=RIG,
        reconstructor="independent",
        clock=ClockSettings(sync_rate_hz=50),
        mqtt=MqttSettings(port=mosquitto.port),
    )
    service = Service(settings, load_rig(RIG))
    async with running(service):
        yield service


def sample(module, sequence):
    forged = InertialSample(specific_force=(0.0, 0.0, 9.81), angular_rate=(0.0, 0.0, 0.0))
    return encode_frame(wire_frame(forged, module, sequence, 1_000_000))


async def test_forged_and_replayed_samples_are_dropped_and_counted_and_the_suit_goes_on(
    mosquitto, stranger, until, key_file, port
):
    with ten_modules(key_file, port) as (suit, _):
        async with serving(key_file, port, mosquitto) as service, running(suit):
            modules = service.pipeline.stream.modules
            await until(
                lambda: len(modules) == 10 and all(record.received > 30 for record in modules.values())
            )
            place = ("127.0.0.1", port)
            stranger.sendto(sample(63, 0), place)
            stranger.sendto(SignedFrames(bytes(32), 99, time_count()).sign(sample(62, 0)), place)
            for datagram in suit.transport.datagrams[-5:]:
                stranger.sendto(datagram, place)
            stranger.sendto(SignedFrames(read_key(key_file), 98).sign(sample(61, 0)), place)
            wanted = {"unsigned": 1, "bad_signature": 1, "replayed": 5}

            def counted():
                link = service.statistics()["links"]["wifi"]
                return wanted.items() <= link.items() and link["outdated"] >= 1

            await until(counted)
            before = modules[5].received
            await until(lambda: modules[5].received > before + 10)
            assert set(modules) == set(range(1, 11))
            assert sum(record.lost for record in modules.values()) == 0
            assert sum(record.duplicates for record in modules.values()) == 0
            senders = service.statistics()["senders"]["wifi"]
            assert f"127.0.0.1:{stranger.getsockname()[1]}" not in senders["senders"]
            assert all(record.clock.figures().bound_us for record in modules.values())


async def test_what_was_recorded_before_a_restart_is_worth_nothing_after_it(
    mosquitto, stranger, until, key_file, port
):
    with ten_modules(key_file, port) as (suit, _):
        async with serving(key_file, port, mosquitto) as service, running(suit):
            await until(lambda: service.pipeline.stream.readings > 50)
    async with serving(key_file, port, mosquitto) as service:
        await until(lambda: bool(service.links) and service.links[0].state.value == "up")
        for datagram in suit.transport.datagrams:
            stranger.sendto(datagram, ("127.0.0.1", port))
            await asyncio.sleep(0)
        await until(lambda: service.statistics()["links"]["wifi"].get("outdated", 0) > 50)
        assert not service.pipeline.stream.modules


async def test_a_module_with_a_key_obeys_the_gateway_alone(until, key_file, port):
    """Commands without a signature, and by another key, from the address that the modules send to."""
    identify = Command(7, Verb.IDENTIFY, ANYONE, encode_arguments(Verb.IDENTIFY, 60))
    plain = encode_frame(wire_frame(identify, 255, 0, 0))
    forged = (plain, SignedFrames(bytes(32), count=time_count()).sign(plain))
    right = SignedFrames(read_key(key_file), count=time_count()).sign(plain)
    with ten_modules(key_file, port) as (suit, traffic), impostor(port) as sending:
        async with running(suit):
            ends, modules = suit.transport._ends, await senders(sending, 10)

            def blinking():
                now_s = suit.motion_time_s(gateway_time_ns())
                return [number for number in range(1, 11) if traffic.device(number).is_blinking(now_s)]

            for module in modules:
                for datagram in forged:
                    sending.sendto(datagram, module)
            wanted = {Defect.UNSIGNED: 1, Defect.BAD_SIGNATURE: 1}
            await until(lambda: all(ends.of(number).dropped == wanted for number in range(1, 11)))
            sent = len(suit.transport.datagrams)
            await until(lambda: len(suit.transport.datagrams) > sent + 500)
            assert not blinking()
            for module in modules:
                sending.sendto(right, module)
            await until(lambda: len(blinking()) == 10)


@contextlib.contextmanager
def impostor(port):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(("127.0.0.1", port))
        opened.setblocking(False)
        yield opened


async def senders(listening, n):
    """The addresses of so many modules."""
    found = set()
    async with asyncio.timeout(PATIENCE_S):
        while len(found) < n:
            _, sender = await asyncio.get_running_loop().sock_recvfrom(listening, 5000)
            found.add(sender)
    return found


async def test_the_doctor_names_what_was_dropped(stranger, key_file, port):
    with ten_modules(key_file, port) as (suit, _):
        async with running(suit):
            url = f"udp://127.0.0.1:{port}?key_file={key_file}"
            forging = asyncio.create_task(forge(stranger, port))
            findings = await listen([LinkSettings(name="wifi", url=url)], load_rig(RIG), 1.0, 100.0, "joint")
            forging.cancel()
    found = {finding.subject: finding for finding in findings}
    assert "(UNSIGNED)" in found["wifi: signatures"].found
    assert found["modules: heard"].found == "all 10 modules of the rig are heard"


async def forge(stranger, port):
    while True:
        with contextlib.suppress(OSError):
            stranger.sendto(sample(5, 0), ("127.0.0.1", port))
        await asyncio.sleep(0.02)
