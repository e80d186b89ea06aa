"""What the emulator answers to the wire frames that a module of the reference firmware gets."""

from __future__ import annotations

from devices.emulators.device.command_responder import CommandResponder, IdleDevice
from devices.emulators.device.emulated_flash import KEYS
from firmware_protocol import BROADCAST, Acknowledgement, Command, SyncRequest
from firmware_protocol.commands import Verb, decode_arguments
from firmware_protocol.framing import Entry
from firmware_protocol.messages import ANYONE
from firmware_protocol.packets import decode_body

FUSED = bytes([1])
"""A mode that a module of the reference firmware has not, and answers with result 9."""


class Twin(IdleDevice):
    """A module from the factory, as the emulator has it."""

    def __init__(self, unique_id: bytes) -> None:
        super().__init__(unique_id)
        self._responder = CommandResponder(self)

    @property
    def module(self) -> int:
        """The id that it sends under."""
        return int(self.settings["module_id"])

    def answer(self, entry: Entry) -> Acknowledgement | int | None:
        """Return what it says to a wire frame: to a time request its token; None: nothing."""
        kind, module, _, _, body = entry
        packet = decode_body(kind, body)
        is_addressed = module in (self.module, BROADCAST)
        if isinstance(packet, SyncRequest):
            return packet.token if is_addressed else None
        if not isinstance(packet, Command):
            return None
        if packet.unique_id == self.unique_id or (packet.unique_id == ANYONE and is_addressed):
            (acknowledgement, *_) = self._responder.answer(packet)
            assert isinstance(acknowledgement, Acknowledgement)
            return acknowledgement
        return None


def is_fused(body: bytes) -> bool:
    """Whether a command asks for the mode that the reference has not."""
    command = decode_body(Command.KIND, body)
    return (
        isinstance(command, Command)
        and command.verb == Verb.WRITE_SETTING
        and decode_arguments(command.verb, command.arguments) == (KEYS["mode"], FUSED)
    )
