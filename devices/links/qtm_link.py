"""Qualisys QTM as a link: its real-time stream of 3-D markers, by the vendor's client (extra ``optical``).

The protocol is described at docs.qualisys.com/qtm-rt-protocol: lengths in mm, instants in µs of the cameras'
clock, a marker that is not seen is NaN. Packets are taken apart by the vendor's client (``qtm_rt``), and
become marker messages.
"""

from __future__ import annotations

import asyncio
import struct
from collections.abc import AsyncIterator, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, NamedTuple, Protocol
from xml.etree.ElementTree import ParseError

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring

from devices.extras import how_to_add
from devices.link import Chunk, Framing, LinkError, gateway_time_ns
from devices.links.arrivals import Arrivals
from devices.links.link_counts import LinkCounts, LostBefore
from devices.links.tcp_link import CONNECT_TIMEOUT_S, connect_error, keep_alive
from devices.marker_messages import encode_markers

HEADER = struct.Struct("<II")
"""Size of a packet in bytes with this header, and its type."""
LARGEST_PACKET = 16 * 1024 * 1024
_DECIMALS = 7  # of m: a tenth of a micrometre, less than a single-precision mm resolves


class QtmPacketError(ValueError):
    """Something that the protocol does not allow; the text says what."""


class DataPacket(Protocol):
    """What the vendor's client makes of a data packet."""

    timestamp: int
    framenumber: int

    def get_3d_markers(self) -> tuple[Any, list[tuple[float, float, float]]] | None:
        """Return the named markers' places, mm, in the order of the parameters; None: the packet has none."""

    def get_3d_markers_no_label(self) -> tuple[Any, list[tuple[float, float, float, int]]] | None:
        """Return the other markers' places, mm, each with its id; None: the packet has none."""


@dataclass(frozen=True)
class Marking:
    """What QTM calls its markers."""

    labels: tuple[str, ...]
    """In the order in which the packets have them."""
    up: str | None
    """Axis that points up, x, y or z; None: QTM has one that points down, or does not say."""


def marking_of(xml: bytes) -> Marking:
    """Return the labels in QTM's 3D parameters. Raises ``QtmPacketError`` where there are none."""
    try:
        found = fromstring(xml)
    except (ParseError, DefusedXmlException, ValueError) as error:
        raise QtmPacketError(f"its 3D parameters are no XML: {error}") from error
    section = found if found.tag == "The_3D" else found.find("The_3D")
    if section is None:
        raise QtmPacketError("it has no 3D data")
    labels = tuple((each.findtext("Name") or "").strip() for each in section.iter("Label"))
    axis = (section.findtext("AxisUpwards") or "").strip().lower()
    return Marking(labels, axis[1] if axis in {"+x", "+y", "+z"} else None)


def packets_of(received: bytes) -> tuple[list[bytes], bytes]:
    """Return whole packets, and the rest. Raises ``QtmPacketError`` for a size that no packet has."""
    packets, at = [], 0
    while len(received) - at >= HEADER.size:
        size, _ = HEADER.unpack_from(received, at)
        # A size that no packet has would have us wait for ever.
        if not HEADER.size <= size <= LARGEST_PACKET:
            raise QtmPacketError(f"a packet of {size} bytes")
        if len(received) - at < size:
            break
        packets.append(received[at : at + size])
        at += size
    return packets, received[at:]


def message_of(packet: DataPacket, sequence: int, marking: Marking) -> bytes:
    """Return a data packet as a marker message.

    Raises ``QtmPacketError`` where the number of its markers is not that of the names.
    """
    named, nameless = packet.get_3d_markers(), packet.get_3d_markers_no_label()
    places = [] if named is None else named[1]
    # The names come once, the places in every packet: a project changed meanwhile shows in the number.
    if named is not None and len(places) != len(marking.labels):
        raise QtmPacketError(f"{len(places)} markers, and names for {len(marking.labels)}")
    shown = [
        (label, place) for label, place in zip(marking.labels, map(_metres, places), strict=False) if label
    ]
    return encode_markers(
        sequence,
        None,
        [label for label, _ in shown],
        [place for _, place in shown],
        [_metres(place) for place in ([] if nameless is None else nameless[1])],
        time_s=packet.timestamp * 1e-6,
        up=marking.up,
    )


def _metres(place: tuple[float, ...]) -> tuple[float, float, float]:
    x, y, z = (round(1e-3 * each, _DECIMALS) for each in place[:3])
    return x, y, z


DEFAULT_PORT = 22223
"""That of the protocol with little-endian numbers."""
DEFAULT_VERSION = "1.20"
"""Of the protocol: QTM speaks its own version and all before it."""
ANSWER_TIMEOUT_S = 5.0
_LARGEST_GAP = 100_000
"""In the numbers of frames; a larger one means that QTM has begun to count otherwise."""
_WHAT_WOULD_DO = "open a measurement or a file in QTM and start it (preview, or Play with Real-Time output)"
_IS_IT_THE_PORT = f"is it the port for little-endian numbers ({DEFAULT_PORT} unless QTM was told otherwise)?"
_UNREADABLE = (QtmPacketError, struct.error, ValueError, KeyError, IndexError)


class QtmLink:
    """Labelled and unlabelled 3-D markers of one QTM, as marker messages (``devices.marker_messages``).

    Frames that QTM left out are counted (``NOT_SENT``). When its markers are called otherwise, or it begins
    another measurement, the link is lost, and made anew with the names of then.
    """

    framing = Framing.BYTE_STREAM

    def __init__(
        self, host: str, port: int = DEFAULT_PORT, *, version: str = DEFAULT_VERSION, name: str | None = None
    ) -> None:
        self.name = name or f"qtm://{host}:{port}"
        self.host = host
        self.port = port
        self.version = version
        self.counts = LinkCounts()
        self._arrivals = Arrivals.never_opened(self.name)
        self._connection: _Checked | None = None
        self._numbers = _Numbers(self.counts)

    async def open(self) -> None:
        """Connect, learn the names, have the frames sent. Raises ``LinkError``: no QTM there, it refuses, it
        has no 3-D data, or the extra is missing."""
        if self._connection is not None and not self._arrivals.has_ended:
            raise LinkError(f"{self.name} is already open")
        client = _client()
        loop = asyncio.get_running_loop()
        arrivals = Arrivals(self.name, counts=self.counts)
        protocol = client.QTMProtocol(loop=loop, on_event=lambda event: _restarted(arrivals, event))
        connecting = loop.create_connection(
            lambda: _Checked(protocol, arrivals, f"QTM at {self.host}:{self.port}"), self.host, self.port
        )
        try:
            async with asyncio.timeout(CONNECT_TIMEOUT_S):
                _, self._connection = await connecting
        except OSError as error:  # TimeoutError and gaierror among them
            raise connect_error(self.host, self.port, error) from error
        self._arrivals = arrivals
        try:
            await self._begin(client, client.QRTConnection(protocol, ANSWER_TIMEOUT_S), protocol)
        except LinkError:
            await self.close()
            raise

    async def _begin(self, client: _Client, connection: Any, protocol: Any) -> None:
        place = f"QTM at {self.host}:{self.port}"
        would_do = "write ?version=… with one that it knows behind the address"
        choosing = protocol.set_version(self.version)
        await self._answered(client, choosing, f"{place} refuses version {self.version}", would_do)
        asking = connection.get_parameters(["3d"])
        try:
            refused = f"{place} refuses its 3D parameters"
            marking = marking_of(await self._answered(client, asking, refused, _WHAT_WOULD_DO))
        except QtmPacketError as error:
            raise LinkError(f"{place}: {error}; {_WHAT_WOULD_DO}") from error
        streaming = connection.stream_frames(
            "allframes", ["3d", "3dnolabels"], on_packet=lambda packet: self._take(packet, marking)
        )
        await self._answered(client, streaming, f"{place} refuses to stream", _WHAT_WOULD_DO)

    async def _answered(self, client: _Client, asking: Any, refused: str, would_do: str) -> bytes:
        """Return QTM's answer. Raises ``LinkError``."""
        assert self._connection is not None  # open sees to it
        answering = asyncio.ensure_future(asking)
        # The vendor's client waits for ever when QTM closes the connection in the middle of an answer.
        hung_up = asyncio.ensure_future(self._connection.gone.wait())
        try:
            await asyncio.wait({answering, hung_up}, timeout=ANSWER_TIMEOUT_S, return_when="FIRST_COMPLETED")
            if answering.done():
                return answering.result() or b""  # of the version, nothing
        except client.QRTCommandException as error:
            value = error.value
            text = value.decode(errors="replace") if isinstance(value, bytes) else str(value)
            raise self._arrivals.error or LinkError(f"{refused}: '{text}'; {would_do}") from error
        finally:
            answering.cancel()
            hung_up.cancel()
        raise self._arrivals.error or LinkError(
            f"{self.host}:{self.port} does not answer as QTM does: {_IS_IT_THE_PORT}"
        )

    def _take(self, packet: DataPacket, marking: Marking) -> None:
        """Take one frame in the receive callback; ``_Checked`` reports what cannot be read."""
        sequence = self._numbers.next(packet.framenumber)
        self._arrivals.put(message_of(packet, sequence, marking), gateway_time_ns())

    def __aiter__(self) -> AsyncIterator[Chunk]:
        return self._arrivals

    async def write(self, data: bytes, to: Sequence[str] = ()) -> None:
        """Do nothing: QTM takes no commands of modules."""

    async def close(self) -> None:
        """Hang up; iterating ends."""
        if self._connection is not None:
            await self._connection.close()
            self._connection = None


class _Client(NamedTuple):
    """What is used of the vendor's client."""

    QTMProtocol: Any
    QRTConnection: Any
    QRTCommandException: Any


def _client() -> _Client:
    """Return the vendor's client. Raises ``LinkError`` without the extra."""
    try:
        from qtm_rt import protocol, qrt  # noqa: PLC0415 - an extra
    except ImportError:
        raise LinkError(f"qtm:// needs the extra 'optical': {how_to_add('optical')}") from None
    return _Client(protocol.QTMProtocol, qrt.QRTConnection, protocol.QRTCommandException)


_BEGINNINGS = frozenset({"EventConnected", "EventRTfromFileStarted"})
"""After these, markers may be called otherwise than before."""


def _restarted(arrivals: Arrivals, event: Enum) -> None:
    """End the link when QTM begins another measurement, whose markers may have other names."""
    if event.name in _BEGINNINGS:
        arrivals.end(LinkError("QTM has begun another measurement: its names are asked for again"))


class _Numbers:
    """Sequence numbers out of those of QTM's frames, which begin anew with a measurement or a file.

    Some versions have number 1 on every frame of a live stream; then nothing shows what was left out.
    """

    def __init__(self, counts: LinkCounts) -> None:
        self._counts = counts
        self._last: int | None = None
        self._sequence = -1

    def next(self, number: int) -> int:
        """Return the sequence number of QTM's frame ``number``: one more than the last unless frames are
        missing.
        """
        step = 1 if self._last is None else number - self._last
        self._last = number
        # QTM begins to count anew, or the same frame again: that is no loss.
        if not 0 < step < _LARGEST_GAP:
            step = 1
        self._counts.before[LostBefore.NOT_SENT] += step - 1
        self._sequence += step
        return self._sequence


class _Checked(asyncio.Protocol):
    """Before the vendor's client: only whole packets of sizes that there are reach it.

    Left to itself, it turns for ever at a packet of size 0 and keeps all that a foreign server sends.
    """

    def __init__(self, client: asyncio.Protocol, arrivals: Arrivals, place: str) -> None:
        self._client = client
        self._arrivals = arrivals
        self._place = place
        self._rest = b""
        self._transport: asyncio.Transport | None = None
        self.gone = asyncio.Event()
        """Set once there is no connection any more."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin the vendor's protocol on a new connection."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        keep_alive(transport.get_extra_info("socket"))
        self._client.connection_made(transport)

    def data_received(self, data: bytes) -> None:
        """Hand whole packets to the vendor's client; end the link at what cannot be read."""
        try:
            packets, self._rest = packets_of(self._rest + data)
            for packet in packets:
                self._client.data_received(packet)
        except _UNREADABLE as error:
            self._end(LinkError(f"{self._place} sent what cannot be read: {error}; {_IS_IT_THE_PORT}"))

    def connection_lost(self, error: Exception | None) -> None:
        """End the link, and wake the task that waits for an answer."""
        self._client.connection_lost(error)
        self._end(LinkError(f"{self._place} has hung up" + (f": {error}" if error else "")))
        self.gone.set()

    async def close(self) -> None:
        """End the connection, and wait until it is gone."""
        self._end(None)
        await self.gone.wait()

    def _end(self, error: LinkError | None) -> None:
        self._arrivals.end(error)
        if self._transport is not None:
            self._transport.abort()
