"""Connection to an MQTT broker, publisher, outbox, client, TLS, secrets and signatures."""

from jointfit_daemon.outputs.mqtt._client import MqttClient, NoAnswerError
from jointfit_daemon.outputs.mqtt._connection import (
    PAYLOAD_VERSION,
    BrokerLostError,
    DisconnectErrorFilter,
    Incoming,
)
from jointfit_daemon.outputs.mqtt._outbox import Outbox
from jointfit_daemon.outputs.mqtt._publisher import OFFLINE, ONLINE, MqttPublisher, command_of
from jointfit_daemon.outputs.mqtt._secret_files import RequestKeyError, request_key_of
from jointfit_daemon.outputs.mqtt._signature import (
    SIGNATURE_LIFETIME_US,
    SIGNING_KEYS,
    SignatureRejectedError,
    signed,
    verify,
)

__all__ = [
    "OFFLINE",
    "ONLINE",
    "PAYLOAD_VERSION",
    "SIGNATURE_LIFETIME_US",
    "SIGNING_KEYS",
    "BrokerLostError",
    "DisconnectErrorFilter",
    "Incoming",
    "MqttClient",
    "MqttPublisher",
    "NoAnswerError",
    "Outbox",
    "RequestKeyError",
    "SignatureRejectedError",
    "command_of",
    "request_key_of",
    "signed",
    "verify",
]
