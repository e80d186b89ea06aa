"""Everything that a wearer or a room can do wrong in a body calibration is recognised, and said."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from devices.calibration_script import PERIOD_S, timetable
from devices.emulators.bodies import emulated_body
from devices.emulators.motion.calibrating import WearerFaults, calibration_motion, strapped_on
from devices.emulators.sensing.ideal_sensors import sense
from gateway.body.rig import load_rig
from gateway.calibration.body_session import BodySession
from gateway.emulation.rig import dress
from gateway.errors import GatewayError
from gateway.frames import ImuFrame, Status

RATE_HZ = 25.0


def wearer(faults=None, heading=2.0, seed=4, disturb=None):
    """The lower body goes through the script: its session, and the body as it truly is."""
    suit = load_rig("suit_lower_7")
    body = strapped_on(dress(suit), seed)
    motion = calibration_motion(body, seed, heading, faults)
    times = np.arange(0.0, PERIOD_S, 1.0 / RATE_HZ)
    R_bs = Rotation.from_quat(body.sensor_to_segment, scalar_first=True).as_matrix()
    values = sense(motion.state(times), body.module_positions, R_bs, suit.gravity, suit.magnetic_field)
    noise = np.random.default_rng(seed)
    force = values.specific_force + noise.normal(0, 0.03, values.specific_force.shape)
    rate = values.angular_rate + noise.normal(0, 0.002, values.angular_rate.shape)
    field = values.magnetic_field.copy()
    status = np.zeros(force.shape[:2], dtype=np.uint8)
    if disturb is not None:
        disturb(times, force, rate, field, status)
    session = BodySession(suit)
    n = len(suit.module_ids)
    for k, time in enumerate(times):
        session.add(
            ImuFrame(k, round(time * 1e9), force[k], rate[k], field[k], status[k], np.zeros(n, np.int64))
        )
    for step in session.steps:
        begin, end = timetable()[step.name]
        session.mark(step.name, round(begin * 1e9), round(end * 1e9))
    return session, body


def of(result, segment):
    return next(module for module in result.modules if module.segment == segment)


def reasons(result, segment):
    return " | ".join(of(result, segment).quality.reasons)


def errors_deg(result, body):
    found = []
    for module in result.modules:
        true = Rotation.from_quat(
            body.sensor_to_segment[body.segment_names.index(module.segment)], scalar_first=True
        )
        ours = Rotation.from_quat(module.sensor_to_segment, scalar_first=True)
        found.append(np.degrees((ours * true.inv()).magnitude()))
    return np.array(found)


@pytest.fixture(scope="module")
def faultless():
    session, body = wearer()
    return session, body, session.result()


def test_a_good_calibration_is_good_and_right(faultless):
    _, body, result = faultless
    assert {module.quality.verdict for module in result.modules} == {"good"}
    assert np.sqrt(np.mean(errors_deg(result, body) ** 2)) < 2.0
    assert np.degrees(result.facing) == pytest.approx(np.degrees(2.0), abs=2.0)
    for module in result.modules:
        true = body.module_positions[body.segment_names.index(module.segment)]
        assert np.linalg.norm(module.position - true) < 0.015


def test_without_field_movements_tell_headings(faultless):
    session, body, _ = faultless
    blind = BodySession(session.suit, uses_field=False)
    blind._frames, blind.spans = session._frames, dict(session.spans)
    assert np.sqrt(np.mean(errors_deg(blind.result(), body) ** 2)) < 2.0


@pytest.mark.parametrize("angle_deg", [5.0, 14.0, 40.0])
def test_a_module_that_moves_in_the_pose_is_never_good(angle_deg):
    faults = WearerFaults(moving="left_shank", moving_angle=np.radians(angle_deg))
    session, _ = wearer(faults)
    result = session.result()
    assert of(result, "left_shank").quality.verdict != "good"
    assert "left shank moved during the N-pose by" in reasons(result, "left_shank")
    assert of(result, "right_shank").quality.verdict == "good"


def test_the_angle_that_is_told_is_the_one_it_moved_by():
    session, _ = wearer(WearerFaults(moving="left_foot", moving_angle=np.radians(25.0)))
    text = reasons(session.result(), "left_foot")
    told = float(text.split(" by ")[1].split("°")[0])
    assert told == pytest.approx(20.0, abs=8.0)  # against the mean, which moves along


def test_a_field_that_changes_is_told():
    def disturb(times, force, rate, field, status):
        begin, end = timetable()["squat"]
        field[(times > begin) & (times < end), 1] *= 1.22

    session, _ = wearer(disturb=disturb)
    result = session.result()
    name = result.modules[1].segment
    assert "changed by 22 %" in reasons(result, name) or "changed by 23 %" in reasons(result, name)
    assert of(result, name).quality.verdict != "good"


def test_movements_too_small_are_told():
    session, _ = wearer(WearerFaults(effort=0.15))
    result = session.result()
    assert "too small" in reasons(result, "left_thigh")
    assert of(result, "left_thigh").quality.verdict == "poor"


def test_an_axis_that_does_not_repeat_is_told():
    session, _ = wearer(WearerFaults(wobble=np.radians(25.0)))
    result = session.result()
    assert "not repeatable" in reasons(result, "left_thigh")
    assert of(result, "left_thigh").quality.verdict != "good"


def test_a_silent_module_is_told():
    def disturb(times, force, rate, field, status):
        begin, end = timetable()["n_pose"]
        status[(times > begin) & (times < end), 2] = Status.HELD

    session, _ = wearer(disturb=disturb)
    result = session.result()
    segment = result.modules[2].segment
    assert "was not heard during the N-pose" in reasons(result, segment)
    assert of(result, segment).quality.score == 0.0


def test_no_pose_is_refused():
    session, _ = wearer()
    session.spans = {key: span for key, span in session.spans.items() if "pose" not in key[0]}
    with pytest.raises(GatewayError, match="N-pose"):
        session.result()


def test_one_module_can_be_done_again():
    """The pose of one module is replaced by a later one in which it was still."""

    def disturb(times, force, rate, field, status):
        begin, end = timetable()["n_pose"]
        during = (times > begin) & (times < end)
        rate[during, 2] += np.radians(10.0) * np.sin(2 * np.pi * times[during])[:, None]

    session, _ = wearer(disturb=disturb)
    before = session.result()
    segment = before.modules[2].segment
    assert of(before, segment).quality.verdict != "good"
    begin, _ = timetable()["left_leg"]
    session.spans["n_pose", 2] = (round((begin - 1.5) * 1e9), round((begin - 0.2) * 1e9))
    result = session.result()
    assert "moved" not in reasons(result, segment)
    assert session.spans["n_pose", 1] != session.spans["n_pose", 2]


def test_another_body_is_refused():
    with pytest.raises(GatewayError, match="for people"):
        BodySession(load_rig("robot_arm_4"))


def test_unknown_steps_and_segments_are_refused(faultless):
    session, _, _ = faultless
    with pytest.raises(GatewayError, match="did you mean 'squat'"):
        session.begin("sqat")
    with pytest.raises(GatewayError, match="no module sits on 'tail'"):
        session.begin("squat", ["tail"])
    with pytest.raises(GatewayError, match="no module has been heard"):
        BodySession(session.suit).begin("squat")


def test_the_emulated_body_itself_is_untouched_by_strapping():
    body = emulated_body(("a", "b"), [-1, 0], [[0, 0, 0], [1, 0, 0]])
    worn = strapped_on(body, 3, 0.02)
    away = np.linalg.norm(worn.module_positions - body.module_positions, axis=1)
    np.testing.assert_allclose(away, 0.02, atol=1e-12)
    assert not np.allclose(worn.sensor_to_segment, body.sensor_to_segment)
