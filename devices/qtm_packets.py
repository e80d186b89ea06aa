"""What Qualisys QTM says over its real-time protocol, as marker messages.

The protocol is described at docs.qualisys.com/qtm-rt-protocol: lengths in mm, instants in µs of the cameras'
clock, a marker that is not seen is NaN. Packets are taken apart by the vendor's client (``qtm_rt``).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any, Protocol
from xml.etree.ElementTree import ParseError

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring

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
