"""A GNSS receiver as a local measuring device: fixes in gateway time, east, north and up of an origin."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from devices.geodesy import LocalPlane
from devices.link import Chunk
from gateway.contract.balances import Balance
from gateway.frames import FloatArray, LocalReading, Quantity
from gateway.sources.gnss.sentences import Fix, GnssDecoder
from gateway.sources.link_settings import GnssLinkSettings
from gateway.sources.source import ListeningSource, SourceContext

DATING_WINDOW_NS = 60_000_000_000
"""The least delay of that time gives the receiver's time against the gateway's."""
SILENT_NS = 3_000_000_000


@dataclass(frozen=True)
class GnssParams:
    """What the configuration says of one receiver."""

    device: int = 60
    """Id under which the rig knows it."""
    latency_ns: int = 50_000_000
    """From the instant of a fix to its arrival, at the least."""
    origin: tuple[float, float, float] | None = None
    """Latitude and longitude, degrees, height above the ellipsoid, m; None: the first fix."""


class GnssSource(ListeningSource):
    """Satellite receivers, one a link."""

    observes = LocalReading

    def __init__(self, context: SourceContext) -> None:
        self._links = context.links
        self._receivers: dict[str, GnssReceiver] = {}
        self._readings = 0

    def add_link(self, name: str, content: str) -> None:
        """Announce a receiver; one that the configuration does not name has the defaults."""
        settings = self._links.get(name)
        params = GnssParams()
        if isinstance(settings, GnssLinkSettings):
            params = GnssParams(settings.device, round(settings.latency_ms * 1e6), settings.origin)
        self._receivers[name] = GnssReceiver(params)

    def receive(self, chunk: Chunk) -> Sequence[LocalReading]:
        """Return the readings that a chunk completes."""
        readings = self._receivers[chunk.link].receive(chunk)
        self._readings += len(readings)
        return readings

    def dropped(self) -> Mapping[str, Mapping[str, int]]:
        """Return what could not be read, by link and reason."""
        return {name: receiver.dropped for name, receiver in self._receivers.items()}

    def statistics(self) -> Mapping[str, object]:
        """Return the state of every receiver."""
        return {"gnss": {name: receiver.statistics() for name, receiver in self._receivers.items()}}

    def balances(self) -> Iterator[Balance]:
        """Yield the readings given."""
        yield Balance("readings", self._readings, {})


class GnssReceiver:
    """Sans-I/O. A fix is dated by its own time: jitter of its way does not matter, only constant latency."""

    def __init__(self, params: GnssParams) -> None:
        self._params = params
        self._decoder = GnssDecoder()
        self._plane = LocalPlane(*params.origin) if params.origin is not None else None
        self._delays: deque[tuple[int, int]] = deque()  # (arrival, delay), delays rising: a sliding minimum
        self._fixes = self._without_fix = 0
        self._quality = 0
        self._received_ns = self._now_ns = 0
        self._sigma_m = float("nan")

    def receive(self, chunk: Chunk) -> list[LocalReading]:
        """Return the readings that a chunk completes."""
        self._now_ns = chunk.arrived_ns
        readings: list[LocalReading] = []
        for fix in self._decoder.feed(chunk.data):
            self._received_ns = chunk.arrived_ns
            if not fix.quality:
                self._quality = 0
                self._without_fix += 1
                continue
            readings += self._readings(fix, self._date(fix, chunk.arrived_ns))
        return readings

    def _readings(self, fix: Fix, time_ns: int) -> list[LocalReading]:
        readings = []
        if fix.place is not None and fix.place_sigma is not None:
            self._quality, self._fixes = fix.quality, self._fixes + 1
            self._sigma_m = max(fix.place_sigma[:2])
            # The first place of a session is the origin.
            self._plane = self._plane or LocalPlane(*fix.place)
            place = self._plane.enu(*fix.place)
            readings.append(self._reading(time_ns, Quantity.POSITION, place, fix.place_sigma))
        if fix.velocity is not None and fix.velocity_sigma is not None and self._quality:
            velocity = np.array(fix.velocity)
            readings.append(self._reading(time_ns, Quantity.VELOCITY, velocity, fix.velocity_sigma))
        return readings

    def _reading(
        self, time_ns: int, quantity: Quantity, value: FloatArray, sigma: tuple[float, float, float]
    ) -> LocalReading:
        return LocalReading(self._params.device, time_ns, quantity, value, np.array(sigma))

    def _date(self, fix: Fix, arrived_ns: int) -> int:
        if fix.utc is None:
            return arrived_ns - self._params.latency_ns
        utc_ns = round(fix.utc.timestamp() * 1e6) * 1000
        delay_ns = arrived_ns - utc_ns
        # The least delay of a window in constant time each: only delays that may become the least are kept,
        # in rising order.
        while self._delays and self._delays[-1][1] >= delay_ns:
            self._delays.pop()
        self._delays.append((arrived_ns, delay_ns))
        while self._delays[0][0] < arrived_ns - DATING_WINDOW_NS:
            self._delays.popleft()
        return utc_ns + self._delays[0][1] - self._params.latency_ns

    @property
    def dropped(self) -> dict[str, int]:
        """What could not be read, by reason."""
        return {defect.name.lower(): count for defect, count in self._decoder.dropped.items()}

    def statistics(self) -> dict[str, object]:
        """Return state, quality, standard deviation (m) and counters, for the health message."""
        is_silent = self._now_ns - self._received_ns > SILENT_NS or not self._received_ns
        return {
            "device": self._params.device,
            "state": "silent" if is_silent else "fix" if self._quality else "no fix",
            "quality": self._quality,
            "horizontal_sigma_m": None if np.isnan(self._sigma_m) else round(self._sigma_m, 3),
            "fixes": self._fixes,
            "messages_without_fix": self._without_fix,
            "dropped": self.dropped,
        }
