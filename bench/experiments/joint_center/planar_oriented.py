"""Centers of rotation from the positions of a point and the measured rotation angle of its segment.

The error of the center is compared with the error of a circle fit that ignores the angles.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Literal

import numpy as np

from bench.framework.experiment import Experiment, Result
from bench.framework.material import SEEDED
from bench.subjects.planar_arcs import arc_points
from jointfit_daemon.center_of_rotation.planar import CircleLimits, fit_circles, oriented_estimate

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.arrays import Array

Kind = Literal["white", "slow", "OU", "gain"]

FRAMES, SECONDS, NOISE_M, RADIUS_M = 100, 2.0, 0.002, 0.3
WIDE = CircleLimits(0.0, (0.0, np.inf), 0.0, np.inf)
STATED: tuple[tuple[Kind, float], ...] = (
    ("white", 0.0),
    ("white", 1.0),
    ("slow", 1.0),
    ("OU", 1.5),
)
"""Angle noise that the estimator is designed for: its kind (see `angle_error`) and RMS, deg."""
BEYOND: tuple[tuple[Kind, float], ...] = (
    ("white", 3.0),
    ("slow", 3.0),
    ("slow", 4.5),
    ("OU", 4.5),
    ("gain", 1.0),
    ("gain", 3.0),
)
"""Angle noise beyond the design: larger, or proportional to the angle."""
ARCS = (20, 30, 45, 60, 75, 90, 180)


def angle_error(kind: Kind, size: float, rng: np.random.Generator) -> Array:
    """Return angle errors of RMS `size`, shape (FRAMES,).

    The kinds are white noise, a slow sine, an error of the scale ("gain"), and an
    Ornstein-Uhlenbeck process with a time constant of 1 s ("OU").
    """
    n = FRAMES
    if kind == "white":
        return np.asarray(size * rng.normal(size=n))
    if kind == "slow":
        phase = 2.0 * np.pi * rng.random() + np.linspace(0.0, 2.0 * np.pi, n) * rng.uniform(
            0.3, 1.5
        )
        return np.asarray(size * np.sqrt(2.0) * np.sin(phase))
    if kind == "gain":
        scale = float(size * np.sqrt(12.0) * rng.normal())
        return np.asarray(scale * np.linspace(-0.5, 0.5, n))
    t = np.linspace(0.0, SECONDS, n)
    root = np.linalg.cholesky(np.exp(-np.abs(t[:, None] - t)) + 1e-12 * np.eye(n))
    return np.asarray(size * (root @ rng.normal(size=n)))


@cache
def rms_errors(arc: float, kind: Kind, degrees: float, runs: int) -> tuple[float, float, int]:
    """Return the RMS errors with and without angles, m, and the number of rejections.

    The errors include only runs in which both methods estimate a center.
    """
    rng = np.random.default_rng(1000 + round(arc))
    theta = np.linspace(-0.5, 0.5, FRAMES) * np.deg2rad(arc)
    truth = arc_points(theta, RADIUS_M)
    p = truth + rng.normal(0.0, NOISE_M, (runs, *truth.shape))
    plain = fit_circles(p, tempered=False)
    aided = np.full((runs, 2), np.nan)
    for run in range(runs):
        measured = theta + angle_error(kind, np.deg2rad(degrees), rng)
        found = oriented_estimate(p[run], measured, SECONDS / FRAMES, limits=WIDE)
        if found.refused is None:
            aided[run] = found.center
    both = plain.valid & np.isfinite(aided[:, 0])
    with_angles, without = (
        float(np.sqrt((c[both] ** 2).sum(axis=1).mean())) for c in (aided, plain.center)
    )
    return with_angles, without, int(np.isnan(aided[:, 0]).sum())


def table(_: Path) -> list[Result]:
    """Measure the ratio of the RMS error with angles to the RMS error of Hyper without angles."""
    figures = []
    for arc in ARCS:
        for kind, degrees in (*STATED, *BEYOND):
            with_angles, without, refused = rms_errors(arc, kind, degrees, 200)
            goal = 1.02 if (kind, degrees) in STATED else 1.1
            if (kind, degrees) == ("white", 1.0) and arc < 90:
                goal = 0.999
            label = f"arc of {arc}°: {kind} noise of {degrees:g}°"
            note = f"{refused} of 200 rejected" if refused else ""
            ratio = with_angles / without
            figures.append(Result(label, ratio, goal, unit="× Hyper", note=note))
    return figures


def short_arc(_: Path) -> list[Result]:
    """Measure the RMS errors on an arc of 20°, and the ratios of `table` for two cases at 60°."""
    with_angles, without, refused = rms_errors(20, "slow", 1.0, 200)
    figures = [
        Result("arc of 20°, slow noise of 1°: with angles", 1000 * with_angles, 28.0, unit="mm"),
        Result(
            "arc of 20°, slow noise of 1°: Hyper without angles", 1000 * without, np.inf, unit="mm"
        ),
        Result("arc of 20°, slow noise of 1°: rejected", refused, 0, unit="of 200"),
    ]
    for arc, kind, degrees, goal in ((60, "white", 1.0, 0.999), (60, "slow", 4.5, 1.1)):
        with_angles, without, _refused = rms_errors(arc, kind, degrees, 200)
        label = f"arc of {arc}°, {kind} noise of {degrees:g}°: ratio"
        figures.append(Result(label, with_angles / without, goal, unit="× Hyper"))
    return figures


EXPERIMENTS = (
    Experiment(
        "oriented-circle-angle-noise",
        "Circle fit with measured angles whose noise is as stated, or up to three times larger; "
        "200 runs each",
        table,
        SEEDED,
        long=True,
    ),
    Experiment(
        "oriented-circle-short-arc",
        "Circle fit with measured angles on a short arc, 200 runs each",
        short_arc,
        SEEDED,
    ),
)
