"""Outputs of the daemon: MQTT topics, the log, and the recording of input events."""
