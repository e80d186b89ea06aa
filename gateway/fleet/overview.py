"""What is known of every gateway of a fleet by what it publishes: state, rate, loss, delay, disk, versions.

``Fleet`` is sans-I/O; ``listener`` feeds it from a broker, or from a cluster. Of a pose only its head is read
(the instant and the number), so that one process follows a hundred gateways.
"""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import aiomqtt
import orjson
from pydantic import ValidationError

from gateway.contract import topics
from gateway.contract.messages import BodyMessage, BridgeHealth, BridgeInfo
from gateway.contract.topics import ANY_GATEWAY, Topics
from gateway.outputs.pose_order import PoseOrder
from gateway.outputs.receiving import Receiver
from gateway.outputs.settings import MqttSettings

WINDOW_S = 5.0
"""Over which rates, losses and delays are told."""
SILENT_S = 3.0
"""A gateway that says it is online and sends no pose for so long raises an alert."""
MOST_LOSS = 0.01
MOST_DELAY_S = 0.25
MOST_GATEWAYS = 10_000
MOST_MISSING = 20_000
"""Numbers of poses that did not come, remembered of one gateway."""
_HEAD = re.compile(rb'\{"t_ns":(-?\d{1,19}),"seq":(-?\d{1,19})[,}]')
_MODULE = re.compile(r"module/(\d{1,3})/state")
_ANNOUNCED = (topics.BRIDGE_INFO, topics.BODY, topics.BRIDGE_STATE)
"""What a gateway publishes before anything else, retained."""


@dataclass(frozen=True)
class OverviewRow:
    """One gateway as the overview shows it. None: not known."""

    gateway: str
    wearer: str | None
    state: str
    rate_hz: float
    loss: float
    """Share of the poses of the last seconds that did not arrive, by their numbers."""
    delay_ms: float | None
    """From the instant of a pose to its arrival here, median; true where both computers have the same UTC."""
    lost: int
    """Poses that arrived neither live nor late since this overview began."""
    late: int
    """Poses that came later, on pose/late, and had not come live."""
    free_gb: float | None
    version: str | None
    firmware: tuple[str, ...]
    alerts: tuple[str, ...]


@dataclass
class Second:
    """Live poses of one gateway within a second."""

    begun_s: float
    delay_s: float | None
    """From the pose's instant to us, of the first one; None: not known."""
    received: int = 0
    missing: int = 0


@dataclass
class SeenGateway:
    """What was heard of one gateway."""

    has_left: bool = False
    """Whether it has taken off the brokers what was kept of it, as people before cameras do who go."""
    state: str = "unknown"
    info: BridgeInfo | None = None
    health: BridgeHealth | None = None
    body: BodyMessage | None = None
    firmware: dict[int, str] = field(default_factory=dict)
    last_s: float | None = None
    order: PoseOrder = field(default_factory=PoseOrder)
    received: int = 0
    missing: dict[int, None] = field(default_factory=dict)
    """Numbers that did not come live, and not late yet; the newest ``MOST_MISSING`` of them."""
    lost: int = 0
    """Poses that came neither live nor late."""
    repeated: int = 0
    """Live poses that had come already, or after newer ones."""
    late: int = 0
    """Poses that came later and had not come live."""
    window: list[Second] = field(default_factory=list)
    """The last seconds in which poses came."""

    def pose(self, t_ns: int, seq: int, now_s: float, utc_ns: int) -> None:
        """Count a live pose."""
        before = self.order.seq
        if not self.order.is_new(seq, t_ns):
            self.repeated += 1
            return
        missing = range(0) if before is None else range(before + 1, seq)
        self.missing.update(dict.fromkeys(missing[-MOST_MISSING:]))
        while len(self.missing) > MOST_MISSING:
            self.missing.pop(next(iter(self.missing)))
        self.lost += len(missing)
        self.last_s = now_s
        self.received += 1
        delay_s = None
        if self.info is not None and self.info.utc is not None:
            delay_s = (utc_ns - t_ns - self.info.utc.offset_ns) * 1e-9
        if not self.window or now_s - self.window[-1].begun_s >= 1.0:
            self.window = [each for each in self.window if now_s - each.begun_s < WINDOW_S + 1]
            self.window.append(Second(now_s, delay_s))
        self.window[-1].received += 1
        self.window[-1].missing += len(missing)

    def late_pose(self, seq: int) -> None:
        """Count a pose that came later: once, and only if it is missing."""
        if seq in self.missing:
            del self.missing[seq]
            self.late += 1
            self.lost -= 1

    def is_of_this_run(self, payload: bytes) -> bool:
        """Return whether a late pose was made by the gateway that runs now, as far as it is known."""
        instance = None if self.info is None else self.info.instance
        return instance is None or b'"%b"' % instance.encode() in payload

    def note_info(self, info: BridgeInfo) -> None:
        """Take what the gateway tells of itself; a new run of it begins to count anew."""
        if self.info is not None and info.instance != self.info.instance:
            self.missing.clear()
        self.order.note_instance(info.instance)
        self.info = info


class Fleet:
    """All gateways that were heard."""

    def __init__(self, base_topic: str = "mocap", wearers: Mapping[str, str] | None = None) -> None:
        """Know no gateway yet. wearers: who wears the suit of a gateway, by its name."""
        self.gateways: dict[str, SeenGateway] = {}
        self._topics = Topics(base_topic, ANY_GATEWAY)
        self._wearers = dict(wearers or {})

    def take(self, topic: str, payload: bytes, *, is_retained: bool, now_s: float, utc_ns: int) -> None:
        """Take a message; what is not what its topic promises is left out. now_s: monotonic."""
        address = self._topics.split(topic)
        if address is None or (address[0] not in self.gateways and len(self.gateways) >= MOST_GATEWAYS):
            return
        name, below = address
        if not self._is_there(name, below, payload):
            return
        if below in (topics.POSE, topics.LATE_POSE):
            head = _HEAD.match(payload)
            if head is not None and not is_retained:
                seen, t_ns, seq = self.gateways.setdefault(name, SeenGateway()), int(head[1]), int(head[2])
                if below == topics.POSE:
                    seen.pose(t_ns, seq, now_s, utc_ns)
                elif seen.is_of_this_run(payload):
                    seen.late_pose(seq)
            return
        try:
            self._take_other(self.gateways.setdefault(name, SeenGateway()), below, payload)
        except (ValidationError, orjson.JSONDecodeError):
            return

    def _is_there(self, name: str, below: str, payload: bytes) -> bool:
        """Return whether a message is of somebody who has not left. A pose may still be on its way then, over
        another connection: who comes back says so first."""
        known = self.gateways.get(name)
        if not payload:
            if below == topics.BRIDGE_STATE and known is not None:
                self.gateways[name] = SeenGateway(has_left=True)
            return False
        if known is None or not known.has_left:
            return True
        if below not in _ANNOUNCED:
            return False
        del self.gateways[name]
        return True

    def _take_other(self, seen: SeenGateway, below: str, payload: bytes) -> None:
        match below:
            case topics.BRIDGE_STATE:
                state = orjson.loads(payload)
                seen.state = "online" if state == {"state": "online"} else "offline"
            case topics.BRIDGE_INFO:
                seen.note_info(BridgeInfo.model_validate_json(payload))
            case topics.BRIDGE_HEALTH:
                seen.health = BridgeHealth.model_validate_json(payload)
            case topics.BODY:
                seen.body = BodyMessage.model_validate_json(payload)
            case _ if module := _MODULE.fullmatch(below):
                content = orjson.loads(payload)
                firmware = content.get("firmware") if isinstance(content, dict) else None
                if isinstance(firmware, str):
                    seen.firmware[int(module[1])] = firmware[:40]

    def rows(self, now_s: float) -> list[OverviewRow]:
        """Return a row for each gateway, by name."""
        there = {name: seen for name, seen in sorted(self.gateways.items()) if not seen.has_left}
        versions = Counter(seen.info.version for seen in there.values() if seen.info is not None)
        usual = versions.most_common(1)[0][0] if versions else None
        return [self._row(name, seen, now_s, usual) for name, seen in there.items()]

    def _row(self, name: str, seen: SeenGateway, now_s: float, usual: str | None) -> OverviewRow:
        window = [each for each in seen.window if now_s - each.begun_s < WINDOW_S]
        received, lost = sum(each.received for each in window), sum(each.missing for each in window)
        delays = sorted(each.delay_s for each in window if each.delay_s is not None)
        span_s = now_s - window[0].begun_s if window else 0.0
        recording = seen.health.statistics.get("recording") if seen.health is not None else None
        free_mb = recording.get("free_mb") if isinstance(recording, dict) else None
        row = OverviewRow(
            gateway=name,
            wearer=self._wearers.get(name),
            state=seen.state,
            rate_hz=round(received / span_s, 1) if span_s > 0 else 0.0,
            loss=round(lost / (received + lost), 4) if received else 0.0,
            delay_ms=round(delays[len(delays) // 2] * 1e3, 1) if delays else None,
            lost=seen.lost,
            late=seen.late,
            free_gb=round(free_mb / 1e3, 1) if isinstance(free_mb, int | float) else None,
            version=None if seen.info is None else seen.info.version,
            firmware=tuple(sorted(set(seen.firmware.values()))),
            alerts=(),
        )
        return replace(row, alerts=tuple(_alerts(row, seen, now_s, usual)))


def _alerts(row: OverviewRow, seen: SeenGateway, now_s: float, usual: str | None) -> list[str]:
    """Return what somebody should look at, in words."""
    found = []
    if row.state == "offline":
        found.append("offline")
    elif row.state == "online" and (seen.last_s is None or now_s - seen.last_s > SILENT_S):
        found.append("online, but no poses come")
    if row.loss > MOST_LOSS:
        found.append(f"{row.loss:.1%} of the poses are lost")
    if row.delay_ms is not None and row.delay_ms > MOST_DELAY_S * 1e3:
        found.append(f"poses are {row.delay_ms:.0f} ms late")
    if row.version not in (None, usual):
        found.append(f"version {row.version}, others have {usual}")
    if len(row.firmware) > 1:
        found.append(f"modules with different firmware: {', '.join(row.firmware)}")
    health = seen.health
    if health is not None:
        if health.same_name is not None:
            found.append("another gateway has the same name")
        if health.refused_topics:
            found.append(f"the broker refuses {health.refused_topics[0]}")
        recording = health.statistics.get("recording")
        if isinstance(recording, dict) and recording.get("is_low"):
            found.append("the disk is nearly full")
    return found


Take = Callable[[aiomqtt.Message], None]

MOST_WAITING = 20_000
"""Messages that may wait for one who listens to a whole fleet: some seconds of a hundred gateways."""


def listener(settings: MqttSettings, take: Take) -> Receiver:
    """Return what gives every message of all gateways to ``take``, late poses too. Wants an event loop."""
    own = Topics(settings.base_topic, ANY_GATEWAY)
    passing = [own.pose, own.late_pose, own.bridge_health]
    kept = [own.bridge_state, own.bridge_info, own.body, f"{own.root}/module/+/state"]
    return Receiver(settings, "fleet", passing, kept, take, MOST_WAITING, reads_both=False)


def take_into(fleet: Fleet) -> Take:
    """Return what ``listener`` is to call for a fleet."""

    def take(message: aiomqtt.Message) -> None:
        if isinstance(message.payload, bytes):
            fleet.take(
                message.topic.value,
                message.payload,
                is_retained=message.retain,
                now_s=time.monotonic(),
                utc_ns=time.time_ns(),
            )

    return take


def as_plain(rows: list[OverviewRow]) -> list[dict[str, Any]]:
    """Return rows as JSON values."""
    return [asdict(row) for row in rows]
