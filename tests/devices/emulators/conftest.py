"""Bodies for the emulated suit, and a host that talks with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from devices.emulators.bodies import EmulatedBody, EmulatedLocalDevice, emulated_body
from devices.emulators.imperfections import IDEAL, Imperfections
from devices.emulators.motion.motions import robot_arm_motion
from devices.emulators.motion.waves import Fade
from devices.emulators.suit_settings import SuitSettings
from devices.emulators.suit_traffic import SuitTraffic
from devices.link import Framing
from firmware_protocol import (
    BROADCAST,
    Acknowledgement,
    CanFrameDecoder,
    Command,
    FrameDecoder,
    Packet,
    PacketDecoder,
    ReceivedPacket,
    wire_frame,
)
from firmware_protocol.commands import VERBS, Verb, encode_arguments
from firmware_protocol.device_settings import SETTINGS, encode_value
from firmware_protocol.messages import ANYONE

STANDING_FACING_EAST = [np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0]


def random_mountings(n: int, seed: int) -> np.ndarray:
    return Rotation.random(n, random_state=seed).as_quat(scalar_first=True)


@pytest.fixture
def arm4() -> EmulatedBody:
    """A robot arm on a table: four links along their own x, modules off the joints."""
    return emulated_body(
        ("base", "upper", "lower", "tool"),
        [-1, 0, 1, 2],
        [[0, 0, 0], [0.30, 0, 0], [0.28, 0, 0.02], [0.20, 0.01, 0]],
        module_positions=[[0.15, 0.02, 0.03], [0.14, 0, 0.03], [0.1, -0.02, 0.03], [0.07, 0, 0.02]],
        sensor_to_segment=random_mountings(4, 4),
        reference_posture=Rotation.from_euler(
            "zy", [[0, -60], [0, 20], [30, 40], [30, 60]], degrees=True
        ).as_quat(scalar_first=True),
    )


@pytest.fixture
def pendulum3() -> EmulatedBody:
    """Three links hanging from a pivot, x up along each."""
    x_up = Rotation.from_euler("y", -90, degrees=True).as_quat(scalar_first=True)
    return emulated_body(
        ("upper", "middle", "lower"),
        [-1, 0, 1],
        [[0, 0, 0], [-0.28, 0, 0], [-0.30, 0, 0]],
        module_positions=[[-0.14, 0, 0], [-0.14, 0, 0], [-0.07, 0, 0]],
        module_ids=[1, 2, 3],
        reference_posture=np.tile(x_up, (3, 1)),
    )


@pytest.fixture
def human17() -> EmulatedBody:
    """Standing upright, facing east, ISB axes."""
    names, parents, offsets = (
        ["pelvis", "thorax", "head"],
        [-1, 0, 1],
        [[0, 0, 0], [0, 0.12, 0], [0, 0.45, 0]],
    )
    for side, sign in (("left", -1), ("right", 1)):
        arm = [(1, 0.3, 0.03), (None, 0, 0.16), (None, -0.3, 0), (None, -0.26, 0)]
        leg = [(0, -0.08, 0.09), (None, -0.42, 0), (None, -0.42, 0)]
        for part, (parent, up, out) in zip(
            ("shoulder_girdle", "upper_arm", "forearm", "hand", "thigh", "shank", "foot"),
            arm + leg,
            strict=True,
        ):
            parents.append(len(names) - 1 if parent is None else parent)
            names.append(f"{side}_{part}")
            offsets.append([0, up, sign * out])
    return emulated_body(
        tuple(names),
        parents,
        offsets,
        module_positions=np.tile([0.03, -0.1, 0.02], (17, 1)),
        sensor_to_segment=random_mountings(17, 17),
        reference_posture=np.tile(STANDING_FACING_EAST, (17, 1)),
        local_devices=(EmulatedLocalDevice(40, 0, np.array([0.0, 0.1, 0.0]), 3, sigma=0.01, rate_hz=10.0),),
    )


class Host:
    """The other end of an emulated suit, in motion time: asks, and keeps what it receives."""

    def __init__(self, traffic: SuitTraffic, step_s: float = 0.05) -> None:
        self.traffic = traffic
        self.now_s = 0.0
        self.packets: list[ReceivedPacket] = []
        """All that was received so far."""
        self.arrived_s: list[float] = []
        """When each of them was, motion time."""
        self._step_s = step_s
        self._encoding = traffic.settings.encoding
        is_can = traffic.framing is Framing.CAN
        self.decoder = PacketDecoder(CanFrameDecoder() if is_can else FrameDecoder())
        self._transaction = 0

    def send(self, packet: Packet, module: int, at_s: float | None = None) -> None:
        frame = wire_frame(packet, module, 0, 0)
        self.traffic.receive(self._encoding.encode(frame), self.now_s if at_s is None else at_s)

    def listen(self, duration_s: float) -> list[ReceivedPacket]:
        """What comes in the next so many seconds."""
        before, end_s = len(self.packets), self.now_s + duration_s
        while self.now_s < end_s:
            self.now_s = min(self.now_s + self._step_s, end_s)
            for sent in self.traffic.advance(self.now_s):
                received = self.decoder.feed(sent.data)
                self.packets += received
                self.arrived_s += [sent.time_s] * len(received)
        return self.packets[before:]

    def command(self, verb: int, *values, unique_id: bytes = ANYONE, **changes) -> Command:
        """A new command."""
        self._transaction += 1
        arguments = encode_arguments(verb, *values) if verb in VERBS else b""
        return replace(Command(self._transaction, verb, unique_id, arguments), **changes)

    def tell(self, verb: int, *values, module: int = BROADCAST, unique_id: bytes = ANYONE, **changes):
        """Send a command; every acknowledgement of it, after long enough for all devices' turns."""
        command = self.command(verb, *values, unique_id=unique_id, **changes)
        self.send(command, module)
        return self.answers(command, self.listen(0.2))

    def ask(self, verb: int, *values, module: int = BROADCAST, unique_id: bytes = ANYONE, **changes):
        """The one acknowledgement of a command."""
        (answer,) = self.tell(verb, *values, module=module, unique_id=unique_id, **changes)
        return answer

    def write(self, name: str, value, module: int = BROADCAST, unique_id: bytes = ANYONE):
        """Stage a setting by name."""
        key = next(key for key, setting in SETTINGS.items() if setting.name == name)
        return self.ask(Verb.WRITE_SETTING, key, encode_value(key, value), module=module, unique_id=unique_id)

    def answers(self, command: Command, packets: list[ReceivedPacket]) -> list[Acknowledgement]:
        return [
            p.packet
            for p in packets
            if isinstance(p.packet, Acknowledgement) and p.packet.transaction == command.transaction
        ]

    def of(self, packet_class: type, module: int | None = None) -> list[ReceivedPacket]:
        """All received packets of a class, of one module or all."""
        return [
            p
            for p in self.packets
            if isinstance(p.packet, packet_class) and (module is None or p.module == module)
        ]


@pytest.fixture
def host_of() -> type[Host]:
    """Makes the host of a traffic."""
    return Host


@pytest.fixture
def arm_host(arm4: EmulatedBody) -> Callable[..., Host]:
    """Makes the host of a robot arm, given what is to be otherwise than in an ideal suit."""

    def make(imperfections: Imperfections = IDEAL, seed: int = 1, **settings) -> Host:
        motion = robot_arm_motion(arm4, 1, Fade(rest_s=0.0, ramp_s=0.5))
        return Host(SuitTraffic(motion, SuitSettings(**settings), imperfections, seed))

    return make
