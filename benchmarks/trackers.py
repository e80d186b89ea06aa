"""How far headings drift that trackers with six axes compute, and those that the gateway makes of the same.

Three motions, played to and fro for three quarters of an hour: a person (hipose_mtw17), a chain of five
(ring_chain5) and emulated walking. What each module felt, with gyroscopes as cheap trackers have them, goes
through a six-axis filter (VQF); its orientations and accelerations go, in 16 bits each, as datagrams of
SlimeVR over a network that delays and loses, through the gateway's own source, clocks and ``joint``. No field
is used anywhere.

A motion seen backward is a motion: rates change sign, all else stays. Biases do not, so they are added anew;
errors of the recorded sensors cancel from one way to the other. The trackers' headings are what they were set
to be in the first minute, as their owners do; those of the gateway are never set.

The person's reference is the filter of the suit's maker, which takes headings from the field of the room,
and the field differs from place to place. So ``joint`` is compared with what accelerations at the joints say,
too.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from vqf import VQF

from benchmarks.accuracy import DATA
from benchmarks.figures import Figure, Report, table
from benchmarks.joint_headings import heading_errors
from benchmarks.joint_recordings import as_segments, dressed, facing_of
from devices.emulators.data_sets import METAL_TABLE_S, read_hipose_mtw17, read_ring_chain5
from devices.emulators.motion.motions import gait_motion
from devices.link import Chunk
from devices.recorded_tracks import RecordedTracks
from devices.vendor_protocols import slimevr as wire
from firmware_protocol.samples import STANDARD_GRAVITY
from gateway.body.rig import load_rig
from gateway.body.skeleton import WornSuit
from gateway.emulation.optical_reference import in_time
from gateway.emulation.recordings import reference_at
from gateway.emulation.rig import dress
from gateway.emulation.simulation import SENSORS, assembled
from gateway.frames import FloatArray, ImuFrame, SkeletonFrame
from gateway.pipeline import Pipeline
from gateway.settings import AssemblySettings
from gateway.sources.slimevr import SlimevrLinkSettings

SEED = 1
MINUTES = (5, 15, 45)
FIRST_MINUTE = 1.0
"""Around it headings are taken as they were set; as long a stretch is a mean over ``WINDOW_S``."""
WINDOW_S = 60.0
BIAS_DEG_S, WALK_DEG_S = 0.005, 0.0003
"""Of each gyroscope axis, standard deviations: of the bias that a calibration at rest leaves at the start,
and of its walk in a second. A heading that nothing corrects is off by 2°, 6° and 28° after 5, 15 and 45
minutes."""
REST_S = 4.0
"""At the start nothing moves for so long."""
LATENCY_S, JITTER_S, LOSS = 0.002, 0.003, 0.002
WAIT_MS = 120.0
"""Latency budget of frames: data at 40 Hz come in steps of 25 ms."""
LINK = "trackers"


@dataclass(frozen=True)
class Motion:
    """What modules felt, and where their segments were."""

    name: str
    suit: WornSuit
    rate_hz: float
    force: FloatArray  # (T, M, 3) m/s², in the order of the suit's modules
    rate: FloatArray  # (T, M, 3) rad/s
    q_wb: FloatArray  # (T, M, 4) of the segment of each module; NaN: not known
    still: int
    """Rows at the start in which nothing moves: played until ``REST_S``, and never again."""


def run() -> Report:
    """Drift of headings by motion and minute."""
    report, rows, judged = Report("trackers", also="guide/slimevr.md"), [], []
    for motion in motions():
        found = measure(motion, max(MINUTES))
        for minute in MINUTES:
            rows.append([motion.name, str(minute), *_cells(found.own[minute]), *_cells(found.joint[minute])])
        last = max(MINUTES)
        key = motion.name.split(" ")[0]
        own, joint, reference = found.own[last].rms, found.joint[last].rms, found.reference.rms
        agreed = found.joint_by_accelerations[last]
        what = f"{last} min, between segments"
        report.figures += [
            Figure(f"{key}_own_drift_deg", own, "°", "", what),
            Figure(f"{key}_joint_heading_deg", joint, "°", "<=5", what),
            Figure(f"{key}_joint_by_accelerations_deg", agreed.rms, "°", "<=5", f"{what}, see below"),
            Figure(f"{key}_reference_deg", reference, "°", "", "the reference, likewise"),
        ]
        judged.append([motion.name, *_cells(found.reference)[:2], *_cells(agreed)[:2]])
    heads = ["motion", "minutes"]
    for what in ("trackers' own", "joint"):
        heads += [f"{what}: between segments, RMS", "worst segment", "whole body"]
    report.tables.append(
        "Headings, degrees: trackers' own since they were set in the first minute, `joint` against the "
        "reference, never set. Between segments: the heading common to all is taken out.\n\n"
        + table(heads, rows)
    )
    heads = ["motion", "reference: RMS", "worst segment", f"joint after {last} min: RMS", "worst segment"]
    report.tables.append(
        "How far the reference can be believed: headings between segments against those in which the two "
        "modules at each joint agree on the acceleration of its centre, degrees; all of the motion, by least "
        "squares, without a filter or a field, and with free lever arms.\n\n" + table(heads, judged)
    )
    return report


@dataclass(frozen=True)
class Headings:
    """How far headings are off, degrees."""

    rms: float
    worst: float
    common: float


class Measured(NamedTuple):
    """Headings of one motion, by minute where they are of one."""

    own: dict[int, Headings]
    """Of the trackers, since they were set in the first minute."""
    joint: dict[int, Headings]
    """Of the gateway, against the reference."""
    joint_by_accelerations: dict[int, Headings]
    """The same, against what accelerations at the joints say."""
    reference: Headings
    """The reference, against these."""


def _cells(found: Headings) -> list[str]:
    return [f"{found.rms:.1f}", f"{found.worst:.1f}", f"{found.common:+.1f}"]


def measure(motion: Motion, minutes: float, seed: int = SEED) -> Measured:
    """Play a motion for so long.

    Of a motion that is over, the last minute stands for those that would come. seed: of the network, and of
    where the trackers' references face.
    """
    rng = np.random.default_rng(seed)
    place, sign = _to_and_fro(motion, minutes)
    own = _fused(motion, place, sign, rng)
    truth = motion.q_wb[place]
    at = _windows(motion, len(place))
    own_errors = {minute: _errors(own[rows], truth[rows], motion) for minute, rows in at.items()}
    first = own_errors[FIRST_MINUTE]
    ours: dict[float, list[tuple[FloatArray, FloatArray]]] = {minute: [] for minute in at}
    segments = [int(np.flatnonzero(motion.suit.module_of_segment == m)[0]) for m in range(own.shape[1])]
    for frame in _solved(motion, place, sign, own, rng):
        row = round(frame.time_ns * 1e-9 * motion.rate_hz)
        for minute, rows in at.items():
            if rows[0] <= row <= rows[-1]:
                ours[minute].append((frame.q_wb[segments], truth[row]))
    found = {
        minute: _mean_headings(*(np.array(each) for each in zip(*pairs, strict=True)))
        for minute, pairs in ours.items()
    }
    turned, asked = found[FIRST_MINUTE].mean(), [minute for minute in MINUTES if minute in at]
    reference = heading_errors(motion.suit, motion.rate_hz, motion.force, motion.q_wb)
    return Measured(
        {m: _headings(_wrapped(own_errors[m] - first), 0.0) for m in asked},
        {m: _headings(found[m], turned) for m in asked},
        {m: _headings(found[m] + reference, turned) for m in asked},
        _headings(reference, 0.0),
    )


def _headings(errors: FloatArray, common_before: float) -> Headings:
    """errors: (M,) rad."""
    common = float(np.angle(np.exp(1j * errors).mean()))
    between = np.degrees(_wrapped(errors - common))
    turned = float(np.degrees(_wrapped(np.array(common - common_before))))
    return Headings(float(np.sqrt(np.mean(between**2))), float(np.abs(between).max()), turned)


def _wrapped(angle: FloatArray) -> FloatArray:
    wrapped: FloatArray = (angle + np.pi) % (2 * np.pi) - np.pi
    return wrapped


def _mean_headings(q: FloatArray, q_ref: FloatArray) -> FloatArray:
    """(M,) mean turn about the vertical from a reference to what was found, (T, M, 4) both, rad."""
    found = np.zeros(q.shape[1])
    for module in range(q.shape[1]):
        known = np.isfinite(q_ref[:, module]).all(axis=1) & np.isfinite(q[:, module]).all(axis=1)
        away = _product(q[known, module], _inverse(q_ref[known, module]))
        found[module] = np.angle(np.exp(2j * np.arctan2(away[:, 3], away[:, 0])).mean())
    return found


def _errors(q_es: FloatArray, q_wb: FloatArray, motion: Motion) -> FloatArray:
    """Mean headings (M,) of module orientations."""
    mounted = motion.suit.sensor_to_segment[_segments(motion.suit)]
    q_eb = _product(q_es, _inverse(np.broadcast_to(mounted, q_es.shape)))
    return _mean_headings(q_eb, q_wb)


def _product(q_ab: FloatArray, q_bc: FloatArray) -> FloatArray:
    """(..., 4) of (..., 4) each."""
    (a, b, c, d), (w, x, y, z) = np.moveaxis(q_ab, -1, 0), np.moveaxis(q_bc, -1, 0)
    parts = [
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    ]
    return np.stack(parts, axis=-1)


def _inverse(q: FloatArray) -> FloatArray:
    inverse: FloatArray = q * np.array([1.0, -1.0, -1.0, -1.0])
    return inverse


def _segments(suit: WornSuit) -> list[int]:
    return [int(np.flatnonzero(suit.module_of_segment == row)[0]) for row in range(len(suit.module_ids))]


def _windows(motion: Motion, n_rows: int) -> dict[float, FloatArray]:
    """Rows of a minute's stretch around each minute."""
    half = 0.5 * WINDOW_S
    spans = {m: (60.0 * m - half, 60.0 * m + half) for m in (FIRST_MINUTE, *MINUTES)}
    last_s = n_rows / motion.rate_hz
    found = {}
    for minute, (begin_s, end_s) in spans.items():
        first, last = min(begin_s, last_s - WINDOW_S), min(end_s, last_s)
        found[minute] = np.arange(int(first * motion.rate_hz), int(last * motion.rate_hz))
    return found


def _to_and_fro(motion: Motion, minutes: float) -> tuple[FloatArray, FloatArray]:
    """Rows of the motion in the order of time, and the sign of rates."""
    once = np.resize(np.arange(motion.still), round(REST_S * motion.rate_hz))
    forth = np.arange(motion.still, len(motion.force))
    loop, signs = np.concatenate([forth, forth[::-1]]), np.repeat([1.0, -1.0], len(forth))
    rows = int(60.0 * minutes * motion.rate_hz) - len(once)
    times = -(-rows // len(loop))
    place = np.concatenate([once, np.tile(loop, times)[:rows]])
    return place, np.concatenate([np.ones(len(once)), np.tile(signs, times)[:rows]])


def _felt(motion: Motion, place: FloatArray, sign: FloatArray, module: int) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng([SEED, module])
    rate = motion.rate[place, module] * sign[:, None]
    steps = rng.normal(0.0, np.radians(WALK_DEG_S) / np.sqrt(motion.rate_hz), rate.shape)
    bias = rng.normal(0.0, np.radians(BIAS_DEG_S), 3) + np.cumsum(steps, axis=0)
    return motion.force[place, module], rate + bias


def _fused(motion: Motion, place: FloatArray, sign: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(T, M, 4): what the trackers' filters make of it, each to a level reference of its own."""
    found = []
    for module in range(motion.force.shape[1]):
        force, rate = _felt(motion, place, sign, module)
        q = VQF(1.0 / motion.rate_hz).updateBatch(np.ascontiguousarray(rate), np.ascontiguousarray(force))
        half = rng.uniform(-0.5, 0.5) * np.pi
        turned = np.array([np.cos(half), 0.0, 0.0, np.sin(half)])
        found.append(_product(np.broadcast_to(turned, q["quat6D"].shape), q["quat6D"]))
    return np.stack(found, axis=1)


def _solved(
    motion: Motion, place: FloatArray, sign: FloatArray, q_es: FloatArray, rng: np.random.Generator
) -> Iterator[SkeletonFrame]:
    """Frames of the gateway from the trackers' datagrams; gateway time 0 is the first sample."""
    trackers = {f"10.0.0.{n}": module for n, module in enumerate(motion.suit.module_ids)}
    link = SlimevrLinkSettings(name=LINK, url="udp://0.0.0.0:6969", trackers=trackers)
    params = AssemblySettings(rate_hz=motion.rate_hz, max_wait_ms=WAIT_MS).params()
    pipeline = Pipeline(motion.suit, params, "joint", links={LINK: link})
    pipeline.add_link(LINK, "slimevr")
    sent = [_sent(motion, place, sign, q_es[:, n], n, rng) for n in range(len(trackers))]
    arrived: Iterator[Chunk] = heapq.merge(*sent, key=lambda chunk: chunk.arrived_ns)
    yield from pipeline.replay(arrived)


def _sent(
    motion: Motion, place: FloatArray, sign: FloatArray, q_es: FloatArray, n: int, rng: np.random.Generator
) -> Iterator[Chunk]:
    """What one tracker sends, as it arrives."""
    force, _ = _felt(motion, place, sign, n)
    w, x, y, z = q_es.T
    up = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z], axis=1)
    linear = force - STANDARD_GRAVITY * up
    times = np.arange(len(place)) / motion.rate_hz + LATENCY_S
    arrived = np.maximum.accumulate(times + rng.exponential(JITTER_S, len(times)))
    is_lost = rng.random(len(times)) < LOSS
    sender = f"10.0.0.{n}:4210"
    for k in np.flatnonzero(~is_lost).tolist():
        payload = wire.rotation_and_acceleration(0, tuple(q_es[k]), tuple(linear[k]))
        data = wire.encode(wire.Kind.ROTATION_AND_ACCELERATION, k + 1, payload)
        yield Chunk(data, int(1e9 * arrived[k]), LINK, sender)


def motions() -> Iterator[Motion]:
    yield _walking()
    if (DATA / "ring_chain5").exists():
        yield _ring()
    if (DATA / "hipose_mtw17").exists():
        yield _person()


def _walking() -> Motion:
    """A minute of emulated walking in a circle, seven modules of the lower body."""
    suit = replace(load_rig("suit_lower_7"), local_devices=())
    walk = gait_motion(dress(suit), SEED)
    noisy = replace(SENSORS, gyroscope_bias=0.0, gyroscope_bias_walk=0.0)
    frames: list[ImuFrame] = assembled(suit, walk, noisy, 62.0, SEED)
    force, rate = (
        np.array([getattr(f, name) for f in frames]) for name in ("specific_force", "angular_rate")
    )
    state = walk.state(np.array([frame.time_ns * 1e-9 for frame in frames]))
    return Motion("walking (emulated)", suit, 100.0, force, rate, state.q_wb[:, _segments(suit)], 250)


def _ring() -> Motion:
    recording, _ = in_time(read_ring_chain5(DATA / "ring_chain5" / "trial1"), METAL_TABLE_S)
    suit = replace(load_rig("chain_5"), local_devices=())
    return _of(recording, suit, "chain (ring_chain5)", 0.5, METAL_TABLE_S, still_s=0.5)


def _person() -> Motion:
    """Axes of modules to those of segments by the pose at the start, in which the person stands."""
    recording = read_hipose_mtw17(DATA / "hipose_mtw17")
    suit = dressed(recording)
    times = recording.modules[0].times
    is_still = (times >= 1.0) & (times <= 4.0)
    names = list(suit.skeleton.segment_names)
    q_ws = np.full((len(times), len(names), 4), np.nan)
    for reference in recording.references:
        q_ws[:, names.index(reference.name)] = reference_at(times, reference)
    q_wb = as_segments(q_ws, is_still, facing_of(q_ws, is_still, suit.skeleton), suit.skeleton)
    row = int(np.flatnonzero(is_still)[0])
    mounted = _product(_inverse(q_wb[row]), q_ws[row])
    suit = replace(suit, sensor_to_segment=np.where(np.isfinite(mounted), mounted, [1.0, 0.0, 0.0, 0.0]))
    by_name = {
        r.name: replace(r, times=times, q_wb=q_wb[:, names.index(r.name)]) for r in recording.references
    }
    recording = replace(recording, references=tuple(by_name[r.name] for r in recording.references))
    return _of(recording, suit, "person (hipose_mtw17)", 4.5, 0.0, still_s=4.0)


def _of(
    recording: RecordedTracks, suit: WornSuit, name: str, begin_s: float, cut_s: float, still_s: float = 0.0
) -> Motion:
    """A recording between two times, with the ``still_s`` before that, in which nothing moves."""
    tracks = {track.module: track for track in recording.modules}
    modules = [tracks[module] for module in suit.module_ids]
    times = modules[0].times
    rows = np.flatnonzero((times >= begin_s - still_s) & (times <= times[-1] - cut_s))
    still = round(still_s * recording.sampling_rate_hz)
    references = [recording.reference(track.name) for track in modules]
    return Motion(
        name,
        suit,
        recording.sampling_rate_hz,
        np.stack([track.specific_force[rows] for track in modules], axis=1),
        np.stack([_unbiased(track.angular_rate[rows], still) for track in modules], axis=1),
        np.stack([reference_at(times[rows], reference) for reference in references], axis=1),
        still,
    )


def _unbiased(rate: FloatArray, still: int) -> FloatArray:
    """Without what the gyroscope showed at rest: it would change its sign with the direction of play."""
    unbiased: FloatArray = rate - rate[:still].mean(axis=0)
    return unbiased
