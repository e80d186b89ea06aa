"""The voices by the word that the configuration has for what their links carry. A maker is a line here."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable, Iterable, Mapping

from devices.emulators.mti_voice import MtiCanVoice, MtiVoice
from devices.emulators.voice import Voice
from devices.emulators.ximu3_voice import Ximu3Voice
from devices.vendor_protocols import ximu3

_ANNOUNCED_EVERY_S = 1.0


def _ximu3(place: int, module: int, field_ut: float) -> Voice:
    return Ximu3Voice(module, field_ut, ximu3.COMMAND_PORT + place)


def _mti(_place: int, module: int, field_ut: float) -> Voice:
    return MtiVoice(module, field_ut)


def _mti_can(_place: int, module: int, field_ut: float) -> Voice:
    return MtiCanVoice(module, field_ut)


VOICES: Mapping[str, Callable[[int, int, float], Voice]] = {
    "ximu3": _ximu3,
    "mti": _mti,
    "mti_can": _mti_can,
}
"""By what a link carries: makes the voice of a device from its place among the devices, its number and the
strength of the field, µT."""


async def announce(voices: Iterable[tuple[Voice, int]], host: str) -> None:
    """Have devices announce themselves to a host, again and again. voices: each with the port that it sends
    to; those that never announce themselves are silent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sending:
        sending.setblocking(False)
        told = list(voices)
        while True:
            for voice, port in told:
                announced = voice.announcement(port)
                if announced is not None:
                    sending.sendto(announced[1], (host, announced[0]))
            await asyncio.sleep(_ANNOUNCED_EVERY_S)
