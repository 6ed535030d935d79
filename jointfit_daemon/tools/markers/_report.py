"""Marker refinements as text (mm, degrees) and as JSON (SI units)."""

from __future__ import annotations

from math import degrees, isfinite
from typing import TYPE_CHECKING, Any

from jointfit_daemon.kinematics.accepted_errors import (
    ACCEPTED_MAXIMUM_M,
    ACCEPTED_RMS_M,
    is_accepted,
)
from jointfit_daemon.tools.marker_limits import SOURCE, comparison
from jointfit_daemon.tools.text_output import align_columns
from jointfit_daemon.units import MM_PER_M

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.calibration.marker_refinement import (
        Refinement,
        TrackingStatistics,
        TrialOutcome,
    )
    from jointfit_daemon.kinematics.chains import ChainModel

_MARKER_HEAD = ("marker", "segment", "moved, mm", "x, y, z", "locked", "residual, mm")
_TRIAL_HEAD = ("trial", "", "frames", "RMS, mm", "", "variance over time, mm²", "joint change, °")


def as_text(chain: ChainModel, remarks: Sequence[str], found: Refinement) -> str:
    """Return the tables of markers and trials, and a summary."""
    if found.method == "search":
        effort = f"{found.runs} runs of inverse kinematics"
    else:
        effort = f"{len(found.costs) - 1} steps, prior {found.prior:g}"

    moved = []
    for m in found.markers:
        held = "".join(axis for axis, is_held in zip("xyz", m.held, strict=True) if is_held)
        by_axis = " ".join(f"{MM_PER_M * v:+.1f}" for v in m.moved)
        residual = f"{_mm(m.rms_before)} → {_mm(m.rms_after)}"
        moved.append((m.name, m.segment, f"{MM_PER_M * m.distance:.1f}", by_axis, held, residual))

    lines = [
        f"model     {chain.name}: {len(chain.segments)} segments, {chain.nq} degrees of freedom,"
        f" {len(chain.markers)} markers",
        f"method    {found.method}: {effort}; {found.stopped}",
        *(f"import    {text}" for text in remarks),
        *(f"note      {text}" for text in found.notes),
        "",
        align_columns([_MARKER_HEAD, *moved]),
        "",
        align_columns([_TRIAL_HEAD, *map(_trial, found.trials)]),
        "",
        *_summary(found),
    ]
    return "\n".join(lines)


def _trial(t: TrialOutcome) -> tuple[str, ...]:
    turned = max((most for _, most in t.angles.values()), default=float("nan"))
    return (
        t.name,
        "training" if t.trained else "validation",
        f"{t.frames} at {t.rate_hz:g} Hz",
        f"{_mm(t.before.rms)} → {_mm(t.after.rms)}",
        _change(t.before.rms, t.after.rms),
        f"{_mm2(t.before.variance)} → {_mm2(t.after.variance)}",
        f"≤ {degrees(turned):.1f}" if isfinite(turned) else "",
    )


def _summary(found: Refinement) -> list[str]:
    rms, most = found.angle_change()
    lines = [f"joints    angles changed by {degrees(rms):.1f}° RMS, {degrees(most):.1f}° at most"]
    for trained, word in ((True, "training"), (False, "validation")):
        before, after = found.variance_of_trials(trained=trained)
        if isfinite(before):
            lines.append(
                f"variance  of RMS across {word} trials: {_mm2(before)} → {_mm2(after)} mm²"
            )

    for trained, word in ((True, "training"), (False, "validation")):
        # Find the largest RMS error of a trial, and the largest error of a marker in a frame, m.
        errors = [t.after for t in found.trials if t.trained is trained]
        unknown = float("nan")
        rms_after, largest = (
            max((e.rms for e in errors), default=unknown),
            max((e.maximum for e in errors), default=unknown),
        )
        if isfinite(rms_after):
            lines.append(
                f"errors    {word}: {comparison('RMS', rms_after, ACCEPTED_RMS_M)};"
                f" {comparison('maximum', largest, ACCEPTED_MAXIMUM_M)} ({SOURCE})"
            )

    gauge = found.gauge
    if gauge.free:
        remedy = (
            "use --method joint or block, which have a prior"
            if found.method == "search"
            else "set a prior"
        )
        held = {
            "prior": "determined by the prior only",
            "nothing": "UNDETERMINED: joint angles are arbitrary there; lock anatomical"
            f" markers or {remedy}",
        }[gauge.fixed_by]
        lines.append(
            f"gauge     {gauge.free} motions of markers and angles leave the error unchanged"
            f" ({', '.join(gauge.involved)}): {held}"
        )

    if gauge.weak:
        lines.append(f"weak      further motions that hardly change the error: {gauge.weak}")

    return lines


def _mm(metres: float) -> str:
    return f"{MM_PER_M * metres:.2f}" if isfinite(metres) else "–"


def _mm2(square: float) -> str:
    return f"{MM_PER_M**2 * square:.2f}" if isfinite(square) else "–"


def _change(before: float, after: float) -> str:
    return f"{100 * (after / before - 1):+.0f} %" if before > 0.0 else ""


def _statistics(errors: TrackingStatistics) -> dict[str, float]:
    return {"rms_m": errors.rms, "maximum_m": errors.maximum, "variance_m2": errors.variance}


def _gauge(found: Refinement) -> dict[str, Any]:
    gauge = found.gauge
    return {
        "free": gauge.free,
        "weak": gauge.weak,
        "fixed_by": gauge.fixed_by,
        "markers": list(gauge.involved),
        "eigenvalues": gauge.eigenvalues.tolist(),
    }


def as_json(chain: ChainModel, remarks: Sequence[str], found: Refinement) -> dict[str, Any]:
    """Return all results in SI units; null means unknown."""
    rms, most = found.angle_change()
    return {
        "model": chain.name,
        "method": found.method,
        "prior": found.prior,
        "stopped": found.stopped,
        "runs": found.runs,
        "costs": list(found.costs),
        "remarks": list(remarks),
        "notes": list(found.notes),
        "markers": [
            {
                "name": m.name,
                "segment": m.segment,
                "position_m": list(position.position),
                "moved_m": list(m.moved),
                "held": [bool(h) for h in m.held],
                "rms_before_m": m.rms_before,
                "rms_after_m": m.rms_after,
            }
            for m, position in zip(found.markers, found.model.markers, strict=True)
        ],
        "trials": [
            {
                "name": t.name,
                "trained": t.trained,
                "frames": t.frames,
                "rate_hz": t.rate_hz,
                "before": _statistics(t.before),
                "after": _statistics(t.after),
                "accepted": is_accepted(t.after.rms, t.after.maximum),
                "angles_rad": {
                    name: {"rms": rms, "max": most} for name, (rms, most) in t.angles.items()
                },
            }
            for t in found.trials
        ],
        "angle_change_rad": {"rms": rms, "max": most},
        "variance_of_trials_m2": {
            word: found.variance_of_trials(trained=trained)
            for word, trained in (("trained", True), ("unseen", False))
        },
        "gauge": _gauge(found),
    }
