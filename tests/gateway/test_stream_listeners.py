"""Packets that are no readings: taken without harm, counted, and told to whoever listens."""

from __future__ import annotations

import logging

import pytest

from devices.link import Chunk, Framing
from firmware_protocol import InertialSample, encode_frame, wire_frame
from firmware_protocol.messages import (
    Acknowledgement,
    Command,
    Event,
    LogLine,
    SamplingTrigger,
    SyncRequest,
    SyncResponse,
)
from firmware_protocol.samples import FusedSample, LightSample, PassThrough, PressureSample
from gateway.modules.module_log import MOST_LINES, ModuleLog
from gateway.sources.suit import SuitSource

MODULE = 3
FROM_MODULES = [
    FusedSample((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.01),
    LightSample((0.1,) * 6),
    PressureSample((1.0, 2.0, 3.0), 101_325.0, None),
    PassThrough(1, b"$GPGGA"),
    Event(2),
    LogLine(3, "hello"),
    SyncResponse(7, 1, 2),
    Acknowledgement(1, 2, 0, b"u" * 12),
]
FROM_HOST = [SyncRequest(1, 2), SamplingTrigger(5), Command(1, 2)]


def stream_and_chunk(*packets, module=MODULE, arrived_ns=10**18):
    stream = SuitSource()
    stream.add_link("suit", Framing.BYTE_STREAM)
    data = b"".join(encode_frame(wire_frame(packet, module, 0, 1000)) for packet in packets)
    return stream, Chunk(data, arrived_ns, "suit")


@pytest.mark.parametrize("packet", FROM_MODULES, ids=lambda packet: type(packet).__name__)
def test_each_kind_is_counted_and_told(packet):
    stream, chunk = stream_and_chunk(packet)
    heard = []
    stream.listen(type(packet), lambda received, chunk: heard.append((received.packet, chunk)))
    readings = stream.receive(chunk)
    assert len(readings) == isinstance(packet, FusedSample | LightSample | PressureSample)
    (told,) = heard
    assert type(told[0]) is type(packet)
    assert told[1] is chunk
    assert stream.modules[MODULE].sequences[packet.KIND].received == 1
    assert not any(stream.dropped()["suit"].values())


@pytest.mark.parametrize("packet", FROM_HOST, ids=lambda packet: type(packet).__name__)
def test_the_hosts_own_packets_echoed_by_a_bus_are_no_module(packet):
    stream, chunk = stream_and_chunk(packet, module=255)
    assert stream.receive(chunk) == []
    assert stream.modules == {}
    stream, chunk = stream_and_chunk(packet)
    assert stream.receive(chunk) == []
    assert stream.modules == {}


def test_answers_of_two_modules_with_one_id_are_both_told():
    # Their sequence numbers are the same, so that one looks like a repetition of the other.
    answers = [Acknowledgement(1, 2, 0, unique_id * 12) for unique_id in (b"a", b"b")]
    stream, chunk = stream_and_chunk(*answers)
    heard = []
    stream.listen(Acknowledgement, lambda received, _: heard.append(received.packet))
    stream.receive(chunk)
    assert heard == answers


def test_listening_ends():
    stream, chunk = stream_and_chunk(InertialSample(specific_force=(0.0, 0.0, 9.8)))
    heard = []

    def listener(received, _chunk):
        heard.append(received)

    stream.listen(InertialSample, listener)
    stream.receive(chunk)
    stream.stop_listening(InertialSample, listener)
    stream.receive(chunk)
    assert len(heard) == 1


def test_what_modules_say_is_logged_but_not_without_end(caplog):
    caplog.set_level(logging.DEBUG, "gateway.modules.module_log")
    lines = [LogLine(1, f"line {i}\nfoo") for i in range(20)]
    stream, chunk = stream_and_chunk(Event(2), *lines)
    ModuleLog().listen_to(stream)
    stream.receive(chunk)
    assert len(caplog.records) == MOST_LINES
    assert caplog.messages[0] == "module 3: tapped"
    assert caplog.messages[1] == r"module 3: error: 'line 0\nfoo'"
    later = Chunk(chunk.data, chunk.arrived_ns + 2 * 10**9, "suit")
    stream.receive(later)
    assert caplog.messages[MOST_LINES] == "module 3: tapped (16 lines before that left out)"
    assert {record.levelno for record in caplog.records} == {logging.INFO}


def test_debug_lines_are_debug(caplog):
    caplog.set_level(logging.DEBUG, "gateway.modules.module_log")
    stream, chunk = stream_and_chunk(LogLine(4, "tick"))
    ModuleLog().listen_to(stream)
    stream.receive(chunk)
    assert [record.levelno for record in caplog.records] == [logging.DEBUG]
