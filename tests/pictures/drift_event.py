"""Drawing of a heading drift: event, and error of knee rotation with and without correction.

The subject is simulated, the calibration and the fusion are those of the daemon.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bench.subjects import faulty_wearer
from bench.subjects.simulated_wearer import bench_rig
from jointfit_daemon.fusion import LimbFuser
from jointfit_daemon.kinematics import rotation
from tests.pictures.svg_style import document, points, text

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.fusion import SensorReport

SEED, SECONDS, RATE_HZ = 1, 180.0, 25.0
DRIFT_FROM_S, DRIFT_DEG_PER_MIN = 30.0, 10.0
DRIFTING = ("S3", "S4")
"""Both sensors of the shank."""
MEAN_S = 15.0
"""Window of the moving RMS, s: the duration of one motion of the subject."""
LEFT, RIGHT, TOP, BOTTOM = 74.0, 740.0, 96.0, 330.0
LARGEST_DEG = 20.0


class DriftRun(NamedTuple):
    """Error of the knee rotation in a run with heading drift."""

    t_s: Array
    uncorrected_deg: Array
    """Moving RMS, shape (n,)."""
    corrected_deg: Array
    event_s: float
    event: str


def run() -> DriftRun:
    """Run the fusion with heading drift, with and without its correction; return the errors."""
    calibration = faulty_wearer.calibrated(SEED)
    assert calibration is not None
    person = faulty_wearer.live(SEED, SECONDS, RATE_HZ)
    rate = float(np.deg2rad(DRIFT_DEG_PER_MIN)) / 60.0
    turn = rotation.heading(rate * np.maximum(person.t_s - DRIFT_FROM_S, 0.0))
    for name in DRIFTING:
        person = person.with_orientations(name, rotation.multiply(turn, person.orientations[name]))

    errors: dict[bool, Array] = {}
    reports: list[tuple[float, SensorReport]] = []
    for corrected in (False, True):
        fuser = LimbFuser(bench_rig().chain, calibration)
        if not corrected:
            fuser.consistency = None
        states, reports = faulty_wearer.play(fuser, person)
        errors[corrected] = moving_rms(np.rad2deg(faulty_wearer.joint_errors(states, person)))
    event_s, report = next((t_s, news) for t_s, news in reports if news.state == "drift")
    return DriftRun(person.t_s, errors[False], errors[True], event_s, f"{report.id} {report.text}")


def moving_rms(values: Array) -> Array:
    """Return, for each sample, the RMS of the values of the last `MEAN_S` seconds, shape (n,)."""
    squares = np.concatenate([[0.0], np.cumsum(values**2)])
    ends = np.arange(1, len(values) + 1)
    begins = np.maximum(ends - round(MEAN_S * RATE_HZ), 0)
    return np.asarray(np.sqrt((squares[ends] - squares[begins]) / (ends - begins)))


def draw(found: DriftRun) -> str:
    """Return the drawing."""

    def x(t_s: float) -> float:
        return LEFT + (RIGHT - LEFT) * t_s / SECONDS

    def y(degrees: float) -> float:
        return BOTTOM - (BOTTOM - TOP) * degrees / LARGEST_DEG

    def curve(values: Array, kind: str) -> str:
        rows = slice(int(MEAN_S * RATE_HZ), None, 12)
        pairs = zip(found.t_s[rows].tolist(), values[rows].tolist(), strict=True)
        return f'<polyline class="line {kind}" points="{points((x(t), y(v)) for t, v in pairs)}"/>'

    body = [
        text(
            24, 36, "Knee rotation: error while the heading of the shank sensors drifts", "strong"
        ),
        text(24, 62, f"RMS of the last {MEAN_S:g} s; drift of {DRIFT_DEG_PER_MIN:g}° per minute"),
    ]
    for degrees in (0, 5, 10, 15, 20):
        body.append(f'<path class="grid" d="M{LEFT} {y(degrees):.1f} H{RIGHT}"/>')
        body.append(text(LEFT - 10, y(degrees) + 6, f"{degrees}°", "soft right"))
    body += [text(x(t), BOTTOM + 26, f"{t} s", "soft middle") for t in range(0, 181, 30)]
    for t_s, words in ((DRIFT_FROM_S, "drift begins"), (found.event_s, "event")):
        body.append(f'<path class="line dashed gray" d="M{x(t_s):.1f} {TOP} V{BOTTOM}"/>')
        body.append(text(x(t_s) + 8, TOP + 16, words))
    body += [
        curve(found.uncorrected_deg, "orange"),
        curve(found.corrected_deg, "blue"),
        text(x(150), y(9.6), "without correction", "orange-text strong right"),
        text(x(164), y(5.3), "with correction", "blue-text strong right"),
        text(24, 388, f"Event at {found.event_s:.0f} s: “{found.event.split(' (')[0]}”"),
    ]
    description = (
        f"Error of the knee rotation of a simulated subject. From {DRIFT_FROM_S:g} s on the heading"
        f" of both shank sensors drifts. Without correction the error grows to"
        f" {found.uncorrected_deg[-1]:.0f} degrees within {SECONDS:g} s, with correction it stays"
        f" below {found.corrected_deg[int(MEAN_S * RATE_HZ) :].max():.1f} degrees. The event is"
        f" published at {found.event_s:.0f} s."
    )
    return document((770, 408), "Heading drift without and with correction", description, body)
