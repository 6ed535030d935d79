"""Stillness, sensor-to-segment and world alignment, orientation on the gateway."""
