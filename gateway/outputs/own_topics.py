"""What a gateway can learn of its own topics: whether a broker takes what it publishes, and whether another
gateway publishes there too. Sans-I/O.

MQTT 5 answers every publication of QoS 1 with a reason. MQTT 3.1.1 knows no such answer: a broker whose
access list forbids a message takes it and drops it, and nobody is told.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Literal

import orjson
from paho.mqtt.reasoncodes import ReasonCode

from gateway.contract.topics import Topics

_log = logging.getLogger(__name__)

Publishing = Literal["allowed", "refused", "unknown"]

WARN_INTERVAL_S = 60.0
"""Between two warnings of one kind: what comes over a broker may be anybody's."""
_PROBE_INTERVAL_S = 2.0
"""Between two poses that the broker is to answer for."""
FORGET_S = 30.0
"""A gateway of the same name that was not heard for so long is gone."""


class PublishRights:
    """Which topics the broker refuses to take messages on."""

    def __init__(self, are_reported: bool, clock: Callable[[], float] = time.monotonic) -> None:
        """are_reported: whether the broker reports refusals, as with MQTT 5; clock in s."""
        self.refused: dict[str, str] = {}
        """Reason by topic."""
        self.are_reported = are_reported
        self._has_answer = False
        self._clock = clock
        self._due_s = 0.0

    @property
    def state(self) -> Publishing:
        """``unknown`` before the first answer, and always where the broker does not tell."""
        if self.refused:
            return "refused"
        return "allowed" if self._has_answer else "unknown"

    def begin_again(self) -> None:
        """Forget all: a new connection may have other rights."""
        self.refused.clear()
        self._has_answer = False
        self._due_s = 0.0

    @property
    def is_due(self) -> bool:
        """Whether the next pose is one that the broker has to answer for."""
        return self.are_reported and self._clock() >= self._due_s

    @property
    def wants_answer(self) -> bool:
        """Whether the next pose is such a one, or some topics are refused."""
        return self.are_reported and (bool(self.refused) or self._clock() >= self._due_s)

    def asked(self) -> None:
        """Note that a pose goes out for which the broker has to answer."""
        self._due_s = self._clock() + _PROBE_INTERVAL_S

    def answered(self, topic: str, code: ReasonCode) -> None:
        """Note how the broker answered a publication of QoS 1."""
        if not self.are_reported:
            return
        self._has_answer = True
        if not code.is_failure:
            if self.refused.pop(topic, None) is not None:
                _log.info("the broker takes messages on %s again", topic)
            return
        if not self.refused:
            _log.warning(
                "the broker refuses messages on %s (%s): its access list must let this user write there",
                topic,
                code,
            )
        self.refused[topic] = str(code)


class TwinWatch:
    """Finds another gateway of the same name by what it publishes on the topics of both."""

    def __init__(self, topics: Topics, instance: str, clock: Callable[[], float] = time.monotonic) -> None:
        """instance: our own id; clock in s."""
        self.watched = (topics.bridge_state, topics.bridge_info, topics.bridge_health)
        self._topics = topics
        self._instance = instance
        self._clock = clock
        self._twin: str | None = None
        self._received_s = 0.0
        self._warned_s: float | None = None
        self._retained_other = self._retained_online = False

    @property
    def twin(self) -> str | None:
        """Id of another gateway of our name that was heard lately."""
        is_recent = self._twin is not None and self._clock() - self._received_s < FORGET_S
        return self._twin if is_recent else None

    @property
    def is_suspected(self) -> bool:
        """Whether what the broker kept is of another gateway that has not said goodbye. It may have died
        together with a broker: only a message that comes now is a proof."""
        return self._retained_other and self._retained_online

    def take(self, topic: str, payload: bytes, *, is_retained: bool) -> bool:
        """Take a message of a watched topic; whether our own state and info must be published anew, since
        somebody else has said in our name that we are offline."""
        try:
            content = orjson.loads(payload)
        except orjson.JSONDecodeError:
            return False
        if not isinstance(content, dict):
            return False
        if topic == self._topics.bridge_state:
            is_offline = content.get("state") == "offline"
            self._retained_online = is_retained and not is_offline
            return is_offline and not is_retained
        instance = content.get("instance")
        if isinstance(instance, str) and instance != self._instance:
            if is_retained:
                self._retained_other = True
            else:
                self._note(instance[:64])
        return False

    def _note(self, instance: str) -> None:
        now_s = self._clock()
        is_new = self.twin is None
        self._twin, self._received_s = instance, now_s
        if is_new and (self._warned_s is None or now_s - self._warned_s > WARN_INTERVAL_S):
            self._warned_s = now_s
            _log.warning(
                "another gateway publishes on %s (instance %s, this one is %s): their poses are mixed; "
                "give one of them another name ('gateway:' in its configuration)",
                self._topics.root,
                instance,
                self._instance,
            )
