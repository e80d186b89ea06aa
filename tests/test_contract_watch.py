"""The watch that system tests rely on notices what it should."""

from __future__ import annotations

import pytest
from paho.mqtt import publish

from gateway.outputs.mqtt import MqttOutput
from gateway.outputs.settings import MqttSettings
from tests.contract_watch import ContractWatch, assert_kept


@pytest.fixture
def watch(unused_port):
    watch = ContractWatch("127.0.0.1", unused_port)
    yield watch
    watch.stop()


@pytest.mark.parametrize(
    ("topic", "payload"),
    [
        ("mocap/lab/pose", b"{}"),
        ("mocap/lab/bridge/state", b'{"state":"asleep"}'),
        ("mocap/lab/bridge/state", b'{"state":"online","colour":"red"}'),
        ("mocap/lab/module/3/availability", b"online"),
        ("mocap/lab/something/else", b'{"state":"online"}'),
        ("mocap/lab/pose/msgpack", b"\xc1"),
    ],
)
def test_what_the_contract_does_not_have_is_noticed(watch, topic, payload):
    watch.take(topic, payload)
    with pytest.raises(AssertionError, match=topic):
        assert_kept(watch)


def test_what_it_has_passes_and_is_counted(watch):
    watch.take("mocap/lab/bridge/state", b'{"state":"online"}')
    watch.take("mocap/lab/bridge/response/modules/list", b'{"status":"ok","data":{},"error":null}')
    watch.take("mocap/lab/bridge/request/modules/list", b"whatever a test asks")
    assert_kept(watch)
    assert watch.messages == {"BridgeState": 1, "ResponseMessage": 1}


@pytest.mark.system
async def test_it_reads_along_on_a_real_broker(mosquitto, pose_source, until):

    watch = ContractWatch(mosquitto.host, mosquitto.port)
    async with MqttOutput(
        MqttSettings(port=mosquitto.port), pose_source.skeleton, pose_source.info()
    ) as output:
        await until(lambda: watch.messages["BodyMessage"] == 1 and output.is_connected)
        output.offer(pose_source.frame(1))
        await until(lambda: watch.messages["PoseMessage"] == 1)
    watch.stop()
    assert_kept(watch)


@pytest.mark.system
def test_all_that_was_relayed_is_judged_when_the_watch_has_settled(own_watch, mosquitto):
    mosquitto.is_for_gateways_only = False
    sent = [("mocap/lab/pose", b"{}", 1, False)] * 100  # confirmed: the broker has relayed them
    publish.multiple(sent, hostname=mosquitto.host, port=mosquitto.port)
    own_watch.settle()
    assert len(own_watch.problems) == 100


@pytest.fixture
async def own_watch(mosquitto, until):
    watch = ContractWatch(mosquitto.host, mosquitto.port)
    publish.single("mocap/lab/pose", b"{}", hostname=mosquitto.host, port=mosquitto.port, retain=True)
    await until(lambda: watch.problems)  # it has subscribed
    watch.problems.clear()
    yield watch
    watch.stop()
