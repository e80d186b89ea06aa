"""How much of a line a suit takes: bits of every wire frame, on a UART and on a CAN bus.

CAN figures are the worst case of bit stuffing, so a bus that fits by them fits always. Sources: ISO 11898-1
(frame formats); Davis, Burns, Bril, Lukkien 2007, "Controller Area Network schedulability analysis",
sec. 3.1 (stuff bits of classic CAN).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from firmware_protocol.can_framing import fragment
from firmware_protocol.framing import encode_frame
from firmware_protocol.packets import Packet, relay_batch, wire_frame

UART_BITS_A_BYTE = 10  # 8N1: start bit, 8 data bits, stop bit

_CLASSIC_STUFFED = 54  # from start of frame to the CRC, extended identifier, without data
_TRAILER = 13  # CRC delimiter, acknowledgement and its delimiter, end of frame, space between frames
_FD_ARBITRATION = 36  # from start of frame to the bit-rate switch, extended identifier
_FD_CONTROL = 5  # error state and length, at the data bit rate
_FD_STUFF_COUNT = 4
_FD_SHORT_DATA = 16  # up to here the CRC has 17 bits, beyond 21


@dataclass(frozen=True, slots=True)
class Traffic:
    """What one kind of packet takes."""

    packet: Packet
    senders: int
    rate_hz: float
    """Packets a second of each sender."""


def can_frame_seconds(data_size: int, bitrate: int, data_bitrate: int | None = None) -> float:
    """Return the longest time of one frame with an extended identifier, s. ``data_bitrate``: CAN FD; None:
    classic."""
    bits = 8 * data_size
    if data_bitrate is None:
        stuffed = _CLASSIC_STUFFED + bits
        # At worst one bit is stuffed after every four that follow the first.
        return (stuffed + (stuffed - 1) // 4 + _TRAILER) / bitrate
    arbitration = _FD_ARBITRATION + (_FD_ARBITRATION - 1) // 4 + _TRAILER
    # The checksum of CAN FD has its stuff bits at fixed places, and is longer for long data.
    crc, fixed_stuff = (17, 6) if data_size <= _FD_SHORT_DATA else (21, 7)
    payload = _FD_CONTROL + bits
    data = payload + payload // 4 + _FD_STUFF_COUNT + crc + fixed_stuff
    return arbitration / bitrate + data / data_bitrate


def can_load(traffic: Iterable[Traffic], bitrate: int, data_bitrate: int | None = None) -> float:
    """Return share of a CAN bus that the traffic takes at worst; above 1 it does not fit."""
    load = 0.0
    for part in traffic:
        pieces = fragment(wire_frame(part.packet, 0, 0, 0), fd=data_bitrate is not None)
        seconds = sum(can_frame_seconds(len(piece.data), bitrate, data_bitrate) for piece in pieces)
        load += seconds * part.senders * part.rate_hz
    return load


def uart_load(traffic: Iterable[Traffic], baud: int, has_relay: bool = False) -> float:
    """Return share of a UART (8N1) that the traffic takes; above 1 it does not fit.

    has_relay: all senders of one kind share a batch each time.
    """
    bytes_a_second = 0.0
    for part in traffic:
        frame = wire_frame(part.packet, 0, 0, 0)
        if has_relay:
            bytes_a_second += len(encode_frame(relay_batch([frame] * part.senders, 0, 0))) * part.rate_hz
        else:
            bytes_a_second += len(encode_frame(frame)) * part.senders * part.rate_hz
    return bytes_a_second * UART_BITS_A_BYTE / baud
