"""How wrong joint angles are: against simulated truth, an optical reference, and vendors' orientations."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.accuracy import DATA
from benchmarks.figures import Figure, Report, table
from benchmarks.joint_recordings import QMT_STILL_S, JointTrial, hipose, joint_trial, read_qmt
from devices.emulators.data_sets import METAL_TABLE_S, read_ring_chain5
from devices.emulators.imperfections import TYPICAL
from gateway.body.body_file import load_body
from gateway.body.joint_angles import joint_angles
from gateway.body.rig import load_rig
from gateway.emulation.recordings import align, orientations, reference_at, solve
from gateway.emulation.rig import dress, move
from gateway.emulation.simulation import through_the_wire
from gateway.frames import FloatArray

PUBLISHED = "<=6"
"""OpenSense against optical capture: 3–6° median RMS (Al Borno et al. 2022, J. NeuroEng. Rehab. 19:22)."""
SECONDS = 30.0
SETTLING_S = 5.0


def run() -> Report:
    """Simulation, then every recording that is there."""
    report = Report("joints")
    for trial, what in _trials():
        errors = rmse_deg(trial)
        report.tables.append(_table(trial, errors, what))
        known = errors[np.isfinite(errors)]
        name = trial.name
        report.figures += [
            Figure(
                f"{name}_joint_median_deg", float(np.median(known)), "°", PUBLISHED, f"median angle, {what}"
            ),
            Figure(f"{name}_joint_worst_deg", float(known.max()), "°", "", f"worst angle, {what}"),
        ]
    return report


def rmse_deg(trial: JointTrial) -> FloatArray:
    """(n_joints, 3) degrees; differences by whole turns are none."""
    difference = np.degrees(trial.found - trial.reference)
    difference = (difference + 180.0) % 360.0 - 180.0
    seen = np.isfinite(difference)
    square = np.where(seen, difference, 0.0) ** 2
    with np.errstate(invalid="ignore"):
        return np.sqrt(square.sum(axis=0) / seen.sum(axis=0))


def _trials() -> Iterator[tuple[JointTrial, str]]:
    yield _simulated(), "simulated gait through the wire, typical modules, against the truth"
    sources = [
        ("ring_chain5/trial1", _ring, "five links with optical reference, `independent`"),
        ("hipose_mtw17", hipose, "our reconstruction of raw readings against the vendor's (not a truth)"),
        (
            "qmt_fullbody16/full_body_example_data.mat",
            _qmt,
            "no magnetometer, against the set's orientations",
        ),
    ]
    for path, read, what in sources:
        if (DATA / path).exists():
            yield read(DATA / path), what
        else:
            print(f"skipped {path}: not there")


def _simulated() -> JointTrial:
    shoulders = dict.fromkeys(("left_shoulder", "right_shoulder"), "swing_twist")
    suit = load_rig("suit_17")
    suit = replace(suit, skeleton=load_body("human_17", joint_definitions=shoulders))
    motion = move(dress(suit), "human_17", 1)
    frames = through_the_wire(suit, motion, TYPICAL, "independent", SECONDS, 1)
    times = np.array([frame.time_ns for frame in frames]) * 1e-9
    settled = times >= SETTLING_S
    found = joint_angles(suit.skeleton, np.stack([frame.q_wb for frame in frames]))[settled]
    truth = joint_angles(suit.skeleton, motion.state(times[settled]).q_wb)
    return JointTrial("simulated", suit.skeleton, truth, found, SETTLING_S)


def _qmt(path: Path) -> JointTrial:
    return joint_trial(read_qmt(path), QMT_STILL_S, "independent")


def _ring(trial: Path) -> JointTrial:
    """Both aligned to the optical segments: one heading and one misalignment each, as in ``accuracy``."""
    recording, suit = read_ring_chain5(trial), load_rig("chain_5")
    times, q_wb = orientations(solve(recording, suit, "independent"), 0.0)
    q_ref = np.stack([reference_at(times, reference) for reference in recording.references], axis=1)
    known = (
        np.isfinite(q_ref).all(axis=(1, 2)) & np.isfinite(q_wb).all(axis=(1, 2)) & (times >= METAL_TABLE_S)
    )
    aligned = np.stack([align(q_wb[known, i], q_ref[known, i]) for i in range(q_wb.shape[1])], axis=1)
    neutral = [
        Rotation.from_quat(q_ref[known, i], scalar_first=True).mean().inv() for i in range(q_ref.shape[1])
    ]
    skeleton = load_body("chain_5")
    both = [joint_angles(skeleton, _from_neutral(q, neutral)) for q in (q_ref[known], aligned)]
    return JointTrial("ring", skeleton, both[0], both[1], METAL_TABLE_S)


def _from_neutral(q: FloatArray, neutral: list[Rotation]) -> FloatArray:
    """Angles are counted from the mean posture, so that no joint stays near its singularity."""
    turned = [
        (Rotation.from_quat(q[:, i], scalar_first=True) * rotation).as_quat(scalar_first=True)
        for i, rotation in enumerate(neutral)
    ]
    return np.stack(turned, axis=1)


def _table(trial: JointTrial, errors: FloatArray, what: str) -> str:
    rows = []
    for joint, error, seen in zip(
        trial.skeleton.joints, errors, np.moveaxis(trial.reference, 1, 0), strict=True
    ):
        for i, angle in enumerate(joint.angles):
            if np.isfinite(error[i]):
                low, high = np.degrees([np.nanmin(seen[:, i]), np.nanmax(seen[:, i])])
                rows.append([joint.name, angle.name, f"{low:.0f} to {high:.0f}", f"{error[i]:.2f}"])
    heads = ["joint", "angle", "range of the reference °", "RMSE °"]
    return f"## {trial.name}: {what}\n\n" + table(heads, rows)
