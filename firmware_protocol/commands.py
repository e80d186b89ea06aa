"""What the host can ask of a module: every verb declared once, with its arguments and its answer.

A command names a verb and carries its arguments; the acknowledgement carries the payload::

    arguments = encode_arguments(Verb.CARD_READ, 3, 4096, 192)
    command = Command(transaction=7, verb=Verb.CARD_READ, arguments=arguments)
    ...
    answer = decode_payload(Verb.CARD_READ, acknowledgement.payload)
    if answer is not None:
        file, offset, data = answer
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from firmware_protocol.codec import FieldsCodec
from firmware_protocol.fields import WireField
from firmware_protocol.messages import MAX_PAYLOAD_SIZE

FACTORY_RESET_MAGIC = 0x46414354
ALL_FILES = 0xFFFF
MAX_CARD_READ = 192
"""Most bytes of a file that one answer carries."""

ANSWER_MEMORY = 8
"""Commands, by (transaction, verb), whose answers a device repeats without acting again."""

BROADCAST_ANSWER_DELAY_US = 2000
"""On a broadcast a device waits for its id times this before it answers."""


class Verb(IntEnum):
    """What a command asks for. Numbers are never reused."""

    HELLO = 1
    IDENTIFY = 2
    GET_INFO = 3
    START = 4
    STOP = 5
    READ_SETTING = 10
    WRITE_SETTING = 11
    COMMIT = 12
    DISCARD = 13
    FACTORY_RESET = 14
    CARD_LIST = 20
    CARD_READ = 21
    CARD_ERASE = 22


class Result(IntEnum):
    """How a command ended."""

    DONE = 0
    UNKNOWN_VERB = 1
    BAD_ARGUMENTS = 2
    REFUSED = 3
    BUSY = 4
    FLASH_FAILED = 5
    NO_SUCH_SETTING = 6
    NO_SUCH_FILE = 7
    NOTHING_STAGED = 8
    NOT_SUPPORTED = 9


@dataclass(frozen=True, slots=True, kw_only=True)
class VerbDeclaration:
    """One verb: what goes with it, what comes back, and whether it changes the device."""

    verb: Verb
    arguments: tuple[WireField, ...] = ()
    payload: tuple[WireField, ...] = ()
    entries: tuple[WireField, ...] = ()
    """Fields repeated to the end of the payload, after those of ``payload``."""
    changes_device: bool = False
    """Whether the device keeps the change: refused while writes are locked."""
    sentence: str

    @property
    def name(self) -> str:
        """Name of the verb."""
        return self.verb.name

    @property
    def max_entries(self) -> int:
        """How many entries one payload holds at most."""
        entry, fixed = (sum(f.size for f in fields) for fields in (self.entries, self.payload))
        return (MAX_PAYLOAD_SIZE - fixed) // entry if entry else 0


def _field(name: str, code: str, sentence: str, count: int = 1, **rest: Any) -> WireField:
    return WireField(name=name, code=code, count=count, sentence=sentence, **rest)


_KEY = _field("key", "B", 'Which setting, as listed under "Settings".')
_VALUE = _field("value", "s", "As the setting declares.", count=0, max_size=MAX_PAYLOAD_SIZE - 1)
_FILE = _field("file", "H", "Number of the file.")
_OFFSET = _field("offset", "I", "First byte of the piece.", unit="bytes")

_DECLARED = (
    VerbDeclaration(
        verb=Verb.HELLO,
        arguments=(
            _field("min_version", "B", "Lowest protocol version that the host speaks."),
            _field("max_version", "B", "Highest."),
        ),
        payload=(
            _field("chosen", "B", "Version to be spoken from now on: the highest that both know; 0: none."),
            _field("min_version", "B", "Lowest protocol version that the device speaks."),
            _field("max_version", "B", "Highest."),
        ),
        sentence="Agree on the protocol version. Always sent, and answered, as version 1.",
    ),
    VerbDeclaration(
        verb=Verb.IDENTIFY,
        arguments=(_field("seconds", "B", "How long; 0 stops it.", unit="s"),),
        sentence="Blink, to be found.",
    ),
    VerbDeclaration(verb=Verb.GET_INFO, sentence="Answer, then send DeviceInfo and Health."),
    VerbDeclaration(verb=Verb.START, sentence="Start sampling."),
    VerbDeclaration(verb=Verb.STOP, sentence="Stop sampling."),
    VerbDeclaration(
        verb=Verb.READ_SETTING,
        arguments=(_KEY,),
        payload=(_KEY, _VALUE),
        sentence="Read a setting: the staged value when there is one.",
    ),
    VerbDeclaration(
        verb=Verb.WRITE_SETTING,
        arguments=(_KEY, _VALUE),
        payload=(_KEY, _VALUE),
        changes_device=True,
        sentence="Stage a new value. It reaches the flash with COMMIT; the answer holds it as staged.",
    ),
    VerbDeclaration(
        verb=Verb.COMMIT,
        payload=(_field("generation", "I", "Generation of the slot that now holds the settings."),),
        changes_device=True,
        sentence="Store what is staged, all or nothing, and act by it.",
    ),
    VerbDeclaration(verb=Verb.DISCARD, sentence="Forget what is staged."),
    VerbDeclaration(
        verb=Verb.FACTORY_RESET,
        arguments=(
            _field(
                "magic",
                "I",
                f"Only {FACTORY_RESET_MAGIC:#x} (the letters FACT) is obeyed.",
                minimum=FACTORY_RESET_MAGIC,
                maximum=FACTORY_RESET_MAGIC,
            ),
        ),
        changes_device=True,
        sentence="Commit the factory value of every setting.",
    ),
    VerbDeclaration(
        verb=Verb.CARD_LIST,
        arguments=(_field("first", "H", "Place in the list to begin at, from 0."),),
        payload=(_field("total", "H", "Files on the card."),),
        entries=(
            _FILE,
            _field("size", "I", "Bytes of the file.", unit="bytes"),
            _field("start_time_us", "I", "Module's clock at the first sample.", unit="µs"),
            _field("crc32", "I", "CRC-32 of the whole file."),
        ),
        sentence="List the files on the card, as many as fit the answer.",
    ),
    VerbDeclaration(
        verb=Verb.CARD_READ,
        arguments=(
            _FILE,
            _OFFSET,
            _field("length", "B", "Bytes wanted.", unit="bytes", maximum=MAX_CARD_READ),
        ),
        payload=(
            _FILE,
            _OFFSET,
            _field("data", "s", "Shorter than asked for at the file's end.", count=0, max_size=MAX_CARD_READ),
        ),
        sentence="Read a piece of a file.",
    ),
    VerbDeclaration(
        verb=Verb.CARD_ERASE,
        arguments=(_field("file", "H", f"Number of the file; {ALL_FILES}: all of them."),),
        changes_device=True,
        sentence="Erase a file.",
    ),
)

VERBS: Mapping[int, VerbDeclaration] = {int(declared.verb): declared for declared in _DECLARED}
"""Number to declaration."""

_ARGUMENTS = {number: FieldsCodec(declared.arguments) for number, declared in VERBS.items()}
_PAYLOADS = {number: FieldsCodec(declared.payload) for number, declared in VERBS.items()}
_ENTRIES = {number: FieldsCodec(declared.entries) for number, declared in VERBS.items() if declared.entries}


def encode_arguments(verb: int, *values: Any) -> bytes:
    """Return the arguments of a command, one value a declared field.

    Raises ValueError, naming the verb and the field, for an unknown verb or what cannot be sent.
    """
    return _encode(_ARGUMENTS, verb, values)


def decode_arguments(verb: int, arguments: bytes) -> tuple[Any, ...] | None:
    """Return the values, one a declared field; None for an unknown verb or bad arguments. Never raises."""
    codec = _ARGUMENTS.get(verb)
    return None if codec is None else codec.decode(arguments)


def encode_payload(verb: int, *values: Any) -> bytes:
    """Return the payload of an acknowledgement: one value a declared field; where entries are declared, a
    sequence of them, each a sequence of its fields' values, comes last.

    Raises ValueError, naming the verb and the field, for an unknown verb or what cannot be sent.
    """
    if verb not in _ENTRIES:
        return _encode(_PAYLOADS, verb, values)
    *fixed, entries = values
    if len(entries) > VERBS[verb].max_entries:
        raise ValueError(f"{VERBS[verb].name}: {len(entries)} entries; {VERBS[verb].max_entries} fit")
    return _encode(_PAYLOADS, verb, fixed) + b"".join(_encode(_ENTRIES, verb, entry) for entry in entries)


def decode_payload(verb: int, payload: bytes) -> tuple[Any, ...] | None:
    """Return the values as ``encode_payload`` takes them; None for an unknown verb or payload. Never
    raises."""
    if verb not in _ENTRIES:
        codec = _PAYLOADS.get(verb)
        return None if codec is None else codec.decode(payload)
    start, size = _PAYLOADS[verb].fixed_size, _ENTRIES[verb].fixed_size
    fixed = _PAYLOADS[verb].decode(payload[:start])
    entries = [_ENTRIES[verb].decode(payload[at : at + size]) for at in range(start, len(payload), size)]
    if fixed is None or None in entries or len(payload) > MAX_PAYLOAD_SIZE:
        return None
    return (*fixed, tuple(entries))


def _encode(codecs: Mapping[int, FieldsCodec], verb: int, values: Any) -> bytes:
    if verb not in codecs:
        raise ValueError(f"verb {verb}: there are {', '.join(f'{v.value} {v.name}' for v in Verb)}")
    try:
        return codecs[verb].encode(*values)
    except ValueError as error:
        raise ValueError(f"{VERBS[verb].name}: {error}") from None
