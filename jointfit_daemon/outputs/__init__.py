"""Where results go: MQTT and the event log."""
