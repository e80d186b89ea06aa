"""READ FIRST: the whole flow, as code.

    link → chunk ─┬─ framing → packets → clocks ─┬─ frame assembly ─┬─ reconstructor ─→ outputs
                  └────────── Stream ────────────┘    ImuFrame      └─ SkeletonFrame

``Pipeline`` is sans-I/O and deterministic: fed the same chunks with the same arrival times, and told in
the same order what the gateway sent and when (``sent``) and what was asked of it (``event``), it gives the
same skeleton frames, bit for bit.
``gateway.service.service`` puts links before it and outputs after.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from devices.link import Chunk, Framing, SentChunk
from gateway.assembly.frame_assembler import AssemblyParams, FrameAssembler
from gateway.assembly.fused_assembler import FusedAssembler
from gateway.assembly.heat_map_frames import NO_CAMERAS, HeatMapFrames
from gateway.assembly.marker_frames import MarkerFrames
from gateway.body.corrections import SensorCorrections
from gateway.body.skeleton import WornSuit, remounted
from gateway.clocks import ClockTable, TriggerAnswers, load_clock_table
from gateway.errors import GatewayError, SettingsError
from gateway.frames import FusedReading, ImuFrame, LightReading, LocalReading, SkeletonFrame, StatusArray
from gateway.reconstruction import (
    FUSED,
    OPTICAL,
    RootMode,
    RootSettings,
    WholeBodyReconstructor,
    create_reconstructor,
    update_many,
)
from gateway.reconstruction.optical.reconstructor import OpticalReconstructor
from gateway.reconstruction.optical.warm_up import warm_up
from gateway.reconstruction.reconstructor import Reconstructor
from gateway.reconstruction.resets import Resets
from gateway.reconstruction.whole_body import tell_doubtful
from gateway.settings import GatewaySettings, fitting_suit
from gateway.sources.despiking import Despiker
from gateway.sources.gnss import GnssParams, GnssReceiver
from gateway.sources.hip_position import HipPosition
from gateway.sources.light import SunCompass
from gateway.sources.stream import ClockMode, Reading, Stream

FRAMES_AT_A_TIME = 256
"""Of a recording: enough that a call costs nothing, few enough to stay in the processor's cache."""
RESET_EVENT, CALIBRATED_EVENT, LOAD_EVENT = "reset", "calibrated", "load"
INPUT_EVENTS = frozenset({RESET_EVENT, CALIBRATED_EVENT, LOAD_EVENT})
NO_MARKERS = "the rig has no markers: 'rig' must name a subject that `mocap-gateway optical fit` wrote"
"""Events that are inputs: a recording must hand them over again in their place."""


class InputEvent(NamedTuple):
    """What was asked of the gateway: see ``Pipeline.event``."""

    name: str
    data: Mapping[str, Any]


class NoModules:
    """In the place of a reconstructor where no module is worn: no frame of any ever comes."""

    def __init__(self, suit: WornSuit) -> None:
        self._name = suit.skeleton.name

    def update(self, observation: ImuFrame) -> SkeletonFrame:
        """Raises ``GatewayError``."""
        raise GatewayError(f"frame {observation.sequence} of modules, and none is worn on '{self._name}'")

    def reset(self) -> None:
        """Nothing is remembered."""


def _watched(suit: WornSuit) -> WornSuit | None:
    """The person as cameras see them; None: there are no cameras."""
    person = suit if suit.camera_position is None else suit.camera_position.person
    return None if person.video is None else person


def _reference(suit: WornSuit, table: ClockTable | None) -> int:
    """The module to whose instants the others are brought."""
    return suit.module_ids[0] if table is None else table.reference


def _triggers(suit: WornSuit, mode: ClockMode, patience_ns: int) -> TriggerAnswers | None:
    """What pairs triggers with their answers, in the clock mode that has some."""
    return TriggerAnswers(suit.module_ids, patience_ns) if mode is ClockMode.TRIGGER else None


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
        trigger_patience_ns: int = 250_000_000,
        root: RootSettings | None = None,
        delay_s: float = 0.0,
    ) -> None:
        """trigger_patience_ns: in clock mode TRIGGER, how long after a trigger its answers are taken.
        delay_s: by which the method's frames come later and better; for those that can."""
        self.stream = Stream(clock_mode, clock_table, _triggers(suit, clock_mode, trigger_patience_ns))
        self.corrections = SensorCorrections(suit.calibrations)
        self.despiker = despiker
        self.assembler = FrameAssembler(suit.module_ids, params)
        self.fused_assembler: FusedAssembler | None = None
        """In the place of the other where orientations fused on board are wanted."""
        if reconstructor in FUSED:
            self.fused_assembler = FusedAssembler(suit.module_ids, params, _reference(suit, clock_table))
        self.unused: Counter[str] = Counter()
        """Readings of a kind that the reconstructor has no use for."""
        if reconstructor == OPTICAL:
            if suit.markers is None:
                raise SettingsError(NO_MARKERS)
            reconstructor = "independent"  # for modules that may be worn beside the markers
            root = RootSettings(RootMode.FIXED)
        interval_s = params.frame_interval_ns * 1e-9
        self._make: Callable[[WornSuit], Reconstructor] = partial(
            create_reconstructor, reconstructor, nominal_interval_s=interval_s, root=root, delay_s=delay_s
        )
        if not suit.module_ids and (suit.markers is not None or suit.video is not None):
            self._make = NoModules  # or half a minute would go into compiling what is never used
        self.suit = suit
        """As worn now: a calibration may have changed it."""
        self.reconstructor = self._make(suit)
        self.resets = Resets(suit.skeleton)
        self.sun = None if suit.sun is None else SunCompass(suit)
        self.skeleton_frames = 0
        self.left_out = 0
        """Frames that were not reconstructed, since the machine could not keep up (see ``overload``)."""
        self._solve_every = 1
        self._restless: dict[int, StatusArray] = {}
        """By number of a frame that is to be solved: segments whose modules' clocks begin anew time and
        again."""
        self.on_imu_frame: Callable[[ImuFrame], None] | None = None
        """Told every frame before it is reconstructed: for calibrations."""
        self.gnss_params: dict[str, GnssParams] = {}
        """By link; a receiver that is not named has the defaults."""
        self._gnss: dict[str, GnssReceiver] = {}
        self.optical: OpticalReconstructor | None = None
        """In the place of the other on links that carry markers; None for a suit without."""
        if suit.markers is not None and suit.video is None:
            warm_up()
            self.optical = OpticalReconstructor(suit.skeleton, suit.markers)
        self._markers: dict[str, MarkerFrames] = {}
        self.video = None if (watched := _watched(suit)) is None else HeatMapFrames(watched)
        """Of cameras; it takes the heat maps of all links that carry some. ``hips``: where they are a local
        device of somebody with modules."""
        self.hips = HipPosition.of(suit, self.video)
        self._heat_map_links: set[str] = set()
        self.satellite_readings = 0
        """Readings that satellite receivers gave, beside those of the stream."""

    @classmethod
    def from_settings(cls, settings: GatewaySettings, suit: WornSuit) -> Pipeline:
        """The pipeline that a configuration describes. Raises ``SettingsError`` for a bad clock table,
        for a body that cannot walk and shall, and for a method that the suit has no modules for."""
        settings = fitting_suit(settings, suit)
        table = settings.clock.table
        pipeline = cls(
            suit,
            settings.assembly.params(),
            settings.reconstructor,
            settings.clock.mode,
            None if table is None else load_clock_table(Path(table)),
            Despiker() if settings.assembly.despike else None,
            round(settings.clock.trigger_patience_ms * 1e6),
            settings.root_motion.root(),
            settings.reconstructor_delay_ms * 1e-3,
        )
        pipeline.gnss_params = {
            link.name: GnssParams(link.device, round(link.latency_ms * 1e6), link.origin)
            for link in settings.links
            if link.carries == "gnss"
        }
        return pipeline

    def add_link(self, name: str, framing: Framing) -> None:
        """Announce a link, before its first chunk."""
        if framing is Framing.GNSS:
            self._gnss[name] = GnssReceiver(self.gnss_params.get(name, GnssParams()))
        elif framing is Framing.MARKERS:
            if self.suit.markers is None:
                raise SettingsError(f"link '{name}' carries markers: {NO_MARKERS}")
            self._markers[name] = MarkerFrames(self.suit.markers)
        elif framing is Framing.HEAT_MAPS:
            if self.video is None:
                raise SettingsError(f"link '{name}' carries heat maps: {NO_CAMERAS}")
            self._heat_map_links.add(name)
        else:
            self.stream.add_link(name, framing)

    def sent(self, chunk: SentChunk) -> None:
        """The gateway put this on a link: time requests and sampling triggers, whose answers need it."""
        self.stream.sent(chunk)

    def event(self, name: str, data: Mapping[str, Any]) -> dict[str, object]:
        """Something asked of the gateway that changes what follows; other events pass without effect.

        ``reset`` (kind, facing), ``calibrated`` (see ``mounting_event``) and ``load`` (solve_every: of the
        frames, how many are reconstructed). What came of it; raises
        ``GatewayError`` where that cannot be done, and then has changed nothing.
        """
        try:
            if name == RESET_EVENT:
                return self.resets.reset(str(data["kind"]), float(data.get("facing", 0.0)))
            if name == LOAD_EVENT:
                self._solve_every = max(int(data["solve_every"]), 1)
                return {}
            mounted = remounted(self.suit, data) if name == CALIBRATED_EVENT else None
        except (
            KeyError,
            TypeError,
            ValueError,
            OverflowError,
        ) as error:  # a recorded one may be damaged, or another's
            raise GatewayError(f"event '{name}' cannot be read: {error!r}") from error
        if mounted is not None:
            self.suit = mounted
            self.reconstructor = self._make(self.suit)
            self.resets = Resets(self.suit.skeleton)
        return {}

    def feed(self, chunk: Chunk) -> list[SkeletonFrame]:
        """The skeleton frames that a chunk completes."""
        if chunk.link in self._markers or chunk.link in self._heat_map_links:
            return self._seen_frames(chunk)
        skeleton_frames = [
            self._finished(self.reconstructor.update(imu_frame)) for imu_frame in self.imu_frames(chunk)
        ]
        self.skeleton_frames += len(skeleton_frames)
        return skeleton_frames

    def _seen_frames(self, chunk: Chunk) -> list[SkeletonFrame]:
        """Of an optical system or cameras."""
        if self.hips is not None and chunk.link in self._heat_map_links:
            readings = self.hips.receive(chunk)
            for reading in readings:
                self._assemble(reading, chunk.arrived_ns)
            return []
        if chunk.link in self._heat_map_links:
            assert self.video is not None  # add_link saw to it
            made = self.video.receive(chunk)
        else:
            assert self.optical is not None  # add_link saw to it
            made = [self.optical.update(markers) for markers in self._markers[chunk.link].receive(chunk)]
        self.skeleton_frames += len(made)
        return [self.resets.apply(frame) for frame in made]

    def replay(self, items: Iterable[Chunk | SentChunk | InputEvent]) -> Iterator[SkeletonFrame]:
        """A recording: the frames that ``feed``, ``sent`` and ``event`` of each item give, bit for bit, but
        many at a time. An event that is not possible with this suit or method is passed over."""
        block: list[ImuFrame] = []
        for item in items:
            if isinstance(item, Chunk) and (item.link in self._markers or item.link in self._heat_map_links):
                yield from self._seen_frames(item)
            elif isinstance(item, Chunk):
                block += self.imu_frames(item)
            elif isinstance(item, SentChunk):
                self.sent(item)
            if isinstance(item, InputEvent) or len(block) >= FRAMES_AT_A_TIME:
                yield from self._solved(block)
                block = []
            if isinstance(item, InputEvent):
                with contextlib.suppress(GatewayError):
                    self.event(item.name, item.data)
        yield from self._solved(block)

    def _solved(self, block: list[ImuFrame]) -> Iterator[SkeletonFrame]:
        self.skeleton_frames += len(block)
        if block:
            yield from map(self._finished, update_many(self.reconstructor, block))

    def _finished(self, frame: SkeletonFrame) -> SkeletonFrame:
        """A reconstructed frame as it is handed on."""
        restless = self._restless.pop(frame.sequence, None) if self._restless else None
        if restless is not None:
            status, sigma = np.array(frame.status), np.array(frame.sigma)
            tell_doubtful(status, sigma, restless)
            frame = replace(frame, status=status, sigma=sigma)
        return self.resets.apply(frame)

    def _note_restless(self, imu_frames: Sequence[ImuFrame]) -> None:
        """Remember whose modules begin their clocks anew again and again, until the frames are solved."""
        ids = [m for m, record in self.stream.modules.items() if record.restlessness is not None]
        rows = [self.suit.module_ids.index(m) for m in ids if m in self.suit.module_ids]
        if rows:
            is_restless = np.isin(self.suit.module_of_segment, rows).astype(np.uint8)
            self._restless |= {imu_frame.sequence: is_restless for imu_frame in imu_frames}

    def imu_frames(self, chunk: Chunk) -> list[ImuFrame]:
        """The frames of all modules that a chunk completes, not yet reconstructed."""
        imu_frames: list[ImuFrame] = []
        for reading in self._readings(chunk):
            imu_frames += self._assemble(reading, chunk.arrived_ns)
        if self.sun is not None:
            imu_frames = [self.sun.sighted(imu_frame) for imu_frame in imu_frames]
        if self.on_imu_frame is not None:
            for imu_frame in imu_frames:
                self.on_imu_frame(imu_frame)
        solved = imu_frames
        if self._solve_every != 1:
            solved = [imu_frame for imu_frame in imu_frames if imu_frame.sequence % self._solve_every == 0]
            self.left_out += len(imu_frames) - len(solved)
        if solved:
            self._note_restless(solved)
        return solved

    def _readings(self, chunk: Chunk) -> Sequence[Reading]:
        receiver = self._gnss.get(chunk.link)
        if receiver is None:
            return self.stream.receive(chunk)
        readings = receiver.receive(chunk)
        self.satellite_readings += len(readings)
        return readings

    def _assemble(self, reading: Reading, arrived_ns: int) -> list[ImuFrame]:
        fused = self.fused_assembler
        if isinstance(reading, LocalReading) and fused is None:
            self.assembler.add_local(reading)
            return []
        if isinstance(reading, LightReading):
            if self.sun is not None and fused is None:
                self.assembler.add_light(reading)
            else:
                self.unused["light"] += 1
            return []
        if isinstance(reading, FusedReading):
            if fused is not None:
                return fused.add(reading, arrived_ns)
            self.unused["fused"] += 1
            return []
        if fused is not None or isinstance(reading, LocalReading):
            self.unused["local" if isinstance(reading, LocalReading) else "raw"] += 1
            return []
        corrected = self.corrections.apply(reading)
        clean = corrected if self.despiker is None else self.despiker.add(corrected)
        return [] if clean is None else self.assembler.add(clean, arrived_ns)

    def doubts(self) -> dict[int, str]:
        """Why the segments of some modules are doubtful, and what to do, by module id."""
        worn = self.reconstructor.doubts() if isinstance(self.reconstructor, WholeBodyReconstructor) else {}
        restless = {m: r.restlessness for m, r in self.stream.modules.items() if r.restlessness is not None}
        return worn | restless

    def statistics(self) -> dict[str, object]:
        """Counters for the health message."""
        dropped = {
            link: {defect.name.lower(): count for defect, count in defects.items()}
            for link, defects in self.stream.dropped.items()
        }
        triggers, assembler = self.stream.triggers, self.fused_assembler or self.assembler
        return {
            **({} if triggers is None else {"triggers": triggers.figures.summary()}),
            **({"gnss": {name: r.statistics() for name, r in self._gnss.items()}} if self._gnss else {}),
            **({} if self.sun is None else {"light": self.sun.statistics()}),
            **({} if self.optical is None else {"markers": self._marker_statistics(self.optical)}),
            **({} if self.video is None else {"video": self.video.statistics()}),
            "skeleton_frames": self.skeleton_frames,
            "left_out_frames": self.left_out,
            "dropped_by_link": dropped,
            "dropped_by_assembly": {reason.name.lower(): count for reason, count in assembler.lost.items()},
            "unused_readings": dict(self.unused),
            "spikes": self.despiker.summary() if self.despiker is not None else {},
            "joint_agreement": self.reconstructor.joint_agreement()
            if isinstance(self.reconstructor, WholeBodyReconstructor)
            else {},
            "doubts": {str(module): why for module, why in self.doubts().items()},
            "modules": {str(module): record.summary() for module, record in self.stream.modules.items()},
        }

    @property
    def marker_frames(self) -> int:
        """Of optical systems, so far."""
        return sum(frames.receiver.received for frames in self._markers.values())

    def _marker_statistics(self, optical: OpticalReconstructor) -> dict[str, object]:
        """What became of marker messages, and how well the last pose explains the markers."""
        dropped: Counter[str] = Counter()
        for frames in self._markers.values():
            dropped += frames.receiver.dropped
        return {
            "dropped": dict(dropped),
            "counts": dict(optical.counts),
            "unknown_labels": len(set().union(*(frames.unknown for frames in self._markers.values()))),
            "rmse_mm": None if optical.last is None else round(1e3 * optical.last.rmse, 3),
        }
