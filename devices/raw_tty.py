"""Opening a terminal device as a raw, exclusive, non-blocking byte stream.

Works alike for UARTs, USB receivers and pseudo-terminals.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import struct
import termios
from array import array

from devices.serial_ports import open_error

# Linux: any speed at all goes through termios2 (asm-generic/termbits.h), standard ones through termios.
_TCGETS2 = 0x802C542A
_TCSETS2 = 0x402C542B
_TERMIOS2 = struct.Struct("<4I B 19s 2I")  # iflag oflag cflag lflag, line, cc, ispeed ospeed
_CBAUD = 0o010017
_BOTHER = 0o010000

_ASYNC_LOW_LATENCY = 1 << 13
_SERIAL_STRUCT_WORDS = 32  # struct serial_struct has 72 bytes at most; the rest is room
_SERIAL_STRUCT_FLAGS = 4  # index of its flags word


def open_raw_tty(path: str, baud: int) -> int:
    """Open ``path`` raw (8N1, no flow control, no echo) and exclusive; the descriptor never blocks.

    What waited in the input buffer is discarded: it is older than its arrival time would say.
    Raises ``LinkError`` when the port is absent, forbidden, busy or no terminal.
    """
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise open_error(path, error) from error
    try:
        _configure(descriptor, path, baud)
    except termios.error as error:  # not an OSError, though it carries the same numbers
        os.close(descriptor)
        raise open_error(path, OSError(*error.args)) from error
    except OSError as error:
        os.close(descriptor)
        raise open_error(path, error) from error
    return descriptor


def _configure(descriptor: int, path: str, baud: int) -> None:
    termios.tcgetattr(descriptor)  # refuses what is not a terminal before anything is locked
    _lock(descriptor, path)
    _set_raw(descriptor)
    _set_speed(descriptor, baud)
    _set_low_latency(descriptor)
    termios.tcflush(descriptor, termios.TCIFLUSH)


def _lock(descriptor: int, path: str) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise OSError(errno.EBUSY, os.strerror(errno.EBUSY)) from error
    # The kernel's own exclusive mode also keeps out programs that do not lock. Not on a
    # pseudo-terminal: if we were killed it would stay set for as long as the emulator keeps its end.
    if not os.path.realpath(path).startswith("/dev/pts/"):
        fcntl.ioctl(descriptor, termios.TIOCEXCL)


def _set_raw(descriptor: int) -> None:
    iflag, oflag, cflag, lflag, ispeed, ospeed, characters = termios.tcgetattr(descriptor)
    iflag &= ~(termios.IGNBRK | termios.BRKINT | termios.PARMRK | termios.ISTRIP | termios.INPCK)
    iflag &= ~(termios.INLCR | termios.IGNCR | termios.ICRNL | termios.IXON | termios.IXOFF | termios.IXANY)
    oflag &= ~termios.OPOST
    lflag &= ~(termios.ECHO | termios.ECHONL | termios.ICANON | termios.ISIG | termios.IEXTEN)
    cflag &= ~(termios.CSIZE | termios.PARENB | termios.CSTOPB | termios.CRTSCTS)
    cflag |= termios.CS8 | termios.CREAD | termios.CLOCAL
    # With VMIN 0 "nothing yet" and "hung up" would both read as zero bytes.
    characters[termios.VMIN] = 1
    characters[termios.VTIME] = 0
    attributes = [iflag, oflag, cflag, lflag, ispeed, ospeed, characters]
    termios.tcsetattr(descriptor, termios.TCSANOW, attributes)


def _set_speed(descriptor: int, baud: int) -> None:
    standard = getattr(termios, f"B{baud}", None)
    if standard is not None:
        attributes = termios.tcgetattr(descriptor)
        attributes[4] = attributes[5] = standard
        termios.tcsetattr(descriptor, termios.TCSANOW, attributes)
        return
    # Other rates go through Linux's termios2, where the rate is a number and not one of a list.
    settings = bytearray(_TERMIOS2.size)
    fcntl.ioctl(descriptor, _TCGETS2, settings)
    iflag, oflag, cflag, lflag, line, characters, _, _ = _TERMIOS2.unpack(settings)
    cflag = (cflag & ~_CBAUD) | _BOTHER
    fcntl.ioctl(
        descriptor, _TCSETS2, _TERMIOS2.pack(iflag, oflag, cflag, lflag, line, characters, baud, baud)
    )


def _set_low_latency(descriptor: int) -> None:
    """Ask the driver to hand bytes on at once: an FTDI receiver otherwise holds them for 16 ms."""
    settings = array("i", [0] * _SERIAL_STRUCT_WORDS)
    # Drivers and pseudo-terminals without this setting refuse it, and some allow it to root only.
    with contextlib.suppress(OSError):
        fcntl.ioctl(descriptor, termios.TIOCGSERIAL, settings)
        settings[_SERIAL_STRUCT_FLAGS] |= _ASYNC_LOW_LATENCY
        fcntl.ioctl(descriptor, termios.TIOCSSERIAL, settings)
