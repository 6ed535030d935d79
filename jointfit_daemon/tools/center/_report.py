"""Centres of rotation as text (mm, degrees) and as JSON (SI units)."""

from __future__ import annotations

from math import degrees, inf, isfinite, sqrt
from typing import TYPE_CHECKING, Any

import numpy as np

from jointfit_daemon.tools.text_output import align_columns
from jointfit_daemon.units import MM_PER_M

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from jointfit_daemon.files.mocap import MarkerTrial
    from jointfit_daemon.tools.center.trial import ParentFrameMotion, WindowEstimate

_FLAGS = {
    "orientation_inconsistent": "inertial angles contradict the circle fit; the circle fit is used",
    "residuals_persist": "residuals are correlated over time: frames are not independent",
    "residuals_repeat": "residuals repeat with posture, as soft-tissue artefact does: repetitions"
    " of the movement are counted once",
    "hinge": "rotation about one axis: the position of the centre along the axis is unobservable",
    "marker_off": "the path of marker % contradicts the other markers, so it has a small weight:"
    " check its label and its attachment",
    "noisy_marker": "marker % has much larger residuals than the other markers, so it has a small"
    " weight: check its label and its attachment",
    "marker_moved": "marker % moved on its segment: only its frames after the movement are used",
}
"""Sentences by the part of a flag before the colon; % is the part after the colon."""
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
    trial: MarkerTrial, parent: Sequence[str], markers: Sequence[str], reduced: ParentFrameMotion
) -> str:
    """Return a description of the trial, the visibility of the markers, and the parent frame."""
    data = trial.trajectories
    seen = np.isfinite(trial.points(markers)).all(axis=-1).mean(axis=0)
    whole = np.isfinite(reduced.poses.q).all(axis=-1).mean()
    lines = [
        f"trial     {len(data.t_s)} frames at {data.rate_hz:g} Hz,"
        f" {len(data.t_s) / data.rate_hz:.2f} s; {trial.up_axis} is up ({trial.up_said_by})",
        f"parent    {', '.join(parent)}: tracked in {100 * whole:.0f} % of the frames, rigid-fit"
        f" residual {MM_PER_M * reduced.rms:.1f} mm RMS",
        "markers   "
        + ", ".join(f"{m} ({100 * s:.0f} %)" for m, s in zip(markers, seen, strict=True)),
        "axes      " + _axes(parent, planar=reduced.basis.shape[1] == len("xy")),
    ]
    return "\n".join(lines + [f"warning   {text}" for text in data.warnings])


def _axes(parent: Sequence[str], *, planar: bool) -> str:
    first = f"parent frame: origin at the mean of its markers, x from {parent[0]} to {parent[1]}"
    if planar:
        return f"{first}, y in the plane, normal to x"
    return f"{first}, z normal to the plane of {', '.join(parent[:3])}"


def details(answer: WindowEstimate) -> str:
    """Return one estimate as lines of text."""
    e = answer.estimate
    lines = [f"method    {e.method}"]
    if e.refused is not None:
        lines.append(f"REFUSED   {e.refused}")
        if not np.isfinite(e.center).all():
            return "\n".join(lines)
        lines.append("          do not use the following values")

    if not len(e.unseen):
        error = (
            f"{mm(e.rms_error)} mm RMS predicted; lower bound for any method, with independent"
            f" noise: {mm(e.bound)} mm"
        )
    else:
        error = "unknown along the unobservable directions"
        if len(e.unseen) < len(e.center):
            error += f"; {mm(error_seen(answer))} mm RMS predicted in the other directions"

    lines += [
        f"center    in the parent  {point(e.center)} mm",
        f"          in the world   {point(answer.world)} mm, at the mean parent pose, in the"
        " axes of the file",
        f"error     {error}",
        f"          95 % ellipsoid: semi-axes {_semi_axes(answer)} mm",
        f"arc       {degrees(e.arc):.0f}°",
        f"residual  {mm(e.residual)} mm RMS; marker noise {mm(e.noise)} mm per coordinate",
        f"radius    {', '.join(mm(r) for r in e.radii)} mm, one value per marker",
        f"T         {number(e.conditioning)} (6 or more is usable)",
        f"frames    {e.frames} used, equivalent to {e.effective_frames:.0f} independent frames",
    ]
    lines += [f"unseen    unobservable along {_direction(u)} of the parent" for u in e.unseen]
    if e.axis is not None:
        lines.append(f"axis      {_direction(e.axis)} of the parent: hinge joint")

    lines += [f"note      {_sentence(flag)}" for flag in e.flags]
    return "\n".join(lines)


def _sentence(flag: str) -> str:
    kind, _, marker = flag.partition(":")
    return _FLAGS.get(kind, kind.replace("_", " ")).replace("%", marker)


def error_seen(answer: WindowEstimate) -> float:
    """Return the predicted RMS error in the observable directions, m; infinity if none exists."""
    e = answer.estimate
    if len(e.unseen) >= len(e.center):
        return inf
    return sqrt(max(float(np.trace(e.covariance)), 0.0))


def windows(found: Sequence[WindowEstimate]) -> str:
    """Return a table with one line per window."""
    rows: list[tuple[str, ...]] = [_WINDOW_HEAD]
    for answer in found:
        e = answer.estimate
        rows.append(
            (
                f"{answer.start_s:.2f}–{answer.end_s:.2f}",
                point(e.center),
                mm(e.rms_error),
                mm(e.bound),
                _semi_axes(answer),
                f"{degrees(e.arc):.0f}°",
                mm(e.residual),
                number(e.conditioning),
                "" if e.refused is None else f"REFUSED: {e.refused}",
            )
        )

    return align_columns(rows, right=range(len(_WINDOW_HEAD) - 1))


def point(x: NDArray[np.float64]) -> str:
    """Return coordinates in mm, each with its axis."""
    if not np.isfinite(x).all():
        return "unknown"
    return " ".join(f"{name} {MM_PER_M * value:.1f}" for name, value in zip("xyz", x, strict=False))


def _direction(u: NDArray[np.float64]) -> str:
    return "(" + ", ".join(f"{value:+.2f}" for value in u) + ")"


def _semi_axes(answer: WindowEstimate) -> str:
    return " × ".join(mm(length) for length in answer.semi_axes)


def mm(metres: float) -> str:
    """Return a length as text in mm."""
    if not isfinite(metres):
        return "unknown"
    size = MM_PER_M * metres
    return f"{size:.1f}" if size >= 1.0 else f"{size:.2g}"


def number(value: float) -> str:
    """Return a number with three significant digits."""
    return "∞" if value == inf else f"{value:.3g}"


def as_json(
    trial: MarkerTrial,
    parent: Sequence[str],
    markers: Sequence[str],
    reduced: ParentFrameMotion,
    found: Sequence[WindowEstimate],
) -> dict[str, Any]:
    """Return all results in SI units; NaN and infinity become null."""
    return {
        "frames": len(trial.trajectories.t_s),
        "rate_hz": trial.trajectories.rate_hz,
        "up_axis": trial.up_axis,
        "parent": list(parent),
        "markers": list(markers),
        "parent_rms_m": reduced.rms,
        "answers": [answer_json(answer) for answer in found],
    }


def answer_json(answer: WindowEstimate) -> dict[str, Any]:
    """Return one estimate in SI units."""
    e = answer.estimate
    return {
        "start_s": answer.start_s,
        "end_s": answer.end_s,
        "method": e.method,
        "refused": e.refused,
        "center_parent_m": e.center.tolist(),
        "center_world_m": answer.world.tolist(),
        "covariance_m2": e.covariance.tolist(),
        "error_m": e.rms_error,
        "error_seen_m": error_seen(answer),
        "bound_m": e.bound,
        "semi_axes_95_m": answer.semi_axes.tolist(),
        "unseen": e.unseen.tolist(),
        "axis": None if e.axis is None else e.axis.tolist(),
        "noise_m": e.noise,
        "residual_m": e.residual,
        "radii_m": e.radii.tolist(),
        "arc_rad": e.arc,
        "conditioning": e.conditioning,
        "frames": e.frames,
        "effective_frames": e.effective_frames,
        "flags": list(e.flags),
    }
