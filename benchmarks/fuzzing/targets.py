"""What is fuzzed: one target for everything that reads bytes from outside.

Nothing of the gateway is imported here: ``child`` must import it under the eyes of the fuzzer.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent
CORPORA = ROOT / "tests" / "fuzz" / "corpora"
"""Inputs that once broke something, named for what they found: a folder for every target that has some."""

Check = Callable[[bytes], None]
"""Reads an input as the gateway would. Raises for a defect, never for an input that is merely bad."""


@dataclass(frozen=True)
class Target:
    """One reader."""

    name: str
    meaning: str
    place: str
    """Module of ``benchmarks.fuzzing`` that holds the check, a function of the target's name."""
    watched: tuple[str, ...]
    """Modules whose coverage guides the fuzzer, and is reported."""
    largest: int
    """Bytes of an input."""
    mutants: int = 1000
    """Damaged inputs that the tests try."""

    def check(self) -> Check:
        """The check; imports what it needs."""
        check: Check = getattr(importlib.import_module(f"benchmarks.fuzzing.{self.place}"), self.name)
        return check

    @property
    def found(self) -> list[Path]:
        """Inputs that once broke something, in a fixed order."""
        return sorted(path for path in (CORPORA / self.name).glob("*") if path.is_file())


_WIRE = (
    "firmware_protocol.codec",
    "firmware_protocol.codec",
    "firmware_protocol.fields",
    "firmware_protocol.framing",
    "firmware_protocol.packets",
    "firmware_protocol.relay",
)
_MANY = 5000
"""Mutants of readers that take a tenth of a millisecond."""
_SETTINGS = ("gateway.settings", "gateway.support.settings_files")
_SHEETS = (
    "devices.vendor_formats.gaps",
    "devices.vendor_formats.tracks",
    "devices.vendor_formats.sheets",
)

_ALL = (
    Target("wire_stream", "wire frames on a byte stream, to packets", "wire", _WIRE, 4096, _MANY),
    Target(
        "can_stream",
        "CAN frames, reassembled, to packets",
        "wire",
        (*_WIRE, "firmware_protocol.can_framing", "firmware_protocol.can_framing"),
        4096,
        _MANY,
    ),
    Target(
        "ximu3_stream",
        "messages of an x-IMU3, and its announcements",
        "wire",
        ("devices.vendor_protocols.ximu3",),
        2048,
        _MANY,
    ),
    Target("mti_stream", "messages of an MTi", "wire", ("devices.vendor_protocols.mti",), 2048, _MANY),
    Target(
        "slimevr_datagrams",
        "datagrams of SlimeVR trackers, and of their server",
        "wire",
        ("devices.vendor_protocols.slimevr", "devices.vendor_protocols.slimevr_tracker"),
        2048,
        _MANY,
    ),
    Target(
        "witmotion_stream",
        "packets of WitMotion",
        "wire",
        ("devices.vendor_protocols.witmotion",),
        2048,
        _MANY,
    ),
    Target(
        "suit_datagrams",
        "datagrams of MVN and mocopi, reports of a BNO08x",
        "wire",
        tuple(f"devices.vendor_protocols.{name}" for name in ("mvn", "mocopi", "bno08x")),
        4096,
        _MANY,
    ),
    Target("slcan_text", "lines of an slcan adapter", "wire", ("devices.links.slcan",), 1024, _MANY),
    Target(
        "can_transfers",
        "long transfers over CAN, both directions of the receiver",
        "wire",
        ("firmware_protocol.can_transfer", "firmware_protocol.can_transfer"),
        4096,
        _MANY,
    ),
    Target(
        "commands",
        "commands to a device, and answers to the host",
        "wire",
        (
            "firmware_protocol.commands",
            "firmware_protocol.device_settings",
            "devices.commands.transactions",
            "devices.emulators.device.command_responder",
        ),
        2048,
        _MANY,
    ),
    Target("flash_slots", "settings in a module's flash", "wire", ("firmware_protocol.flash_slots",), 2048),
    Target("markers", "markers of an optical system, as JSON", "wire", ("devices.marker_messages",), 2048),
    Target(
        "gnss",
        "NMEA and UBX of a satellite receiver",
        "wire",
        ("gateway.sources.gnss.sentences",),
        2048,
        _MANY,
    ),
    Target("card_file", "a memory card's file, to a recording", "wire", ("devices.commands.card",), 4096),
    Target("gateway_file", "gateway.yaml", "configuration", _SETTINGS, 4096),
    Target(
        "rig_file",
        "rig files",
        "configuration",
        ("gateway.body.rig", "gateway.body.anthropometry", "gateway.support.settings_files"),
        4096,
    ),
    Target(
        "body_file",
        "body files",
        "configuration",
        ("gateway.body.body_file", "gateway.body.body_file", "gateway.support.settings_files"),
        4096,
    ),
    Target("clock_table", "clock tables", "configuration", ("gateway.clocks.table",), 2048),
    Target("urdf", "robots as URDF", "configuration", ("gateway.body.urdf",), 4096, _MANY),
    Target(
        "map_file", "maps of modules to segments", "configuration", ("gateway.imports.segment_names",), 2048
    ),
    Target(
        "requests",
        "requests over MQTT, up to what carries them out",
        "requests",
        (
            "gateway.contract.request_messages",
            "gateway.outputs.requests",
            "gateway.service.own_requests",
            "gateway.recording.control",
        ),
        2048,
    ),
    Target(
        "published",
        "what a subscriber takes from the broker",
        "requests",
        ("gateway.outputs.subscriber", "gateway.contract.topics"),
        2048,
    ),
    Target(
        "recording",
        "recordings (MCAP), with all that stands in them",
        "recordings",
        (
            "devices.recording_file",
            "gateway.recording.reading",
            "gateway.recording.snapshot",
            "gateway.recording.pose_encoding",
            "mcap.stream_reader",
            "mcap.records",
        ),
        65536,
    ),
    Target(
        "recorded_suit",
        "the suit in a recording",
        "recordings",
        ("gateway.recording.snapshot",),
        4096,
    ),
    Target(
        "recorded_frame",
        "skeleton frames in a recording",
        "recordings",
        ("gateway.recording.pose_encoding",),
        2048,
    ),
    Target("import_xsens", "Xsens text", "vendors", (*_SHEETS, "devices.vendor_formats.xsens_text"), 4096),
    Target("import_mvnx", "MVNX", "vendors", ("devices.vendor_formats.mvnx",), 4096),
    Target("import_ximu3", "x-IMU3 folders", "vendors", (*_SHEETS, "devices.vendor_formats.ximu3"), 4096),
    Target(
        "import_movella_dot",
        "Movella DOT",
        "vendors",
        (*_SHEETS, "devices.vendor_formats.movella_dot"),
        4096,
    ),
    Target(
        "import_csv",
        "any CSV and the map of its columns",
        "vendors",
        (*_SHEETS, "devices.vendor_formats.column_map"),
        4096,
    ),
    Target(
        "import_c3d",
        "C3D",
        "vendors",
        ("devices.marker_files.c3d", "devices.marker_files.c3d_parameters"),
        8192,
    ),
    Target("import_trc", "TRC", "vendors", ("devices.marker_files.trc",), 4096),
)

TARGETS: dict[str, Target] = {target.name: target for target in _ALL}
"""By name."""
