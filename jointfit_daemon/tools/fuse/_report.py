"""Evaluations, fits and fused limbs as text (degrees) and as JSON (SI units)."""

from __future__ import annotations

from math import degrees, isfinite
from typing import TYPE_CHECKING, Any

from jointfit_daemon.tools.flag_words import flag_sentence
from jointfit_daemon.tools.text_output import align_columns

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.calibration.phases import MethodEvaluation, MethodScore
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.tools.fuse._output import FusedTrial

BASELINE = "mean"
"""Method with which the other methods are compared."""
_DIGITS = 2
"""Number of decimals of displayed degrees. Errors that are equal at this precision count as
equal."""


def evaluation_table(found: MethodEvaluation) -> str:
    """Return a table of all methods, and the errors that exceed those of the method ``mean``."""
    first = found.rows[0]
    head = (
        "trial",
        "frames",
        "method",
        *first.segments,
        *(f"{joint} flexion" for joint in first.joints),
    )
    rows: list[tuple[str, ...]] = [head]
    last = None
    for row in found.rows:
        lead = (row.trial, str(row.frames)) if row.trial != last else ("", "")
        last = row.trial
        rows.append((*lead, row.method, *map(_deg, _figures(row))))

    lines = [f"RMS error in degrees; hold-out: {found.held_out}", "", _format_columns(rows), ""]
    return "\n".join(lines + _comparisons(found))


def _figures(row: MethodScore) -> list[float]:
    return [*row.segments.values(), *row.joints.values()]


def _comparisons(found: MethodEvaluation) -> list[str]:
    """Return a line for each fitted method: its errors that exceed those of the method ``mean``."""
    base = {row.trial: row for row in found.rows if row.method == BASELINE}
    worse: dict[str, list[str]] = {}
    for row in found.rows:
        if row.method == BASELINE or row.method.startswith("single") or row.trial not in base:
            continue
        names = [*row.segments, *(f"{joint} flexion" for joint in row.joints)]
        pairs = zip(names, _figures(row), _figures(base[row.trial]), strict=True)
        lost = [n for n, mine, plain in pairs if _round_degrees(mine) > _round_degrees(plain)]
        worse.setdefault(row.method, []).extend(f"{n} in {row.trial}" for n in lost)

    return [
        f"{method} is worse than {BASELINE}: {', '.join(lost)}"
        if lost
        else f"{method} is not worse than {BASELINE} in any column"
        for method, lost in worse.items()
    ]


def evaluation_json(found: MethodEvaluation) -> dict[str, Any]:
    """Return the evaluation in SI units (rad); NaN becomes null."""
    return {
        "judged_on": found.held_out,
        "unit": "rad",
        "rows": [
            {
                "trial": row.trial,
                "method": row.method,
                "frames": row.frames,
                "segments_rms": dict(row.segments),
                "flexion_rms": dict(row.joints),
            }
            for row in found.rows
        ],
    }


def fit_summary(calibration: Calibration, frames: int) -> str:
    """Return a summary of the fit: one line per segment, then notes."""
    rows = [("segment", "sensors", "models", "residual sd, deg", "length, m")]
    for i, (name, segment) in enumerate(calibration.segment.items()):
        sensors = calibration.chain_sensors[i]
        whole = max(segment.models, key=len, default=None)
        left = "–" if whole is None else _deg(segment.models[whole].residual_sd)
        length = "–" if segment.length is None else f"{segment.length:.3f}"
        rows.append((name, ", ".join(sensors), str(len(segment.models)), left, length))
    lines = [f"method {calibration.method}, {frames} frames", "", _format_columns(rows)]
    return "\n".join([*lines, *(f"note: {note}" for note in calibration.notes)])


def fusion_summary(found: FusedTrial) -> str:
    """Return the shares of frames with known segments and with flags, and the notes, as text."""
    count = len(found.t_s)
    lines = [f"{count} frames, {found.t_s[-1] - found.t_s[0]:.2f} s"]
    for name, known in found.known.items():
        lines.append(f"{name}: known in {100 * known:.0f} % of the frames")
    for flag, share in found.flags.items():
        words = flag_sentence(flag).removesuffix(".")
        lines.append(f"{words} ({flag}): {100 * share:.0f} % of the frames")
    lines += found.notes
    return "\n".join(lines)


def _format_columns(rows: Sequence[Sequence[str]]) -> str:
    """Return rows as aligned text columns; numeric columns are right-aligned."""
    columns = enumerate(zip(*rows[1:], strict=True))
    numeric = [
        k
        for k, column in columns
        if all(cell in {"", "–"} or cell.replace(".", "", 1).isdigit() for cell in column)
    ]
    return align_columns(rows, right=numeric)


def _round_degrees(angle: float) -> float:
    return round(degrees(angle), _DIGITS)


def _deg(angle: float) -> str:
    return f"{degrees(angle):.{_DIGITS}f}" if isfinite(angle) else "–"
