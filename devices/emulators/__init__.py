"""Emulated suits: modules that move, sense and speak the wire protocol, without any hardware.

They import nothing of the gateway: the motion is known in closed form, so that they are the independent
truth that the gateway is judged by.

Reading order: ``bodies`` (who wears it) → ``waves``, ``kinematics_truth``, ``walking``, ``motions``,
``bench`` (how it moves) → ``ideal_sensors``, ``sensed_motion`` → ``imperfections``, ``imperfect_sensors``,
``disturbances`` (what is wrong) → ``sample_encoding``, ``fused_samples``, ``inertial_sampler``,
``local_sampler`` (what is read) → ``sender``, ``sampling_timer``, ``status_reports`` (what a device says by
itself) → ``emulated_flash``, ``stored_settings``, ``emulated_card``, ``command_responder``,
``emulated_device``, ``emulated_relay``, ``relay_device`` (what it does when told) → ``delivery``,
``host_side`` (what becomes of what is said) → ``suit_settings``, ``suit_devices``, ``suit_traffic`` (all of
it in order of time) → ``emulated_suit`` and ``transports`` (real time, real ports). ``recordings`` and
``recording_formats`` put real captures in the place of all that.

Time 0 of a motion is ``EmulatedSuit.start_ns``. Samples arrive ``Imperfections.latency`` and more after
their instant; no receiver can tell the constant part from the clock's offset.
"""

from devices.emulators.bench import bench_suit
from devices.emulators.bodies import NO_MODULE, EmulatedBody, EmulatedLocalDevice, emulated_body
from devices.emulators.delivery import Encoding, Transmission
from devices.emulators.device.emulated_device import EmulatedDevice
from devices.emulators.device.emulated_flash import Moment, PowerCut
from devices.emulators.emulated_suit import Conversation, EmulatedSuit, SuitCounts
from devices.emulators.imperfections import IDEAL, PRESETS, ROUGH, TYPICAL, Imperfections
from devices.emulators.motion.kinematics_truth import MotionState
from devices.emulators.motion.motions import MOTIONS, BodyMotion, generic_motion
from devices.emulators.motion.waves import Fade
from devices.emulators.recordings import RecordedTracks, play
from devices.emulators.suit_settings import SuitSettings
from devices.emulators.suit_traffic import SuitTraffic

__all__ = [
    "IDEAL",
    "MOTIONS",
    "NO_MODULE",
    "PRESETS",
    "ROUGH",
    "TYPICAL",
    "BodyMotion",
    "Conversation",
    "EmulatedBody",
    "EmulatedDevice",
    "EmulatedLocalDevice",
    "EmulatedSuit",
    "Encoding",
    "Fade",
    "Imperfections",
    "Moment",
    "MotionState",
    "PowerCut",
    "RecordedTracks",
    "SuitCounts",
    "SuitSettings",
    "SuitTraffic",
    "Transmission",
    "bench_suit",
    "emulated_body",
    "generic_motion",
    "play",
]
