"""Packets out of the chunks of a link, with a decoder for each of its senders. Sans-I/O, deterministic.

Anybody who reaches a UDP port can send to it. Bytes of one sender therefore never join those of another, and
only those who have sent a valid packet lately are to be written to (``senders``). A link whose chunks name
no sender has one decoder, as a serial port has one other end.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sized
from typing import Generic, Protocol, TypeVar

from devices.link import Chunk, Framing
from firmware_protocol import CanFrameDecoder, Defect, FrameDecoder, PacketDecoder, ReceivedPacket

MOST_SENDERS = 128
"""Remembered at once: twice as many as there are module ids. Strangers make room first."""

SILENT_AFTER_NS = 60_000_000_000
"""Nothing is written any more to a sender that has sent nothing valid for so long: it has another port since
it restarted, or is gone."""

_MOST_NAMED = 8
"""Strangers that are named."""


Packets = TypeVar("Packets", bound=Sized)
_Packets_co = TypeVar("_Packets_co", bound=Sized, covariant=True)


class Decoder(Protocol[_Packets_co]):
    """What takes the bytes of one sender apart: ``PacketDecoder``, or what does the same."""

    @property
    def dropped(self) -> Counter[Defect]:
        """What was dropped by reason."""
        ...

    @property
    def damaged(self) -> int:
        """How many drops there were that packets of ours may have been lost in."""
        ...

    def feed(self, chunk: bytes) -> _Packets_co:
        """Return the packets that a chunk completes, in order."""
        ...


class _Sender(Generic[Packets]):
    """One sender's bytes so far."""

    __slots__ = ("chunks", "decoder", "valid_ns")

    def __init__(self, decoder: Decoder[Packets]) -> None:
        self.decoder = decoder
        self.valid_ns: int | None = None
        """Arrival of the newest chunk that completed a packet; None: it is a stranger."""
        self.chunks = 0
        """That came while it was a stranger."""


class SenderDecoders(Generic[Packets]):
    """Takes the chunks of one link apart. ``feed`` never raises; what is dropped is counted."""

    def __init__(self, make: Callable[[], Decoder[Packets]]) -> None:
        """Begin without senders; ``make`` returns the decoder of a new one."""
        self.accepted = 0
        """Packets handed out."""
        self.strange_chunks = 0
        """Chunks of senders that had sent no valid packet until then."""
        self.is_trusted = False
        """Whether the sender of the chunk fed last has ever sent a valid packet, or is the only one."""
        self.is_damaged = False
        """Whether packets of a trusted sender may have been lost in the chunk fed last."""
        self._make = make
        self._by_sender: dict[str, _Sender[Packets]] = {}  # the one heard least recently first
        self._dropped_before: Counter[Defect] = Counter()  # of senders that are forgotten
        self._now_ns = 0

    def feed(self, chunk: Chunk) -> Packets:
        """Return the packets that a chunk completes, in order."""
        self._now_ns = chunk.arrived_ns
        # Taken out and put in again: the dictionary's order is that of the last word.
        sender = self._by_sender.pop(chunk.sender, None) or _Sender(self._make())
        self._by_sender[chunk.sender] = sender
        if len(self._by_sender) > MOST_SENDERS:
            self._forget_one(chunk.sender)
        damaged = sender.decoder.damaged
        packets = sender.decoder.feed(chunk.data)
        if packets:
            sender.valid_ns = chunk.arrived_ns
            self.accepted += len(packets)
        # A stranger's garbage must not count as damage of the suit's data.
        self.is_trusted = not chunk.sender or sender.valid_ns is not None
        self.is_damaged = self.is_trusted and sender.decoder.damaged != damaged
        if not self.is_trusted:
            sender.chunks += 1
            self.strange_chunks += 1
        return packets

    @property
    def senders(self) -> tuple[str, ...]:
        """Who may be written to: those who sent something valid lately. Empty where chunks name no sender."""
        oldest_ns = self._now_ns - SILENT_AFTER_NS
        return tuple(
            name
            for name, sender in self._by_sender.items()
            if name and sender.valid_ns is not None and sender.valid_ns >= oldest_ns
        )

    @property
    def dropped(self) -> Counter[Defect]:
        """What was dropped by reason, of all senders."""
        total = self._dropped_before.copy()
        for sender in self._by_sender.values():
            total.update(sender.decoder.dropped)
        return total

    @property
    def strangers(self) -> tuple[str, ...]:
        """Senders that never sent anything valid, the latest ones first; at most eight are named."""
        names = [name for name, sender in self._by_sender.items() if name and sender.valid_ns is None]
        return tuple(reversed(names[-_MOST_NAMED:]))

    def statistics(self) -> dict[str, object]:
        """Return who sends, for the health message; empty where chunks name no sender."""
        if not any(self._by_sender):
            return {}
        return {
            "senders": list(self.senders),
            "strangers": list(self.strangers),
            "strange_chunks": self.strange_chunks,
        }

    def _forget_one(self, newest: str) -> None:
        """Forget a stranger other than the newest; without one, the sender heard least recently."""
        strangers = (
            name for name, sender in self._by_sender.items() if sender.valid_ns is None and name != newest
        )
        forgotten = self._by_sender.pop(next(strangers, next(iter(self._by_sender))))
        # Its counts stay in the sum: what was dropped must stay accounted for.
        self._dropped_before.update(forgotten.decoder.dropped)


class LinkDecoder(SenderDecoders[list[ReceivedPacket]]):
    """The same, to packets one by one."""

    def __init__(self, framing: Framing) -> None:
        super().__init__(lambda: packet_decoder(framing))


def packet_decoder(framing: Framing) -> PacketDecoder:
    """Return a decoder of one stream of bytes, or of CAN records."""
    return PacketDecoder(FrameDecoder() if framing is Framing.BYTE_STREAM else CanFrameDecoder())
