"""The demo tells apart what its method errs by and what a busy machine lost."""

from types import SimpleNamespace

import numpy as np
import pytest

from gateway.body.rig import load_rig
from gateway.cli.demo_truth import SETTLING_S, Truth
from gateway.cli.emulated_rig import dress, move

RIG = "robot_arm_4"


def received(suit, time_s, q_wb, late_s):
    segments = dict(zip(suit.skeleton.segment_names, q_wb.tolist(), strict=True))
    pose = SimpleNamespace(t_ns=round(time_s * 1e9), segments=segments)
    return SimpleNamespace(pose=pose, latency_s=late_s)


def stream(taken, lost):
    return SimpleNamespace(modules={0: SimpleNamespace(received=taken, lost=lost)})


@pytest.mark.parametrize(
    ("late_s", "lost", "expected_loss", "said"),
    [
        (0.01, 0, 0.0, None),
        (0.01, 15, 0.0, None),
        (0.01, 300, 0.0, "30% of the samples were lost"),
        (0.01, 45, 0.03, None),
        (0.25, 0, 0.0, "more than 250 ms late"),
    ],
)
def test_a_machine_that_did_not_keep_up_is_told(late_s, lost, expected_loss, said):
    suit = load_rig(RIG)
    truth = Truth(suit)
    times_s = np.arange(0.0, SETTLING_S + 1.0, 0.1)
    for time_s, q_wb in zip(times_s, move(dress(suit), RIG, 1).state(times_s).q_wb, strict=True):
        truth.add(received(suit, time_s, q_wb, late_s))
    assert truth.errors_deg().max() < 1e-3
    note = truth.busy_note(stream(1000 - lost, lost), expected_loss)
    assert (note is None) == (said is None)
    assert said is None or said in note
