"""Where skeleton frames go: MQTT, and beside it VMC, UDP and LSL.

``mqtt.MqttOutput`` publishes them, ``PoseSubscriber`` receives them; ``messages`` declares every payload
and ``topics`` where it is published. Reading order: ``messages``, ``topics``, ``settings``,
``mqtt``, ``connection``, ``pose_encoding``, ``queues``, ``subscriber``, ``broker_process``; then
``side_outputs``, ``unity``.
"""

from gateway.contract.messages import BridgeInfo, ModuleInfo, PoseMessage
from gateway.contract.topics import Topics
from gateway.outputs.broker_process import BrokerProcess, EmbeddedBrokerError
from gateway.outputs.output import Output
from gateway.outputs.settings import MqttSettings, PoseMap, TlsSettings
from gateway.outputs.subscriber import BrokerUnreachableError, PoseSubscriber, ReceivedPose
from gateway.support.credentials import CredentialError

__all__ = [
    "BridgeInfo",
    "BrokerProcess",
    "BrokerUnreachableError",
    "CredentialError",
    "EmbeddedBrokerError",
    "ModuleInfo",
    "MqttSettings",
    "Output",
    "PoseMap",
    "PoseMessage",
    "PoseSubscriber",
    "ReceivedPose",
    "TlsSettings",
    "Topics",
]
