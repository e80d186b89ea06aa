"""Every number that tunes the tree filter, in one table: one set for all bodies and motions.

A row says its default, unit and meaning, and where it comes from. The filter is given all of them at run time
as one record, so that another value asks for no other code. Numbers of noise are one standard deviation per
axis. What is physics, exact arithmetic or the size of an array is a constant where it is used.
"""

from __future__ import annotations

import math

from gateway.geometry.records import Constant, Record, constant, constants_of, table_of

JUDGED = "chosen on the arms, rings and pendulum of the accuracy suite"
MOTION = "how fast people move"


class Tuning(Record):
    """The table. ``tuning`` makes a record of it, ``CONSTANTS`` has its rows by name."""

    # rows of accelerations
    specific_force: float = constant(
        0.1, "m/s²", "what a row is off by besides lever arms", "play of joints, clocks; sensors are better"
    )
    lever_arm: float = constant(
        0.01, "m", "by how much a lever arm changes while the body moves, times ‖[ω̇, ω]‖", "soft tissue"
    )
    lever_arm_offset: float = constant(
        0.03,
        "m",
        "how far a lever arm was measured wrong; what of it shows in the motion is found",
        "a tape measure",
    )
    force_bias: float = constant(
        0.07, "m/s²", "constant error of an accelerometer after its calibration", "data sheets"
    )
    row_memory_s: float = constant(
        0.1,
        "s",
        "for how long a row stays off to the same side: denser rows say no more in all",
        "soft tissue and clocks",
    )
    huber: float = constant(
        2.0, "σ", "beyond which a row counts linearly, no longer quadratically", "usual for Huber's loss"
    )
    smoothing_s: float = constant(
        0.05, "s", "time constant of the low-pass through which both sides of a row go: 3 Hz", JUDGED
    )
    settled: float = constant(
        3.0,
        "smoothing_s",
        "after which a row counts: over less, it is mostly the noise of rates",
        "exp(−3) = 5 %",
    )
    tilt_memory_s: float = constant(
        1.0, "s", "for how long an uncertain tilt or lever arm stays, as rows see it", JUDGED
    )
    joint_nis_memory_s: float = constant(
        5.0,
        "s",
        "over which a joint's residuals are compared with what is expected of them",
        "several swings",
    )
    largest_nis: float = constant(1e4, "", "one sample's share in that comparison at the most", "100 σ")
    tilt_nis: float = constant(
        3.0,
        "",
        "square of a tilt's error over its variance, for joints of mean NIS 1",
        "training recordings of suite never_worse",
    )
    loose_nis: float = constant(
        9.0,
        "",
        "mean NIS of a joint that counts for nothing",
        "three times the deviations expected, for seconds",
    )
    joint_slack: float = constant(
        1.0,
        "length",
        "where a segment without module bends that goes with its parent; half: one with a rule",
        "anywhere on the way",
    )

    # gyroscopes
    gyroscope: float = constant(
        0.001, "rad/s/√Hz", "noise", "consumer sensors have 0.0002; sampling and aliasing add"
    )
    gyroscope_scale: float = constant(
        0.006, "", "relative error of scale and axes", "data sheets, after calibration"
    )
    scale_memory_s: float = constant(
        0.5, "s", "for how long a scale error keeps its effect in a motion to and fro", MOTION
    )
    bias: float = constant(
        0.01, "rad/s", "at the start", "half a degree per second, as after a factory calibration"
    )
    bias_walk: float = constant(2e-4, "rad/s/√s", "of the bias", "warming up, data sheets")
    largest_rate: float = constant(
        34.8, "rad/s", "beyond it a gyroscope is saturated", "2000 °/s less rounding"
    )
    largest_force: float = constant(
        156.0, "m/s²", "beyond it an accelerometer is saturated", "16 g less rounding"
    )
    saturated_noise: float = constant(5.0, "rad/s/√Hz", "of a gyroscope long at the end of its range", JUDGED)
    longest_clip_s: float = constant(
        0.4, "s", "at the end of a range, over which a rate is taken for a cubic", MOTION
    )
    missed_share: float = constant(
        0.25, "1", "error of what a gyroscope is found to have missed", "cubics in simulated motion"
    )

    # silence and start
    dead_rate: float = constant(2.0, "rad/s", "how a segment turns while its module is silent", MOTION)
    longest_coast_s: float = constant(0.15, "s", "so long a silent segment about keeps its rate", MOTION)
    longest_bridge_s: float = constant(
        0.2, "s", "a gap over which rates and accelerations are taken to change evenly", "random losses"
    )
    longest_silence_s: float = constant(
        1.0, "s", "after a longer silence, or saturation, a segment begins anew", MOTION
    )
    start_tilt: float = constant(
        0.3, "rad", "of a first orientation from one specific force", "3 m/s² over gravity"
    )
    start_arm: float = constant(
        0.3, "m", "of a module from what it turns about when it begins", "length of a limb"
    )
    starting_share: float = constant(
        0.02,
        "",
        "of the square of what a first sample shows of acceleration: times the memory of speeds, a speed's",
        "chains and rings that begin in motion",
    )
    device_start_s: float = constant(
        2.0, "s", "so long a device may take to say its first", "satellite receivers that are warm"
    )

    # headings
    unknown_heading: float = constant(
        1.6, "rad", "a heading of which nothing is known", "near π / √3 of an even distribution"
    )
    start_heading: float = constant(
        0.5,
        "rad",
        "how far the field may be off throughout, before any has been seen",
        "indoors",
    )
    heading_evidence: float = constant(
        6.0,
        "",
        "concentration (von Mises) from which an unobserved heading is taken as shown",
        "0.9 rad with the density; starts of the training part",
    )
    heading_contradiction: float = constant(
        3.0, "", "times that evidence takes a heading back that is far off", "as sure again, and once more"
    )
    heading_far_off: float = constant(
        math.pi / 4.0, "rad", "such a heading is taken back", "a linearised row brings back what is less"
    )
    heading_noise: float = constant(
        2.0, "", "concentration of evidence of which half is shown at once", JUDGED
    )
    heading_coherence: float = constant(
        0.6, "", "least agreement of the two sides' horizontal accelerations for that", JUDGED
    )
    heading_time_s: float = constant(
        1.0, "s", "for how long it must have been gathered", "what one swing tells is off to one side"
    )
    heading_forgets_s: float = constant(20.0, "s", "older evidence counts less", "gyroscopes drift")
    heading_density: float = constant(
        5.0,
        "",
        "rows share errors: the angle is less sure than the evidence says by this factor",
        "row_memory_s at 50 Hz",
    )
    lost_heading: float = constant(
        1.0, "rad", "a heading less certain than that is unobserved again", "where linearised rows fail"
    )
    lone_share: float = constant(
        0.9,
        "",
        "share of a turn from which a side has turned alone: how others head is not found anew",
        "a module that comes back against the many that have stayed",
    )

    # the magnetic field
    heading_memory_s: float = constant(
        10.0, "s", "for how long changes stay off to the same side, and what is not yet found", JUDGED
    )
    dip_tolerance: float = constant(
        0.1, "rad", "a field steeper or flatter than it should be by that much is half disturbed", "buildings"
    )
    norm_tolerance: float = constant(0.1, "", "the same of its norm, relative", "buildings")
    field_memory_s: float = constant(20.0, "s", "over which its norm and dip are averaged", JUDGED)
    field_change_s: float = constant(3.0, "s", "over which their changes are averaged", JUDGED)
    field_change: float = constant(
        0.14, "", "of norm (relative) and dip (rad), before any has been seen", "both tolerances together"
    )
    field_proof: float = constant(
        5.0, "rad", "turned by so much a module has shown whether the field is as it should be", JUDGED
    )
    least_horizontal: float = constant(
        0.1, "", "part of the field that counts as horizontal at least", "near the magnetic poles"
    )
    compass_s: float = constant(10.0, "s", "over which a compass's scatter is averaged at first", JUDGED)
    compass_settles_s: float = constant(
        3.0, "s", "after the last heading was shown the body turns to the field at once", JUDGED
    )
    compass_clean: float = constant(0.14, "rad", "a field off by that much is half believed", JUDGED)
    compass_finds_s: float = constant(
        60.0, "s", "within which a body turns back that was turned wrongly", JUDGED
    )
    largest_offset: float = constant(1.0, "rad", "of the field, at the most", "near iron")
    compass_scatter: float = constant(0.1, "rad", "of a compass, before any has been seen", "buildings")
    compass_least: float = constant(0.01, "rad", "of a compass at the least", "tilts in motion")

    stuck_change: float = constant(
        0.05, "", "a field that changes by less, relative, stays where it is", "3°; noise of magnetometers"
    )
    stuck_turn: float = constant(
        math.pi / 6.0,
        "rad",
        "a field that stays while the module turns by that much is stuck",
        "ten times that",
    )
    stuck_s: float = constant(
        1.0, "s", "for which it must have stayed", "magnetometers read seldom repeat their values"
    )

    # the sun
    sun_memory_s: float = constant(
        1.0, "s", "for how long cells stay off to the same side while the module turns", "simulated skies"
    )
    sun_height_tolerance: float = constant(
        0.1, "rad", "light from higher or lower than the sun by that much is half believed", "simulated skies"
    )
    sun_look_s: float = constant(
        0.3, "s", "seen steadily for so long, the sun settles an unobserved heading", "simulated skies"
    )
    sun_look_memory_s: float = constant(1.0, "s", "over which it is looked for", "simulated skies")
    sun_steady: float = constant(
        0.97, "", "mean resultant length of the headings seen meanwhile", "14° about their mean"
    )
    sun_unsure: float = constant(
        0.5,
        "rad",
        "a heading no surer than this is turned at once, not by a linearised row",
        "where linearised rows fail",
    )

    # zero rate
    zero_rate_change: float = constant(0.035, "rad/s", "less change of the rate than this is rest", "2°/s")
    zero_rate_force_change: float = constant(
        0.3, "m/s²", "more change of the specific force than that is no rest", "breathing"
    )
    zero_rate_s: float = constant(0.7, "s", "for which both must have been small", JUDGED)
    zero_rate_window_s: float = constant(0.5, "s", "over which they are averaged", JUDGED)
    zero_rate_sigma: float = constant(
        0.002, "rad/s", "of a mean rate at rest against the bias", "0.1°/s, swaying"
    )
    largest_bias: float = constant(
        0.05, "rad/s", "a steady rate above it is a motion, not a bias", "3°/s, data sheets"
    )

    # zero acceleration
    stance_acceleration: float = constant(0.3, "m/s²", "of a foot that stands in a shoe", "recorded walks")
    stance_arm: float = constant(
        0.12, "m", "of its module from the heel or ball about which it rolls on and off", "half a foot"
    )
    stride_s: float = constant(
        1.0,
        "s",
        "a foot that has stood aids its chain for so long",
        "runners touch the ground for a fifth of the time",
    )

    # nothing aids
    unaided_speed: float = constant(
        0.3, "m/s", "how fast a body moves whose acceleration nothing tells", MOTION
    )
    unaided_memory_s: float = constant(1.0, "s", "for how long a speed stays about the same", MOTION)
    aided_tilt: float = constant(0.15, "rad", "an inclination less sure than that tells no speed", JUDGED)
    unsettled_tilt: float = constant(
        0.5,
        "rad",
        "less sure than that an inclination in an aided chain is not that of the others",
        "random chains",
    )
    least_speed: float = constant(0.05, "m/s", "of a body at the least", "swaying")
    speed_mean_s: float = constant(3.0, "s", "over which the squares of speeds are averaged", JUDGED)

    # local devices
    local_window_s: float = constant(
        0.2, "s", "least span of readings that an acceleration is fitted to", "bandwidth about 5 Hz"
    )
    local_acceleration: float = constant(
        0.2,
        "m/s²",
        "the span is so long that the readings' noise leaves no more than that, where it can be",
        JUDGED,
    )
    local_longest_gap_s: float = constant(
        0.35, "s", "between readings; over a longer one nothing is differentiated", "beacons at 3 Hz"
    )
    local_longest_window_s: float = constant(
        3.0, "s", "longest span", "gyroscopes keep the directions that are averaged"
    )
    local_window_change: float = constant(
        1.25, "", "a span stays while readings ask for one that is longer or shorter by less", "no flutter"
    )
    local_frames: float = constant(
        80.0, "", "frames remembered of a span", "somewhat less than there is room for"
    )
    device_aids_s: float = constant(
        0.5, "s", "a device that has been silent for longer aids its chain no more", MOTION
    )

    # lever arms
    point_memory_s: float = constant(
        1.0,
        "s",
        "for which an orientation error stays where a point is known",
        "a constant error of the accelerometer looks much the same",
    )
    learn_s: float = constant(
        0.025, "s", "how often a joint is asked, at most", "half of smoothing_s, a quarter of row_memory_s"
    )

    # what corrections and vibration say
    correction_block_s: float = constant(
        0.5, "s", "over which corrections are summed", "several times what rows share"
    )
    correction_memory_s: float = constant(5.0, "s", "over which blocks are compared", JUDGED)
    correction_gain: float = constant(
        0.05, "", "by how much a noise inflation may change with a block", JUDGED
    )
    row_inflation: float = constant(
        2.0, "", "by how much a joint's variance is raised at the most, over itself", JUDGED
    )
    vibration_memory_s: float = constant(1.0, "s", "over which vibration is averaged", JUDGED)
    vibration_floor: float = constant(
        0.1, "m/s²", "vibration below it is not told from none", "noise of accelerometers"
    )
    vibration_shock: float = constant(
        9.0,
        "",
        "times the mean square that one sample counts for at the most; what is beyond is a shock",
        "a heel that strikes is no vibration",
    )
    rate_shock: float = constant(
        25.0,
        "",
        "times the mean square of its vibration from which a reading of a gyroscope is a shock",
        "pendulum and rings of the training recordings",
    )


CONSTANTS: dict[str, Constant] = constants_of(Tuning)


def tuning(**changes: float) -> Tuning:
    """Return the defaults with some of them changed. Raises ``TypeError`` for a name not in the table."""
    return table_of(Tuning, **changes)
