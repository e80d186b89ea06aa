"""A CAN adapter that speaks slcan over a byte stream (serial port, pseudo-terminal, TCP) as a link."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Sequence

from devices.link import Chunk, Framing, LinkError, LiveLink
from devices.links.link_counts import LinkCounts
from devices.links.slcan import CLOSE_COMMAND, SlcanDecoder, encode_slcan, open_commands
from firmware_protocol.can_framing import pack_can_records, unpack_can_records

DEFAULT_DATA_BITRATE = 2_000_000
_COMMAND_TIMEOUT_S = 1.0


class SlcanLink:
    """CAN frame records of one slcan adapter.

    ``stream`` carries the text; its arrival times stand. Malformed lines and refused commands are
    counted in ``decoder``; a refused first command is ordinary (the channel was closed already).
    """

    framing = Framing.CAN

    def __init__(
        self,
        stream: LiveLink,
        *,
        bitrate: int = 1_000_000,
        fd: bool = False,
        data_bitrate: int = DEFAULT_DATA_BITRATE,
        name: str | None = None,
    ) -> None:
        """Prepare a link, not yet open; rates in bit/s. Raises ``ValueError`` when slcan has no such rate."""
        self.name = name or stream.name
        self.decoder = SlcanDecoder()
        self._stream = stream
        self._open_commands = open_commands(bitrate, data_bitrate if fd else None)

    @property
    def counts(self) -> LinkCounts:
        """Of the text that carries the frames; empty where its link counts nothing."""
        counts = getattr(self._stream, "counts", None)
        return counts if isinstance(counts, LinkCounts) else LinkCounts()

    async def open(self) -> None:
        """Open the serial port, then the channel by command. Raises ``LinkError`` when it takes none."""
        await self._stream.open()
        self.decoder = SlcanDecoder()
        try:
            for command in self._open_commands:
                async with asyncio.timeout(_COMMAND_TIMEOUT_S):
                    await self._stream.write(command)
        except TimeoutError as error:
            await self._stream.close()
            raise LinkError(f"{self.name} takes no commands: is it an slcan adapter, and alive?") from error
        # Cancelled, too: the port must not stay open without anybody to close it.
        except BaseException:
            await self._stream.close()
            raise

    async def __aiter__(self) -> AsyncIterator[Chunk]:
        async for chunk in self._stream:
            frames = self.decoder.feed(chunk.data)
            if frames:
                yield Chunk(pack_can_records(frames), chunk.arrived_ns, self.name)

    async def write(self, data: bytes, to: Sequence[str] = ()) -> None:
        """Send CAN frame records. Raises ValueError for a frame that CAN does not have."""
        await self._stream.write(b"".join(encode_slcan(frame) for frame in unpack_can_records(data)))

    async def close(self) -> None:
        """Close the adapter's channel, if it is still there, and the port."""
        try:
            # An adapter that is gone, or never was there, takes no command.
            with contextlib.suppress(LinkError, TimeoutError):
                async with asyncio.timeout(_COMMAND_TIMEOUT_S):
                    await self._stream.write(CLOSE_COMMAND)
        finally:
            await self._stream.close()
