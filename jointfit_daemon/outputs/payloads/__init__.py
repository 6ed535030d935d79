"""JSON payloads of the MQTT topics, and the writer that puts core outputs into an outbox."""

from jointfit_daemon.outputs.payloads._encoding import encode, encode_joint, encode_pose
from jointfit_daemon.outputs.payloads._topic_writer import TopicWriter

__all__ = ["TopicWriter", "encode", "encode_joint", "encode_pose"]
