"""The voices by the word that the configuration has for what their links carry. A maker is a line here."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable, Iterable, Mapping, Sequence

from devices.emulators.bno08x_voice import Bno08xVoice
from devices.emulators.mocopi_voice import mocopi_voices
from devices.emulators.mti_voice import MtiCanVoice, MtiVoice
from devices.emulators.mvn_voice import mvn_voices
from devices.emulators.slimevr_voice import SlimevrVoice
from devices.emulators.voice import Voice
from devices.emulators.witmotion_voice import WitMotionCanVoice, WitMotionVoice
from devices.emulators.ximu3_voice import Ximu3Voice
from devices.vendor_protocols import ximu3

_ANNOUNCED_EVERY_S = 1.0


_Voices = Mapping[int, Voice]


def _each(make: Callable[[int, float], Voice]) -> Callable[[Sequence[int], float], _Voices]:
    return lambda modules, field_ut: {module: make(module, field_ut) for module in modules}


def _ximu3(modules: Sequence[int], field_ut: float) -> _Voices:
    ports = enumerate(modules, start=ximu3.COMMAND_PORT)
    return {module: Ximu3Voice(module, field_ut, port) for port, module in ports}


VOICES: Mapping[str, Callable[[Sequence[int], float], Mapping[int, Voice]]] = {
    "ximu3": _ximu3,
    "mti": _each(MtiVoice),
    "mti_can": _each(MtiCanVoice),
    "witmotion": _each(WitMotionVoice),
    "witmotion_can": _each(WitMotionCanVoice),
    "slimevr": _each(SlimevrVoice),
    "mvn": mvn_voices,
    "bno08x_rvc": _each(Bno08xVoice),
    "mocopi": mocopi_voices,
}
"""By what a link carries: makes voices from the numbers of devices and the strength of the field, µT."""


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
