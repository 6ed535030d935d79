"""Recorded and simulated subjects, joints, devices and clocks that experiments share."""
