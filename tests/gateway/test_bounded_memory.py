"""Memory that does not grow with time, whoever of a suit is silent."""

from __future__ import annotations

import gc
from collections import deque
from types import BuiltinFunctionType, FunctionType, ModuleType

import numpy as np
import pytest

from devices.link import Chunk, Framing
from firmware_protocol import InertialSample, LightSample, LocalMeasurement, encode_frame, wire_frame
from gateway.body.rig import load_rig
from gateway.contract.balances import unaccounted
from gateway.frames import NOT_READ, InertialBatch, LocalReading, Quantity
from gateway.pipeline import Pipeline
from gateway.service.accounting import balances_of
from gateway.stages.frame_assembler import MOST_WAITING, AssemblyParams, FrameAssembler, Lost

LINK = "suit"
PARAMS = AssemblyParams(10e6, 30_000_000, 100_000_000, 500_000_000)
INTERVAL_NS = 10_000_000
SLACK = 2000
"""Items: what is gathered for a while, and given up again, is no growth."""
_NO_DATA = (type, ModuleType, FunctionType, BuiltinFunctionType)

RAW = InertialSample((0.0, 0.0, 9.81), (0.1, 0.0, 0.0), (20.0, 0.0, -40.0))
POSITION = LocalMeasurement(Quantity.POSITION, (1.0, 2.0, 3.0), (0.1, 0.1, 0.1))
LIGHT = LightSample((0.5, 0.0, 0.25, 0.0, 1.0, 0.0))


def items_held(root: object) -> int:
    """Items in all lists, dicts, sets and deques that can be reached from an object."""
    seen, waiting, items = set(), [root], 0
    while waiting:
        thing = waiting.pop()
        if id(thing) in seen or isinstance(thing, _NO_DATA):
            continue
        seen.add(id(thing))
        if isinstance(thing, list | dict | set | deque):
            items += len(thing)
        waiting += gc.get_referents(thing)
    return items


def fed(pipeline: Pipeline, steps: range, packets) -> None:
    for step in steps:
        data = b"".join(
            encode_frame(wire_frame(packet, module, step % 2**16, step * 10_000 % 2**32))
            for module, packet in packets
        )
        pipeline.feed(Chunk(data, (step + 1) * INTERVAL_NS, LINK))


@pytest.mark.parametrize(
    ("rig", "packets", "makes_poses"),
    [
        pytest.param("single", [(1, RAW)], True, id="a rig of one module"),
        pytest.param("single_placed", [(60, POSITION)], False, id="only a local device"),
        pytest.param("robot_arm_4_sun", [(1, LIGHT)], False, id="only photoelectric cells"),
        pytest.param("suit_17", [(5, RAW)], True, id="1 of 17 alive"),
        pytest.param("suit_17", [(63, RAW)], False, id="only a module that the rig does not name"),
    ],
)
def test_what_a_pipeline_holds_does_not_grow_with_time(rig, packets, makes_poses):
    suit = load_rig(rig)
    pipeline = Pipeline(suit, PARAMS, "independent")
    pipeline.add_link(LINK, Framing.BYTE_STREAM)
    fed(pipeline, range(2500), packets)
    held, poses = items_held(pipeline), pipeline.skeleton_frames
    fed(pipeline, range(2500, 7500), packets)
    assert items_held(pipeline) < held + SLACK
    assert (pipeline.skeleton_frames > poses) == makes_poses
    assert not unaccounted(balances_of(pipeline))


@pytest.mark.parametrize("silent", [0, 16])
def test_readings_of_one_module_leave_nothing_behind(silent):
    assembler = FrameAssembler(tuple(range(silent + 1)), PARAMS)
    frames = 0
    for k in range(20_000):
        time_ns = k * INTERVAL_NS
        measured = (0.0, 0.0, 9.81), (0.0, 0.0, 0.0), NOT_READ
        batch = InertialBatch.of([(0, k, time_ns, measured, 0)])
        frames += len(assembler.add(batch.samples, time_ns))
    assert frames > 19_000
    assert items_held(assembler) < 500


def test_local_readings_that_no_frame_comes_for_are_bounded_and_counted():
    assembler = FrameAssembler((0,), PARAMS)
    nothing = np.zeros(3)
    for k in range(MOST_WAITING + 100):
        assembler.add_local(LocalReading(60, k * INTERVAL_NS, Quantity.POSITION, nothing, nothing))
    assert assembler.lost == {Lost.NO_FRAME: 100}
    assert assembler.taken == MOST_WAITING
    last = 0, 0, MOST_WAITING * INTERVAL_NS, ((0.0, 0.0, 9.81), NOT_READ, NOT_READ), 0
    (first, *_) = assembler.add(InertialBatch.of([last]).samples, 10**12)
    assert len(first.local) == MOST_WAITING - 99
    assert first.local[0].time_ns == 100 * INTERVAL_NS
