"""Outputs of the daemon: MQTT topics, the log, recordings, metrics and LSL streams."""
