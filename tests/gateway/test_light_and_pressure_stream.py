"""Light and pressure samples from bytes to readings, and where they go from there."""

from dataclasses import replace

import pytest

from devices.link import Chunk, Framing
from firmware_protocol import LightSample, PressureSample, encode_frame, wire_frame
from gateway.body.rig import load_rig
from gateway.contract.balances import unaccounted
from gateway.frames import LightReading, LocalReading, Quantity
from gateway.pipeline import Pipeline
from gateway.service.accounting import balances_of
from gateway.sources.suit import SuitSource
from gateway.stages.frame_assembler import AssemblyParams

LINK = "suit"
LIGHT = LightSample((0.5, 0.0, 0.25, 0.0, 1.0, 0.0))
AIR = PressureSample((12.25, -12.25, 0.0), static_pressure=101_325.0, temperature_celsius=15.0)


def chunk(packet, module, sequence=0):
    data = encode_frame(wire_frame(packet, module, sequence, 1000 + sequence))
    return Chunk(data, 10_000_000 + sequence, LINK)


def test_readings_are_in_si_units_and_have_the_modules_time():
    stream = SuitSource()
    stream.add_link(LINK, Framing.BYTE_STREAM)
    (light,), (air,) = stream.receive(chunk(LIGHT, 3)), stream.receive(chunk(AIR, 61))
    assert isinstance(light, LightReading)
    assert light.module == 3
    assert light.intensity == pytest.approx(LIGHT.intensity, abs=1e-4)
    assert isinstance(air, LocalReading)
    assert (air.device, air.quantity) == (61, Quantity.AIR_VELOCITY)
    assert air.value == pytest.approx([4.472, -4.472, 0.0], abs=0.01)


@pytest.mark.parametrize("uses_sun", [True, False])
def test_every_light_reading_is_accounted_for(uses_sun):
    suit = load_rig("robot_arm_4_sun")
    suit = suit if uses_sun else replace(suit, sun=None)
    pipeline = Pipeline(suit, AssemblyParams(10e6, 30_000_000, 100_000_000, 500_000_000), "independent")
    pipeline.add_link(LINK, Framing.BYTE_STREAM)
    for sequence, module in enumerate([0, 1, 2, 3, 40]):
        pipeline.feed(chunk(LIGHT, module, sequence))
    assert pipeline.module_stage.unused["light"] == (0 if uses_sun else 5)
    assert not unaccounted(balances_of(pipeline))
    assert ("light" in pipeline.statistics()) is uses_sun
