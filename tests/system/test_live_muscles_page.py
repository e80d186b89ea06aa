"""Muscles on the live page, of poses over a real broker: as the analysis of the whole motion has them."""

from __future__ import annotations

import asyncio
import time

import aiomqtt
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("viser", reason="the extra 'viewer' is not installed")
pytest.importorskip("mujoco", reason="the extra 'biomech' is not installed")
pytest.importorskip("osqp", reason="the extra 'biomech' is not installed")
pytest.importorskip("myo_sim", reason="the extra 'biomech' is not installed")

import viser

from gateway.analysis.analysing import analyse_motion
from gateway.analysis.live import GRAVITY, LiveMuscles
from gateway.analysis.muscles import find_muscles
from gateway.analysis.smooth_motion import smooth_motion
from gateway.body.inertia import body_inertia
from gateway.body.rig import load_rig
from gateway.contract.messages import BridgeState, PoseMessage, describe_body
from gateway.contract.topics import Topics
from gateway.outputs.settings import MqttSettings
from gateway.viewer import muscle_wires
from gateway.viewer.live import LiveViewer
from gateway.viewer.texts import ENGLISH, translated
from tests.patience import PATIENCE_S

NOT_PLACED = translated(ENGLISH, "muscles_not_placed")

pytestmark = pytest.mark.system
BODY = load_rig("suit_17").skeleton
ROOT = (0.3, -0.2, 0.93)
KG = 70.0
TIMES_S = np.arange(140) * 0.02
LEGS = ("pelvis", "thigh", "shank", "foot")


def bow(time_s):
    """(S, 4): the trunk goes forward and back."""
    angle = 0.6 * np.sin(1.7 * time_s) ** 2
    turned = Rotation.from_quat(BODY.neutral, scalar_first=True) * Rotation.from_rotvec([0.0, 0.0, -angle])
    is_leg = np.array([name.endswith(LEGS) for name in BODY.segment_names])
    return np.where(is_leg[:, None], BODY.neutral, turned.as_quat(scalar_first=True))


def message(index, is_placed):
    names, q_wb = BODY.segment_names, bow(TIMES_S[index]).tolist()
    return PoseMessage(
        t_ns=round(TIMES_S[index] * 1e9), seq=index, frame="ENU", order="wxyz", root="pelvis",
        segments=dict(zip(names, map(tuple, q_wb), strict=True)), status=dict.fromkeys(names, "measured"),
        position={"pelvis": ROOT} if is_placed else None,
    )  # fmt: skip


async def watched(port, monkeypatch, is_placed, is_enough):
    """What the page is told of muscles, and its legends, while the motion is published, and afterwards until
    ``is_enough(told, legends)``."""
    told, legends = [], []
    now, legend = LiveMuscles.now, muscle_wires._legend
    monkeypatch.setattr(LiveMuscles, "now", lambda self: told.append(now(self)) or told[-1])
    monkeypatch.setattr(
        muscle_wires, "_legend", lambda *given, **more: legends.append(legend(*given, **more)) or legends[-1]
    )
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    topics = Topics("mocap", "lab")
    showing = asyncio.create_task(LiveViewer(server, MqttSettings(port=port), "lab", KG).run())
    async with aiomqtt.Client("127.0.0.1", port) as client:
        await client.publish(topics.bridge_state, BridgeState(state="online").payload(), retain=True)
        await client.publish(topics.body, describe_body(BODY).payload(), retain=True)
        while not legends:  # the page knows the body
            assert not showing.done()
            await asyncio.sleep(0.05)
        for index in range(len(TIMES_S)):
            await client.publish(topics.pose, message(index, is_placed).payload())
            await asyncio.sleep(0.01)
        deadline_s = time.monotonic() + PATIENCE_S
        while not is_enough(told, legends):
            assert time.monotonic() < deadline_s, (told, legends)
            await asyncio.sleep(0.05)
    showing.cancel()
    await asyncio.gather(showing, return_exceptions=True)
    server.stop()
    return told, legends


async def test_the_page_has_the_activities_of_the_whole_motion(mosquitto, monkeypatch):
    def is_enough(told, _):  # a busy machine draws few pictures
        return sum(found is not None for found in told) >= 3

    answers, legends = await watched(mosquitto.port, monkeypatch, is_placed=True, is_enough=is_enough)
    told = [found for found in answers if found is not None]
    motion = np.array([bow(t) for t in TIMES_S])
    smooth = smooth_motion(BODY, TIMES_S, motion, np.tile(ROOT, (len(TIMES_S), 1)), 6.0)
    whole = find_muscles(analyse_motion(smooth, "bow", body_inertia(BODY, KG), GRAVITY))
    for found in told:
        then = whole.activity[int(np.argmin(np.abs(TIMES_S - found.time_s)))]
        assert found.activity == pytest.approx(then, abs=0.06)
    assert max(found.activity.max() for found in told) > 0.1
    assert all(NOT_PLACED not in each for each in legends)


async def test_the_page_says_that_positions_are_missing(mosquitto, monkeypatch):
    def is_enough(_, legends):
        return NOT_PLACED in legends[-1]

    await watched(mosquitto.port, monkeypatch, is_placed=False, is_enough=is_enough)
