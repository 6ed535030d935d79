"""JSON payloads of the MQTT topics, and the writer that puts core outputs into an outbox."""

from jointfit_daemon.outputs.payloads._encoding import encode, encode_joint, encode_pose
from jointfit_daemon.outputs.payloads._health_encoding import (
    BridgeHealth,
    ProcessHealth,
    StateHealth,
    health_payload,
)
from jointfit_daemon.outputs.payloads._quality_units import quality_payload
from jointfit_daemon.outputs.payloads._topic_writer import TopicWriter

__all__ = [
    "BridgeHealth",
    "ProcessHealth",
    "StateHealth",
    "TopicWriter",
    "encode",
    "encode_joint",
    "encode_pose",
    "health_payload",
    "quality_payload",
]
