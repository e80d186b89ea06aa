"""Figures of a simulated capture: all joints of a body fitted to one half, in the other."""

from __future__ import annotations

from benchmarks.figures import Figure
from gateway.emulation.optical_truth import rms, rms_of, solved_simulation


def simulated_rows() -> tuple[list[Figure], tuple[list[str], list[list[str]]]]:
    """Figures, and a table of all joints."""
    errors = solved_simulation()
    rows = []
    for joint, early, late in zip(errors.body.joints, errors.live, errors.offline, strict=True):
        seen = errors.shown[:, joint.distal]
        for k, angle in enumerate(joint.angles):
            cells = [late[:, k], early[:, k], early[seen, k], early[~seen, k]]
            rows.append([joint.name, angle.name, *(f"{rms(each):.2f}" for each in cells)])
    figures = [
        Figure(
            "truth_joint_angles_deg", rms_of(errors.offline), "°", "<=1",
            "1 mm noise, markers 3 cm off, 10 % gaps, swaps; all joints and angles; a whole trial, "
            "by `optical solve --method both_ways`",
        ),
        Figure(
            "truth_live_joint_angles_deg", rms_of(errors.live), "°",
            note="the same, frame by frame, without knowing what comes after a gap",
        ),
        Figure(
            "truth_live_seen_joint_angles_deg",
            rms_of(errors.live_seen), "°", "<=1",
            "the same, of all joints while every marker of the segment beyond them is seen",
        ),
        Figure(
            "truth_swaps_found_percent", 100.0 * errors.swaps_found, "%", ">=99",
            "points with a wrong name",
        ),
        Figure(
            "truth_bone_length_spread_mm", errors.length_spread_mm, "mm", "<=0.001",
            "largest change of a bone's length over all frames",
        ),
    ]  # fmt: skip
    heads = ["joint", "angle", "both ways", "live", "live, all its markers seen", "live, in gaps"]
    return figures, (heads, rows)
