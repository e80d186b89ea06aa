"""One module on one link: everything that it said is kept, and anything can be said to it."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator
from typing import Any, NamedTuple, TypeVar

from devices.commands.command_client import host_bytes
from devices.link import Chunk, Link, LinkError, gateway_time_ns
from devices.link_decoder import LinkDecoder
from firmware_protocol import BROADCAST, Packet, ReceivedPacket, WireFrame, wire_frame
from firmware_protocol.commands import Verb, encode_arguments
from firmware_protocol.messages import ANYONE, Acknowledgement, Command, DeviceInfo

PATIENCE_S = 3.0
"""For what should come at once: ends the wait for what does not come at all."""
_ATTEMPT_S = 1.0
_ATTEMPTS = 3
_QUIET_S = 0.15

P = TypeVar("P", bound=Packet)


class ArrivedPacket(NamedTuple):
    """A packet, and when the chunk that completed it came."""

    received: ReceivedPacket
    arrived_ns: int

    @property
    def packet(self) -> Any:
        """Return what was in the wire frame."""
        return self.received.packet


class NoModuleError(Exception):
    """There is nothing to be tested; says what was heard."""


class Bench:
    """A link that is open, and the module under test at its other end."""

    unique_id: bytes
    module: int
    """Id that it sends under; ``identify`` and every answer renew it."""

    def __init__(self, link: Link) -> None:
        self.link = link
        self.decoder = LinkDecoder(link.framing)
        self.packets: list[ArrivedPacket] = []
        self.is_lost: str | None = None
        """Why the link is no longer read."""
        # From the time, since the module may still remember answers to the numbers of an earlier run.
        self._transaction = gateway_time_ns() // 1000 % 2**16
        self._sequences: Counter[int] = Counter()
        self._news = asyncio.Event()

    @contextlib.asynccontextmanager
    async def reading(self) -> AsyncIterator[None]:
        """Open the link and read it for as long as the block lasts. Raises ``LinkError``."""
        await self.link.open()
        reader = asyncio.create_task(self._read())
        try:
            yield
        finally:
            reader.cancel()
            await asyncio.gather(reader, return_exceptions=True)
            await self.link.close()

    async def find(self, device: str | None = None, listen_s: float = PATIENCE_S) -> None:
        """Find the module under test: by id or beginning of its unique id, else the only one there is.

        Raises ``NoModuleError``.
        """
        infos: dict[bytes, int] = {}
        chosen: list[bytes] = []
        for _ in range(_ATTEMPTS):  # behind a relay others may answer first
            await self.send_command(Verb.GET_INFO)
            await self.until(lambda: bool(self.of(DeviceInfo)), listen_s)
            await asyncio.sleep(_QUIET_S)
            infos = {each.packet.unique_id: each.received.module for each in self.of(DeviceInfo)}
            chosen = [uid for uid, module in infos.items() if device is None or _means(device, uid, module)]
            if chosen:
                break
        if not infos:
            raise NoModuleError(
                f"no DeviceInfo came in {_ATTEMPTS * listen_s:.0f} s, but {len(self.packets)} other packets: "
                "a module sends one when it is asked for it, and every 5 s"
            )
        if len(chosen) != 1:
            there = ", ".join(f"{module} ({uid.hex()})" for uid, module in infos.items())
            raise NoModuleError(f"there are {there}: name one with --device")
        self.unique_id = chosen[0]
        self.module = infos[self.unique_id]

    # What was heard.

    def mark(self) -> int:
        """Return the place in ``heard`` from which ``of`` is to look on."""
        return len(self.packets)

    def of(self, packet: type[P], since: int = 0) -> list[ArrivedPacket]:
        """Return what was heard of a kind since a mark."""
        return [each for each in self.packets[since:] if isinstance(each.received.packet, packet)]

    def from_module(self, packet: type[P], since: int = 0) -> list[ArrivedPacket]:
        """Return what the module under test sent of a kind."""
        return [each for each in self.of(packet, since) if each.received.module == self.module]

    async def until(self, condition: Callable[[], bool], timeout_s: float = PATIENCE_S) -> bool:
        """Wait for a condition on what was heard; whether it came true."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                while not condition():
                    self._news.clear()
                    await self._news.wait()
        return condition()

    async def answered(self, transaction: int, since: int, timeout_s: float = PATIENCE_S) -> bool:
        """Return whether the module answers a transaction in time."""
        return await self.until(lambda: bool(self.answers(transaction, since)), timeout_s)

    # What is said.

    async def send(self, packet: Packet, module: int) -> int:
        """Send a packet of the host; when it was handed over, ns."""
        return await self.write(host_bytes(self.frame(packet, module), self.link.framing))

    def frame(self, packet: Packet, module: int) -> WireFrame:
        """Return the next wire frame of the host with this packet."""
        sequence = self._sequences[packet.KIND]
        self._sequences[packet.KIND] = (sequence + 1) % 2**16
        return wire_frame(packet, module, sequence, gateway_time_ns() // 1000 % 2**32)

    async def write(self, data: bytes) -> int:
        """Send bytes as they are; when they were handed over, ns."""
        sent_ns = gateway_time_ns()
        await self.link.write(data, self.decoder.senders)
        return sent_ns

    def next_transaction(self) -> int:
        """Return a number that was not used for long."""
        self._transaction = (self._transaction + 1) % 2**16
        return self._transaction

    async def send_command(
        self,
        verb: int,
        arguments: bytes = b"",
        *,
        module: int = BROADCAST,
        unique_id: bytes = ANYONE,
        transaction: int | None = None,
    ) -> int:
        """Send a command once; return its transaction."""
        number = self.next_transaction() if transaction is None else transaction
        await self.send(Command(number, verb, unique_id, arguments), module)
        return number

    def answers(self, transaction: int, since: int = 0) -> list[ArrivedPacket]:
        """Return the module's answers to a transaction."""
        return [
            each
            for each in self.of(Acknowledgement, since)
            if each.packet.transaction == transaction and each.packet.unique_id == self.unique_id
        ]

    async def request(
        self, verb: int, *values: Any, arguments: bytes | None = None
    ) -> Acknowledgement | None:
        """Ask the module by its unique id, again where it does not answer; None where it never does.

        values: as the verb declares them, or ``arguments`` as bytes.
        """
        data = encode_arguments(verb, *values) if arguments is None else arguments
        number = self.next_transaction()
        since = self.mark()
        for _ in range(_ATTEMPTS):
            await self.send_command(verb, data, unique_id=self.unique_id, transaction=number)
            if await self.until(lambda: bool(self.answers(number, since)), _ATTEMPT_S):
                answer = self.answers(number, since)[0]
                self.module = answer.received.module
                acknowledgement: Acknowledgement = answer.packet
                return acknowledgement
        return None

    async def is_answering(self) -> bool:
        """Return whether the module answers a command now; its answers to earlier ones have come by then."""
        answer = await self.request(Verb.HELLO, 1, 1)
        await asyncio.sleep(_QUIET_S)
        return answer is not None

    async def _read(self) -> None:
        try:
            async for item in self.link:
                if isinstance(item, Chunk):
                    self.packets += [ArrivedPacket(each, item.arrived_ns) for each in self.decoder.feed(item)]
                    self._news.set()
            self.is_lost = "the other side closed it"
        except LinkError as error:
            self.is_lost = str(error)


def _means(text: str, unique_id: bytes, module: int) -> bool:
    return text == str(module) or (len(text) >= 4 and unique_id.hex().startswith(text.lower()))


def steps(numbers: list[int], modulus: int) -> Iterator[int]:
    """Yield the differences of neighbours of a counter that wraps."""
    for before, after in itertools.pairwise(numbers):
        yield (after - before) % modulus
