"""The part of the accuracy suite whose truth is known exactly: simulated arms."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmarks.fast_arm import ALL_ON, Switches, fast_arm, fast_motion, sampled, tip_acceleration
from benchmarks.figures import Figure, Report, table
from benchmarks.peers import solved
from benchmarks.scoring import coverage_percent
from benchmarks.simulation import PLACEMENTS, SMOOTHED, arm, errors_deg, ideal_frames
from devices.emulators.motions import BodyMotion, robot_arm_motion
from devices.emulators.waves import Fade
from gateway.body.skeleton import WornSuit
from gateway.cli.emulated_rig import dress
from gateway.comparison import orientation_error, rmse_deg
from gateway.frames import FloatArray
from gateway.reconstruction.inertial.articulated import ArticulatedReconstructor, StartingPose

RATES_HZ = (100.0, 200.0, 400.0, 800.0, 1600.0)
SEEDS = (1, 2, 3)
SETTLING_S = 4.0
ALREADY_MOVING = Fade(rest_s=-10.0, ramp_s=1.0)
SWITCHED = {
    "noise, bias, lever arms 1 cm off": Switches(),
    "nothing wrong": Switches(has_noise=False, has_bias=False, lever_arm_m=0.0),
    "and soft tissue": Switches(has_wobble=True),
    "and clock residue 0.1 ms": Switches(clock_residue_s=100e-6),
    "and iron near the base": Switches(is_field_disturbed=True),
    "all of it": ALL_ON,
}
STANDARD = "noise, bias, lever arms 1 cm off"
METHODS = ("independent", "imufusion", "outward", "joint", SMOOTHED)


def add_convergence(report: Report) -> None:
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


def add_fast_arm(report: Report) -> None:
    """A fast arm, with each kind of error."""
    suit, rows = fast_arm(), []
    means: dict[tuple[str, str], list[float]] = {}
    covered: list[float] = []
    for name, switches in SWITCHED.items():
        for seed in SEEDS:
            motion = fast_motion(suit, seed)
            for method, errors, coverage in _fast_arm_errors(suit, motion, switches, seed):
                means.setdefault((name, method), []).append(float(np.mean(errors)))
                if name == STANDARD and method == "joint":
                    covered.append(coverage)
                cells = [f"{error:.2f}" for error in (*errors, np.mean(errors))]
                rows.append([name, str(seed), f"{tip_acceleration(motion):.0f}", method, *cells])
    heads = ["wrong", "seed", "m/s² RMS at the last joint", "method", *suit.skeleton.segment_names, "mean"]
    report.tables.append(
        "### Simulated fast arm of 5 segments on a fixed base, 100 Hz: RMSE, degrees\n\nOrientation against "
        "the world, nothing aligned or taken out; the field shows the heading.\n\n" + table(heads, rows)
    )
    for name, figure, target in (
        (STANDARD, "sim_arm_ratio_vqf", "<=0.15"),
        ("nothing wrong", "sim_arm_ideal_ratio_vqf", ""),
        ("all of it", "sim_arm_all_ratio_vqf", ""),
    ):
        ratio = float(np.mean(means[name, "joint"]) / np.mean(means[name, "independent"]))
        note = f"`joint` over `independent` (VQF), simulated fast arm: {name}"
        report.figures.append(Figure(figure, ratio, "", target, note))
    smoothed, live = (
        np.mean([mean for name in SWITCHED for mean in means[name, method]]) for method in (SMOOTHED, "joint")
    )
    note = "`joint` smoothed over `joint` as it runs live, mean error, simulated fast arm, all switches"
    report.figures.append(Figure("smoothed_sim_arm_total_ratio", float(smoothed / live), "", "<1.0", note))
    note = "share of errors of `joint` within two sigma, simulated fast arm; 95 is honest"
    report.figures.append(Figure("sigma_coverage_sim_arm_percent", float(np.mean(covered)), "%", "", note))


def _fast_arm_errors(
    suit: WornSuit, motion: BodyMotion, switches: Switches, seed: int
) -> Iterator[tuple[str, FloatArray, float]]:
    """Method, RMSE of each segment in degrees, coverage of sigma in percent."""
    observed = sampled(suit, motion, switches, seed)
    for method in METHODS:
        frames = solved(method, suit, 0.01, observed)
        settled = [frame for frame in frames if frame.time_ns * 1e-9 >= SETTLING_S]
        times_s = np.array([frame.time_ns for frame in settled]) * 1e-9
        error = orientation_error(np.stack([f.q_wb for f in settled]), motion.state(times_s).q_wb).total
        coverage = coverage_percent(error, np.stack([f.sigma for f in settled]))
        yield method, rmse_deg(error), coverage
