"""A whole suit in a box, through the wire: its errors are found, written to a rig file, and taken out."""

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from devices.calibration import SensorCalibration
from devices.emulators.imperfections import UNCALIBRATED, draw_errors, module_random
from devices.emulators.motion.kinematics_truth import MotionState
from devices.emulators.motion.tumbling import TumblingMotion
from devices.emulators.suit_settings import ERRORS
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.link import Chunk, Framing
from firmware_protocol.device_settings import factory_settings
from gateway.body.rig import load_rig
from gateway.calibration.rig_file import write_calibrated_rig
from gateway.calibration.sensor_session import SensorSession, combined
from gateway.emulation.rig import dress
from gateway.errors import SettingsError
from gateway.frames import (
    ANGULAR_RATE,
    INERTIAL_SAMPLE,
    MAGNETIC_FIELD,
    NOT_READ,
    SPECIFIC_FORCE,
    InertialBatch,
)
from gateway.pipeline import Pipeline
from gateway.sources.suit import SuitSource
from gateway.stages.frame_assembler import AssemblyParams
from gateway.stages.modules import SensorCorrections
from gateway.support.settings_files import find_file

SEED = 4
SECONDS = 80.0
MODULES = load_rig("arm_3").module_ids


def traffic(suit, seconds):
    settings = SuitSettings(
        gravity=suit.gravity, magnetic_field=suit.magnetic_field, is_fine=True, sampling_rate_hz=25.0
    )
    return SuitTraffic(TumblingMotion(dress(suit), SEED), settings, UNCALIBRATED, SEED).transmissions(seconds)


@pytest.fixture(scope="module")
def session():
    suit = load_rig("arm_3")
    stream, session = SuitSource(), SensorSession(MODULES, 9.81, 49.0)
    stream.add_link("box", Framing.BYTE_STREAM)
    for sent in traffic(suit, SECONDS):
        for reading in stream.receive(Chunk(sent.data, round(sent.time_s * 1e9), "box")):
            for module, _, time_ns, measured, _ in reading.samples.tolist():
                session.add(module, time_ns, *(None if np.isnan(m[0]) else tuple(m) for m in measured))
    return session


def test_it_is_enough_and_all_of_it_good(session):
    for module, one in session.modules.items():
        progress = one.progress()
        assert session.is_enough(progress), progress
        for sensor, result in session.results(module).items():
            assert not isinstance(result, str), (sensor, result)
            assert result.quality.verdict == "good", (sensor, result.quality)


def test_the_errors_that_were_drawn_are_found(session):
    for module in MODULES:
        errors = draw_errors(UNCALIBRATED, module_random(SEED, module, ERRORS))
        found = session.results(module)
        np.testing.assert_allclose(found["gyroscope"].bias, errors.gyroscope_bias, atol=np.radians(0.1))
        np.testing.assert_allclose(found["accelerometer"].fit.bias, errors.accelerometer_bias, atol=0.05)
        np.testing.assert_allclose(found["magnetometer"].fit.bias, errors.magnetometer_bias, atol=1.0)
        assert found["accelerometer"].fit.spread_after < 0.002
        assert found["magnetometer"].fit.spread_after < 0.02
        assert found["magnetometer"].fit.spread_after < 0.3 * found["magnetometer"].fit.spread_before


def test_where_the_field_points_is_found(session, tmp_path):
    """66° below the horizontal, as it was emulated; the rig file that is written says so."""
    calibrations = {module: combined(session.results(module)) for module in MODULES}
    dip_deg = session.dip_deg(calibrations)
    assert dip_deg == pytest.approx(66.0, abs=0.5)
    plain = yaml.safe_load(find_file("arm_3", "rigs").read_text())
    del plain["world"]
    (tmp_path / "plain.yaml").write_text(yaml.safe_dump(plain))
    write_calibrated_rig(tmp_path / "plain.yaml", tmp_path / "mine.yaml", calibrations, dip_deg=dip_deg)
    x, y, z = load_rig(str(tmp_path / "mine.yaml")).magnetic_field
    assert np.degrees(np.arctan2(-z, np.hypot(x, y))) == pytest.approx(dip_deg, abs=0.06)


@pytest.mark.parametrize(("other", "found"), [(67.0, 66.5), (72.0, None)])
def test_modules_that_disagree_about_the_dip_tell_none(other, found):
    """As beside iron; they lie on a table."""
    session = SensorSession([1, 2], 9.81, 49.0)
    for k in range(200):
        for module, dip in ((1, np.radians(66.0)), (2, np.radians(other))):
            field = (0.0, float(49.0 * np.cos(dip)), float(-49.0 * np.sin(dip)))
            session.add(module, k * 40_000_000, (0.0, 0.0, 9.81), (0.0, 0.0, 0.0), field)
    plain = SensorCalibration()
    assert session.dip_deg({1: plain, 2: plain}) == (None if found is None else pytest.approx(found))
    assert session.dip_deg({}) is None


def norms(suit):
    """Standard deviation of the norm over its mean: specific force at rest, field, by module."""

    class Keep:
        def __init__(self):
            self.frames = []

        def update(self, frame):
            self.frames.append(frame)

    pipeline = Pipeline(suit, AssemblyParams(4e7, 30_000_000, 100_000_000, 500_000_000))
    pipeline.module_stage.reconstructor = keep = Keep()
    pipeline.add_link("box", Framing.BYTE_STREAM)
    for sent in traffic(suit, 20.0):
        pipeline.feed(Chunk(sent.data, round(sent.time_s * 1e9), "box"))
    field = np.stack([frame.magnetic_field for frame in keep.frames])[10:]
    lengths = np.linalg.norm(field, axis=2)
    return np.nanstd(lengths, axis=0) / np.nanmean(lengths, axis=0)


def test_a_rig_file_takes_them_out_of_the_readings(session, tmp_path):
    target = tmp_path / "mine.yaml"
    calibrations = {module: combined(session.results(module)) for module in MODULES}
    write_calibrated_rig(find_file("arm_3", "rigs"), target, calibrations, "2025-01-01")
    suit = load_rig(str(target))
    assert set(suit.calibrations) == set(MODULES)
    before, after = norms(load_rig("arm_3")), norms(suit)
    assert (before > 0.03).all()
    assert (after < 0.02).all()
    text = yaml.safe_load(target.read_text())
    assert text["modules"][0]["calibration"]["measured"] == "2025-01-01"


def test_modules_without_calibration_pass_as_they_are():
    force, rate, field = (1.0, 2.0, 3.0), (1.0, 2.0, 3.0), (4.0, 5.0, 6.0)
    rows = [(3, 0, 0, (force, rate, field), 0), (4, 0, 0, (force, rate, field), 0)]
    samples = InertialBatch.of([*rows, (4, 1, 9, (force, NOT_READ, field), 0)]).samples
    assert SensorCorrections({}).apply(samples) is samples
    corrected = SensorCorrections({4: SensorCalibration(gyroscope_bias=np.ones(3))}).apply(samples)
    assert corrected[0] == samples[0]
    assert corrected["measured"][1, ANGULAR_RATE].tolist() == [0.0, 1.0, 2.0]
    assert (corrected["measured"][:, SPECIFIC_FORCE] == force).all()
    assert np.isnan(corrected["measured"][2, ANGULAR_RATE]).all()
    assert samples["measured"][1, ANGULAR_RATE].tolist() == list(rate)  # what came is left as it was


def test_a_batch_is_corrected_to_the_bit_as_each_sample_by_itself():
    rng = np.random.default_rng(4)
    calibrations = {module: random_calibration(module) for module in (2, 3, 9)}
    samples = np.zeros(400, INERTIAL_SAMPLE)
    samples["module"] = rng.integers(0, 12, len(samples))
    samples["measured"] = 30.0 * rng.normal(size=(len(samples), 3, 3))
    samples["measured"][rng.random((len(samples), 3)) < 0.2] = np.nan
    corrected = SensorCorrections(calibrations).apply(samples)
    for sample, (force, rate, field) in zip(samples, corrected["measured"], strict=True):
        if calibration := calibrations.get(int(sample["module"])):
            sample["measured"][SPECIFIC_FORCE] = calibration.specific_force(
                sample["measured"][SPECIFIC_FORCE]
            )
            sample["measured"][ANGULAR_RATE] = calibration.angular_rate(sample["measured"][ANGULAR_RATE])
            sample["measured"][MAGNETIC_FIELD] = calibration.magnetic_field(
                sample["measured"][MAGNETIC_FIELD]
            )
        np.testing.assert_array_equal(sample["measured"], [force, rate, field])


def random_calibration(seed):
    rng = np.random.default_rng(seed)
    return SensorCalibration(
        np.eye(3) + 0.1 * rng.uniform(-1, 1, (3, 3)),
        rng.normal(size=3),
        rng.normal(size=3),
        np.eye(3) + 0.1 * rng.uniform(-1, 1, (3, 3)),
        10 * rng.normal(size=3),
    )


@pytest.mark.parametrize("seed", range(3))
def test_one_correction_after_another_is_one_correction(seed):
    first, second = random_calibration(seed), random_calibration(seed + 100)
    both, values = second.after(first), np.random.default_rng(seed).normal(size=(5, 3))
    for sensor in ("specific_force", "angular_rate", "magnetic_field"):
        expected = getattr(second, sensor)(getattr(first, sensor)(values))
        np.testing.assert_allclose(getattr(both, sensor)(values), expected, atol=1e-12)


def test_the_setting_of_modules_is_the_same_thing():
    calibration = random_calibration(1)
    again = SensorCalibration.from_setting(calibration.to_setting())
    for name in (
        "accelerometer_matrix",
        "accelerometer_bias",
        "gyroscope_bias",
        "magnetometer_matrix",
        "magnetometer_bias",
    ):
        np.testing.assert_array_equal(getattr(again, name), getattr(calibration, name))
    assert SensorCalibration().to_setting() == tuple(factory_settings()[9])
    with pytest.raises(ValueError, match="30 finite numbers"):
        SensorCalibration.from_setting([0.0] * 29)


def test_a_rig_with_an_impossible_calibration_is_refused(tmp_path):
    text = find_file("arm_3", "rigs").read_text()
    entry = "calibration: {magnetometer: {matrix: [[1, 0, 0], [0, 0, 0], [0, 0, 1]]}}"
    path = tmp_path / "rig.yaml"
    path.write_text(text.replace("position: [0.11, 0.30, 0]}", "position: [0.11, 0.30, 0], " + entry + "}"))
    with pytest.raises(SettingsError, match="no sensor is distorted so much"):
        load_rig(str(path))


def test_the_box_moves_as_its_derivatives_say():
    motion = TumblingMotion(dress(load_rig("suit_17")), 1)
    times, h = np.arange(0.31, 70, 1.73), 1e-4
    before, now, after = (motion.state(times + step) for step in (-h, 0.0, h))

    def flat(state: MotionState):
        return Rotation.from_matrix(state.R_wb.reshape(-1, 3, 3))

    turned = (flat(before).inv() * flat(after)).as_rotvec() / (2 * h)
    np.testing.assert_allclose(turned, now.angular_rate.reshape(-1, 3), atol=1e-5)
    for position, rate in (("joint_position", "joint_velocity"), ("joint_velocity", "joint_acceleration")):
        slope = (getattr(after, position) - getattr(before, position)) / (2 * h)
        np.testing.assert_allclose(slope, getattr(now, rate), atol=0.02)
    np.testing.assert_allclose(
        (after.angular_rate - before.angular_rate) / (2 * h), now.angular_acceleration, atol=0.02
    )
