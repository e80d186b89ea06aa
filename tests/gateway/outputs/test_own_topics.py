"""What a gateway learns of its own topics, without a broker."""

from __future__ import annotations

import logging

import pytest
from hypothesis import given
from hypothesis import strategies as st
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.reasoncodes import ReasonCode

from gateway.contract.topics import Topics
from gateway.outputs.own_topics import FORGET_S, PublishRights, TwinWatch

TOPICS = Topics("mocap", "lab")
GOOD = ReasonCode(PacketTypes.PUBACK, "Success")
NOBODY = ReasonCode(PacketTypes.PUBACK, "No matching subscribers")
BAD = ReasonCode(PacketTypes.PUBACK, "Not authorized")


def test_a_refused_topic_is_told_once_and_forgotten_when_it_is_taken_again(caplog):
    rights = PublishRights(are_reported=True)
    assert rights.state == "unknown"
    rights.answered("mocap/lab/pose", BAD)
    rights.answered("mocap/lab/body", BAD)
    rights.answered("mocap/lab/bridge/state", GOOD)
    assert rights.state == "refused"
    assert rights.refused == {"mocap/lab/pose": "Not authorized", "mocap/lab/body": "Not authorized"}
    assert len(caplog.records) == 1
    rights.answered("mocap/lab/pose", NOBODY)
    rights.answered("mocap/lab/body", GOOD)
    assert rights.state == "allowed"
    rights.begin_again()
    assert rights.state == "unknown"


def test_an_answer_of_mqtt_3_1_1_says_nothing():
    rights = PublishRights(are_reported=False)
    rights.answered("mocap/lab/pose", GOOD)
    assert rights.state == "unknown"


class Clock:
    now_s = 100.0

    def __call__(self):
        return self.now_s


def test_the_broker_is_asked_now_and_then_and_no_pose_passes_by_while_it_refuses():
    clock = Clock()
    rights = PublishRights(are_reported=True, clock=clock)
    assert rights.is_due
    rights.asked()
    assert not rights.is_due
    assert not rights.wants_answer
    rights.answered("mocap/lab/pose", BAD)
    assert rights.wants_answer
    assert not rights.is_due
    clock.now_s += 2.0
    assert rights.is_due
    rights.asked()
    rights.begin_again()  # with another connection
    assert rights.is_due
    assert not PublishRights(are_reported=False, clock=clock).wants_answer


@pytest.fixture
def watch():
    return TwinWatch(TOPICS, "own", Clock())


def test_only_a_message_that_comes_now_proves_another_gateway(watch, caplog):
    watch.take(TOPICS.bridge_info, b'{"instance": "old"}', is_retained=True)
    assert not watch.is_suspected
    watch.take(TOPICS.bridge_state, b'{"state": "online"}', is_retained=True)
    assert watch.is_suspected
    assert watch.twin is None
    watch.take(TOPICS.bridge_health, b'{"instance": "old"}', is_retained=False)
    assert watch.twin == "old"
    assert "instance old" in caplog.text
    assert "give one of them another name" in caplog.text
    watch._clock.now_s += FORGET_S
    assert watch.twin is None


def test_one_that_has_said_goodbye_is_not_suspected(watch):
    watch.take(TOPICS.bridge_info, b'{"instance": "old"}', is_retained=True)
    watch.take(TOPICS.bridge_state, b'{"state": "offline"}', is_retained=True)
    assert not watch.is_suspected


def test_our_own_messages_are_no_proof(watch):
    for topic in (TOPICS.bridge_info, TOPICS.bridge_health):
        watch.take(topic, b'{"instance": "own"}', is_retained=False)
        watch.take(topic, b"{}", is_retained=False)
    assert watch.twin is None


def test_a_goodbye_in_our_name_has_to_be_renewed_but_not_one_from_before(watch):
    offline = b'{"state": "offline"}'
    assert watch.take(TOPICS.bridge_state, offline, is_retained=False)
    assert not watch.take(TOPICS.bridge_state, offline, is_retained=True)
    assert not watch.take(TOPICS.bridge_state, b'{"state": "online"}', is_retained=False)


def test_ever_new_instances_do_not_fill_the_log(watch, caplog):
    caplog.set_level(logging.WARNING)
    for k in range(1000):
        watch.take(TOPICS.bridge_info, b'{"instance": "%d"}' % k, is_retained=False)
        watch._clock.now_s += 0.5
    assert len(caplog.records) <= 1


@given(st.sampled_from([TOPICS.bridge_state, TOPICS.bridge_info]), st.binary(max_size=60), st.booleans())
def test_whatever_comes_is_taken(topic, payload, is_retained):
    watch = TwinWatch(TOPICS, "own", Clock())
    watch.take(topic, payload, is_retained=is_retained)
    assert watch.twin is None
