"""Result of inverse kinematics as text (mm, degrees) and as JSON (SI units)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from jointfit_daemon.kinematics.accepted_errors import (
    ACCEPTED_MAXIMUM_M,
    ACCEPTED_RMS_M,
    is_accepted,
)
from jointfit_daemon.tools.marker_limits import SOURCE, comparison
from jointfit_daemon.tools.text_output import align_columns
from jointfit_daemon.units import MM_PER_M

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.tools.ik._solution import TrialSolution

_WORST = 3
"""Number of markers that the output line ``worst`` lists."""
_MARKER_HEAD = ("marker", "segment", "frames", "RMS, mm", "max, mm", "at, s")
_COORDINATE_HEAD = ("coordinate", "unit", "min", "max", "sd")


def as_text(found: TrialSolution) -> str:
    """Return the tables of markers and coordinates, and a summary."""
    segments = {m.name: m.segment for m in found.model.markers}
    rms, most, when = _by_marker(found)
    order = np.argsort(-rms)
    markers = []
    for k in order.tolist():
        name = found.marker_names[k]
        count = int(_errors(found)[1][:, k].sum())
        errors = (f"{MM_PER_M * rms[k]:.1f}", f"{MM_PER_M * most[k]:.1f}", f"{when[k]:.2f}")
        markers.append((name, segments[name], str(count), *errors))

    chain = found.model
    count, solved = len(found.t_s), int(found.solved.sum())
    total, largest = _overall(found)
    worst = ", ".join(f"{found.marker_names[k]} {MM_PER_M * rms[k]:.1f}" for k in order[:_WORST])
    lines = [
        f"model     {chain.name}: {len(chain.segments)} segments, {chain.nq} degrees of freedom,"
        f" {len(found.marker_names)} of {len(chain.markers)} markers tracked",
        f"trial     {found.trial}: {count} frames at {found.rate_hz:g} Hz,"
        f" {found.t_s[0]:g} to {found.t_s[-1]:g} s",
        *(f"note      {text}" for text in found.notes),
        "",
        align_columns([_MARKER_HEAD, *markers], right=(2, 3, 4, 5)),
        "",
        align_columns([_COORDINATE_HEAD, *_coordinates(found)], right=(2, 3, 4)),
        "",
        f"frames    {count - solved} without solution,"
        f" {int((found.solved & ~found.complete).sum())} with unknown coordinates,"
        f" {found.restarted} improved by a restart from another pose",
        f"errors    {comparison('RMS', total, ACCEPTED_RMS_M)};"
        f" {comparison('maximum', largest, ACCEPTED_MAXIMUM_M)} ({SOURCE})",
        f"worst     {worst} mm RMS",
    ]
    return "\n".join(lines)


def _coordinates(found: TrialSolution) -> list[tuple[str, ...]]:
    rows = []
    for k, name in enumerate(found.names):
        unit, scale = ("°", np.degrees(1.0)) if found.is_angle[k] else ("mm", MM_PER_M)
        values, sd = scale * found.values[:, k], scale * found.sd[:, k]
        numbers = (np.nanmin(values), np.nanmax(values), np.nanmedian(sd))
        rows.append((name, unit, *(f"{number:.1f}" for number in numbers)))
    return rows


def _errors(found: TrialSolution) -> tuple[Array, NDArray[np.bool_]]:
    """Return the squared errors, m^2 (0 where unknown), and whether each error is known."""
    seen: NDArray[np.bool_] = np.isfinite(found.distances) & found.solved[:, None]
    return np.where(seen, found.distances, 0.0) ** 2, seen


def _overall(found: TrialSolution) -> tuple[float, float]:
    """Return the RMS and the largest marker error over all frames with a solution, m."""
    square, seen = _errors(found)
    return float(np.sqrt(square.sum() / max(seen.sum(), 1))), float(np.sqrt(square.max()))


def _by_marker(found: TrialSolution) -> tuple[Array, Array, Array]:
    """Return RMS error (m), largest error (m) and time of the largest error (s) by marker."""
    square, seen = _errors(found)
    rms = np.sqrt(square.sum(axis=0) / np.maximum(seen.sum(axis=0), 1))
    return rms, np.sqrt(square.max(axis=0)), found.t_s[square.argmax(axis=0)]


def as_json(found: TrialSolution) -> dict[str, Any]:
    """Return all results in SI units; null means unknown."""
    total, largest = _overall(found)
    rms, most, when = _by_marker(found)
    return {
        "model": found.model.name,
        "trial": found.trial,
        "frames": len(found.t_s),
        "rate_hz": found.rate_hz,
        "without_solution": int((~found.solved).sum()),
        "with_unknown_coordinates": int((found.solved & ~found.complete).sum()),
        "restarted": found.restarted,
        "rms_m": total,
        "maximum_m": largest,
        "accepted": {
            "rms_m": ACCEPTED_RMS_M,
            "maximum_m": ACCEPTED_MAXIMUM_M,
            "source": SOURCE,
            "within": is_accepted(total, largest),
        },
        "markers": [
            {"name": name, "rms_m": float(r), "maximum_m": float(m), "maximum_at_s": float(t)}
            for name, r, m, t in zip(found.marker_names, rms, most, when, strict=True)
        ],
        "coordinates": [
            {
                "name": name,
                "unit": "rad" if angle else "m",
                "minimum": float(np.nanmin(found.values[:, k])),
                "maximum": float(np.nanmax(found.values[:, k])),
                "median_sd": float(np.nanmedian(found.sd[:, k])),
            }
            for k, (name, angle) in enumerate(zip(found.names, found.is_angle, strict=True))
        ],
        "notes": list(found.notes),
    }
