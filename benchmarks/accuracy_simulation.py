"""The part of the accuracy suite whose truth is known exactly: simulated arms."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from benchmarks.figures import Figure, Report, table
from benchmarks.peers import NO_FIELD, solved
from devices.emulators.motion.motions import BodyMotion, robot_arm_motion
from gateway.body.skeleton import WornSuit
from gateway.emulation.fast_arm import (
    ALL_ON,
    IDEAL,
    RATE_HZ,
    Switches,
    carried_arm,
    carried_motion,
    fast_arm,
    fast_motion,
    felt,
    sampled,
)
from gateway.emulation.recordings import SMOOTHED
from gateway.emulation.rig import dress
from gateway.emulation.simulation import ALREADY_MOVING, PLACEMENTS, arm, errors_deg, ideal_frames
from gateway.frames import FloatArray, ImuFrame
from gateway.geometry.comparison import coverage_percent, orientation_error, rmse_deg
from gateway.reconstruction.inertial.articulated import ArticulatedReconstructor, StartingPose

RATES_HZ = (100.0, 200.0, 400.0, 800.0, 1600.0)
SEEDS = (1, 2, 3)
SETTLING_S = 4.0
SWITCHED = {
    "noise, bias, lever arms 1 cm off": Switches(),
    "nothing wrong": IDEAL,
    "as first, lever arms known": Switches(lever_arm_m=0.0),
    "as first, scales exact": Switches(has_scale=False),
    "as first, no bias": Switches(has_bias=False),
    "and soft tissue": Switches(has_wobble=True),
    "and clock residue 0.1 ms": Switches(clock_residue_s=100e-6),
    "and iron near the base": Switches(is_field_disturbed=True),
    "all of it": ALL_ON,
}
STANDARD = "noise, bias, lever arms 1 cm off"
HALF_LATER = "independent, ½ sample later"
METHODS = ("independent", "imufusion", "articulated", "outward", "joint", SMOOTHED)


class Arm(NamedTuple):
    """One way to move the arm, and how often it is sampled."""

    suit: Callable[[], WornSuit]
    motion: Callable[[WornSuit, int], BodyMotion]
    rate_hz: float
    switched: tuple[str, ...]
    methods: tuple[str, ...] = METHODS


ARMS = {
    "fixed base": Arm(fast_arm, fast_motion, RATE_HZ, tuple(SWITCHED)),
    "fixed base, 50 Hz": Arm(fast_arm, fast_motion, 0.5 * RATE_HZ, (STANDARD,)),
    "carried base": Arm(carried_arm, carried_motion, RATE_HZ, (STANDARD, "all of it"), (*METHODS, NO_FIELD)),
}
RATIOS = (
    ("sim_arm_ratio_vqf", "fixed base", STANDARD, "independent", "<=0.15"),
    ("sim_arm_ratio_vqf_half_later", "fixed base", STANDARD, HALF_LATER, ""),
    ("sim_arm_50hz_ratio_vqf", "fixed base, 50 Hz", STANDARD, "independent", "<=0.15"),
    ("sim_arm_carried_ratio_vqf", "carried base", STANDARD, "independent", "<=0.15"),
    ("sim_arm_carried_all_ratio_vqf", "carried base", "all of it", "independent", ""),
    ("sim_arm_ideal_ratio_vqf", "fixed base", "nothing wrong", "independent", ""),
    ("sim_arm_known_arms_ratio_vqf", "fixed base", "as first, lever arms known", "independent", ""),
    ("sim_arm_exact_scale_ratio_vqf", "fixed base", "as first, scales exact", "independent", ""),
    ("sim_arm_no_bias_ratio_vqf", "fixed base", "as first, no bias", "independent", ""),
    ("sim_arm_all_ratio_vqf", "fixed base", "all of it", "independent", ""),
)
"""Figure, arm, what is wrong, the peer, target."""


def add_convergence(report: Report) -> None:
    """The literal method on noise-free data: its error falls with the sampling interval."""
    rows = []
    for place, position in PLACEMENTS.items():
        for has_gyroscopes in (True, False):
            suit = arm(position)
            motion = robot_arm_motion(dress(suit), seed=1, fade=ALREADY_MOVING)
            errors = np.array([_literal_errors(suit, motion, r, has_gyroscopes) for r in RATES_HZ])
            gyro = "with" if has_gyroscopes else "without"
            report.figures.append(_literal_figure(place, gyro, errors[RATES_HZ.index(800.0)]))
            rows += [
                [place, gyro, str(rank + 1), *(f"{error:.4f}" for error in column)]
                for rank, column in enumerate(errors.T)
            ]
    heads = ["modules", "gyroscopes", "rank", *(f"{rate:g} Hz" for rate in RATES_HZ)]
    report.tables.append(
        "## Literal method, noise-free arm of 4 links, 3 rad/s and 20 rad/s² at the peaks: RMSE, degrees\n\n"
        "The starting pose is given. Without gyroscopes two limits show: rounding of double precision, "
        "amplified by every rank and by 1/Δt² (on the joints, rank 4, beyond 800 Hz), and places of the "
        "module from which the equations cannot hold the heading (up an upright link).\n\n"
        + table(heads, rows)
    )


def _literal_figure(place: str, gyro: str, errors: FloatArray) -> Figure:
    short = {"on the joints": "on_joint", "0.12 m beside the joints": "beside", "0.12 m up the links": "up"}
    name = f"literal_{short[place]}_{gyro}_gyro_800hz_deg"
    note = f"noise-free arm, modules {place}, {gyro} gyroscopes, 800 Hz, worst of 4 ranks"
    return Figure(name, float(np.max(errors)), "°", "<0.5", note)


def _literal_errors(suit: WornSuit, motion: BodyMotion, rate_hz: float, has_gyroscopes: bool) -> FloatArray:
    """RMSE of each segment over 1 s to 6 s, degrees."""
    times_ns = np.arange(round(6.0 * rate_hz)) * round(1e9 / rate_hz)
    first = motion.state(0.0)
    pose = StartingPose(first.q_wb[0], first.angular_rate[0])
    reconstructor = ArticulatedReconstructor(suit, 1.0 / rate_hz, starting_pose=pose)
    ideal = ideal_frames(suit, dress(suit), motion, times_ns, has_gyroscopes)
    return errors_deg([reconstructor.update(frame) for frame in ideal], motion, from_s=1.0)


def add_fast_arm(report: Report) -> None:
    """Fast arms, with each kind of error."""
    rows: list[list[str]] = []
    means: dict[tuple[str, str, str], list[float]] = {}
    covered: list[float] = []
    for place, arm_ in ARMS.items():
        suit = arm_.suit()
        for name in arm_.switched:
            for seed in SEEDS:
                motion = arm_.motion(suit, seed)
                observed = sampled(suit, motion, SWITCHED[name], seed, arm_.rate_hz)
                forces = felt(observed)
                for method, errors, coverage in _fast_arm_errors(arm_, suit, motion, observed):
                    means.setdefault((place, name, method), []).append(float(np.mean(errors)))
                    if name == STANDARD and method == "joint":
                        covered.append(coverage)
                    cells = [f"{error:.2f}" for error in (*errors, np.mean(errors))]
                    felt_by = f"{np.min(forces):.0f} – {np.max(forces):.0f}"
                    rows.append([place, name, str(seed), felt_by, method, *cells])
    heads = ["arm", "wrong", "seed", "m/s² RMS", "method", *suit.skeleton.segment_names, "mean"]
    report.tables.append(
        "## Simulated fast arms of 5 segments, 100 Hz unless said otherwise: RMSE, degrees\n\nOrientation "
        "against the world, nothing aligned or taken out; the field shows the heading. m/s² RMS: of the "
        "modules' specific force, least and most. A base is fixed, or its position is told to 1 mm, 100 "
        f"times a second. `{HALF_LATER}`: most of VQF's error here is that it runs half a sampling interval "
        "ahead; in these rows that is taken back.\n\n" + table(heads, rows)
    )
    report.figures.extend(_arm_figures(means))
    note = "share of errors of `joint` within two sigma, simulated fast arms; 95 is honest"
    report.figures.append(Figure("sigma_coverage_sim_arm_percent", float(np.mean(covered)), "%", "", note))


def _arm_figures(means: dict[tuple[str, str, str], list[float]]) -> Iterator[Figure]:
    """Ratios of mean errors, by arm, what is wrong, and method."""
    for figure, place, name, peer, target in RATIOS:
        ratio = float(np.mean(means[place, name, "joint"]) / np.mean(means[place, name, peer]))
        note = f"`joint` over `{peer}` (VQF), simulated fast arm, {place}: {name}"
        yield Figure(figure, ratio, "", target, note)
    with_field, without = (np.mean(means["carried base", STANDARD, m]) for m in ("joint", NO_FIELD))
    note = "`joint` without magnetometers over `joint` with them, simulated fast arm, carried base"
    yield Figure("sim_arm_magnetometer_free_ratio", float(without / with_field), "", "<=1.2", note)
    smoothed, live = (
        np.mean([mean for (_, _, used), each in means.items() if used == method for mean in each])
        for method in (SMOOTHED, "joint")
    )
    note = "`joint` smoothed over `joint` as it runs live, mean error, simulated fast arm, all switches"
    yield Figure("smoothed_sim_arm_total_ratio", float(smoothed / live), "", "<1.0", note)


def _fast_arm_errors(
    arm_: Arm, suit: WornSuit, motion: BodyMotion, observed: list[ImuFrame]
) -> Iterator[tuple[str, FloatArray, float]]:
    """Method, RMSE of each segment in degrees, coverage of sigma in percent."""
    for method in arm_.methods:
        frames = solved(method, suit, 1.0 / arm_.rate_hz, observed)
        settled = [frame for frame in frames if frame.time_ns * 1e-9 >= SETTLING_S]
        times_s = np.array([frame.time_ns for frame in settled]) * 1e-9
        q_wb = np.stack([frame.q_wb for frame in settled])
        error = orientation_error(q_wb, motion.state(times_s).q_wb).total
        yield method, rmse_deg(error), coverage_percent(error, np.stack([f.sigma for f in settled]))
        if method == "independent":
            later = motion.state(times_s + 0.5 / arm_.rate_hz).q_wb
            yield HALF_LATER, rmse_deg(orientation_error(q_wb, later).total), float("nan")
