"""Checks of what comes over links. Decoders never raise; what they give must not depend on how it was cut."""

from __future__ import annotations

import contextlib
import functools
import operator
import struct
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path

from devices.commands.card import convert_card_file
from devices.commands.transactions import Transactions
from devices.emulators.device.command_responder import CommandResponder, IdleDevice
from devices.emulators.device.emulated_card import EmulatedCard
from devices.emulators.faults.makers_campaign import LANGUAGES
from devices.link import Chunk, Framing
from devices.links.slcan import SlcanDecoder
from devices.marker_messages import MarkerReceiver, encode_markers
from devices.vendor_protocols.mti import Mid, MtiCanDecoder, MtiDecoder, read_output_configuration
from devices.vendor_protocols.mti import encode as encode_xbus
from devices.vendor_protocols.slimevr import Handshake, SensorInfo, SlimevrDecoder
from devices.vendor_protocols.slimevr_tracker import TrackerSession
from devices.vendor_protocols.witmotion import WitMotionCanDecoder, read_writes
from devices.vendor_protocols.ximu3 import read_announcement
from firmware_protocol import (
    MAX_FRAME_SIZE,
    PACKETS,
    VERBS,
    Acknowledgement,
    CanFrameDecoder,
    Command,
    Defect,
    FrameDecoder,
    PacketDecoder,
    SlotStore,
    TransferReceiver,
    TransferToHost,
    TransferToModule,
    Verb,
    WireFrame,
    WireFrameDecoder,
    decode_arguments,
    decode_body,
    decode_payload,
    encode_frame,
    encode_packet,
    encode_payload,
    fragment,
    pack_can_records,
    unpack_can_records,
)
from firmware_protocol.flash_slots import SLOT_MAGIC, SLOT_SIZE
from firmware_protocol.messages import ANYONE
from gateway.emulation.both_ways import BothWays
from gateway.sources.clock_mode import ClockMode
from gateway.sources.gnss.sentences import GnssDecoder
from gateway.sources.module_table import ModuleTable
from gateway.sources.suit import SuitSource

_SCRATCH = Path(tempfile.mkdtemp(prefix="mocap-fuzz-"))
MAX_DATAGRAM = 2048
"""Bytes: no tracker answers with more than it was sent."""
_PATIENCE_NS = 50_000_000


def wire_stream(data: bytes) -> None:
    """Cut in two at a place that the input names, a stream gives what it gives in one piece.

    And the input as a header and a body, under the checksum that chance would never find.
    """
    _same_however_cut(data, FrameDecoder)
    frame, sent = _framed(data), b""
    if frame is not None:
        decoder, sent = PacketDecoder(FrameDecoder()), encode_frame(frame)
        decoder.feed(sent)
        assert not decoder.dropped[Defect.BAD_CRC]
    _same_both_ways(Framing.BYTE_STREAM, data, sent, sent)


def ximu3_stream(data: bytes) -> None:
    """Messages of an x-IMU3; and what would announce one."""
    _same_messages_however_cut(data, "ximu3")
    read_announcement(data)


def mti_stream(data: bytes) -> None:
    """Xbus messages of an MTi; what one of them may hold; and its frames on CAN."""
    _same_messages_however_cut(data, "mti")
    MtiDecoder().feed(encode_xbus(Mid.MT_DATA_2, data))
    read_output_configuration(data)
    MtiCanDecoder().feed(data)


def slimevr_datagrams(data: bytes) -> None:
    """Datagrams of a tracker, each after its length; and the same from a server to a tracker."""
    decoder, session = SlimevrDecoder(), TrackerSession(Handshake(22, "fuzz", ""), [SensorInfo(0, 1, 13, 0)])
    session.due(0.0)
    rest, now_s = data, 0.0
    while rest:
        size, rest, now_s = rest[0], rest[1:], now_s + 0.7
        datagram, rest = rest[:size], rest[size:]
        decoder.feed(datagram)
        for sent in (*session.receive(datagram, now_s), *session.data(session.presentations(now_s))):
            assert len(sent) <= MAX_DATAGRAM, len(sent)
        session.due(now_s)
    SlimevrDecoder().feed(data)
    session.receive(data, now_s)


def witmotion_stream(data: bytes) -> None:
    """Packets of a WitMotion device, its frames on CAN, and what a host writes."""
    _same_messages_however_cut(data, "witmotion")
    WitMotionCanDecoder().feed(data)
    read_writes(data)


def suit_datagrams(data: bytes) -> None:
    """What MVN, mocopi and a BNO08x send."""
    for language in ("mvn", "mocopi", "bno08x_rvc"):
        _same_messages_however_cut(data, language)


def _same_messages_however_cut(data: bytes, language: str) -> None:
    whole, cut = (LANGUAGES[language].decoder() for _ in range(2))
    place = data[0] * len(data) // 256 if data else 0
    together, apart = whole.feed(data), [*cut.feed(data[:place]), *cut.feed(data[place:])]
    assert repr(list(together)) == repr(apart), "messages depend on chunks"
    assert whole.dropped == cut.dropped, (whole.dropped, cut.dropped)


def can_stream(data: bytes) -> None:
    """Records are whole in a chunk, so a stream of them is cut between two."""
    frames = unpack_can_records(data)
    pieces = [pack_can_records([each]) for each in frames if _can_be_sent(each.identifier, each.is_extended)]
    frame, sent = _framed(data), b""
    if frame is not None:
        with contextlib.suppress(ValueError):  # a body that CAN does not carry
            sent = pack_can_records(fragment(frame))
    _same_both_ways(Framing.CAN, data, sent, sent)
    if len(pieces) != len(frames):
        return
    whole, cut = PacketDecoder(CanFrameDecoder()), PacketDecoder(CanFrameDecoder())
    together = whole.feed(b"".join(pieces))
    one_by_one = [packet for piece in pieces for packet in cut.feed(piece)]
    assert repr(together) == repr(one_by_one), "reassembly depends on chunks"
    assert whole.dropped == cut.dropped, (whole.dropped, cut.dropped)


def slcan_text(data: bytes) -> None:
    """Lines of text to CAN frames that can be packed."""
    whole, cut = SlcanDecoder(), SlcanDecoder()
    frames = whole.feed(data)
    pack_can_records(frames)
    at = data[0] % len(data) if data else 0
    assert len(cut.feed(data[:at]) + cut.feed(data[at:])) == len(frames)


def can_transfers(data: bytes) -> None:
    """Pieces in any order from any module; time goes on with the input."""
    receiver, now_ns = TransferReceiver(), 0
    for at in range(0, len(data), 16):
        block = data[at : at + 16]
        module, kind = block[0] % 64, TransferToHost.KIND if block[0] & 64 else TransferToModule.KIND
        piece = decode_body(kind, block[2:])
        now_ns += block[1] * _PATIENCE_NS if len(block) > 1 else 0
        if isinstance(piece, TransferToHost | TransferToModule):
            receiver.receive(module, piece, now_ns)
        for _, answer in receiver.due(now_ns):
            encode_packet(answer)
    assert receiver.accepted + sum(receiver.dropped.values()) <= len(data)


class _Device(IdleDevice):
    """A device that has a card with two files."""

    def __init__(self) -> None:
        super().__init__(unique_id=bytes(12))
        self.card = EmulatedCard()
        for start_us in (0, 1000):
            self.card.begin(start_us)
            self.card.write(bytes(300))
            self.card.end()


def commands(data: bytes) -> None:
    """A command to a device whose answer the host takes; and any bytes as an answer."""
    if len(data) < 2:
        return
    verb, body = data[0], data[1:]
    decode_arguments(verb, body)
    answer = decode_payload(verb, body)
    if answer is not None:
        assert encode_payload(verb, *answer) == body, f"{verb}: {body!r} is read as {answer}"
    responder = CommandResponder(_Device())
    for packet in responder.answer(Command(transaction=1, verb=verb, arguments=body[:200])):
        encode_packet(packet)
    for kind in PACKETS:
        packet_or_defect = decode_body(kind, body)
        if isinstance(packet_or_defect, Command):
            responder.answer(packet_or_defect)
        elif isinstance(packet_or_defect, Acknowledgement):
            waiting = Transactions(packet_or_defect.transaction)
            asked = packet_or_defect.verb if packet_or_defect.verb in VERBS else Verb.HELLO
            waiting.begin(Verb(asked), 1, ANYONE, b"", 0.0)
            waiting.take(packet_or_defect, 1, "link")
        elif not isinstance(packet_or_defect, Defect):
            encode_packet(packet_or_defect)


class _Image:
    """A flash that holds the input."""

    def __init__(self, data: bytes) -> None:
        self.content = bytearray(data[: 2 * SLOT_SIZE].ljust(2 * SLOT_SIZE, b"\xff"))

    def read(self, address: int, n: int) -> bytes:
        return bytes(self.content[address : address + n])

    def erase(self, slot: int) -> None:
        self.content[slot * SLOT_SIZE : (slot + 1) * SLOT_SIZE] = b"\xff" * SLOT_SIZE

    def program(self, address: int, data: bytes) -> None:
        self.content[address : address + len(data)] = data


def flash_slots(data: bytes) -> None:
    """Whatever stands in the flash, settings can be loaded, stored, and loaded again."""
    half = len(data) // 2
    _stored_and_loaded(data[:half], data[half:])
    _stored_and_loaded(_slot(data), b"")


def _slot(entries: bytes) -> bytes:
    """A slot whose checksum is right, whatever its entries are."""
    head = struct.pack("<IIHH", SLOT_MAGIC, 1, len(entries), 0)
    return head + entries + zlib.crc32(head + entries).to_bytes(4, "little")


def _stored_and_loaded(first: bytes, second: bytes) -> None:
    store = SlotStore(_Image(first.ljust(SLOT_SIZE, b"\xff")[:SLOT_SIZE] + second))
    settings = store.load()
    store.commit(settings)
    assert repr(store.load()) == repr(settings)


def gnss(data: bytes) -> None:
    """Cut anywhere, fixes are the same; and with the checksums that belong to it."""
    _same_fixes_however_cut(data)
    _same_fixes_however_cut(b"\r\n".join(_with_checksum(line) for line in data.split(b"\n")) + b"\r\n")
    if data[:2] == _UBX_HEAD:
        _same_fixes_however_cut(_ubx(data[2:4], data[6:]))


_UBX_HEAD = b"\xb5\x62"


def _with_checksum(line: bytes) -> bytes:
    content = line.strip().partition(b"*")[0].removeprefix(b"$")
    return b"$%s*%02X" % (content, functools.reduce(operator.xor, content, 0))


def _ubx(kind: bytes, payload: bytes) -> bytes:
    content = kind + len(payload).to_bytes(2, "little") + payload
    first = second = 0
    for value in content:
        first = (first + value) & 255
        second = (second + first) & 255
    return _UBX_HEAD + content + bytes([first, second])


def _same_fixes_however_cut(data: bytes) -> None:
    whole, cut = GnssDecoder(), GnssDecoder()
    fixes = whole.feed(data)
    at = data[0] % len(data) if data else 0
    assert repr(cut.feed(data[:at]) + cut.feed(data[at:])) == repr(fixes), "fixes depend on chunks"


def markers(data: bytes) -> None:
    """Cut anywhere as a stream is, the messages are the same; every one can be written again.

    Not where the first piece is whole by itself: then it is a datagram, whatever comes after it.
    """
    whole, cut = MarkerReceiver(), MarkerReceiver()
    at = data[0] % len(data) if data else 0
    messages = whole.receive(Chunk(data + b"\n", 10, "optical"))
    pieces = (data[:at], data[at:] + b"\n")
    received = cut.receive(Chunk(pieces[0], 10, "optical"))
    is_datagram = b"\n" not in pieces[0] and (received or cut.dropped)
    received += cut.receive(Chunk(pieces[1], 10, "optical"))
    assert is_datagram or repr(received) == repr(messages)
    for message in messages:
        encode_markers(
            message.sequence, message.time_ns, list(message.markers), list(message.markers.values())
        )


def card_file(data: bytes) -> None:
    """Anything on a card becomes a recording of what is whole in it."""
    source = _SCRATCH / "card.bin"
    source.write_bytes(data)
    convert_card_file(source, _SCRATCH / "card.mcap")


def _same_however_cut(data: bytes, frames: Callable[[], WireFrameDecoder]) -> None:
    whole, cut = PacketDecoder(frames()), PacketDecoder(frames())
    at = data[0] * 17 % len(data) if data else 0
    packets = whole.feed(data)
    assert repr(cut.feed(data[:at]) + cut.feed(data[at:])) == repr(packets), "packets depend on chunks"
    assert whole.dropped == cut.dropped, (whole.dropped, cut.dropped)


def _same_both_ways(framing: Framing, *chunks: bytes) -> None:
    """Kernels give what the readable way gives."""
    both = BothWays(lambda is_compiled: SuitSource(ModuleTable(ClockMode.SHARED, is_compiled=is_compiled)))
    both.add_link("fuzzed", framing)
    for k, data in enumerate(chunks):
        both.receive(Chunk(data, k * 1_000_000, "fuzzed"))
    both.compare_accounts()


def _framed(data: bytes) -> WireFrame | None:
    """The input as a wire frame: kind, module, sequence, time, body; None for one too short or too long."""
    if not 8 <= len(data) <= MAX_FRAME_SIZE - 32:
        return None
    sequence, time_us = int.from_bytes(data[2:4], "little"), int.from_bytes(data[4:8], "little")
    return WireFrame(data[0], data[1], sequence, time_us, data[8:])


def _can_be_sent(identifier: int, is_extended: bool) -> bool:
    return is_extended or identifier < 1 << 11
