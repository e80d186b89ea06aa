"""Emulated suits: modules that move, sense and speak the wire protocol, without any hardware.

They import nothing of the gateway: the motion is known in closed form, so that they are the independent
truth that the gateway is judged by.

Reading order: ``bodies`` (who wears it) → ``waves``, ``kinematics_truth``, ``walking``, ``motions`` (how it
moves) → ``ideal_sensors`` → ``imperfections``, ``imperfect_sensors`` (what is wrong) → ``sample_encoding``,
``emulated_module``, ``emulated_relay``, ``delivery`` (what is said, and what becomes of it) →
``suit_traffic`` (all of it in order of time) → ``emulated_suit`` and ``transports`` (real time, real ports).
``recordings`` and ``recording_formats`` put real captures in the place of all that.

Time 0 of a motion is ``EmulatedSuit.start_ns``. Samples arrive ``Imperfections.latency`` and more after
their instant; no receiver can tell the constant part from the clock's offset.
"""

from devices.emulators.bodies import NO_MODULE, EmulatedBody, EmulatedLocalDevice, emulated_body
from devices.emulators.delivery import Encoding, Transmission
from devices.emulators.emulated_suit import EmulatedSuit, SuitCounts
from devices.emulators.imperfections import IDEAL, PRESETS, ROUGH, TYPICAL, Imperfections
from devices.emulators.kinematics_truth import MotionState
from devices.emulators.motions import MOTIONS, BodyMotion, generic_motion
from devices.emulators.recordings import Recording, play
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.emulators.waves import Fade

__all__ = [
    "IDEAL",
    "MOTIONS",
    "NO_MODULE",
    "PRESETS",
    "ROUGH",
    "TYPICAL",
    "BodyMotion",
    "EmulatedBody",
    "EmulatedLocalDevice",
    "EmulatedSuit",
    "Encoding",
    "Fade",
    "Imperfections",
    "MotionState",
    "Recording",
    "SuitCounts",
    "SuitSettings",
    "SuitTraffic",
    "Transmission",
    "emulated_body",
    "generic_motion",
    "play",
]
