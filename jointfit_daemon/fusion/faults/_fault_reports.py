"""Texts and data of the events that report contradictions between sensors."""

from __future__ import annotations

from math import degrees
from typing import TYPE_CHECKING

from jointfit_daemon.fusion.faults._sensor_monitor import SensorReport

if TYPE_CHECKING:
    from jointfit_daemon.fusion.faults._slip import SlipDetector


def slip_report(
    pair: SlipDetector, segment: str, disturbed: tuple[str, float] | None
) -> SensorReport:
    """Return the report of a pair of sensors that became inconsistent or consistent.

    Parameters
    ----------
    pair : SlipDetector
        The pair, after the update that changed its state.
    segment : str
        Segment of the pair.
    disturbed : tuple of str and float, optional
        Sensor of the pair whose heading deviates from all other sensors, and its deviation, rad.
    """
    a, b = pair.link.a, pair.link.b
    data: dict[str, object] = {"pair": [a, b], "apart_deg": round(degrees(pair.distance), 1)}
    if not pair.inconsistent:
        text = f"{a} and {b} agree with the calibration again"
        return SensorReport(segment, "agrees", text, "info", data)

    text = (
        f"relative orientation of {a} and {b} differs by {degrees(pair.distance):.0f} deg from the "
        "calibration: "
    )
    if disturbed is None:
        text += "one of them slipped; reattach it and repeat the static pose"
    else:
        name, angle = disturbed
        data |= {"turned": name, "heading_deg": round(degrees(angle), 1)}
        text += (
            f"heading of {name} deviates by {degrees(angle):.0f} deg from all other sensors and is "
            "corrected; probably a magnetic disturbance. If it persists, repeat the static pose"
        )
    return SensorReport(segment, "pair_disagrees", text, "warning", data)


def drift_report(heading: float, proximal: str, distal: str, joint: str) -> SensorReport:
    """Return the report of a drift by `heading` rad of segment `distal` relative to `proximal`."""
    text = (
        f"heading drifted by {degrees(heading):.0f} deg relative to {proximal} (estimated at "
        f"{joint}, corrected). A new static pose resets the headings"
    )
    data = {"heading_deg": round(degrees(heading), 1)}
    return SensorReport(distal, "drift", text, "info", data)


def heading_report(
    heading: float, proximal: str, distal: str, *, inconsistent: bool
) -> SensorReport:
    """Return the report of two segments whose headings diverged, or agree again.

    `heading` is the difference that appeared within seconds, rad.
    """
    data = {"heading_deg": round(degrees(heading), 1)}
    if not inconsistent:
        text = f"heading agrees with {proximal} again"
        return SensorReport(distal, "agrees", text, "info", data)
    text = (
        f"heading changed by {degrees(heading):.0f} deg relative to {proximal}; probably a "
        "magnetic disturbance. Joint angles are corrected, the headings of both segments are "
        "uncertain. If it persists, repeat the static pose"
    )
    return SensorReport(distal, "heading_disagrees", text, "warning", data)
