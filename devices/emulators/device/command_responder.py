"""How a device answers commands, verb by verb, as its firmware would. Sans-I/O."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

from devices.emulators.device.emulated_card import EmulatedCard
from devices.emulators.device.emulated_flash import EmulatedFlash, StoredSettings
from firmware_protocol import Acknowledgement, Command, Event, Packet
from firmware_protocol.commands import (
    ALL_FILES,
    ANSWER_MEMORY,
    VERBS,
    Result,
    Verb,
    decode_arguments,
    encode_payload,
)
from firmware_protocol.device_settings import SETTINGS, decode_value, encode_value
from firmware_protocol.framing import NO_VERSION, SUPPORTED, negotiate

SETTINGS_COMMITTED = 7
"""Event of a device whose settings were committed."""

_CARD_VERBS = frozenset({Verb.CARD_LIST, Verb.CARD_READ, Verb.CARD_ERASE})


class CommandedDevice(Protocol):
    """What the commands act on."""

    unique_id: bytes
    settings: StoredSettings
    is_locked: bool
    """Whatever changes the device is refused."""
    card: EmulatedCard | None
    fixed_settings: frozenset[int]
    """Keys of settings that this kind of device does not let be changed."""

    def start(self) -> None:
        """Begin to sample."""

    def stop(self) -> None:
        """Sample no more."""

    def blink(self, seconds: int) -> None:
        """Blink for so many seconds."""

    def introduction(self) -> tuple[Packet, ...]:
        """Return the packets that say who the device is and how it fares."""
        ...

    def act_by_settings(self) -> None:
        """Act by the active settings, which have changed."""
        ...


class IdleDevice:
    """A device from the factory that keeps settings, and carries out no other command."""

    is_locked = False
    card: EmulatedCard | None = None
    fixed_settings: frozenset[int] = frozenset()

    def __init__(self, unique_id: bytes) -> None:
        self.unique_id = unique_id
        self.settings = StoredSettings(EmulatedFlash())

    def start(self) -> None:
        """Begin to sample."""

    def stop(self) -> None:
        """Sample no more."""

    def blink(self, seconds: int) -> None:
        """Blink for so many seconds."""

    def introduction(self) -> tuple[Packet, ...]:
        """Return nothing: no command waits for it."""
        return ()

    def act_by_settings(self) -> None:
        """Act by the active settings, which have changed."""


class CommandReply(NamedTuple):
    """What became of a command."""

    result: Result = Result.DONE
    payload: tuple[Any, ...] = ()
    """Values as the verb declares them; sent only when it is done."""
    follows: tuple[Packet, ...] = ()
    """Packets that are sent after the acknowledgement."""


class CommandResponder:
    """Answers commands to one device, and repeats its last answers to those that come again."""

    def __init__(self, device: CommandedDevice) -> None:
        self._device = device
        self._answers: OrderedDict[tuple[int, int], tuple[Packet, ...]] = OrderedDict()

    def answer(self, command: Command) -> tuple[Packet, ...]:
        """Act, and say what is to be sent: the acknowledgement, then what the verb asks for.

        Raises ``PowerLost`` when the flash says so.
        """
        key = command.transaction, command.verb
        if key not in self._answers:
            self._answers[key] = self._new_answer(command)
            if len(self._answers) > ANSWER_MEMORY:
                self._answers.popitem(last=False)
        return self._answers[key]

    def _new_answer(self, command: Command) -> tuple[Packet, ...]:
        outcome = self._act(command)
        is_done = outcome.result is Result.DONE
        acknowledgement = Acknowledgement(
            command.transaction,
            command.verb,
            int(outcome.result),
            self._device.unique_id,
            encode_payload(command.verb, *outcome.payload) if is_done else b"",
        )
        return (acknowledgement, *outcome.follows)

    def _act(self, command: Command) -> CommandReply:
        declared = VERBS.get(command.verb)
        if declared is None:
            return CommandReply(Result.UNKNOWN_VERB)
        if declared.verb in _CARD_VERBS and self._device.card is None:
            return CommandReply(Result.NOT_SUPPORTED)
        arguments = decode_arguments(command.verb, command.arguments)
        if arguments is None:
            return CommandReply(Result.BAD_ARGUMENTS)
        # Arguments are looked at first: a locked device still says that they are wrong.
        if declared.changes_device and self._device.is_locked:
            return CommandReply(Result.REFUSED)
        return _ACTIONS[declared.verb](self, *arguments)

    def _hello(self, lowest: int, highest: int) -> CommandReply:
        chosen = negotiate((lowest, highest), SUPPORTED)
        return CommandReply(payload=(NO_VERSION if chosen is None else chosen, *SUPPORTED))

    def _identify(self, seconds: int) -> CommandReply:
        self._device.blink(seconds)
        return CommandReply()

    def _introduce(self) -> CommandReply:
        return CommandReply(follows=self._device.introduction())

    def _start(self) -> CommandReply:
        self._device.start()
        return CommandReply()

    def _stop(self) -> CommandReply:
        self._device.stop()
        return CommandReply()

    def _read_setting(self, key: int) -> CommandReply:
        if key not in SETTINGS:
            return CommandReply(Result.NO_SUCH_SETTING)
        return CommandReply(payload=(key, encode_value(key, self._device.settings.value(key))))

    def _write_setting(self, key: int, data: bytes) -> CommandReply:
        if key not in SETTINGS:
            return CommandReply(Result.NO_SUCH_SETTING)
        if key in self._device.fixed_settings:
            return CommandReply(Result.NOT_SUPPORTED)
        value = decode_value(key, data)
        if value is None:
            return CommandReply(Result.BAD_ARGUMENTS)
        self._device.settings.stage(key, value)
        return CommandReply(payload=(key, encode_value(key, value)))

    def _commit(self) -> CommandReply:
        if not self._device.settings.staged:
            return CommandReply(Result.NOTHING_STAGED)
        generation = self._device.settings.commit()
        if generation is None:
            return CommandReply(Result.FLASH_FAILED)
        self._device.act_by_settings()
        return CommandReply(payload=(generation,), follows=(Event(SETTINGS_COMMITTED),))

    def _discard(self) -> CommandReply:
        self._device.settings.discard()
        return CommandReply()

    def _factory_reset(self, magic: int) -> CommandReply:
        if self._device.settings.reset() is None:
            return CommandReply(Result.FLASH_FAILED)
        self._device.act_by_settings()
        return CommandReply(follows=(Event(SETTINGS_COMMITTED),))

    def _card_list(self, first: int) -> CommandReply:
        entries = self._card.entries()
        listed = entries[first : first + VERBS[Verb.CARD_LIST].max_entries]
        return CommandReply(payload=(len(entries), listed))

    def _card_read(self, file: int, offset: int, length: int) -> CommandReply:
        if file not in self._card:
            return CommandReply(Result.NO_SUCH_FILE)
        data = self._card.read(file, offset, length)
        return (
            CommandReply(Result.BAD_ARGUMENTS) if data is None else CommandReply(payload=(file, offset, data))
        )

    def _card_erase(self, file: int) -> CommandReply:
        if file not in self._card and file != ALL_FILES:
            return CommandReply(Result.NO_SUCH_FILE)
        if self._card.recording is not None and file in (self._card.recording, ALL_FILES):
            return CommandReply(Result.BUSY)
        if file == ALL_FILES:
            self._card.erase_all()
        else:
            self._card.erase(file)
        return CommandReply()

    @property
    def _card(self) -> EmulatedCard:
        card = self._device.card
        assert card is not None
        return card


_ACTIONS: dict[Verb, Callable[..., CommandReply]] = {
    Verb.HELLO: CommandResponder._hello,
    Verb.IDENTIFY: CommandResponder._identify,
    Verb.GET_INFO: CommandResponder._introduce,
    Verb.START: CommandResponder._start,
    Verb.STOP: CommandResponder._stop,
    Verb.READ_SETTING: CommandResponder._read_setting,
    Verb.WRITE_SETTING: CommandResponder._write_setting,
    Verb.COMMIT: CommandResponder._commit,
    Verb.DISCARD: CommandResponder._discard,
    Verb.FACTORY_RESET: CommandResponder._factory_reset,
    Verb.CARD_LIST: CommandResponder._card_list,
    Verb.CARD_READ: CommandResponder._card_read,
    Verb.CARD_ERASE: CommandResponder._card_erase,
}
