"""A step that is asked for before the first samples have come, as just after a gateway has begun anew."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace

import numpy as np
import pytest

from gateway.body.rig import load_rig
from gateway.calibration import control as calibration_control
from gateway.calibration.control import CalibrationControl
from gateway.errors import GatewayError
from gateway.frames import ImuFrame


@pytest.fixture
async def begun():
    """A calibration under way, and what stands for the pipeline that feeds it frames."""
    pipeline = SimpleNamespace(suit=load_rig("suit_lower_7"), module_stage=SimpleNamespace(on_frame=None))
    control = CalibrationControl(pipeline, None, None, None)
    await control.perform("begin", {})
    yield control, pipeline
    await control.perform("cancel", {})


def frame_of(suit):
    n = len(suit.module_ids)
    vectors = np.zeros((n, 3))
    return ImuFrame(0, 1, vectors, vectors, vectors, np.zeros(n, np.uint8), np.zeros(n, np.int64))


async def test_a_step_waits_for_the_first_frame(begun):
    control, pipeline = begun
    frame = frame_of(pipeline.suit)
    asyncio.get_running_loop().call_later(0.2, lambda: pipeline.module_stage.on_frame(frame))
    answer = await control.perform("step", {"step": "n_pose"})
    assert answer["step"] == "n_pose"
    await asyncio.sleep(0.0)  # the step's own task begins
    assert (await control.perform("status", {}))["phase"] == "get ready for n_pose"


async def test_a_step_without_modules_is_refused(begun, monkeypatch):
    monkeypatch.setattr(calibration_control, "FIRST_FRAME_S", 0.1)
    control, _ = begun
    with pytest.raises(GatewayError, match="no module has been heard yet: are they switched on"):
        await control.perform("step", {"step": "n_pose"})
    assert (await control.perform("status", {}))["phase"] == "ready"
