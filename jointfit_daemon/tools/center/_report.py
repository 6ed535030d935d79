"""Centers of rotation as text and JSON. Law: pure; millimetres and degrees for people only."""

from __future__ import annotations

from math import degrees, inf, isfinite, sqrt
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from jointfit_daemon.files.mocap import MarkerTrial
    from jointfit_daemon.tools.center.trial import Answer, Reduced

_MM = 1000.0
_FLAGS = {
    "orientation_inconsistent": "the angles contradict the circle, which was used instead",
    "residuals_persist": "residuals last from frame to frame: frames are not independent",
    "residuals_repeat": "residuals go with posture, as skin does: counted as seen once, however"
    " long the trial",
    "hinge": "the joint turned about one axis: the center's place along it is not shown",
}
_WINDOW_HEAD = (
    "window, s",
    "x, y, z in parent, mm",
    "sd, mm",
    "bound",
    "95 % semi-axes",
    "arc",
    "residual",
    "T",
    "",
)


def head(
    trial: MarkerTrial, parent: Sequence[str], markers: Sequence[str], reduced: Reduced
) -> str:
    """Return what was read, how much of it was seen, and where x, y, z point."""
    data = trial.trajectories
    seen = np.isfinite(trial.points(markers)).all(axis=-1).mean(axis=0)
    whole = np.isfinite(reduced.poses.q).all(axis=-1).mean()
    lines = [
        f"trial     {len(data.t_s)} frames at {data.rate_hz:g} Hz,"
        f" {len(data.t_s) / data.rate_hz:.2f} s; {trial.up_axis} is up, by {trial.up_said_by}",
        f"parent    {', '.join(parent)}: known in {100 * whole:.0f} % of the frames, rigid to"
        f" {_MM * reduced.rms:.1f} mm RMS",
        "markers   "
        + ", ".join(f"{m} ({100 * s:.0f} %)" for m, s in zip(markers, seen, strict=True)),
        "axes      " + _axes(parent, planar=reduced.basis.shape[1] == len("xy")),
    ]
    return "\n".join(lines + [f"warning   {text}" for text in data.warnings])


def _axes(parent: Sequence[str], *, planar: bool) -> str:
    first = f"of the parent: origin amid its markers, x from {parent[0]} to {parent[1]}"
    if planar:
        return f"{first}, y across x in the plane"
    return f"{first}, z across the plane of {', '.join(parent[:3])}"


def details(answer: Answer) -> str:
    """Return one answer, one finding a line."""
    e = answer.estimate
    lines = [f"method    {e.method}"]
    if e.refused is not None:
        lines.append(f"REFUSED   {e.refused}")
        if not np.isfinite(e.center).all():
            return "\n".join(lines)
        lines.append("          what follows is not to be used")
    lines += [
        f"center    in the parent  {_point(e.center)} mm",
        f"          in the world   {_point(answer.world)} mm, at the parent's mean pose, in the"
        " file's axes",
        _error(answer),
        f"          95 % ellipsoid: semi-axes {_semi_axes(answer)} mm",
        f"arc       {degrees(e.arc):.0f}°",
        f"residual  {_mm(e.residual)} mm RMS; noise of a marker {_mm(e.noise)} mm a coordinate",
        f"radius    {', '.join(_mm(r) for r in e.radii)} mm, marker by marker",
        f"T         {_number(e.conditioning)} (6 or more is usable)",
        f"frames    {e.frames} used, worth {e.effective_frames:.0f} independent ones",
    ]
    lines += [f"unseen    nothing is known along {_direction(u)} of the parent" for u in e.unseen]
    if e.axis is not None:
        lines.append(f"axis      {_direction(e.axis)} of the parent: a hinge")
    lines += [f"note      {_FLAGS.get(flag, flag.replace('_', ' '))}" for flag in e.flags]
    return "\n".join(lines)


def _error(answer: Answer) -> str:
    e = answer.estimate
    if len(e.unseen) == 0:
        least = f"no method can be below {_mm(e.bound)} mm on this movement"
        return f"error     {_mm(e.sd)} mm RMS predicted; {least}"
    seen = f"; {_mm(_sd_seen(answer))} mm RMS predicted across that"
    known = len(e.unseen) < len(e.center)
    return f"error     unknown along what is unseen{seen if known else ''}"


def _sd_seen(answer: Answer) -> float:
    """Return the predicted RMS error in the directions that the movement showed, m."""
    e = answer.estimate
    if len(e.unseen) >= len(e.center):
        return inf
    return sqrt(max(float(np.trace(e.covariance)), 0.0))


def windows(found: Sequence[Answer]) -> str:
    """Return one line an answer, as a table."""
    rows: list[tuple[str, ...]] = [_WINDOW_HEAD]
    for answer in found:
        e = answer.estimate
        rows.append(
            (
                f"{answer.start_s:.2f}–{answer.end_s:.2f}",
                _point(e.center),
                _mm(e.sd),
                _mm(e.bound),
                _semi_axes(answer),
                f"{degrees(e.arc):.0f}°",
                _mm(e.residual),
                _number(e.conditioning),
                "" if e.refused is None else f"REFUSED: {e.refused}",
            )
        )
    widths = [max(len(row[i]) for row in rows) for i in range(len(_WINDOW_HEAD) - 1)]
    return "\n".join(_aligned(row, widths) for row in rows)


def _aligned(row: Sequence[str], widths: Iterable[int]) -> str:
    cells = (cell.rjust(width) for cell, width in zip(row, widths, strict=False))
    return "  ".join((*cells, row[-1])).rstrip()


def _point(x: NDArray[np.float64]) -> str:
    if not np.isfinite(x).all():
        return "unknown"
    return " ".join(f"{name} {_MM * value:.1f}" for name, value in zip("xyz", x, strict=False))


def _direction(u: NDArray[np.float64]) -> str:
    return "(" + ", ".join(f"{value:+.2f}" for value in u) + ")"


def _semi_axes(answer: Answer) -> str:
    return " × ".join(_mm(length) for length in answer.semi_axes)


def _mm(metres: float) -> str:
    if not isfinite(metres):
        return "unknown"
    size = _MM * metres
    return f"{size:.1f}" if size >= 1.0 else f"{size:.2g}"


def _number(value: float) -> str:
    return "∞" if value == inf else f"{value:.3g}"


def as_json(
    trial: MarkerTrial,
    parent: Sequence[str],
    markers: Sequence[str],
    reduced: Reduced,
    found: Sequence[Answer],
) -> dict[str, Any]:
    """Return everything for programs, SI; null is unknown or infinite."""
    return {
        "frames": len(trial.trajectories.t_s),
        "rate_hz": trial.trajectories.rate_hz,
        "up_axis": trial.up_axis,
        "parent": list(parent),
        "markers": list(markers),
        "parent_rms_m": _nullable(reduced.rms),
        "answers": [_answer(answer) for answer in found],
    }


def _answer(answer: Answer) -> dict[str, Any]:
    e = answer.estimate
    return {
        "start_s": answer.start_s,
        "end_s": answer.end_s,
        "method": e.method,
        "refused": e.refused,
        "center_parent_m": [_nullable(v) for v in e.center],
        "center_world_m": [_nullable(v) for v in answer.world],
        "covariance_m2": [[_nullable(v) for v in row] for row in e.covariance],
        "sd_m": _nullable(e.sd),
        "sd_seen_m": _nullable(_sd_seen(answer)),
        "bound_m": _nullable(e.bound),
        "semi_axes_95_m": [_nullable(v) for v in answer.semi_axes],
        "unseen": e.unseen.tolist(),
        "axis": None if e.axis is None else e.axis.tolist(),
        "noise_m": _nullable(e.noise),
        "residual_m": _nullable(e.residual),
        "radii_m": [_nullable(r) for r in e.radii],
        "arc_rad": _nullable(e.arc),
        "conditioning": _nullable(e.conditioning),
        "frames": e.frames,
        "effective_frames": _nullable(e.effective_frames),
        "flags": list(e.flags),
    }


def _nullable(value: float) -> float | None:
    return float(value) if isfinite(value) else None
