"""What a link to heat maps at the broker says of itself; tests/system has the way through a broker."""

import pytest

from devices.endpoints import EndpointError
from devices.link import LinkError
from devices.links.tcp_link import TcpLink
from gateway.cameras.broker_link import BrokerLink, link_of
from gateway.outputs.settings import MqttSettings
from gateway.sources.link_settings import LinkSettings

MQTT = MqttSettings()


def made(url):
    return link_of(LinkSettings(name="cameras", url=url, carries="heat_maps"), MQTT, lambda: MQTT.port)


def test_a_topic_at_the_gateways_broker_and_other_links():
    assert isinstance(made("mqtt:///mocap_cameras/+"), BrokerLink)
    assert isinstance(made("tcp://localhost:9765"), TcpLink)


@pytest.mark.parametrize("url", ["mqtt://host/topic", "mqtt:///", "mqtt:///a?qos=1"])
def test_another_broker_or_no_topic_is_refused(url):
    with pytest.raises(EndpointError, match="the broker is that of the section 'mqtt': write mqtt:///TOPIC"):
        made(url)


def test_nothing_but_heat_maps_comes_over_mqtt():
    assert LinkSettings(name="cameras", url="mqtt:///topic").carries == "heat_maps"
    with pytest.raises(ValueError, match="carries heat_maps and nothing else: leave 'carries' out"):
        LinkSettings(name="cameras", url="mqtt:///topic", carries="gnss")


async def test_a_broker_that_is_away_is_told(unused_port):
    settings = MqttSettings(port=unused_port)
    link = BrokerLink("topic", settings, lambda: settings.port, "cameras")
    with pytest.raises(LinkError, match=f"no MQTT broker at 127.0.0.1:{unused_port}"):
        await link.open()
    await link.close()
