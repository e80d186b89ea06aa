"""Describe the wire to the tools of a CAN bus, from the declarations, as a DBC file.

::

    python -m firmware_protocol.dbc          # writes module.dbc: module 0

``mocap-gateway config dbc`` writes the file of a suit. A DBC file knows CAN frames, not wire frames:
each piece is a message of its own, for each module, since the identifier holds the module. What it
cannot say, and how the signals are named, stands in ``README.md`` under "DBC file". Letters outside
ASCII are spelt out: tools disagree on the encoding.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from firmware_protocol.can_framing import FD_LENGTHS, OVERHEAD, identifier
from firmware_protocol.can_records import CLASSIC_DATA_SIZE, EXTENDED, FD_DATA_SIZE
from firmware_protocol.dbc_layout import SENSORS, Signal, cut, multiplexed_signals, packet_signals
from firmware_protocol.fields import Layout, layout_of
from firmware_protocol.framing import BROADCAST
from firmware_protocol.kinds import FROM_HOST
from firmware_protocol.packets import PACKETS, InertialSample, Packet

PATH = Path(__file__).parent / "module.dbc"
ALL_SENSORS = tuple(f.name for f in layout_of(InertialSample).fields)

_EXTENDED_CAN, _EXTENDED_CAN_FD = 1, 15  # of the attribute VFrameFormat
_FORMATS = ["StandardCAN", "ExtendedCAN", *["reserved"] * 12, "StandardCAN_FD", "ExtendedCAN_FD"]
_SPELT_OUT = str.maketrans({"²": "^2", "µ": "u", "°": "deg", "×": "x", "−": "-"})


@dataclass(frozen=True, slots=True)
class Message:
    """One CAN frame."""

    name: str
    identifier: int
    length: int
    is_fd: bool
    sender: str
    comment: str
    signals: tuple[Signal, ...]


def render(modules: Sequence[int], sensors: Sequence[str] = ALL_SENSORS) -> str:
    """Return the whole file.

    modules: ids, each with messages of its own, besides those that the host sends to all.
    sensors: those that samples hold on classic CAN.
    """
    messages = [
        message
        for packet_class in PACKETS.values()
        for module in (*modules, *((BROADCAST,) if packet_class.KIND in FROM_HOST else ()))
        for message in _messages(packet_class, module, sensors)
    ]
    nodes = ["Host", *(f"Module_{module}" for module in modules)]
    sections = [
        'VERSION ""',
        "NS_ :\n",
        "BS_:",
        f"BU_: {' '.join(nodes)}",
        *map(_message_text, messages),
        "\n".join(f'CM_ BO_ {_number(m)} "{m.comment}";' for m in messages),
        'BA_DEF_ BO_ "VFrameFormat" ENUM ' + ",".join(f'"{name}"' for name in _FORMATS) + ";",
        f'BA_DEF_DEF_ "VFrameFormat" "{_FORMATS[_EXTENDED_CAN]}";',
        "\n".join(map(_format_text, messages)),
        "\n".join(text for m in messages for text in _meaning_texts(m)),
        "\n".join(
            f"SIG_VALTYPE_ {_number(m)} {s.name} : 1;" for m in messages for s in m.signals if s.is_float
        ),
        "\n".join(text for m in messages for text in _multiplex_texts(m)),
    ]
    # DBC files are read in many code pages: only ASCII is safe.
    return "\n\n".join(sections).translate(_SPELT_OUT) + "\n"


def _messages(packet_class: type[Packet], module: int, sensors: Sequence[str]) -> list[Message]:
    layout = layout_of(packet_class)
    mask = sum(1 << f.presence_bit for f in layout.fields if f.presence_bit is not None and f.name in sensors)
    least = OVERHEAD + layout.sizes(mask)[0]
    classic = [
        _message(packet_class, module, place, place == _n_pieces(least) - 1, signals, least)
        # Where the size is not fixed, only what comes before the last piece is sure to be there.
        for place in range(_n_pieces(least) - (layout.rest is not None))
        if (signals := cut(packet_signals(layout, mask), place))
    ]
    return classic + _fd_messages(packet_class, module, layout)


def _fd_messages(packet_class: type[Packet], module: int, layout: Layout) -> list[Message]:
    largest = OVERHEAD + max(layout.sizes(mask)[1] for mask in layout.valid_masks())
    if layout.rest or largest > FD_DATA_SIZE:
        return []
    signals = multiplexed_signals(layout)
    return [_message(packet_class, module, 0, True, signals, largest, is_fd=True)]


def _message(
    packet_class: type[Packet],
    module: int,
    place: int,
    is_last: bool,
    signals: Sequence[Signal],
    size: int,
    is_fd: bool = False,
) -> Message:
    rest = size - place * CLASSIC_DATA_SIZE
    return Message(
        name=f"{packet_class.__name__}_{module}_{'fd' if is_fd else f'p{place}'}",
        identifier=identifier(packet_class.KIND, module, place, is_last),
        length=min(n for n in FD_LENGTHS if n >= size) if is_fd else min(rest, CLASSIC_DATA_SIZE),
        is_fd=is_fd,
        sender="Host" if packet_class.KIND in FROM_HOST else f"Module_{module}",
        comment=(inspect.getdoc(packet_class) or "").split("\n\n", maxsplit=1)[0].replace('"', "'"),
        signals=tuple(signals),
    )


def _n_pieces(size: int) -> int:
    return -(-size // CLASSIC_DATA_SIZE)


def _number(message: Message) -> int:
    return message.identifier | EXTENDED


def _message_text(message: Message) -> str:
    is_multiplexed = any(signal.masks for signal in message.signals)
    head = f"BO_ {_number(message)} {message.name}: {message.length} {message.sender}"
    return "\n".join([head, *(_signal_text(signal, is_multiplexed) for signal in message.signals)])


def _signal_text(signal: Signal, is_multiplexed: bool) -> str:
    selector = " M" if is_multiplexed and signal.name == SENSORS else ""
    if signal.masks:
        selector = f" m{signal.masks[0]}"
    sign = "-" if signal.is_signed else "+"
    factor = repr(signal.factor) if signal.factor % 1 else f"{signal.factor:.0f}"
    place = f"{signal.bit}|{signal.width}@1{sign}"
    return f' SG_ {signal.name}{selector} : {place} ({factor},0) [0|0] "{signal.unit}" Vector__XXX'


def _format_text(message: Message) -> str:
    return (
        f'BA_ "VFrameFormat" BO_ {_number(message)} {_EXTENDED_CAN_FD if message.is_fd else _EXTENDED_CAN};'
    )


def _meaning_texts(message: Message) -> Iterable[str]:
    for signal in message.signals:
        if signal.meanings:
            values = " ".join(f'{value} "{meaning}"' for value, meaning in signal.meanings.items())
            yield f"VAL_ {_number(message)} {signal.name} {values} ;"


def _multiplex_texts(message: Message) -> Iterable[str]:
    for signal in message.signals:
        if signal.masks:
            ranges = ", ".join(f"{mask}-{mask}" for mask in signal.masks)
            yield f"SG_MUL_VAL_ {_number(message)} {signal.name} {SENSORS} {ranges};"


if __name__ == "__main__":
    PATH.write_text(render([0]), encoding="ascii")
