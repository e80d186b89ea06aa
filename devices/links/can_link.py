"""Any CAN interface that python-can drives (virtual, PCAN, Kvaser, gs_usb, …) as a link."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Any

import can

from devices.known_names import nearest
from devices.link import Framing, LinkError
from devices.links.reader_thread import ThreadLink
from firmware_protocol.can_framing import CanFrame, pack_can_records, unpack_can_records

# How long the reading thread may take to notice that the link is being closed.
_RECEIVE_TIMEOUT_S = 0.05
_SEND_TIMEOUT_S = 1.0
# What waits is read as one chunk with one arrival time; so few frames pass in well under a millisecond.
_BATCH = 64


class CanLink(ThreadLink[can.BusABC]):
    """CAN frame records of one python-can bus, read in a thread of its own.

    (python-can's own asyncio reader takes one frame a wake-up and falls behind in bursts.)
    """

    framing = Framing.CAN

    def __init__(
        self,
        interface: str,
        channel: str,
        *,
        bitrate: int | None = None,
        fd: bool = False,
        data_bitrate: int | None = None,
        name: str | None = None,
    ) -> None:
        """Prepare a link, not yet open; rates in bit/s, None leaves the interface's own.

        Raises ValueError for an interface that python-can does not know.
        """
        if interface not in can.VALID_INTERFACES:
            raise ValueError(_unknown_interface(interface))
        super().__init__(name or f"can://{interface}/{channel}")
        self.interface = interface
        self.channel = channel
        wanted = {"bitrate": bitrate, "data_bitrate": data_bitrate, "fd": fd or None}
        self._settings: dict[str, Any] = {key: value for key, value in wanted.items() if value is not None}

    async def write(self, data: bytes, to: Sequence[str] = ()) -> None:
        """Send CAN frame records. Raises ``LinkError`` when the bus is closed, lost or does not take them."""
        bus = self._in_use()
        messages = [message_of(frame) for frame in unpack_can_records(data)]
        try:
            await asyncio.to_thread(_send_all, bus, messages)
        except Exception as error:  # drivers raise all kinds
            raise LinkError(
                f"{self.name} did not send ({error}): is another node on the bus, at the same bit rate?"
            ) from error

    def _open(self) -> can.BusABC:
        try:
            return can.Bus(interface=self.interface, channel=self.channel, **self._settings)
        except can.CanInterfaceNotImplementedError as error:
            raise LinkError(
                f"{self.name} does not work here ({error}): install the adapter's driver"
            ) from error
        except Exception as error:  # drivers raise all kinds: their library is absent, a setting is unknown
            raise LinkError(
                f"{self.name} cannot be opened ({error}): check the adapter, its driver and channel"
            ) from error

    def _read(self, opened: can.BusABC) -> bytes:
        messages = []
        message = opened.recv(_RECEIVE_TIMEOUT_S)
        while message is not None:
            messages.append(message)
            # A bus that is never idle must not keep the batch from being handed over.
            if len(messages) == _BATCH:
                break
            message = opened.recv(0)
        return pack_can_records(map(frame_of, messages))

    def _close(self, opened: can.BusABC) -> None:
        opened.shutdown()


def _unknown_interface(interface: str) -> str:
    return f"unknown CAN interface '{interface}'{nearest(interface, can.VALID_INTERFACES)}"


def _send_all(bus: can.BusABC, messages: list[can.Message]) -> None:
    for message in messages:
        bus.send(message, _SEND_TIMEOUT_S)


def frame_of(message: can.Message) -> CanFrame:
    """Return a frame of python-can as ours."""
    return CanFrame(
        identifier=message.arbitration_id,
        data=bytes(message.data),
        is_extended=message.is_extended_id,
        is_fd=message.is_fd,
        is_remote=message.is_remote_frame,
        is_error=message.is_error_frame,
        bitrate_switch=message.bitrate_switch,
    )


def message_of(frame: CanFrame) -> can.Message:
    """Return a frame of ours as python-can takes it."""
    return can.Message(
        arbitration_id=frame.identifier,
        data=frame.data,
        is_extended_id=frame.is_extended,
        is_fd=frame.is_fd,
        is_remote_frame=frame.is_remote,
        is_error_frame=frame.is_error,
        bitrate_switch=frame.bitrate_switch,
    )
