"""MQTT: connection to a broker, publisher, outbox, client, TLS, secrets and signatures."""

from jointfit_daemon.outputs.mqtt._client import MqttClient, NoAnswerError
from jointfit_daemon.outputs.mqtt._connection import (
    BrokerLostError,
    DisconnectErrorFilter,
    Incoming,
    MqttConnection,
    Outgoing,
)
from jointfit_daemon.outputs.mqtt._outbox import Outbox
from jointfit_daemon.outputs.mqtt._publisher import LinkHealth, MqttPublisher
from jointfit_daemon.outputs.mqtt._rig_search import find_rigs
from jointfit_daemon.outputs.mqtt._secret_files import (
    RequestKeyError,
    missing_password,
    request_key_of,
)
from jointfit_daemon.outputs.mqtt._signature import (
    SIGNATURE_LIFETIME_US,
    SIGNING_KEYS,
    SignatureRejectedError,
    check_age,
    sign_request,
    verify,
)

__all__ = [
    "SIGNATURE_LIFETIME_US",
    "SIGNING_KEYS",
    "BrokerLostError",
    "DisconnectErrorFilter",
    "Incoming",
    "LinkHealth",
    "MqttClient",
    "MqttConnection",
    "MqttPublisher",
    "NoAnswerError",
    "Outbox",
    "Outgoing",
    "RequestKeyError",
    "SignatureRejectedError",
    "check_age",
    "find_rigs",
    "missing_password",
    "request_key_of",
    "sign_request",
    "verify",
]
