"""Emulated suits: modules that move, sense and speak the wire protocol, without any hardware.

They import nothing of the gateway: the motion is known in closed form, so that they are the independent
truth that the gateway is judged by.

The flow of a sample: ``bodies`` (who wears it) → ``motion`` (how it moves) → ``sensing`` (what is read, with
the ``imperfections`` of it) → ``device`` (what a device says by itself and does when told) → ``delivery``
(what becomes of what is said) → ``suit_traffic`` (all of it in order of time, for devices built as
``suit_settings`` has it) → ``emulated_suit`` and ``transports`` (real time, real ports). ``playback``, with
the readers in ``data_sets``, puts real captures in the place of all that.

- ``makers``: the same suit in other makers' protocols. ``faults``: what goes wrong on purpose.
- ``bench``: modules on a table that nobody wears yet. Programs of their own: ``ring_pair``, ``paced_writer``.
- Other things at the gateway's door: ``gnss_receiver``, ``qtm_stand_in``, ``local_broker``.

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
from devices.emulators.playback import play
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
    "SuitCounts",
    "SuitSettings",
    "SuitTraffic",
    "Transmission",
    "bench_suit",
    "emulated_body",
    "generic_motion",
    "play",
]
