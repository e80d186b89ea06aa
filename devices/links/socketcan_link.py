"""A CAN interface of the Linux kernel (``can0``, ``vcan0``) as a link.

Read straight from a raw socket: a burst is drained in one wake-up, the receive buffer is large
enough for it, and what the kernel had to drop is counted.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import socket
import struct
from collections import Counter
from collections.abc import AsyncIterator, Sequence
from enum import Enum
from pathlib import Path

from devices.link import Chunk, Framing, LinkError, gateway_time_ns
from devices.links.arrivals import Arrivals
from devices.links.link_counts import (
    ANCILLARY_SIZE,
    LinkCounts,
    LostBefore,
    SystemCount,
    ask_for_drops,
    reported_drops,
)
from firmware_protocol.can_framing import CanFrame, pack_can_records, unpack_can_records

# linux/can.h and asm-generic/socket.h; Python's socket module lacks the last three.
_CAN_FRAME = struct.Struct("=IB3x8s")
_CANFD_FRAME = struct.Struct("=IBB2x64s")
_FD_BITRATE_SWITCH = 0x01
_EXTENDED, _REMOTE, _ERROR = 1 << 31, 1 << 30, 1 << 29
_IDENTIFIER = (1 << 29) - 1
_CAN_RAW_ERR_FILTER = 2
_SO_RCVBUFFORCE = 33
_INTERFACE_TYPE_CAN = "280"

# The kernel's default holds some 300 frames; a burst of a full suit was lost by more than half.
_RECEIVE_BUFFER_BYTES = 8 * 1024 * 1024
_BATCH = 64
_SEND_RETRY_S = 0.001
_SEND_RETRIES = 1000

# Error frames: linux/can/error.h.
_TX_TIMEOUT, _CONTROLLER, _BUS_OFF, _RESTARTED = 0x001, 0x004, 0x040, 0x100
_STATE = 1
"""Byte of an error frame that holds the controller's state."""

_WANTED_ERRORS = _TX_TIMEOUT | _CONTROLLER | _BUS_OFF | _RESTARTED
"""Mask of the error frames to ask the kernel for."""


class BusError(Enum):
    """What went wrong on a bus, as its controller reports it, in order of gravity."""

    WARNING = "the error counter passed 96"
    PASSIVE = "the error counter passed 127: the controller may no longer mark others' frames as bad"
    OVERFLOW = "the controller's own buffer was full: frames were lost before the kernel saw them"
    TRANSMIT_TIMEOUT = "a frame could not be sent in time"
    BUS_OFF = "the error counter passed 255: the controller has left the bus"
    RESTARTED = "the controller takes part again after bus-off"


_BY_CLASS = {
    _TX_TIMEOUT: BusError.TRANSMIT_TIMEOUT,
    _BUS_OFF: BusError.BUS_OFF,
    _RESTARTED: BusError.RESTARTED,
}
_BY_STATE = {0x03: BusError.OVERFLOW, 0x0C: BusError.WARNING, 0x30: BusError.PASSIVE}


def _errors_of(frame: CanFrame) -> list[BusError]:
    """Return what an error frame reports; empty for any other frame."""
    if not frame.is_error:
        return []
    errors = [error for mask, error in _BY_CLASS.items() if frame.identifier & mask]
    if frame.identifier & _CONTROLLER and len(frame.data) > _STATE:
        errors += [error for mask, error in _BY_STATE.items() if frame.data[_STATE] & mask]
    return errors


class SocketCanLink:
    """CAN frame records of one kernel interface. Its bit rate is the system's to set (``ip link``)."""

    framing = Framing.CAN

    def __init__(
        self, channel: str, *, fd: bool = False, bitrate: int = 1_000_000, name: str | None = None
    ) -> None:
        """Prepare a link, not yet open; ``bitrate`` [bit/s] only completes the remedy for an interface that
        is down.
        """
        self.name = name or f"can://socketcan/{channel}"
        self.channel = channel
        self.bus_errors: Counter[BusError] = Counter()
        """What the controller has reported, ever."""
        self._fd = fd
        self._bitrate = bitrate
        self.counts = LinkCounts()
        self._kernel_drops = SystemCount(self.counts, LostBefore.KERNEL_OVERFLOW)
        self._arrivals = Arrivals.never_opened(self.name)
        self._socket: socket.socket | None = None

    async def open(self) -> None:
        """Bind to the interface. Raises ``LinkError``: absent, down, no rights, or bus-off."""
        if self._socket is not None:
            raise LinkError(f"{self.name} is already open")
        try:
            self._socket = open_can_socket(self.channel, self._fd)
        except OSError as error:
            raise self._open_error(error) from error
        # An interface that is bus-off can be bound all the same, and nothing ever comes from it.
        if not has_carrier(self.channel):
            self._socket.close()
            self._socket = None
            raise LinkError(self._bus_off())
        set_receive_buffer(self._socket)
        self._kernel_drops = SystemCount(self.counts, LostBefore.KERNEL_OVERFLOW)
        self._arrivals = Arrivals(self.name, counts=self.counts)
        asyncio.get_running_loop().add_reader(self._socket, self._receive, self._socket)

    def __aiter__(self) -> AsyncIterator[Chunk]:
        return self._arrivals

    async def write(self, data: bytes, to: Sequence[str] = ()) -> None:
        """Send CAN frame records, waiting up to a second for room in the transmit queue."""
        for frame in unpack_can_records(data):
            await self._send(kernel_bytes(frame))

    async def close(self) -> None:
        """Leave the bus; iterating the link ends."""
        self._release(None)

    def _receive(self, bus: socket.socket) -> None:
        frames: list[CanFrame] = []
        lost: LinkError | None = None
        begun_ns = gateway_time_ns()
        try:
            while len(frames) < _BATCH and lost is None:
                data, ancillary, _, _ = bus.recvmsg(_CANFD_FRAME.size, ANCILLARY_SIZE)
                frame = frame_from_kernel(data)
                frames.append(frame)
                if frame.is_error:
                    lost = self._note_error(frame)
                if (dropped := reported_drops(ancillary)) is not None:
                    self._kernel_drops.now(dropped)
            self.counts.end_turn(begun_ns, bus)
        except BlockingIOError:
            self.counts.backlog_since_ns = None  # that was all there is for now
        except OSError as error:
            lost = self._lost_error(error)
        if frames:
            # Stamped after the last was taken: no frame seems to have come before it did.
            self._arrivals.put(pack_can_records(frames), gateway_time_ns())
        if lost is not None:
            self._release(lost)

    async def _send(self, data: bytes) -> None:
        for _ in range(_SEND_RETRIES):
            if self._socket is None:
                raise self._arrivals.error or LinkError(f"{self.name} is closed")
            try:
                self._socket.send(data)
            except OSError as error:
                # A full queue (ENOBUFS) does not show in the socket's readiness: it must be asked again.
                if error.errno not in (errno.EAGAIN, errno.ENOBUFS):
                    raise self._lost_error(error) from error
                await asyncio.sleep(_SEND_RETRY_S)
            else:
                return
        raise LinkError(
            f"{self.name}: the transmit queue stays full; is another node on the bus, at the same bit rate?"
        )

    def _release(self, error: LinkError | None) -> None:
        if self._socket is None:
            return
        asyncio.get_running_loop().remove_reader(self._socket)
        self.counts.backlog_since_ns = None
        self._socket.close()
        self._socket = None
        self._arrivals.end(error)

    def _note_error(self, frame: CanFrame) -> LinkError | None:
        """Count what the controller reports; the loss of the link when it has left the bus."""
        errors = _errors_of(frame)
        self.bus_errors.update(errors)
        self.counts.before[LostBefore.CONTROLLER_OVERFLOW] += errors.count(BusError.OVERFLOW)
        return LinkError(self._bus_off()) if BusError.BUS_OFF in errors else None

    def _bus_off(self) -> str:
        return (
            f"{self.channel} is off the bus (bus-off): check wiring, termination and bit rate; then "
            f"'sudo ip link set {self.channel} type can restart', or set it up with 'restart-ms 100'"
        )

    def _up_command(self) -> str:
        return f"sudo ip link set {self.channel} up type can bitrate {self._bitrate}"

    def _open_error(self, error: OSError) -> LinkError:
        if error.errno in (errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT):
            return LinkError(
                f"{self.name}: this kernel has no CAN sockets; run 'sudo modprobe can_raw', "
                "or use an slcan adapter or can://virtual"
            )
        if error.errno == errno.ENODEV:
            present = ", ".join(can_interfaces())
            found = f"CAN interfaces present: {present}" if present else "no CAN interface is present"
            return LinkError(
                f"no CAN interface '{self.channel}'; {found}; plug it in, then '{self._up_command()}'"
            )
        return LinkError(f"{self.name} cannot be opened: {error.strerror}; try '{self._up_command()}'")

    def _lost_error(self, error: OSError) -> LinkError:
        if error.errno == errno.ENETDOWN:
            return LinkError(f"{self.channel} is down: run '{self._up_command()}'")
        if error.errno in (errno.EINVAL, errno.EMSGSIZE):
            return LinkError(
                f"{self.channel} takes no FD frames: set it up with 'fd on', or send classic ones"
            )
        return LinkError(f"{self.name} was lost: {error.strerror}; plug it in, then '{self._up_command()}'")


def open_can_socket(channel: str, fd: bool) -> socket.socket:
    """Return a non-blocking raw socket on the interface. Raises ``OSError``."""
    if not hasattr(socket, "AF_CAN"):
        raise OSError(errno.EAFNOSUPPORT, os.strerror(errno.EAFNOSUPPORT))
    bus = socket.socket(socket.AF_CAN, socket.SOCK_RAW | socket.SOCK_NONBLOCK, socket.CAN_RAW)
    try:
        # The kernel passes on the controller's errors only to those who ask for them.
        bus.setsockopt(socket.SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, _WANTED_ERRORS)
        if fd:
            bus.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
        bus.bind((channel,))
    except OSError:
        bus.close()
        raise
    return bus


def set_receive_buffer(bus: socket.socket) -> None:
    """Raise the receive buffer, past the system's limit where allowed, and have drops reported."""
    try:
        bus.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _RECEIVE_BUFFER_BYTES)
    except PermissionError:
        bus.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
    ask_for_drops(bus)


def has_carrier(channel: str) -> bool:
    """Return whether the interface takes part in its bus: a controller in bus-off does not."""
    try:
        return Path(f"/sys/class/net/{channel}/carrier").read_text().strip() != "0"
    except OSError:  # down, or no such interface: reading and writing will fail and say so
        return True


def can_interfaces() -> list[str]:
    """Return the names of the CAN interfaces that the kernel has."""
    names = []
    for path in sorted(Path("/sys/class/net").glob("*/type")):
        with contextlib.suppress(OSError):
            if path.read_text().strip() == _INTERFACE_TYPE_CAN:
                names.append(path.parent.name)
    return names


def frame_from_kernel(data: bytes) -> CanFrame:
    """Return the frame of a ``struct can_frame`` (16 bytes) or ``struct canfd_frame`` (72 bytes)."""
    is_fd = len(data) == _CANFD_FRAME.size
    flags = 0
    if is_fd:
        flagged, length, flags, content = _CANFD_FRAME.unpack(data)
    else:
        flagged, length, content = _CAN_FRAME.unpack(data)
    return CanFrame(
        identifier=flagged & _IDENTIFIER,
        data=content[:length],
        is_extended=bool(flagged & _EXTENDED),
        is_fd=is_fd,
        is_remote=bool(flagged & _REMOTE),
        is_error=bool(flagged & _ERROR),
        bitrate_switch=bool(flags & _FD_BITRATE_SWITCH),
    )


def kernel_bytes(frame: CanFrame) -> bytes:
    """Return the kernel's struct of a frame: the inverse of ``frame_from_kernel``."""
    flagged = (
        frame.identifier | _EXTENDED * frame.is_extended | _REMOTE * frame.is_remote | _ERROR * frame.is_error
    )
    if frame.is_fd:
        return _CANFD_FRAME.pack(
            flagged, len(frame.data), _FD_BITRATE_SWITCH * frame.bitrate_switch, frame.data
        )
    return _CAN_FRAME.pack(flagged, len(frame.data), frame.data)
