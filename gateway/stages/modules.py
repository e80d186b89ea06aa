"""Readings of modules and local devices to frames of one instant, and to poses.

    readings → ranges → calibration → (despiking) → frame assembly → (sun) → reconstructor → pose

``SensorCorrections`` puts samples right by the rig file's calibrations. ``FrameAssembler`` and
``FusedAssembler`` put readings together; which one it is, the method decides.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from devices.calibration import SensorCalibration
from gateway.body.skeleton import WornSuit
from gateway.contract.balances import Balance
from gateway.errors import GatewayError, SettingsError
from gateway.frames import (
    ANGULAR_RATE,
    MAGNETIC_FIELD,
    SPECIFIC_FORCE,
    FusedReading,
    ImuFrame,
    InertialBatch,
    LightReading,
    LocalReading,
    Reading,
    SkeletonFrame,
    StatusArray,
)
from gateway.reconstruction import (
    FUSED,
    OPTICAL,
    RootMode,
    RootSettings,
    create_reconstructor,
    update_many,
)
from gateway.reconstruction.reconstructor import Reconstructor
from gateway.reconstruction.whole_body import WholeBodyReconstructor
from gateway.reconstruction.whole_body_frames import mark_doubtful
from gateway.sources.light import SunCompass
from gateway.sources.registry import NO_MARKERS
from gateway.stages.clipping import RangeWatch
from gateway.stages.frame_assembler import FrameAssembler, Lost
from gateway.stages.fused_assembler import FusedAssembler
from gateway.stages.stage import StageContext

_TURNED = (SPECIFIC_FORCE, MAGNETIC_FIELD)
"""Sensors that have a matrix."""


class SensorCorrections:
    """By module id; a module without a calibration passes as it is."""

    def __init__(self, calibrations: Mapping[int, SensorCalibration]) -> None:
        self._ids = np.array(sorted(calibrations), np.int64)
        k = len(self._ids)
        self._bias, self._matrix = np.zeros((k, 3, 3)), np.zeros((k, 3, 3, 3))  # by sensor
        for row, module in enumerate(self._ids.tolist()):
            calibration = calibrations[module]
            self._bias[row, SPECIFIC_FORCE] = calibration.accelerometer_bias
            self._bias[row, ANGULAR_RATE] = calibration.gyroscope_bias
            self._bias[row, MAGNETIC_FIELD] = calibration.magnetometer_bias
            self._matrix[row, SPECIFIC_FORCE] = calibration.accelerometer_matrix
            self._matrix[row, MAGNETIC_FIELD] = calibration.magnetometer_matrix

    def apply(self, samples: NDArray[np.void]) -> NDArray[np.void]:
        """Return samples (n,) ``INERTIAL_SAMPLE`` as faultless modules would have sent them.

        All at once, and to the last bit what ``SensorCalibration`` makes of each.
        """
        if not len(self._ids):
            return samples
        rows = np.searchsorted(self._ids, samples["module"]) % len(self._ids)
        is_calibrated = self._ids[rows] == samples["module"]
        corrected = samples.copy()
        measured = corrected["measured"]  # (n, 3, 3)
        right = measured - self._bias[rows]
        for sensor in _TURNED:
            matrix = self._matrix[rows, sensor].transpose(0, 2, 1)  # a view, as in ``SensorCalibration``
            right[:, sensor] = (right[:, None, sensor] @ matrix)[:, 0]
        counts = is_calibrated[:, None] & ~np.isnan(measured[:, :, 0])
        measured[counts] = right[counts]
        return corrected


_UNUSED = {FusedReading: "fused", InertialBatch: "raw", LocalReading: "local", LightReading: "light"}
"""What readings are called that the method has no use for."""
_OF_READINGS = frozenset(Lost) - {Lost.SKIPPED_INSTANT}

Add = Callable[[Any, int], list[ImuFrame]]
"""Takes a reading and when it arrived (gateway time, ns); returns the frames that this completes."""


class NoModules:
    """In the place of a reconstructor where no module is worn: no frame of any ever comes."""

    def __init__(self, suit: WornSuit) -> None:
        self._name = suit.skeleton.name

    def update(self, observation: ImuFrame) -> SkeletonFrame:
        """Raise ``GatewayError``: this person wears no modules."""
        raise GatewayError(f"frame {observation.sequence} of modules, and none is worn on '{self._name}'")

    def reset(self) -> None:
        """Do nothing: the stage keeps no state."""


class ModuleStage:
    """Readings of all modules and local devices of a suit."""

    def __init__(self, context: StageContext) -> None:
        suit, params = context.suit, context.params
        self.make: Callable[[WornSuit], Reconstructor] = _maker(context)
        """Makes a reconstructor for the suit as worn: see ``wear``."""
        self.reconstructor = self.make(suit)
        self.sun = None if suit.sun is None else SunCompass(suit)
        self.on_frame: Callable[[ImuFrame], None] | None = None
        """Called with every frame before it is reconstructed: for calibrations."""
        self.solve_every = 1
        """Of the frames, which are reconstructed: fewer while the machine cannot keep up."""
        self.left_out = 0
        """Frames that were not reconstructed for that reason."""
        self.unused: Counter[str] = Counter()
        """Readings of a kind that the method has no use for."""
        self._suit, self._modules = suit, context.modules
        self._corrections, self._despiker = SensorCorrections(suit.calibrations), context.despiker
        self._ranges = RangeWatch(suit.ranges)
        self._restless: dict[int, StatusArray] = {}
        """By number of a frame that is to be solved: segments whose modules' clocks begin anew time and
        again."""
        self.assembler: FrameAssembler | FusedAssembler
        self._add: dict[type[Reading], Add]
        if context.method in FUSED:
            reference = suit.module_ids[0] if context.reference is None else context.reference
            self.assembler = fused = FusedAssembler(suit.module_ids, params, reference)
            self._add = {FusedReading: fused.add}
        else:
            self.assembler = raw = FrameAssembler(suit.module_ids, params)
            self._add = {
                InertialBatch: partial(self._add_inertial, raw),
                LocalReading: _kept(raw.add_local),
            }
            if self.sun is not None:
                self._add[LightReading] = _kept(raw.add_light)

    def wear(self, suit: WornSuit, reconstructor: Reconstructor) -> None:
        """Go on with modules that are worn otherwise. reconstructor: made for that suit by ``make``."""
        self._suit, self.reconstructor = suit, reconstructor

    def add(self, observations: Sequence[Reading], arrived_ns: int) -> list[ImuFrame]:
        """Return the frames that readings complete and that are to be solved."""
        frames: list[ImuFrame] = []
        for reading in observations:
            add = self._add.get(type(reading))
            if add is None:
                count = len(reading) if isinstance(reading, InertialBatch) else 1
                self.unused[_UNUSED[type(reading)]] += count
            else:
                frames += add(reading, arrived_ns)
        if self.sun is not None:
            frames = [self.sun.sighted(frame) for frame in frames]
        if self.on_frame is not None:
            for frame in frames:
                self.on_frame(frame)
        solved = frames
        if self.solve_every != 1:
            # By number, so that a replay leaves out the same frames.
            solved = [frame for frame in frames if frame.sequence % self.solve_every == 0]
            self.left_out += len(frames) - len(solved)
        if solved:
            self._note_restless(solved)
        return solved

    def solve(self, frames: Sequence[ImuFrame]) -> list[SkeletonFrame]:
        """Return the poses of frames in time order."""
        return [self._marked_doubtful(pose) for pose in update_many(self.reconstructor, frames)]

    @property
    def _whole_body(self) -> WholeBodyReconstructor | None:
        """The reconstructor, if it is one that knows how far its joints agree."""
        return self.reconstructor if isinstance(self.reconstructor, WholeBodyReconstructor) else None

    def doubts(self) -> dict[int, str]:
        """Return why the segments of some modules are doubtful, and what to do, by module id."""
        worn = {} if self._whole_body is None else self._whole_body.doubts()
        return worn | self._modules.restless()

    def statistics(self) -> Mapping[str, object]:
        """Return counters for the health message."""
        lost = self.assembler.lost
        return {
            **({} if self.sun is None else {"light": self.sun.statistics()}),
            "left_out_frames": self.left_out,
            "dropped_by_assembly": {reason.name.lower(): count for reason, count in lost.items()},
            "unused_readings": dict(self.unused),
            "spikes": {} if self._despiker is None else self._despiker.summary(),
            "clipped": self._ranges.summary(),
            "joint_agreement": {} if self._whole_body is None else self._whole_body.joint_agreement(),
            "certainty": {} if self._whole_body is None else self._whole_body.certainty(),
            "doubts": {str(module): why for module, why in self.doubts().items()},
        }

    def balances(self) -> Iterator[Balance]:
        """Yield what became of readings, instants and frames."""
        assembler = self.assembler
        parts = {"taken": assembler.taken}
        parts |= {reason.name.lower(): n for reason, n in assembler.lost.items() if reason in _OF_READINGS}
        parts |= {f"unused_{kind}": n for kind, n in self.unused.items()}
        if self._despiker is not None:
            parts["held_back"] = self._despiker.held_back
        yield Balance("readings", 0, parts)
        if isinstance(assembler, FrameAssembler):
            skipped = assembler.lost[Lost.SKIPPED_INSTANT]
            yield Balance("instants", assembler.instants, {"frames": assembler.frames, "skipped": skipped})
        yield Balance("frames", assembler.frames, {"left_out": self.left_out})

    def _add_inertial(
        self, assembler: FrameAssembler, batch: InertialBatch, arrived_ns: int
    ) -> list[ImuFrame]:
        samples = self._corrections.apply(self._ranges.add(batch.samples))
        if self._despiker is not None:
            samples = self._despiker.add(samples)
        return assembler.add(samples, arrived_ns)

    def _note_restless(self, frames: Sequence[ImuFrame]) -> None:
        """Remember whose modules begin their clocks anew again and again, until the frames are solved."""
        ids = self._suit.module_ids
        rows = [ids.index(module) for module in self._modules.restless() if module in ids]
        if rows:
            is_restless = np.isin(self._suit.module_of_segment, rows).astype(np.uint8)
            self._restless |= {frame.sequence: is_restless for frame in frames}

    def _marked_doubtful(self, pose: SkeletonFrame) -> SkeletonFrame:
        """Mark segments doubtful whose modules begin their clocks anew again and again."""
        restless = self._restless.pop(pose.sequence, None) if self._restless else None
        if restless is None:
            return pose
        status, sigma = np.array(pose.status), np.array(pose.sigma)
        mark_doubtful(status, sigma, restless)
        return replace(pose, status=status, sigma=sigma)


def _kept(keep: Callable[[Any], None]) -> Add:
    """Return what takes a reading that waits for the next frame, and completes none itself."""

    def add(reading: Reading, _arrived_ns: int) -> list[ImuFrame]:
        keep(reading)
        return []

    return add


def _maker(context: StageContext) -> Callable[[WornSuit], Reconstructor]:
    """Return what makes the reconstructor of a method. Raises ``SettingsError`` for one of markers without
    any."""
    suit, method, root = context.suit, context.method, context.root
    if method == OPTICAL and suit.markers is None:
        raise SettingsError(NO_MARKERS)
    if not suit.module_ids and (suit.markers is not None or suit.video is not None):
        return NoModules  # or half a minute would go into compiling what is never used
    if method == OPTICAL:
        method, root = "independent", RootSettings(RootMode.FIXED)  # for modules beside the markers
    interval_s = context.params.frame_interval_ns * 1e-9
    return partial(
        create_reconstructor, method, nominal_interval_s=interval_s, root=root, delay_s=context.delay_s
    )
