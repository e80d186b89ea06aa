"""Resets: what they turn, that nothing jumps, and that a replay of the recording gives the same frames."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from devices.emulators.imperfections import TYPICAL
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.link import Chunk, Framing
from gateway.body.body_file import load_body
from gateway.body.rig import load_rig
from gateway.emulation.rig import dress, move
from gateway.errors import GatewayError
from gateway.frames import SkeletonFrame
from gateway.pipeline import CALIBRATED_EVENT, RESET_EVENT, Pipeline
from gateway.reconstruction.resets import FADE_S, Resets
from gateway.sources.clock_mode import ClockMode
from gateway.stages.frame_assembler import AssemblyParams

STEP_NS = 10_000_000


def frame(skeleton, heading=0.0, turns=None, k=0, place=(1.0, 2.0, 0.9)):
    n = skeleton.n_segments
    world = Rotation.from_rotvec([0, 0, heading]) * Rotation.from_quat(skeleton.neutral, scalar_first=True)
    rotations = [world * (turns or {}).get(i, Rotation.identity()) for i in range(n)]
    q = np.stack([r.as_quat(scalar_first=True, canonical=True) for r in rotations])
    p = np.tile(place, (n, 1)).astype(float)
    return SkeletonFrame(
        k, k * STEP_NS, q, np.ones((n, 3)), np.ones((n, 3)), p, np.zeros(n), np.zeros(n, np.uint8), 0
    )


def settle(resets, skeleton, **kwargs):
    for k in range(1, 102):
        shown = resets.apply(frame(skeleton, k=k, **kwargs))
    return shown


def heading_of(q, neutral):
    turned = Rotation.from_quat(q, scalar_first=True) * Rotation.from_quat(neutral, scalar_first=True).inv()
    return turned.as_rotvec()[2]


@pytest.fixture(scope="module")
def person():
    return load_body("human_17")


@pytest.mark.parametrize("heading", np.radians([-170, -90, -10, 0, 45, 120, 179]))
def test_heading_reset_faces_the_asked_direction(person, heading):
    resets = Resets(person)
    resets.apply(frame(person, heading))
    answer = resets.reset("heading", np.radians(30.0))
    shown = settle(resets, person, heading=heading)
    assert heading_of(shown.q_wb[0], person.neutral) == pytest.approx(np.radians(30.0), abs=1e-9)
    turned = (30.0 - np.degrees(heading) + 180.0) % 360.0 - 180.0
    assert answer["turned_deg"] == pytest.approx(turned, abs=0.01)
    np.testing.assert_allclose(shown.p_w[0], [1.0, 2.0, 0.9])  # turned on the spot


def test_mounting_reset_straightens_every_segment_and_keeps_the_heading(person):
    slipped = {3: Rotation.from_rotvec([0.2, -0.3, 0.1]), 12: Rotation.from_rotvec([0, 0.5, 0])}
    resets = Resets(person)
    resets.apply(frame(person, 0.7, slipped))
    answer = resets.reset("mounting")
    shown = settle(resets, person, heading=0.7, turns=slipped)
    for q in shown.q_wb:
        assert heading_of(q, person.neutral) == pytest.approx(0.7, abs=1e-9)
    assert answer["remounted_deg"][person.segment_names[12]] == pytest.approx(np.degrees(0.5), abs=0.01)

    new_axes = slipped[12].apply([1.0, 1.0, 1.0])  # turned back by what was put right
    np.testing.assert_allclose(shown.angular_rate[12], new_axes, atol=1e-9)


def test_full_reset_is_both(person):
    slipped = {5: Rotation.from_rotvec([0.4, 0.2, 0.0])}
    resets = Resets(person)
    resets.apply(frame(person, 2.0, slipped))
    resets.reset("full")
    shown = settle(resets, person, heading=2.0, turns=slipped)
    np.testing.assert_allclose(np.abs(shown.q_wb @ person.neutral), 1.0, atol=1e-9)


def test_position_reset_brings_the_body_to_the_origin_and_it_walks_on_from_there(person):
    resets = Resets(person)
    resets.apply(frame(person, 0.4, place=(3.0, -4.0, 0.9)))
    assert resets.reset("position") == {"turned_deg": 0.0, "remounted_deg": {}, "moved_m": 5.0}
    shown = settle(resets, person, heading=0.4, place=(3.0, -4.0, 0.9))
    np.testing.assert_allclose(shown.p_w[0], [0.0, 0.0, 0.9], atol=1e-12)
    assert heading_of(shown.q_wb[0], person.neutral) == pytest.approx(0.4, abs=1e-9)
    shown = resets.apply(frame(person, 0.4, k=102, place=(3.5, -4.0, 0.9)))
    np.testing.assert_allclose(shown.p_w[0], [0.5, 0.0, 0.9], atol=1e-12)

    resets.reset("heading")  # turns on the spot, and the origin stays what it is
    turned = settle(resets, person, heading=0.4, place=(3.5, -4.0, 0.9))
    np.testing.assert_allclose(turned.p_w[0], [0.5, 0.0, 0.9], atol=1e-12)


def test_a_heading_reset_in_the_middle_of_one_of_the_position_lets_it_come_to_its_end(person):
    resets = Resets(person)
    places = [resets.apply(frame(person, 0.4, place=(3.0, -4.0, 0.9))).p_w[0]]
    resets.reset("position")
    for k in range(1, 150):
        places.append(resets.apply(frame(person, 0.4, k=k, place=(3.0, -4.0, 0.9))).p_w[0])
        if k == 25:
            resets.reset("heading", 1.0)
    np.testing.assert_allclose(places[-1], [0.0, 0.0, 0.9], atol=1e-12)
    quickest = 1.875 * 5.0 / FADE_S * STEP_NS * 1e-9
    assert max(np.linalg.norm(b - a) for a, b in pairwise(places)) < 1.01 * quickest


def test_a_body_whose_place_nobody_knows_is_not_moved(person):
    resets = Resets(person)
    resets.apply(frame(person, place=(np.nan,) * 3))
    with pytest.raises(GatewayError, match="nobody knows the place"):
        resets.reset("position")


@pytest.mark.parametrize("kind", ["heading", "full", "mounting", "position"])
def test_nothing_jumps(person, kind):
    slipped = {5: Rotation.from_rotvec([1.0, 0.5, 0.0])}
    resets = Resets(person)
    shown = [resets.apply(frame(person, 3.0, slipped))]
    resets.reset(kind)
    resets_again_at = 25  # in the middle of the fade
    for k in range(1, 150):
        shown.append(resets.apply(frame(person, 3.0, slipped, k)))
        if k == resets_again_at:
            resets.reset("heading", 1.0)
    steps = [
        max(
            (
                Rotation.from_quat(a, scalar_first=True).inv() * Rotation.from_quat(b, scalar_first=True)
            ).magnitude()
            for a, b in zip(before.q_wb, after.q_wb, strict=True)
        )
        for before, after in pairwise(shown)
    ]
    quickest = 1.875 * 2 * np.pi / FADE_S * STEP_NS * 1e-9  # of the quintic, over a turn of 2π at most
    assert max(steps) < quickest
    assert max(steps[-20:]) < 1e-9


def test_bad_resets_are_refused_and_change_nothing(person):
    resets = Resets(person)
    with pytest.raises(GatewayError, match="no pose yet"):
        resets.reset("heading")
    resets.apply(frame(person))
    with pytest.raises(GatewayError, match="did you mean 'heading'"):
        resets.reset("headin")
    lying = {i: Rotation.from_rotvec([np.pi / 2, 0, 0]) for i in range(17)}
    resets.apply(frame(person, turns=lying))
    with pytest.raises(GatewayError, match="stand upright"):
        resets.reset("full")
    assert resets.count == 0


def _played(reconstructor, events):
    """Frames of two seconds of an emulated suit; events: chunk number to (name, data)."""
    suit = load_rig("suit_lower_7")
    settings = SuitSettings(gravity=suit.gravity, magnetic_field=suit.magnetic_field)
    traffic = SuitTraffic(move(dress(suit), suit.skeleton.name, 1), settings, TYPICAL, 1)
    pipeline = Pipeline(
        suit, AssemblyParams(1e7, 30_000_000, 100_000_000, 500_000_000), reconstructor, ClockMode.ESTIMATED
    )
    pipeline.add_link("suit", Framing.BYTE_STREAM)
    frames = []
    for k, sent in enumerate(traffic.transmissions(2.0)):
        if k in events:
            pipeline.event(*events[k])
        frames += pipeline.feed(Chunk(sent.data, round(sent.time_s * 1e9), "suit"))
    return frames


@pytest.mark.parametrize("reconstructor", ["independent", "joint"])
def test_every_reconstructor_is_reset_alike_and_repeatably(reconstructor):
    events = {120: (RESET_EVENT, {"kind": "heading", "facing": 1.0})}
    first, second = _played(reconstructor, events), _played(reconstructor, events)
    for one, other in zip(first, second, strict=True):
        assert one.q_wb.tobytes() == other.q_wb.tobytes()
        assert one.p_w.tobytes() == other.p_w.tobytes()
    plain = _played(reconstructor, {})
    names = load_rig("suit_lower_7").skeleton
    turned = heading_of(first[-1].q_wb[0], names.neutral) - heading_of(plain[-1].q_wb[0], names.neutral)
    assert abs(turned) > 0.5


def test_a_calibration_is_an_input_like_any_other():
    suit = load_rig("suit_lower_7")
    name = suit.skeleton.segment_names[1]
    q = Rotation.from_rotvec([0.3, 0, 0]).as_quat(scalar_first=True).tolist()
    event = {"modules": {name: {"sensor_to_segment": q, "position": [0.1, 0.2, 0.3]}}}
    changed = _played("independent", {100: (CALIBRATED_EVENT, event)})
    plain = _played("independent", {})
    off = Rotation.from_quat(changed[-1].q_wb[1], scalar_first=True).inv() * Rotation.from_quat(
        plain[-1].q_wb[1], scalar_first=True
    )
    assert off.magnitude() == pytest.approx(0.3, abs=0.05)


@pytest.mark.parametrize(
    ("name", "data"),
    [
        (RESET_EVENT, {}),
        (RESET_EVENT, {"kind": "heading", "facing": "east"}),
        (CALIBRATED_EVENT, {}),
        (CALIBRATED_EVENT, {"modules": {"tail": {}}}),
        (CALIBRATED_EVENT, {"modules": {"pelvis": {"sensor_to_segment": [1]}}}),
    ],
)
def test_events_that_mean_nothing_are_refused_in_one_line(name, data):
    pipeline = Pipeline(load_rig("suit_lower_7"), AssemblyParams(1e7, 10**7, 10**8, 10**8))
    with pytest.raises(GatewayError):
        pipeline.event(name, data)
