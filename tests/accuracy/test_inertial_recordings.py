"""Real modules with optical truth: BROAD (Laidig et al. 2021), one rigid body.

Of some trials the end of their rest and half a minute of motion; whole ones are slow.
"""

import functools
import os
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat
from scipy.signal import butter, filtfilt
from scipy.spatial.transform import Rotation
from vqf import VQF

from gateway.body.skeleton import LocalDevice, Skeleton, WornSuit
from gateway.frames import ImuFrame, LocalReading, Quantity
from gateway.reconstruction import create_reconstructor

DATA = Path(os.environ.get("MOCAP_DATA", Path(__file__).resolve().parents[3] / "shared" / "data")) / "broad"

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason=f"no recordings in {DATA}")

DEVICE = 9
PART, WHOLE = (9_000, 20_000), (0, None)
"""Rows, 286 a second."""


def in_part_and_whole(names, part, *whole):
    """Parameters ``names`` and rows: ``part`` of one trial, and all of this and others, which is slow."""
    reason = "half a minute a trial; a part of the other trials is mostly the settling of a start in it"
    slow = [pytest.param(*each, WHOLE, marks=pytest.mark.slow(reason=reason)) for each in (part, *whole)]
    return pytest.mark.parametrize((*names, "rows"), [(*part, PART), *slow])


@functools.cache
def load(name, rows):
    whole = loadmat(next(DATA.glob(f"{name}_*.mat")), squeeze_me=True)
    n = len(whole["imu_acc"])
    return {
        key: value[slice(*rows)] if getattr(value, "shape", ())[:1] == (n,) else value
        for key, value in whole.items()
    }


@functools.cache
def by_filter(name, rows):
    """Orientations of ``independent``."""
    return orientations("independent", load(name, rows))


def suit(trial, device):
    """One rigid body; the field as the optical reference sees it on average."""
    q, mag = trial["opt_quat"], trial["imu_mag"]
    ok = np.isfinite(q).all(axis=1) & np.isfinite(mag).all(axis=1)
    field = Rotation.from_quat(q[ok][:, [1, 2, 3, 0]]).apply(mag[ok]).mean(axis=0)
    return WornSuit(
        skeleton=Skeleton("rigid body", ("body",), np.array([-1]), np.zeros((1, 3)), np.zeros((1, 3))),
        module_ids=(0,),
        module_of_segment=np.array([0]),
        sensor_to_segment=np.array([[1.0, 0.0, 0.0, 0.0]]),
        lever_arms=np.zeros((1, 3)),
        local_devices=() if device is None else (LocalDevice(device, 0, np.zeros(3), DEVICE),),
        gravity=np.array([0.0, 0.0, -9.81]),
        magnetic_field=field,
    )


def orientations(name, trial, positions=None):
    """q_wb at every row, (n, 4)."""
    rate_hz = float(trial["sampling_rate"])
    quantity = None if positions is None else Quantity.POSITION
    reconstructor = create_reconstructor(name, suit(trial, quantity), 1.0 / rate_hz)
    q_wb = np.empty((len(trial["imu_acc"]), 4))
    for k in range(len(q_wb)):
        time_ns = round(k / rate_hz * 1e9)
        local = ()
        if positions is not None:
            local = (LocalReading(DEVICE, time_ns, Quantity.POSITION, positions[k], np.zeros(3)),)
        rows = (trial[sensor][k : k + 1] for sensor in ("imu_acc", "imu_gyr", "imu_mag"))
        imu_frame = ImuFrame(k, time_ns, *rows, np.zeros(1, np.uint8), np.zeros(1, np.int64), local)
        q_wb[k] = reconstructor.update(imu_frame).q_wb[0]
    return q_wb


def total_errors_deg(q_wb, trial):
    """On the rows that BROAD scores, wherever an orientation is defined."""
    truth = trial["opt_quat"]
    scored = trial["movement"].astype(bool) & np.isfinite(truth).all(axis=1)
    scored &= np.isfinite(q_wb).all(axis=1)
    assert scored.sum() > 0.9 * trial["movement"].sum()
    cosine = np.abs((q_wb[scored] * truth[scored]).sum(axis=1))
    return np.degrees(2.0 * np.arccos(np.minimum(cosine, 1.0)))


def smoothed_positions(trial, cutoff_hz):
    """Without it, optical noise of 0.1 mm is 20 m/s² after two differences at 286 Hz."""
    positions = trial["opt_pos"].astype(float)
    ok, k = np.isfinite(positions).all(axis=1), np.arange(len(positions))
    filled = np.stack([np.interp(k, k[ok], positions[ok, axis]) for axis in range(3)], axis=1)
    b, a = butter(2, cutoff_hz / (trial["sampling_rate"] / 2.0))
    return np.asarray(filtfilt(b, a, filled, axis=0))


def rms(errors):
    return np.sqrt(np.mean(errors**2))


@in_part_and_whole(("name", "bound_deg"), ("02", 1.3), ("10", 1.0))
def test_independent_is_as_good_as_vqf_is_known_to_be(name, bound_deg, rows):
    assert rms(total_errors_deg(by_filter(name, rows), load(name, rows))) < bound_deg


@in_part_and_whole(("name",), ("02",))
def test_independent_is_vqf_and_the_declination_and_nothing_else(name, rows):
    trial = load(name, rows)
    sensors = [np.ascontiguousarray(trial[name]) for name in ("imu_gyr", "imu_acc", "imu_mag")]
    q = VQF(1.0 / float(trial["sampling_rate"])).updateBatch(*sensors)["quat9D"]
    field = suit(trial, None).magnetic_field
    declination = Rotation.from_euler("z", -np.arctan2(field[0], field[1]))
    expected = (declination * Rotation.from_quat(q[:, [1, 2, 3, 0]])).as_quat()[:, [3, 0, 1, 2]]
    cosine = np.abs((by_filter(name, rows) * expected).sum(axis=1))
    np.testing.assert_allclose(cosine, 1.0, atol=1e-12)


@in_part_and_whole(("name", "rms_deg", "median_deg"), ("21", 18.0, 8.0), ("02", 8.0, 5.0))
def test_articulated_with_known_root_acceleration_solves_every_sample(name, rms_deg, median_deg, rows):
    trial = load(name, rows)
    positions = smoothed_positions(trial, 10.0)
    aided = total_errors_deg(orientations("articulated", trial, positions), trial)
    assert rms(aided) < rms_deg
    assert np.median(aided) < median_deg
    assert rms(aided) < 0.7 * rms(total_errors_deg(orientations("articulated", trial), trial))
