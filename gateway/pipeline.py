"""READ FIRST: the whole flow, as code.

    link → chunk ─┬─ framing → packets → clocks ─┬─ frame assembly ─┬─ reconstructor ─→ outputs
                  └────────── Stream ────────────┘    ImuFrame      └─ SkeletonFrame

``Pipeline`` is sans-I/O and deterministic: fed the same chunks with the same arrival times it gives
the same skeleton frames, bit for bit. ``gateway.service`` puts links before it and outputs after.
"""

from __future__ import annotations

from pathlib import Path

from devices.link import Chunk, Framing
from gateway.assembly import AssemblyParams, FrameAssembler
from gateway.body.skeleton import WornSuit
from gateway.clocks import ClockTable, load_clock_table
from gateway.despiking import Despiker
from gateway.frames import LocalReading, SkeletonFrame
from gateway.errors import SettingsError
from gateway.reconstruction import NO_CONTACTS, RootMode, RootSettings, create_reconstructor
from gateway.settings import GatewaySettings
from gateway.stream import ClockMode, Stream


class Pipeline:
    """Chunks in, skeleton frames out."""

    def __init__(
        self,
        suit: WornSuit,
        params: AssemblyParams,
        reconstructor: str = "independent",
        clock_mode: ClockMode = ClockMode.ESTIMATED,
        clock_table: ClockTable | None = None,
        despiker: Despiker | None = None,
        root: RootSettings | None = None,
    ) -> None:
        self.stream = Stream(clock_mode, clock_table)
        self.despiker = despiker
        self.assembler = FrameAssembler(suit.module_ids, params)
        self.reconstructor = create_reconstructor(
            reconstructor, suit, params.frame_interval_ns * 1e-9, root
        )
        self.skeleton_frames = 0

    @classmethod
    def from_settings(cls, settings: GatewaySettings, suit: WornSuit) -> Pipeline:
        """The pipeline that a configuration describes. Raises ``SettingsError`` for a bad clock table, and for a
        body that cannot walk and shall."""
        if settings.root_motion.mode is RootMode.WALKING and not suit.skeleton.contacts:
            raise SettingsError(f"root_motion.mode: walking: {NO_CONTACTS.format(suit.skeleton.name)}")
        table = settings.clock.table
        return cls(
            suit,
            settings.assembly.params(),
            settings.reconstructor,
            settings.clock.mode,
            None if table is None else load_clock_table(Path(table)),
            Despiker() if settings.assembly.despike else None,
            settings.root_motion.root(),
        )

    def add_link(self, name: str, framing: Framing) -> None:
        """Announce a link, before its first chunk."""
        self.stream.add_link(name, framing)

    def feed(self, chunk: Chunk) -> list[SkeletonFrame]:
        """The skeleton frames that a chunk completes."""
        skeleton_frames: list[SkeletonFrame] = []
        for reading in self.stream.receive(chunk):
            if isinstance(reading, LocalReading):
                self.assembler.add_local(reading)
                continue
            clean = reading if self.despiker is None else self.despiker.add(reading)
            if clean is None:
                continue
            imu_frames = self.assembler.add(clean, chunk.arrived_ns)
            skeleton_frames.extend(self.reconstructor.update(imu_frame) for imu_frame in imu_frames)
        self.skeleton_frames += len(skeleton_frames)
        return skeleton_frames

    def statistics(self) -> dict[str, object]:
        """Counters for the health message."""
        dropped = {
            link: {defect.name.lower(): count for defect, count in defects.items()}
            for link, defects in self.stream.dropped.items()
        }
        return {
            "skeleton_frames": self.skeleton_frames,
            "dropped_by_link": dropped,
            "dropped_by_assembly": {
                reason.name.lower(): count for reason, count in self.assembler.lost.items()
            },
            "spikes": self.despiker.summary() if self.despiker is not None else {},
            "joint_agreement": self.reconstructor.joint_agreement(),
            "modules": {str(module): record.summary() for module, record in self.stream.modules.items()},
        }
