"""The options of ``emulate``, one name each."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from devices.emulators.gnss_receiver import FORMATS
from devices.emulators.imperfections import PRESETS
from devices.emulators.recording_formats import READERS


class Medium(StrEnum):
    """Where the emulated suit speaks."""

    PTY = "pty"
    TCP = "tcp"
    UDP = "udp"
    SLCAN = "slcan"
    CAN = "can"


class SamplingMode(StrEnum):
    """What the modules send until a host sets them otherwise."""

    RAW = "raw"
    FUSED = "fused"
    TRIGGERED = "triggered"


class MotionKind(StrEnum):
    """What the emulated body does."""

    OWN = "own"
    CALIBRATION = "calibration"


class StrapOn(StrEnum):
    """How the modules sit."""

    RIG = "rig"
    RANDOM = "random"


Rig = Annotated[str, typer.Option(help="Rig to wear: a shipped one or a file.")]
On = Annotated[Medium, typer.Option(help="What to speak on.")]
Link = Annotated[Path | None, typer.Option(help="pty, slcan: make this link to the port.")]
Port = Annotated[
    int, typer.Option(min=0, max=65535, help="tcp: listen here (0: a free port). udp: the gateway's port.")
]
Host = Annotated[str, typer.Option(help="udp: the gateway's address.")]
Channel = Annotated[str, typer.Option(help="can: SocketCAN interface.")]
Fd = Annotated[bool, typer.Option("--fd", help="can, slcan: CAN FD frames.")]
KeyFile = Annotated[
    Path | None,
    typer.Option(
        help="tcp, udp: sign with the key in this file (mocap-gateway config key), obey signed commands only."
    ),
]
Imperfections = Annotated[str, typer.Option(help=f"How bad it is: {', '.join(PRESETS)}.")]
Rate = Annotated[float, typer.Option(min=1, max=4000, help="Samples of each module a second.")]
Mode = Annotated[
    SamplingMode,
    typer.Option(help="Raw samples or orientations fused on board, or raw ones when the host triggers them."),
]
Relay = Annotated[
    bool | None,
    typer.Option(
        "--relay/--no-relay",
        help="Through a relay that batches (not on CAN); over udp else each module from its own address.",
        show_default="--no-relay over udp",
    ),
]
Fine = Annotated[bool, typer.Option("--fine", help="Send the fine (32-bit) samples.")]
Recording = Annotated[Path | None, typer.Option(help="Play a real recording instead of a motion.")]
Kind = Annotated[str, typer.Option("--format", help=f"Of the recording: {', '.join(READERS)}.")]
Fresh = Annotated[int, typer.Option(min=0, help="So many modules come from the factory, all of id 0.")]
IdConflict = Annotated[
    bool, typer.Option("--id-conflict", help="The last module has the id of the one before it.")
]
Gnss = Annotated[
    Path | None, typer.Option(help="A satellite receiver on the body's root too: link to its port.")
]
GnssFormat = Annotated[str, typer.Option(help=f"What it speaks: {', '.join(FORMATS)}.")]
Faults = Annotated[
    Path | None,
    typer.Option(help="What goes wrong and when: a YAML file such as config/faults.yaml."),
]
Tumbling = Annotated[
    bool,
    typer.Option("--tumbling", help="The suit lies in a box that is turned: for `calibrate sensors`."),
]
Motion = Annotated[
    MotionKind,
    typer.Option(help="What the body does; calibration: the steps of `calibrate body`, over and over."),
]
StrappedOn = Annotated[
    StrapOn,
    typer.Option(help="random: modules turned anyhow on their segments, each 2 cm off its place."),
]
UpsideDown = Annotated[
    list[int] | None, typer.Option(help="This module sits upside down on its segment; as often as needed.")
]
Swapped = Annotated[
    tuple[int, int] | None, typer.Option(help="These two modules have changed places.", metavar="ID ID")
]
Facing = Annotated[
    float, typer.Option(help="Heading of the wearer who calibrates, degrees anticlockwise from east.")
]
Seed = Annotated[int, typer.Option(help="Of the motion and of everything random.")]
Seconds = Annotated[float | None, typer.Option(min=0.1, help="End after so long.")]
AsJson = Annotated[bool, typer.Option("--json", help="Say where and since when as JSON.")]
