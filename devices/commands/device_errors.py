"""What can go wrong when devices are asked to do something.

DeviceError                  one line: what was found, and what would do
├── NoAnswerError            the device is off, out of range, or does not know commands
├── CommandRefusedError      the device answered, and said no (``result``)
├── WritesLockedError        the gateway itself may not change devices
├── UnknownDeviceError       no such device on the air, or more than one is meant
├── UnverifiedError          what was written did not read back
├── UnfinishedError          only a part was changed; says what was and what not
└── CardError                a file of a memory card is not what the card promised
"""

from __future__ import annotations

from collections.abc import Mapping

from firmware_protocol.commands import Result


class DeviceError(Exception):
    """A device could not be asked, or did not do it. ``str(error)`` says what would help."""


class NoAnswerError(DeviceError):
    """No device answered, however often it was asked."""


class WritesLockedError(DeviceError):
    """A command that changes a device was asked for while that is not allowed."""

    def __init__(self, action: str) -> None:
        super().__init__(
            f"{action} changes a device, which is not allowed: set 'allow_device_writes: true' in the "
            "gateway's configuration, or pass --allow-writes where the command line reads the suit itself"
        )


class CommandRefusedError(DeviceError):
    """The device answered that it did not do it."""

    def __init__(self, device: str, action: str, result: Result | None) -> None:
        self.result = result
        super().__init__(f"{device} did not do {action}: {_REASONS.get(result, 'unknown reason')}")


class UnknownDeviceError(DeviceError):
    """No device is meant, or more than one."""


class UnverifiedError(DeviceError):
    """A device holds other settings than were written to it."""


class UnfinishedError(DeviceError):
    """Some of what was asked for was changed, and some not."""

    def __init__(
        self, message: str, present: Mapping[bytes, int | None] | None = None, reason: str = ""
    ) -> None:
        self.present = dict(present or {})
        """Id of each device that was to have another, by unique id; None: it does not answer."""
        self.reason = reason
        """What kept it from being finished."""
        super().__init__(message)


class CardError(DeviceError):
    """A file of a memory card cannot be had, or is not what was promised."""


_REASONS: Mapping[Result | None, str] = {
    Result.UNKNOWN_VERB: "its firmware does not know the command; update it",
    Result.BAD_ARGUMENTS: "the value is outside of what it takes",
    Result.REFUSED: "writing is locked on the device itself; unlock it there",
    Result.BUSY: "it stays busy; try again later",
    Result.FLASH_FAILED: "its flash could not be written; the settings from before still stand",
    Result.NO_SUCH_SETTING: "its firmware has no such setting",
    Result.NO_SUCH_FILE: "its card has no such file",
    Result.NOTHING_STAGED: "it has nothing to commit; it may have restarted meanwhile",
    Result.NOT_SUPPORTED: "it cannot do that",
}
