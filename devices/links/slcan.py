"""CAN frames as lines of text (slcan, the protocol of LAWICEL and CANable adapters). Sans-I/O.

A line is a letter, the identifier (3 or 8 hexadecimal digits), the data length code (one digit),
the data, and where the adapter stamps frames 4 or 8 digits of time, ended by a carriage return::

    t1232AABB            classic, 11-bit identifier      d, b   FD without, with bit-rate switch
    T001020304AABBCCDD   classic, 29-bit identifier      D, B   FD without, with bit-rate switch
    r, R                 remote request, 11- and 29-bit identifier
"""

from __future__ import annotations

from binascii import unhexlify
from dataclasses import dataclass

from firmware_protocol.can_framing import FD_LENGTHS, CanFrame

BITRATES = {
    10_000: 0,
    20_000: 1,
    50_000: 2,
    100_000: 3,
    125_000: 4,
    250_000: 5,
    500_000: 6,
    800_000: 7,
    1_000_000: 8,
}
"""Nominal bit rate, bit/s, to the digit of the command ``S``."""

DATA_BITRATES = {500_000: 0, 1_000_000: 1, 2_000_000: 2, 4_000_000: 4, 5_000_000: 5, 8_000_000: 8}
"""Bit rate of an FD frame's data, bit/s, to the digit of the command ``Y``."""

CLOSE_COMMAND = b"C\r"

_BELL = b"\x07"  # the adapter refused a command
_LONGEST_LINE = 1 + 8 + 1 + 2 * 64 + 8
_STAMP_SIZES = (0, 2, 4)  # bytes: none, milliseconds, microseconds


@dataclass(frozen=True, slots=True)
class _Line:
    """What the letter at the start of a line says."""

    is_extended: bool = False
    is_remote: bool = False
    is_fd: bool = False
    bitrate_switch: bool = False


_LINES = {
    b"t": _Line(),
    b"T": _Line(is_extended=True),
    b"r": _Line(is_remote=True),
    b"R": _Line(is_extended=True, is_remote=True),
    b"d": _Line(is_fd=True),
    b"D": _Line(is_extended=True, is_fd=True),
    b"b": _Line(is_fd=True, bitrate_switch=True),
    b"B": _Line(is_extended=True, is_fd=True, bitrate_switch=True),
}
_LETTERS = {line: letter for letter, line in _LINES.items()}
_BY_BYTE = {letter[0]: line for letter, line in _LINES.items()}
_REPLIES = frozenset(b"zZVvNF")  # transmission done, version, serial number, status flags


def open_commands(bitrate: int, data_bitrate: int | None = None) -> list[bytes]:
    """Return the commands to an adapter, in order, to join the bus at ``bitrate`` [bit/s].

    ``data_bitrate`` [bit/s] makes it an FD bus. Raises ValueError for a rate that slcan cannot name.
    """
    commands = [CLOSE_COMMAND, b"S%d\r" % _rate_digit(bitrate, BITRATES)]
    if data_bitrate is not None:
        commands.append(b"Y%d\r" % _rate_digit(data_bitrate, DATA_BITRATES))
    return [*commands, b"O\r"]


def encode_slcan(frame: CanFrame) -> bytes:
    """Return the line that sends ``frame``. Raises ``ValueError`` when CAN has no such frame."""
    line = _Line(frame.is_extended, frame.is_remote, frame.is_fd, frame.bitrate_switch and frame.is_fd)
    letter = _LETTERS.get(line)
    identifier_bits = 29 if frame.is_extended else 11
    code = _length_code(len(frame.data), frame.is_fd)
    if letter is None or code is None or frame.is_error or frame.identifier >> identifier_bits:
        raise ValueError(f"{frame} is not a frame that can be sent")
    head = b"%08X%X" if frame.is_extended else b"%03X%X"
    return letter + head % (frame.identifier, code) + frame.data.hex().upper().encode() + b"\r"


class SlcanDecoder:
    """Takes the text of an adapter apart, in chunks of any size.

    Text from the wire is untrusted: ``feed`` never raises, it counts what it drops. No more than
    one longest line is kept between chunks.
    """

    def __init__(self) -> None:
        self.accepted = 0
        """CAN frames handed out."""
        self.malformed = 0
        """Lines that are no frame and no answer."""
        self.refused = 0
        """Commands that the adapter refused."""
        self._partial = b""
        self._skipping = False

    def feed(self, chunk: bytes) -> list[CanFrame]:
        """Return the CAN frames that this chunk completes, in order."""
        # An adapter answers a refused command with a bell in place of a carriage return.
        if _BELL in chunk:
            self.refused += chunk.count(_BELL)
            chunk = chunk.replace(_BELL, b"\r")
        *complete, self._partial = (self._partial + chunk).split(b"\r")
        frames = [frame for line in complete if (frame := self._take(line)) is not None]
        if len(self._partial) > _LONGEST_LINE:
            self._partial, self._skipping = b"", True
        self.accepted += len(frames)
        return frames

    def _take(self, line: bytes) -> CanFrame | None:
        if self._skipping:
            self._skipping = False
            self.malformed += 1
            return None
        line = line.strip(b"\n")
        if not line:
            return None
        frame = _decode(line)
        # An adapter also answers commands, and those lines are no frames.
        if frame is None and line[0] not in _REPLIES:
            self.malformed += 1
        return frame


def _decode(text: bytes) -> CanFrame | None:
    line = _BY_BYTE.get(text[0])
    if line is None:
        return None
    try:
        # An identifier of 8 digits and a length code of one are 4½ bytes: a leading 0 makes them 5.
        raw = unhexlify(b"0" + text[1:] if line.is_extended else text[1:])
    except ValueError:
        return None
    head_size = 5 if line.is_extended else 2
    head = int.from_bytes(raw[:head_size], "big")
    length = FD_LENGTHS[head & 0xF]  # the length code is the index of the length
    identifier = head >> 4
    if length > 8 and not line.is_fd:
        return None
    end = head_size if line.is_remote else head_size + length
    if len(raw) - end not in _STAMP_SIZES or identifier >> (29 if line.is_extended else 11):
        return None
    data = raw[head_size:end]
    return CanFrame(
        identifier, data, line.is_extended, line.is_fd, line.is_remote, False, line.bitrate_switch
    )


def _length_code(length: int, is_fd: bool) -> int | None:
    if length not in FD_LENGTHS or (length > 8 and not is_fd):
        return None
    return FD_LENGTHS.index(length)


def _rate_digit(bitrate: int, rates: dict[int, int]) -> int:
    if bitrate not in rates:
        nearest = min(rates, key=lambda rate: abs(rate - bitrate))
        known = ", ".join(str(rate) for rate in rates)
        raise ValueError(f"slcan has no bit rate {bitrate}; the nearest is {nearest} (known: {known})")
    return rates[bitrate]
