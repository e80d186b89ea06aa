"""Two gateways of one name, and a broker whose access list refuses what a gateway publishes."""

from __future__ import annotations

import asyncio
import os
import subprocess
from types import SimpleNamespace

import pytest

from gateway.body.rig import load_rig
from gateway.errors import OutputError
from gateway.outputs import own_topics
from gateway.outputs.mqtt import MqttOutput
from gateway.outputs.settings import PASSWORD_VARIABLE, MqttSettings
from gateway.outputs.subscriber import PoseSubscriber
from gateway.service.service import Service
from gateway.settings import GatewaySettings

pytestmark = pytest.mark.system

NAME = f"twins_{os.getpid()}"


@pytest.fixture(params=["3.1.1", "5"])
def settings(request, mosquitto):
    return MqttSettings(port=mosquitto.port, protocol=request.param, health_interval=0.2)


async def test_two_of_one_name_notice_each_other_and_the_one_that_stays_is_online(
    settings, pose_source, until, caplog
):
    info = pose_source.info(NAME)
    async with MqttOutput(settings, pose_source.skeleton, info) as first:
        await until(lambda: first.is_connected)
        async with MqttOutput(settings, pose_source.skeleton, info) as second:
            await until(lambda: first.twin == second.instance and second.twin == first.instance)
            assert first.health().same_name == second.instance
        # The broker has the second's goodbye by now, and nobody else would take it back.
        async with PoseSubscriber(settings, NAME) as late_comer:
            await until(lambda: late_comer.states.get(NAME) == "online")
    assert caplog.text.count("another gateway publishes on") == 2


async def test_one_alone_has_no_twin_after_a_restart(settings, pose_source, until, caplog):
    info = pose_source.info(NAME)
    for _ in range(2):
        async with MqttOutput(settings, pose_source.skeleton, info) as output:
            await until(lambda: output.is_connected)
            await asyncio.sleep(0.3)
            assert output.twin is None
    assert "another gateway" not in caplog.text


async def test_the_later_one_ends_where_it_is_to_be_alone(settings, pose_source, until, tmp_path):
    alone = settings.model_copy(update={"same_name": "refuse"})
    async with MqttOutput(alone, pose_source.skeleton, pose_source.info(NAME)) as first:
        await until(lambda: first.is_connected)
        gateway = GatewaySettings(
            gateway=NAME, links=[{"name": "suit", "url": str(tmp_path / "absent")}], rig="single", mqtt=alone
        )
        service = Service(gateway, load_rig("single"))
        with pytest.raises(
            OutputError, match=f"another gateway named '{NAME}' publishes at .*{first.instance}"
        ):
            await asyncio.wait_for(service.run(), 60)
        assert first.is_connected
        assert service.mqtt.counters.connections == 0


@pytest.fixture
def forbidding(mosquitto, tmp_path, monkeypatch):
    """A broker whose access list lets the user write below ``bridge`` only; writes another list."""
    mosquitto.is_for_gateways_only = False  # who reads along needs a password here
    passwords, acl = tmp_path / "passwords", tmp_path / "acl"
    subprocess.run(["mosquitto_passwd", "-b", "-c", str(passwords), "suit", "open sesame"], check=True)
    monkeypatch.setenv(PASSWORD_VARIABLE, "open sesame")

    def allow(*topics):
        lines = [f"topic write {topic}" for topic in topics]
        acl.write_text("\n".join(["user suit", "topic read mocap/#", *lines]) + "\n")
        acl.chmod(0o600)

    allow(f"mocap/{NAME}/bridge/#")
    mosquitto.configure(f"allow_anonymous false\npassword_file {passwords}\nacl_file {acl}")
    mosquitto.restart()
    return mosquitto, allow


@pytest.mark.parametrize("protocol", ["3.1.1", "5"])
async def test_poses_that_the_broker_refuses_do_not_count_as_published(
    forbidding, pose_source, until, protocol, caplog
):
    mosquitto, allow = forbidding
    settings = MqttSettings(port=mosquitto.port, protocol=protocol, username="suit")
    output = MqttOutput(settings, pose_source.skeleton, pose_source.info(NAME))
    async with output:
        await until(lambda: output.is_connected)
        for sequence in range(100):
            output.offer(pose_source.frame(sequence))
        await until(lambda: output.counters.queued == 0)
        if protocol == "3.1.1":  # the broker takes everything and says nothing
            assert output.health().publishing == "unknown"
            assert output.counters.published == 100
            return
        assert (output.counters.published, output.counters.dropped) == (0, 100)
        health = output.health()
        assert health.publishing == "refused"
        assert set(health.refused_topics) == {f"mocap/{NAME}/pose", f"mocap/{NAME}/body"}
        assert "its access list must let this user write there" in caplog.text

        allow("mocap/#")
        mosquitto.restart()
        await until(lambda: output.counters.connections == 2)
        output.offer(pose_source.frame(1))
        await until(lambda: output.counters.published == 1)
        assert output.health().publishing == "allowed"


async def test_health_is_degraded_while_the_broker_refuses_or_a_twin_is_heard(
    mosquitto, tmp_path, monkeypatch
):
    gateway = GatewaySettings(
        gateway=NAME,
        links=[{"name": "suit", "url": str(tmp_path / "absent")}],
        rig="single",
        mqtt={"port": mosquitto.port, "protocol": "5"},
    )
    service = Service(gateway, load_rig("single"))
    module = SimpleNamespace(module=1, availability="online")
    fed = SimpleNamespace(
        links=[], modules=[module], connected={"mqtt": True}, skeleton_frames=0, balances=[]
    )
    monkeypatch.setattr(service.observer, "figures", lambda: fed)
    health = service.observer.health()
    assert health["status"] == "ok"
    assert health["outputs_publishing"] == {"mqtt": "unknown"}
    assert (health["topics_refused"], health["same_name"]) == ([], None)
    service.mqtt.rights.refused["mocap/pose"] = "Not authorized"
    health = service.observer.health()
    assert health["status"] == "degraded"
    assert health["outputs_publishing"] == {"mqtt": "refused"}
    assert health["topics_refused"] == ["mocap/pose"]
    service.mqtt.rights.begin_again()
    assert service.observer.health()["status"] == "ok"
    monkeypatch.setattr(own_topics.TwinWatch, "twin", property(lambda _: "other"))
    health = service.observer.health()
    assert (health["status"], health["same_name"]) == ("degraded", "other")
