"""The demo tells apart what its method errs by and what a busy machine lost."""

from types import SimpleNamespace

import numpy as np
import pytest

from devices.emulators.imperfections import PRESETS
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.link import Chunk, Framing
from gateway.body.rig import load_rig
from gateway.cli.demo import SEED, SETTLING_S, Truth
from gateway.emulation.rig import dress, move, move_about, perform
from gateway.pipeline import Pipeline
from gateway.settings import GatewaySettings
from gateway.sources.link_settings import LinkSettings

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


def test_the_demo_errs_by_a_few_degrees():
    """Its suit and its settings, in simulated time: no machine is too busy for it."""
    suit = load_rig("suit_17")
    settings = GatewaySettings(links=[LinkSettings(name="suit", url="/dev/null")], rig="suit_17")
    traffic = SuitTraffic(
        perform(dress(suit), suit.skeleton.name, SEED), SuitSettings(), PRESETS["typical"], SEED
    )
    pipeline, truth = Pipeline.from_settings(settings, suit), Truth(suit)
    pipeline.add_link("suit", Framing.BYTE_STREAM)
    for sent in traffic.transmissions(24.0):
        for frame in pipeline.feed(Chunk(sent.data, round(sent.time_s * 1e9), "suit")):
            truth.add(received(suit, frame.time_ns * 1e-9, frame.q_wb, 0.0))
    total, inclination, _ = np.nanmean(truth.errors_deg(), axis=0)
    assert inclination < 3.0
    assert total < 6.0


@pytest.mark.parametrize("rig", ["suit_17", "suit_23_from_17", "suit_lower_7"])
def test_who_walks_stays_where_others_can_see(rig):
    """For an hour; as exactly as the straight walk that accuracy is measured with."""
    suit = load_rig(rig)
    state = move_about(dress(suit), suit.skeleton.name, SEED).state(np.arange(0.0, 3600.0, 0.37))
    assert np.abs(state.joint_position).max() < 6.0
    assert np.ptp(state.joint_position[:, 0], axis=0)[:2].min() > 3.0, "and walks"
