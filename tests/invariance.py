"""Small rigs in motion, and what may be done to them without changing the poses: for tests of invariance.

A ``Scene`` is a rig with the frames that its modules gave. Each change (``turned``, ``mirrored``,
``relisted``) has a counterpart for poses (``turned_pose`` …): what the changed scene must give.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise

import numpy as np
from hypothesis import Phase, settings
from scipy.spatial.transform import Rotation

from devices.emulators.motion.motions import BodyMotion, gait_motion, generic_motion
from devices.emulators.motion.waves import Fade
from devices.emulators.sensing.ideal_sensors import sense
from devices.link import Chunk
from gateway.body.rig import load_rig
from gateway.body.skeleton import BodyMarkers, LocalDevice, Skeleton, WornSuit, field_vector
from gateway.emulation.rig import dress
from gateway.frames import (
    Clipped,
    FloatArray,
    ImuFrame,
    IntArray,
    LocalReading,
    MarkerFrame,
    Quantity,
    SkeletonFrame,
    Status,
)

INTERVAL_NS = 10_000_000
N_FRAMES = 300
PLACE_DEVICE = 60
FADE = Fade(rest_s=0.6, ramp_s=0.5)
SAGITTAL = np.diag([1.0, -1.0, 1.0])
"""World coordinates mirrored in the plane east-up, in which a body in its neutral posture faces; also what
mirrors the axes of a module."""


@dataclass(frozen=True)
class Scene:
    """A rig and what its modules measured."""

    suit: WornSuit
    frames: tuple[ImuFrame, ...]


def held_limb() -> WornSuit:
    """Five segments with two ends; its base is a fixed point, and one between others carries no module."""
    suit = _limb(np.array([1, 0, -1, 3, 2]))
    return replace(suit, local_devices=(LocalDevice(Quantity.FIXED_POINT, 0, np.zeros(3)),))


def placed_limb() -> WornSuit:
    """The same with modules on all segments; a device tells where the second one is."""
    device = LocalDevice(Quantity.POSITION, 1, np.array([0.02, 0.01, 0.1]), PLACE_DEVICE)
    return replace(_limb(np.array([1, 0, 4, 3, 2])), local_devices=(device,))


def walking_legs() -> WornSuit:
    """The shipped lower body: it stands on its feet."""
    return load_rig("suit_lower_7")


SCENES: dict[str, Callable[[], Scene]] = {
    "held": lambda: scene(held_limb(), 1),
    "placed": lambda: scene(placed_limb(), 2),
    "walking": lambda: scene(walking_legs(), 3),
}


def scene(suit: WornSuit, seed: int, n_frames: int = N_FRAMES) -> Scene:
    """Return the rig at rest, then in motion: noise, biases, a gap, repeated values, saturated sensors."""
    body = dress(suit)
    if suit.skeleton.contacts:
        motion = gait_motion(body, seed, replace(FADE, ramp_s=2.0))
    else:
        still = not any(d.quantity is Quantity.POSITION for d in suit.local_devices)
        motion = generic_motion(
            body, seed, peak_angular_rate=6.0, peak_angular_acceleration=50.0,
            root_travel_m=0.0 if still else 0.2, fade=FADE,
        )  # fmt: skip
    return Scene(suit, tuple(_frames(suit, motion, seed, n_frames)))


def turned(scene: Scene, angle: float) -> Scene:
    """The world turned about the vertical, with all that is in it. Modules feel nothing of that."""
    R = turn_about_up(angle)
    suit = replace(scene.suit, magnetic_field=R @ scene.suit.magnetic_field)
    return Scene(suit, tuple(_turned_frame(frame, R) for frame in scene.frames))


def turned_pose(pose: SkeletonFrame, angle: float) -> SkeletonFrame:
    """The pose in a world so turned."""
    R = turn_about_up(angle)
    return replace(
        pose,
        q_wb=_rotations(R @ _matrices(pose.q_wb)),
        joint_acceleration=pose.joint_acceleration @ R.T,
        p_w=pose.p_w @ R.T,
    )


def mirrored(scene: Scene) -> Scene:
    """Right made left: the rig, its motion and all that was measured. Angular rates and the earth's field are
    pseudo-vectors, so that the field dips to the other side."""
    suit, S = scene.suit, segment_mirror(scene.suit.skeleton)
    skeleton = mirrored_skeleton(suit.skeleton)
    devices = tuple(replace(device, position=S @ device.position) for device in suit.local_devices)
    alignment = _rotations(S @ _matrices(suit.sensor_to_segment) @ SAGITTAL)
    suit = replace(
        suit, skeleton=skeleton, sensor_to_segment=alignment, lever_arms=suit.lever_arms @ S,
        local_devices=devices, magnetic_field=-SAGITTAL @ suit.magnetic_field,
    )  # fmt: skip
    return Scene(suit, tuple(_mirrored_frame(frame) for frame in scene.frames))


def mirrored_pose(pose: SkeletonFrame, skeleton: Skeleton) -> SkeletonFrame:
    """The pose of a body so mirrored; skeleton: the one that was, or the mirrored one."""
    S = segment_mirror(skeleton)
    return replace(
        pose,
        q_wb=_rotations(SAGITTAL @ _matrices(pose.q_wb) @ S),
        angular_rate=-pose.angular_rate @ S,
        joint_acceleration=pose.joint_acceleration @ SAGITTAL,
        p_w=pose.p_w @ SAGITTAL,
    )


def mirrored_skeleton(skeleton: Skeleton) -> Skeleton:
    """The skeleton of the body in a mirror; its neutral posture is the same."""
    S = segment_mirror(skeleton)
    return replace(
        skeleton,
        offsets=skeleton.offsets @ S,
        tips=skeleton.tips @ S,
        contacts=tuple((segment, S @ point) for segment, point in skeleton.contacts),
    )


def segment_mirror(skeleton: Skeleton) -> FloatArray:
    """(3, 3) what mirrors the axes of segments: the sagittal plane in the neutral posture."""
    neutral = _matrices(skeleton.neutral)
    mirror: FloatArray = np.round(neutral.T @ SAGITTAL @ neutral)
    return mirror


@dataclass(frozen=True)
class Listing:
    """Another order of segments and of modules: the new place i has what was at ``segments[i]``."""

    segments: IntArray
    modules: IntArray


def listing_of(suit: WornSuit, rng: np.random.Generator) -> Listing:
    """One drawn at random, parents before children."""
    parents = suit.skeleton.parents
    order: list[int] = []
    while len(order) < len(parents):
        ready = [s for s, p in enumerate(parents) if s not in order and (p < 0 or p in order)]
        order.append(int(rng.choice(ready)))
    return Listing(np.array(order), rng.permutation(len(suit.module_ids)))


def relisted(scene: Scene, listing: Listing) -> Scene:
    """The same modules on the same body under other names and in another order."""
    suit = scene.suit
    segment_to, row_to = _inverse(listing.segments), _inverse(listing.modules)
    modules = suit.module_of_segment[listing.segments]
    suit = replace(
        suit,
        skeleton=relisted_skeleton(suit.skeleton, listing.segments),
        module_ids=tuple(renamed(suit.module_ids[row]) for row in listing.modules),
        module_of_segment=np.where(modules >= 0, row_to[modules], -1),
        sensor_to_segment=suit.sensor_to_segment[listing.segments],
        lever_arms=suit.lever_arms[listing.segments],
        local_devices=tuple(replace(d, segment=int(segment_to[d.segment])) for d in suit.local_devices),
    )
    return Scene(suit, tuple(_relisted_frame(frame, listing.modules) for frame in scene.frames))


def renamed(module: int) -> int:
    """Another id for every module, in the reverse order."""
    return 50 - module


def relisted_skeleton(skeleton: Skeleton, order: IntArray) -> Skeleton:
    """The skeleton with its segments in another order, and under names that sort in yet another."""
    place = _inverse(order)
    parents = skeleton.parents[order]
    return replace(
        skeleton,
        name=f"{skeleton.name} relisted",
        segment_names=tuple(f"{len(name)} {name[::-1]}" for name in np.array(skeleton.segment_names)[order]),
        parents=np.where(parents >= 0, place[parents], -1),
        offsets=skeleton.offsets[order],
        tips=skeleton.tips[order],
        joints=(),
        contacts=tuple((int(place[segment]), point) for segment, point in skeleton.contacts),
        interpolations=tuple(
            replace(
                rule, segment=int(place[rule.segment]), first=int(place[rule.first]),
                second=int(place[rule.second]),
            )
            for rule in skeleton.interpolations
        ),
    )  # fmt: skip


def relisted_pose(pose: SkeletonFrame, listing: Listing) -> SkeletonFrame:
    """The pose with its segments in that order."""
    by_segment = ("q_wb", "angular_rate", "joint_acceleration", "p_w", "sigma", "status")
    rows = {name: getattr(pose, name)[listing.segments] for name in by_segment}
    return replace(pose, root=int(_inverse(listing.segments)[pose.root]), **rows)


@dataclass(frozen=True)
class MarkerScene:
    """A body with markers, and what an optical system saw of it."""

    skeleton: Skeleton
    markers: BodyMarkers
    frames: tuple[MarkerFrame, ...]


def marker_scene(n_frames: int = 60) -> MarkerScene:
    """The limb with four markers on each segment: noise, gaps, points without a name and two swapped ones."""
    rng = np.random.default_rng(5)
    skeleton = _limb(np.arange(5)).skeleton
    segments = np.repeat(np.arange(5), 4)
    places = rng.normal(0.0, 0.08, (20, 3)) + 0.5 * skeleton.tips[segments]
    labels = tuple(f"m{k}" for k in range(20))
    markers = BodyMarkers(labels, segments, places, np.full(20, 0.004))
    motion = generic_motion(dress(_limb(np.arange(5))), 5, root_travel_m=0.2, fade=Fade(-1.0, 0.5))
    state = motion.state(np.arange(n_frames) * 0.01)
    seen = state.joint_position[:, segments] + (state.R_wb[:, segments] @ places[..., None])[..., 0]
    seen += 0.001 * rng.standard_normal(seen.shape)
    seen[20:28, 3:6] = np.nan
    seen[35:38, [9, 10]] = seen[35:38, [10, 9]]
    nameless = np.zeros((0, 3))
    frames = []
    for k, points in enumerate(seen):
        unlabelled = nameless
        if 40 <= k < 44:
            unlabelled, points[12] = points[None, 12].copy(), np.nan
        frames.append(MarkerFrame(k, (k + 1) * INTERVAL_NS, points, unlabelled))
    return MarkerScene(skeleton, markers, tuple(frames))


def moved_markers(scene: MarkerScene, R: FloatArray) -> tuple[MarkerFrame, ...]:
    """All points turned or mirrored by R (3, 3)."""
    return tuple(
        replace(frame, positions=frame.positions @ R.T, unlabelled=frame.unlabelled @ R.T)
        for frame in scene.frames
    )


def recut(chunks: tuple[Chunk, ...], rng: np.random.Generator) -> tuple[Chunk, ...]:
    """The same bytes in pieces of any size. The head of what comes next may come along with what is there;
    a last byte arrives when it did."""
    pieces: list[Chunk] = []
    left = chunks[0].data
    for chunk, later in zip(chunks, (*chunks[1:], None), strict=True):
        head = 0 if later is None else int(rng.integers(0, len(later.data)) * (rng.random() < 0.5))
        data = left if later is None else left + later.data[:head]
        cuts = [0, *sorted(rng.integers(0, len(data) + 1, rng.integers(0, 4)).tolist()), len(data)]
        pieces += [replace(chunk, data=data[a:b]) for a, b in pairwise(cuts)]
        left = b"" if later is None else later.data[head:]
    return tuple(pieces)


def assert_same(one: SkeletonFrame, other: SkeletonFrame) -> None:
    """Bit for bit; of what became of the markers nothing is asked."""
    for field in fields(one):
        if field.name != "markers":
            found, expected = getattr(one, field.name), getattr(other, field.name)
            np.testing.assert_array_equal(found, expected, err_msg=f"{field.name} of frame {one.sequence}")


def assert_close(found: Sequence[SkeletonFrame], expected: Sequence[SkeletonFrame], tolerance: float) -> None:
    """All values within ``tolerance`` rad, rad/s, m/s² and m, and where one is defined so is the other;
    status and root are the same."""
    assert len(found) == len(expected)
    for name in ("time_ns", "status", "root"):
        np.testing.assert_array_equal(*(_stack(poses, name) for poses in (found, expected)), err_msg=name)
    turned = Rotation.from_quat(_known(_stack(found, "q_wb")), scalar_first=True).inv()
    apart = turned * Rotation.from_quat(_known(_stack(expected, "q_wb")), scalar_first=True)
    np.testing.assert_array_equal(*(np.isnan(_stack(poses, "q_wb")) for poses in (found, expected)))
    assert apart.magnitude().max() < tolerance, f"orientations are {apart.magnitude().max():.3g} rad apart"
    for name in ("angular_rate", "joint_acceleration", "p_w", "sigma"):
        values = (_stack(poses, name) for poses in (found, expected))
        np.testing.assert_allclose(*values, rtol=0.0, atol=tolerance, err_msg=name)


def few_examples(n: int) -> settings:
    """At most n, none sought that is simpler than one that fails: each takes a run of a filter."""
    return settings(max_examples=n, phases=[Phase.explicit, Phase.reuse, Phase.generate])


def turn_about_up(angle: float) -> FloatArray:
    """(3, 3) by an angle in rad."""
    R: FloatArray = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
    return R


def _limb(module_of_segment: IntArray) -> WornSuit:
    rng = np.random.default_rng(11)
    parents = np.array([-1, 0, 1, 2, 1])
    lengths = np.array([0.4, 0.35, 0.1, 0.25, 0.3])
    tips = np.stack([0.05 * lengths, -0.04 * lengths, lengths], axis=1)
    offsets = np.where(parents[:, None] >= 0, tips[parents], 0.0)
    offsets[4, 1] += 0.08  # beside the other one's
    lever_arms = 0.4 * tips + rng.uniform(-0.05, 0.05, (5, 3))
    alignment = Rotation.random(5, rng=rng).as_quat(scalar_first=True)
    has_module = module_of_segment >= 0
    names = ("base", "upper", "wrist", "hand", "thumb")
    return WornSuit(
        skeleton=Skeleton("limb", names, parents, offsets, tips),
        module_ids=tuple(7 + 3 * k for k in range(has_module.sum())),
        module_of_segment=module_of_segment,
        sensor_to_segment=np.where(has_module[:, None], alignment, [1.0, 0.0, 0.0, 0.0]),
        lever_arms=np.where(has_module[:, None], lever_arms, 0.0),
        local_devices=(),
        gravity=np.array([0.0, 0.0, -9.81]),
        magnetic_field=field_vector(50.0, 40.0, 5.0),
    )


def _frames(suit: WornSuit, motion: BodyMotion, seed: int, n_frames: int) -> list[ImuFrame]:
    rng = np.random.default_rng([seed, 3])
    rows = range(len(suit.module_ids))
    segments = np.array([int(np.flatnonzero(suit.module_of_segment == row)[0]) for row in rows])
    times = np.arange(n_frames) * INTERVAL_NS * 1e-9
    state = motion.module_state(segments, np.broadcast_to(times[:, None], (n_frames, len(segments))))
    R_bs = _matrices(suit.sensor_to_segment[segments])
    values = sense(state, suit.lever_arms[segments], R_bs, suit.gravity, suit.magnetic_field)
    shape = values.specific_force.shape
    force, rate, field = (
        true + sigma * rng.standard_normal(shape) + bias * rng.standard_normal(shape[1:])
        for true, sigma, bias in (
            (values.specific_force, 0.03, 0.05),
            (values.angular_rate, 0.002, 0.005),
            (values.magnetic_field, 0.5, 1.0),
        )
    )
    turn = Rotation.from_rotvec(0.01 * rng.standard_normal((n_frames * len(segments), 3)))
    R_ws = (turn.as_matrix().reshape(*shape, 3)) @ state.R_wb @ R_bs
    orientation = Rotation.from_matrix(R_ws.reshape(-1, 3, 3)).as_quat(scalar_first=True)
    status, clipped = np.zeros(shape[:2], np.uint8), np.zeros(shape[:2], np.uint8)
    status[110:140, 1], status[160:166, 2], status[166, 2] = Status.MISSING, Status.HELD, Status.INTERPOLATED
    for values_of in (force, rate, field):
        values_of[110:140, 1] = np.nan
        values_of[160:166, 2] = values_of[159, 2]
    field[210:230] += np.array([5.0, -8.0, 6.0])  # iron
    clipped[180:183, 0], clipped[190:192, 2] = Clipped.SPECIFIC_FORCE, Clipped.ANGULAR_RATE
    local = _readings(suit, motion, times, rng)
    return [
        ImuFrame(
            k, (k + 1) * INTERVAL_NS, force[k], rate[k], field[k], status[k], np.zeros(shape[1], np.int64),
            local[k], orientation.reshape(*shape[:2], 4)[k], clipped=clipped[k],
        )
        for k in range(n_frames)
    ]  # fmt: skip


def _readings(
    suit: WornSuit, motion: BodyMotion, times: FloatArray, rng: np.random.Generator
) -> list[tuple[LocalReading, ...]]:
    """Of the position device, if there is one: every third frame, 4 ms old, silent for 0.4 s."""
    local: list[tuple[LocalReading, ...]] = [() for _ in times]
    sigma = np.full(3, 0.003)
    for device in suit.local_devices:
        if device.quantity is Quantity.POSITION:
            state = motion.state(times - 0.004)
            s = device.segment
            place = state.joint_position[:, s] + state.R_wb[:, s] @ device.position
            place += sigma * rng.standard_normal(place.shape)
            for k in (k for k in range(0, len(times), 3) if not 230 <= k < 270):
                time_ns = (k + 1) * INTERVAL_NS - 4_000_000
                local[k] = (LocalReading(PLACE_DEVICE, time_ns, device.quantity, place[k], sigma),)
    return local


def _turned_frame(frame: ImuFrame, R: FloatArray) -> ImuFrame:
    local = tuple(replace(reading, value=R @ reading.value) for reading in frame.local)
    orientation = None if frame.orientation is None else _rotations(R @ _matrices(frame.orientation))
    return replace(frame, local=local, orientation=orientation)


def _mirrored_frame(frame: ImuFrame) -> ImuFrame:
    orientation = frame.orientation
    if orientation is not None:
        orientation = _rotations(SAGITTAL @ _matrices(orientation) @ SAGITTAL)
    return replace(
        frame,
        specific_force=frame.specific_force @ SAGITTAL,
        angular_rate=-frame.angular_rate @ SAGITTAL,
        magnetic_field=-frame.magnetic_field @ SAGITTAL,
        local=tuple(replace(reading, value=SAGITTAL @ reading.value) for reading in frame.local),
        orientation=orientation,
    )


def _relisted_frame(frame: ImuFrame, order: IntArray) -> ImuFrame:
    by_module = (
        "specific_force", "angular_rate", "magnetic_field", "status", "gap_ns", "orientation", "clipped",
    )  # fmt: skip
    rows = {name: getattr(frame, name) for name in by_module}
    return replace(frame, **{name: None if rows[name] is None else rows[name][order] for name in rows})


def _matrices(q: FloatArray) -> FloatArray:
    """(…, 4) to (…, 3, 3); NaN stays NaN."""
    flat = np.asarray(q, float).reshape(-1, 4)
    matrices = np.full((len(flat), 3, 3), np.nan)
    is_known = np.isfinite(flat).all(axis=1)
    if is_known.any():
        matrices[is_known] = Rotation.from_quat(flat[is_known], scalar_first=True).as_matrix()
    result: FloatArray = matrices.reshape(*np.shape(q)[:-1], 3, 3)
    return result


def _rotations(R: FloatArray) -> FloatArray:
    """(…, 3, 3) to (…, 4) with w ≥ 0; NaN stays NaN."""
    flat = R.reshape(-1, 3, 3)
    q = np.full((len(flat), 4), np.nan)
    is_known = np.isfinite(flat).all(axis=(1, 2))
    if is_known.any():
        q[is_known] = Rotation.from_matrix(flat[is_known]).as_quat(canonical=True, scalar_first=True)
    result: FloatArray = q.reshape(*R.shape[:-2], 4)
    return result


def _known(q: FloatArray) -> FloatArray:
    flat = q.reshape(-1, 4)
    known: FloatArray = np.where(np.isnan(flat), [1.0, 0.0, 0.0, 0.0], flat)
    return known


def _stack(poses: Sequence[SkeletonFrame], name: str) -> FloatArray:
    return np.stack([getattr(pose, name) for pose in poses])


def _inverse(order: IntArray) -> IntArray:
    return np.argsort(order)
