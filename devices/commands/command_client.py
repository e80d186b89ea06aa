"""Asks devices to do something, over links that another task reads.

    client = CommandClient(links, allow_writes=False)
    for packet_class in LISTENS_TO:  # or: async with client.reading(): ...
        stream.listen(packet_class, client.take)
    chosen, lowest, highest = await client.request(unique_id, Verb.HELLO, 1, 1)

What changes a device is refused unless ``allow_writes``. Belongs to one event loop.
"""

from __future__ import annotations

import asyncio
import contextlib
import secrets
from collections import Counter
from collections.abc import AsyncIterator, Callable, Collection, Iterable, Sequence
from typing import Any

from devices.commands.device_errors import CommandRefusedError, DeviceError, NoAnswerError, WritesLockedError
from devices.commands.transactions import Answer, Exchange, Transactions
from devices.link import Chunk, Framing, Link, LinkError, SentChunk, gateway_time_ns
from devices.link_decoder import LinkDecoder
from firmware_protocol import (
    BROADCAST,
    DeviceInfo,
    Health,
    ReceivedPacket,
    WireFrame,
    encode_frame,
    fragment,
    pack_can_records,
    wire_frame,
)
from firmware_protocol.commands import VERBS, Result, Verb, decode_payload, encode_arguments
from firmware_protocol.messages import ANYONE, Acknowledgement

LISTENS_TO = (Acknowledgement, DeviceInfo, Health)
"""Packets that the client is to be handed."""

MOST_DEVICES = 1024
"""Remembered: far more than there are ids, since a device may have changed its own."""

_SEND_TIMEOUT_S = 1.0
_BUSY_ATTEMPTS = 4
_BUSY_PAUSE_S = 0.2


class CommandClient:
    """Sends commands, sends them again, and gives back the answers."""

    def __init__(
        self,
        links: Iterable[Link],
        *,
        allow_writes: bool = False,
    ) -> None:
        """Prepare to ask. Numbers begin at random, so that no device takes one for an old one."""
        self.links = {link.name: link for link in links}
        self.allow_writes = allow_writes
        self.transactions = Transactions(secrets.randbelow(2**16))
        self.link_of: dict[bytes, str] = {}
        """Link that each device was last heard on, by unique id."""
        self.sender_of: dict[bytes, str] = {}
        """Its address there, by unique id; empty on a link with one other end."""
        self.senders: Callable[[str], Sequence[str]] = lambda _link: ()
        """Who is to be written to on a link with several senders, by its name."""
        self.infos: dict[bytes, tuple[int, DeviceInfo]] = {}
        """Newest module id and description of each device heard."""
        self.healths: dict[int, Health] = {}
        """Newest health by module id."""
        self.on_sent: Callable[[SentChunk], None] | None = None
        """Called with everything that was written to a link."""
        self._decoders: dict[str, LinkDecoder] = {}  # of links that are read here
        self._sequences: Counter[int] = Counter()
        self._answered: dict[int, asyncio.Event] = {}

    def take(self, received: ReceivedPacket, chunk: Chunk) -> None:
        """Look at a packet and the chunk it came in; others than ``LISTENS_TO`` are let pass."""
        packet, link = received.packet, chunk.link
        if isinstance(packet, Acknowledgement):
            self._note_route(packet.unique_id, chunk)
            if self.transactions.take(packet, received.module, link) is not None:
                self._answered[packet.transaction].set()
        elif isinstance(packet, DeviceInfo):
            self._note_route(packet.unique_id, chunk)
            self.infos[packet.unique_id] = (received.module, packet)
        elif isinstance(packet, Health):
            self.healths[received.module] = packet

    def _note_route(self, unique_id: bytes, chunk: Chunk) -> None:
        """Note by which link, and from which sender, a device is reached; beyond ``MOST_DEVICES`` the oldest
        is forgotten, as ids may be made up.
        """
        self.link_of[unique_id], self.sender_of[unique_id] = chunk.link, chunk.sender
        if len(self.link_of) > MOST_DEVICES:
            oldest = next(iter(self.link_of))
            del self.link_of[oldest]
            self.sender_of.pop(oldest, None)
            self.infos.pop(oldest, None)

    async def request(self, unique_id: bytes, verb: Verb, *values: Any) -> tuple[Any, ...]:
        """Return what the device with this unique id answers: the payload's values.

        Raises ``WritesLockedError``, ``NoAnswerError``, ``CommandRefusedError``, ``LinkError`` when no link
        is up, and ``ValueError`` for values that do not fit the verb.
        """
        for _ in range(_BUSY_ATTEMPTS):
            answer = await self._request_once(unique_id, verb, values)
            if answer.result is not Result.BUSY:
                break
            # The device would repeat "busy" to the same transaction: ask anew.
            await asyncio.sleep(_BUSY_PAUSE_S)
        if answer.result is not Result.DONE:
            raise CommandRefusedError(f"device {unique_id.hex()}", verb.name, answer.result)
        payload = decode_payload(verb, answer.payload)
        if payload is None:
            raise DeviceError(
                f"device {unique_id.hex()} answered {verb.name} in a way that this version cannot read: "
                "its firmware may be newer than the gateway"
            )
        return payload

    async def request_all(
        self, verb: Verb, *values: Any, known: Collection[bytes] = ()
    ) -> dict[bytes, Answer]:
        """Return the answers of all devices that can be heard, by unique id; no answer at all is no error.

        known: unique ids of the devices that were there a moment ago. Once they have answered nobody is asked
        again: that takes a quarter of a second, where it takes more than a second to find out who is there.
        Raises ``WritesLockedError``, and ``LinkError`` when no link is up.
        """
        exchange = self._begin(ANYONE, verb, values, known)
        unsent = await self._carry_out(exchange, None)
        if unsent is not None:
            raise unsent
        return exchange.answers

    @contextlib.asynccontextmanager
    async def reading(self) -> AsyncIterator[None]:
        """Open the links and read them here, for as long as this lasts. Raises ``LinkError``.

        A link that is lost meanwhile shows in that commands are not answered.
        """
        readers: list[asyncio.Task[None]] = []
        # On links read here, the decoders know who sends; elsewhere the stream does.
        self.senders = lambda link: self._decoders[link].senders if link in self._decoders else ()
        try:
            # Readers are cancelled before links are closed, so that none of them reports a loss.
            for link in self.links.values():
                await link.open()
                self._decoders[link.name] = LinkDecoder(link.framing)
                readers.append(asyncio.create_task(self._read(link), name=f"link {link.name}"))
            yield
        finally:
            for reader in readers:
                reader.cancel()
            await asyncio.gather(*readers, return_exceptions=True)
            for link in self.links.values():
                await link.close()

    async def _read(self, link: Link) -> None:
        async for item in link:
            if isinstance(item, Chunk):
                for received in self._decoders[link.name].feed(item):
                    self.take(received, item)

    async def _request_once(self, unique_id: bytes, verb: Verb, values: tuple[Any, ...]) -> Answer:
        exchange = self._begin(unique_id, verb, values)
        unsent = await self._carry_out(exchange, unique_id)
        for answer in exchange.answers.values():
            return answer
        if unsent is not None:
            raise unsent
        raise NoAnswerError(
            f"device {unique_id.hex()} does not answer {verb.name} (asked {exchange.attempts} times): "
            "is it switched on and in range?"
        )

    def _begin(
        self, unique_id: bytes, verb: Verb, values: tuple[Any, ...], known: Collection[bytes] = ()
    ) -> Exchange:
        if VERBS[verb].changes_device and not self.allow_writes:
            raise WritesLockedError(verb.name)
        arguments = encode_arguments(verb, *values)
        return self.transactions.begin(verb, BROADCAST, unique_id, arguments, self._now_s(), known)

    async def _carry_out(self, exchange: Exchange, device: bytes | None) -> LinkError | None:
        """Send and wait until the exchange is over. Why nothing could be sent, when nothing could be.

        device: unique id of the one that is asked; None: all are.
        """
        transaction = exchange.command.transaction
        answered = self._answered[transaction] = asyncio.Event()
        unsent: LinkError | None = None
        has_been_sent = False
        try:
            while not exchange.is_over(self._now_s()):
                answered.clear()
                if exchange.takes_turn(self._now_s()):
                    # A link that is away may be back at the next attempt, as a restarted device on USB.
                    unsent = await self._send(exchange, device if exchange.attempts == 1 else None)
                    has_been_sent |= unsent is None
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(max(exchange.next_s - self._now_s(), 0.0)):
                        await answered.wait()
        finally:
            self.transactions.end(exchange)
            del self._answered[transaction]
        return None if has_been_sent else unsent

    async def _send(self, exchange: Exchange, device: bytes | None) -> LinkError | None:
        """Send to where the device was heard; to all links where that is unknown or did not help.

        Returns why it went out on none of them, or None.
        """

        target = exchange.target
        sequence = self._sequences[target]
        self._sequences[target] = (sequence + 1) % 2**16
        frame = wire_frame(exchange.command, target, sequence, gateway_time_ns() // 1000 % 2**32)
        link = None if device is None else self.link_of.get(device)
        sender = "" if device is None else self.sender_of.get(device, "")
        # A device that has moved to another link must still be found: then all links are tried.
        chosen = [self.links[link]] if link in self.links else list(self.links.values())
        unsent = LinkError("there is no link to send a command on: configure one")
        failures = 0
        for each in chosen:
            sent = SentChunk(host_bytes(frame, each.framing), gateway_time_ns(), each.name)
            try:
                async with asyncio.timeout(_SEND_TIMEOUT_S):
                    # A link whose other end reads nothing must not keep commands from the others.
                    await each.write(sent.data, [sender] if sender else self.senders(each.name))
                if self.on_sent is not None:
                    self.on_sent(sent)
            except TimeoutError:
                unsent = LinkError(f"{each.name} takes nothing: does the other side read what is sent to it?")
                failures += 1
            except LinkError as error:
                unsent = error
                failures += 1
        return unsent if failures == len(chosen) else None

    def _now_s(self) -> float:
        return gateway_time_ns() * 1e-9


def host_bytes(frame: WireFrame, framing: Framing) -> bytes:
    """Return what to write to a link of that framing to send a wire frame from the host."""
    # Classic CAN frames: every CAN device takes them, FD or not.
    return encode_frame(frame) if framing is Framing.BYTE_STREAM else pack_can_records(fragment(frame))
