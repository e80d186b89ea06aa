"""What modules measure, handed to a calibration of their sensors."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence

from devices.link import Chunk
from firmware_protocol import InertialSample, InertialSampleFine, ReceivedPacket
from gateway.calibration.sensor_session import SensorSession
from gateway.frames import Sample
from gateway.modules.makers import MakersModules
from gateway.sources.suit import SuitSource


@contextlib.contextmanager
def fed(session: SensorSession, stream: SuitSource, makers: MakersModules) -> Iterator[None]:
    """Feed a session with all samples meanwhile, of our modules and of other makers'."""

    def take(received: ReceivedPacket, chunk: Chunk) -> None:
        sample = received.packet
        assert isinstance(sample, InertialSample | InertialSampleFine)
        session.add(
            received.module,
            chunk.arrived_ns,
            sample.specific_force,
            sample.angular_rate,
            sample.magnetic_field,
        )

    def take_others(samples: Sequence[Sample], chunk: Chunk) -> None:
        for sample in samples:
            # Other makers mark a sensor that was not read by NaN, our own packets by None.
            force, rate, field = (None if math.isnan(each[0]) else each for each in sample.measured)
            session.add(sample.module, chunk.arrived_ns, force, rate, field)

    for packet_class in (InertialSample, InertialSampleFine):
        stream.listen(packet_class, take)
    try:
        with makers.watched(take_others):
            yield
    finally:
        for packet_class in (InertialSample, InertialSampleFine):
            stream.stop_listening(packet_class, take)
