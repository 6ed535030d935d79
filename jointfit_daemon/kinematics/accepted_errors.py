"""Accepted marker errors of inverse kinematics in biomechanics.

Source: OpenSim documentation, "Simulation with OpenSim: Best Practices", checklist of inverse
kinematics. The limits are an RMS error of about 2 cm, a marker error of 4 cm, and a landmark error
of 2 cm. Hicks et al. 2015, doi 10.1115/1.4029304, describe the same practice.
"""

from __future__ import annotations

ACCEPTED_RMS_M = 0.02
"""Largest accepted RMS over markers and frames, m."""
ACCEPTED_MAXIMUM_M = 0.04
"""Largest accepted error of a single marker in a single frame, m."""


def is_accepted(rms: float, maximum: float) -> bool:
    """Return whether RMS and largest marker error, m, are within the accepted limits."""
    return rms < ACCEPTED_RMS_M and maximum < ACCEPTED_MAXIMUM_M
