"""Connection to an MQTT broker, publisher, outbox, client, TLS, secrets and signatures."""

from jointfit_daemon.outputs.mqtt._client import MqttClient, NoAnswer
from jointfit_daemon.outputs.mqtt._connection import (
    PAYLOAD_VERSION,
    BrokerLost,
    Incoming,
    LoopNoise,
)
from jointfit_daemon.outputs.mqtt._outbox import Outbox
from jointfit_daemon.outputs.mqtt._publisher import OFFLINE, ONLINE, MqttPublisher, command_of
from jointfit_daemon.outputs.mqtt._secret_files import NoKey, request_key_of
from jointfit_daemon.outputs.mqtt._signature import (
    FRESH_US,
    SIGNING_KEYS,
    NotSigned,
    signed,
    verify,
)

__all__ = [
    "FRESH_US",
    "OFFLINE",
    "ONLINE",
    "PAYLOAD_VERSION",
    "SIGNING_KEYS",
    "BrokerLost",
    "Incoming",
    "LoopNoise",
    "MqttClient",
    "MqttPublisher",
    "NoAnswer",
    "NoKey",
    "NotSigned",
    "Outbox",
    "command_of",
    "request_key_of",
    "signed",
    "verify",
]
