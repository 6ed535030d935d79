"""What is told of sensors that contradict each other. Law: words and figures only, no judgement."""

from __future__ import annotations

from math import degrees
from typing import TYPE_CHECKING

from jointfit_daemon.fusion.faults._sensor_monitor import SensorNews

if TYPE_CHECKING:
    from jointfit_daemon.fusion.faults._slip import PairWatch


def pair_told(pair: PairWatch, segment: str, turned: tuple[str, float] | None) -> SensorNews:
    """Return what to tell of a pair whose doubt began or ended.

    Parameters
    ----------
    pair : PairWatch
        Whose last look changed its mind.
    segment : str
        On which it sits.
    turned : tuple of str and float, optional
        The one of them whose heading is off against all others, and by how much, rad.
    """
    a, b = pair.link.a, pair.link.b
    data: dict[str, object] = {"pair": [a, b], "apart_deg": round(degrees(pair.apart), 1)}
    if not pair.doubtful:
        text = f"{a} and {b} lie as calibration had them again"
        return SensorNews(segment, "agrees", text, "info", data)
    text = f"{a} and {b} lie {degrees(pair.apart):.0f} deg from where calibration had them: "
    if turned is None:
        text += "one of them slipped; set it right, stand still and take a new static pose"
    else:
        name, angle = turned
        data |= {"turned": name, "heading_deg": round(degrees(angle), 1)}
        text += (
            f"the heading of {name} has turned by {degrees(angle):.0f} deg against all others, "
            "and that is taken out. Iron nearby? If it stays, take a new static pose"
        )
    return SensorNews(segment, "pair_disagrees", text, "warning", data)


def drift_told(heading: float, above: str, below: str, joint: str) -> SensorNews:
    """Return what to tell of a heading that has drifted, rad, `below` against `above`."""
    text = (
        f"its heading has drifted by {degrees(heading):.0f} deg against {above}; {joint} tells, "
        "and it is taken out. A new static pose sets headings anew"
    )
    data = {"heading_deg": round(degrees(heading), 1)}
    return SensorNews(below, "drift", text, "info", data)


def turn_told(heading: float, above: str, below: str, *, doubtful: bool) -> SensorNews:
    """Return what to tell of two segments whose headings came apart within seconds, rad."""
    data = {"heading_deg": round(degrees(heading), 1)}
    if not doubtful:
        text = f"its heading agrees with that of {above} again"
        return SensorNews(below, "agrees", text, "info", data)
    text = (
        f"its heading and that of {above} have turned by {degrees(heading):.0f} deg against each "
        "other: iron nearby? Angles between them are put right, the heading of both is uncertain. "
        "If it stays, take a new static pose"
    )
    return SensorNews(below, "heading_disagrees", text, "warning", data)
