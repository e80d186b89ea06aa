"""How wrong the orientations are: against simulated truth and optical references, beside the peer VQF.

Nothing is tuned to a trial. ``independent`` *is* VQF with default parameters, one filter a module.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.figures import Figure, Report, table
from benchmarks.gyro_free import add_gyro_free
from benchmarks.offline import imu_frames, orientations
from benchmarks.scoring import Score, score
from benchmarks.simulation import PLACEMENTS, arm, errors_deg, ideal_frames, through_the_wire
from devices.emulators.imperfections import Imperfections
from devices.emulators.motions import BodyMotion, generic_motion, robot_arm_motion
from devices.emulators.recording_formats import (
    read_broad,
    read_repoimu_pendulum,
    read_ring_chain5,
)
from devices.emulators.recordings import Recording
from devices.emulators.waves import Fade
from gateway.body.rig import load_rig
from gateway.body.skeleton import WornSuit
from gateway.cli.emulated_rig import dress
from gateway.frames import FloatArray
from gateway.reconstruction import create_reconstructor
from gateway.reconstruction.inertial.articulated import ArticulatedReconstructor, StartingPose

DATA = Path(os.environ.get("MOCAP_DATA", Path(__file__).parents[2] / "shared" / "data"))
METHODS = ("independent", "articulated", "outward", "joint")
OURS = "joint"
METAL_TABLE_S = 5.0
"""The chain of ``ring_chain5`` lies on a metal table for so long; the figures count what comes after."""
RATES_HZ = (100.0, 200.0, 400.0, 800.0, 1600.0)
SEEDS = (1, 2, 3)
SETTLING_S = 3.0
SENSORS = Imperfections(
    accelerometer_noise=0.03,
    gyrometer_noise=np.radians(0.1),
    magnetometer_noise=0.5,
    accelerometer_bias=0.05,
    gyrometer_bias=np.radians(0.3),
    gyrometer_bias_walk=np.radians(0.005),
    scale=0.002,
    placement=0.01,
)
"""Consumer sensors with lever arms that are 1 cm off."""
ALREADY_MOVING = Fade(rest_s=-10.0, ramp_s=1.0)
COMPARED = "`joint` over `independent` (VQF)"
RATIOS = (
    ("ring_rigid_total_ratio_vqf", "ring_rigid", "total", "<=0.5"),
    ("ring_rigid_tilt_ratio_vqf", "ring_rigid", "tilt", "<=0.45"),
    ("ring_nonrigid_mean_ratio_vqf", "ring_nonrigid", "total", "<=0.7"),
    ("pendulum_ratio_vqf", "pendulum", "total", "<=0.6"),
    ("broad_ml_ratio_vqf", "broad_ml", "total", "<=0.7"),
    ("broad_unaided_ratio_vqf", "broad_unaided", "total", "<=1.0"),
    ("ring_rigid_whole_ratio_vqf", "ring_rigid_whole", "total", ""),
    ("ring_nonrigid_whole_ratio_vqf", "ring_nonrigid_whole", "total", ""),
)
"""Figure, group of trials, kind of error, target."""


class Trial(NamedTuple):
    """A recording with the rig that fits it."""

    figure: str
    read: Callable[[], Recording]
    rig: str
    from_s: float = 0.0
    is_aided: bool = True


def _trials() -> list[Trial]:
    ring, broad = DATA / "ring_chain5" / "trial1", DATA / "broad"
    trials = [
        Trial("ring_rigid", lambda: read_ring_chain5(ring), "chain_5", METAL_TABLE_S),
        Trial("ring_nonrigid", lambda: read_ring_chain5(ring, "nonrigid"), "chain_5", METAL_TABLE_S),
        Trial("ring_rigid_whole", lambda: read_ring_chain5(ring), "chain_5"),
        Trial("ring_nonrigid_whole", lambda: read_ring_chain5(ring, "nonrigid"), "chain_5"),
        Trial("pendulum", lambda: read_repoimu_pendulum(DATA / "repoimu_pendulum"), "pendulum_3"),
    ]
    return trials + [
        Trial(name, lambda path=path: read_broad(path), "single", is_aided=name == "broad_ml")  # type: ignore[misc]
        for path in sorted(broad.glob("*.mat"))
        for name in ("broad_ml", "broad_unaided")
    ]


def run() -> Report:
    """Simulation, then every recording that is there."""
    report = Report("accuracy")
    _add_convergence(report)
    _add_simulated_arm(report)
    _add_recordings(report)
    add_gyro_free(report, DATA / "broad")
    return report


def _add_convergence(report: Report) -> None:
    """The literal method on noise-free data: its error falls with the sampling interval."""
    rows = []
    for place, position in PLACEMENTS.items():
        for has_gyrometers in (True, False):
            suit = arm(position)
            motion = robot_arm_motion(dress(suit), seed=1, fade=ALREADY_MOVING)
            errors = np.array([_literal_errors(suit, motion, r, has_gyrometers) for r in RATES_HZ])
            gyro = "with" if has_gyrometers else "without"
            report.figures.append(_literal_figure(place, gyro, errors[RATES_HZ.index(800.0)]))
            rows += [
                [place, gyro, str(rank + 1), *(f"{error:.4f}" for error in column)]
                for rank, column in enumerate(errors.T)
            ]
    heads = ["modules", "gyrometers", "rank", *(f"{rate:g} Hz" for rate in RATES_HZ)]
    report.tables.append(
        "### Literal method, noise-free arm of 4 links, 3 rad/s and 20 rad/s² at the peaks: RMSE, degrees\n\n"
        "The starting pose is given. Without gyrometers two limits show: rounding of double precision, "
        "amplified by every rank and by 1/Δt² (on the joints, rank 4, beyond 800 Hz), and places of the "
        "module from which the equations cannot hold the heading (up an upright link).\n\n"
        + table(heads, rows)
    )


def _literal_figure(place: str, gyro: str, errors: FloatArray) -> Figure:
    short = {"on the joints": "on_joint", "0.12 m beside the joints": "beside", "0.12 m up the links": "up"}
    name = f"literal_{short[place]}_{gyro}_gyro_800hz_deg"
    note = f"noise-free arm, modules {place}, {gyro} gyrometers, 800 Hz, worst of 4 ranks"
    return Figure(name, float(np.max(errors)), "°", "<0.5", note)


def _literal_errors(suit: WornSuit, motion: BodyMotion, rate_hz: float, has_gyrometers: bool) -> FloatArray:
    """RMSE of each segment over 1 s to 6 s, degrees."""
    times_ns = np.arange(round(6.0 * rate_hz)) * round(1e9 / rate_hz)
    first = motion.state(0.0)
    pose = StartingPose(first.q_wb[0], first.angular_rate[0])
    reconstructor = ArticulatedReconstructor(suit, 1.0 / rate_hz, starting_pose=pose)
    ideal = ideal_frames(suit, dress(suit), motion, times_ns, has_gyrometers)
    return errors_deg([reconstructor.update(frame) for frame in ideal], motion, from_s=1.0)


def _add_simulated_arm(report: Report) -> None:
    """A fast arm with consumer sensors and lever arms 1 cm off."""
    rows, means = [], {method: [] for method in METHODS}
    suit = load_rig("robot_arm_4")
    for seed in SEEDS:
        motion = generic_motion(dress(suit), seed, peak_angular_rate=9.0, peak_angular_acceleration=90.0)
        tip = motion.state(np.arange(SETTLING_S, 20.0, 0.01)).joint_acceleration[:, -1]
        acceleration = f"{np.sqrt(np.mean(np.sum(tip**2, axis=1))):.0f}"
        for method in METHODS:
            frames = through_the_wire(suit, motion, SENSORS, method, 20.0, seed)
            errors = errors_deg(frames, motion, SETTLING_S)
            means[method].append(float(np.mean(errors)))
            cells = [f"{error:.2f}" for error in (*errors, np.mean(errors))]
            rows.append([str(seed), acceleration, method, *cells])
    heads = ["seed", "m/s² RMS at the last joint", "method", *suit.skeleton.segment_names, "mean"]
    report.tables.append(
        "### Simulated fast arm, consumer sensors, lever arms 1 cm off, 100 Hz: RMSE, degrees\n\n"
        + table(heads, rows)
    )
    ratio = float(np.mean(means[OURS]) / np.mean(means["independent"]))
    report.figures.append(Figure("sim_arm_ratio_vqf", ratio, "", "<=0.15", f"{COMPARED}, simulated fast arm"))


def _add_recordings(report: Report) -> None:
    """Every recording that is there, with both methods, scored by one rule."""
    rows: list[list[str]] = []
    scores: dict[tuple[str, str], list[Score]] = {}
    for trial in _trials():
        try:
            recording = trial.read()
        except FileNotFoundError as error:
            print(f"skipped {trial.figure}: {error}")
            continue
        for method, result in _solve(recording, trial):
            scores.setdefault((trial.figure, method), []).append(result)
            cells = ", ".join(f"{t:.1f} / {i:.1f}" for t, i in zip(*result, strict=True))
            rows.append(
                [recording.name, trial.figure, method, cells, *(f"{np.mean(part):.2f}" for part in result)]
            )
    heads = ["recording", "figure", "method", "total / tilt by segment", "mean total", "mean tilt"]
    report.tables.append(
        "### Real recordings with optical reference: RMSE, degrees\n\nOne constant heading and one constant "
        "sensor-to-segment rotation a segment are taken out. The local measuring device is the optical "
        "position of the root, or the fixed pivot; `_unaided`: none. `ring` figures leave out the first "
        f"{METAL_TABLE_S:g} s, on a metal table, except `_whole`.\n\n" + table(heads, rows)
    )
    for name, group, part, target in RATIOS:
        if (group, METHODS[0]) in scores:
            peer, ours = (np.mean([getattr(s, part) for s in scores[group, m]]) for m in (METHODS[0], OURS))
            note = f"{COMPARED}, mean {part} error"
            report.figures.append(Figure(name, float(ours / peer), "", target, note))


def _solve(recording: Recording, trial: Trial) -> Iterator[tuple[str, Score]]:
    """Every method on the same frames."""
    suit = load_rig(trial.rig)
    if not trial.is_aided:
        suit = replace(suit, local_devices=())
    observed = imu_frames(recording, suit)
    first_s = max(float(track.times[0]) for track in recording.modules)
    for method in METHODS:
        if method == "articulated" and not trial.is_aided:
            continue  # it would take the moving body's joint as fixed
        reconstructor = create_reconstructor(method, suit, 1.0 / recording.sampling_rate_hz)
        frames = [reconstructor.update(frame) for frame in observed]
        yield method, score(*orientations(frames, first_s), recording, trial.from_s)
