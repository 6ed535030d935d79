"""Results of the numerical experiment as text (mm, degrees) and as JSON (SI units).

α is the angle between two successive positions of a marker, r its distance from the centre of
rotation, and σ the noise per coordinate.
"""

from __future__ import annotations

from textwrap import indent
from typing import TYPE_CHECKING, Any

import numpy as np

from jointfit_daemon.center_of_rotation.study import (
    APART_RAD,
    CLIPS_M,
    LARGE_NOISE_M,
    PRINTED,
    RADII_M,
    STEPS_RAD,
    correlation,
)
from jointfit_daemon.tools.text_output import align_columns
from jointfit_daemon.units import MM_PER_M

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.center_of_rotation.study import PairMaps, StudyExtension, StudySetup

NEAREST = {"α–σ": 0.3, "r–σ": None, "r–α": 0.15}
"""Clipping limit that reproduces the published correlations best, m, by pair of quantities; None
stands for no clipping."""
CAVEATS = (
    "Three noisy points can be collinear, so the error of the analytic solution has no finite"
    " mean square: single outliers determine the raw correlation, which changes with the seed."
    " The results approach the published table only with clipped errors and a small search region"
    " of the grid.",
    "Clipping limit and search region were chosen so that the results approach the published table"
    " (marked *). The publication states neither these values nor the step of the grid. Some digits"
    " of the published table are illegible.",
    "At small α the grid has smaller errors than the analytic solution, because its search region"
    " is centered on the true center and limits the error: at α = 5° the error equals half the"
    " width of the region. With three points both methods have the same optimum.",
    "On long arcs a grid with a node on the true center finds this center exactly. With the grid"
    " shifted by half a step, the error is at least 0.71 steps. Both grids are shown.",
    "Equations 14 and 15 of the publication are mean squares. F is the square root of equation 15"
    " and is valid while σ/r < (1 - cos α)/6.",
    "The all-frames methods use 100 frames of the same arc, not three. hyper refuses runs with a"
    " conditioning T < 6, so its RMS error covers the other runs. hyper is biased on short arcs."
    " Its error can be below the bound, which holds for unbiased estimators only.",
)
_SHOWN_DEG = (5, 10, 20, 30, 45, 60, 90, 120, 150, 175)
_METHODS = ("predicted", "three frames", "grid", "shifted grid", "bound", "hyper", "oriented")


def tables(setup: StudySetup, study: Sequence[PairMaps], more: StudyExtension) -> str:
    """Return setup, correlations, errors by arc, other methods and limitations as text tables."""
    degrees = np.rint(np.rad2deg(setup.steps)).astype(int).tolist()
    medians: list[tuple[str, ...]] = [("α", *more.median_errors)]
    for angle in (a for a in _SHOWN_DEG if a in degrees):
        at = degrees.index(angle)
        medians.append(
            (
                f"{angle}°",
                *(f"{MM_PER_M * errors[at]:.3g}" for errors in more.median_errors.values()),
            )
        )

    repetition: list[tuple[str, ...]] = [("α", "mean of centers", "center of mean positions")]
    for step, *errors_m in zip(STEPS_RAD, *more.repetition, strict=True):
        repetition.append((f"{np.rad2deg(step):.0f}°", *(f"{MM_PER_M * m:.2g}" for m in errors_m)))

    parts = [
        "Center of rotation from a marker on a circle: the numerical experiment of Akbarifar et al."
        " (2021), repeated",
        _setup(setup),
        "Table 1: correlation of whole maps, prediction–analytic / analytic–grid",
        _indent_table(_correlations(study, "grid")),
        "Table 1 with the grid shifted by half a step",
        _indent_table(_correlations(study, "shifted grid")),
        f"RMS error of the center, mm, at r = {setup.radii[-1]:g} m and"
        f" σ = {MM_PER_M * setup.noise:g} mm; refused: share of runs that hyper refuses",
        _indent_table(_errors(study)),
        f"Median error, mm, of two markers {np.rad2deg(APART_RAD):.0f}° apart that rotate by 2α, at"
        f" r = {setup.radius:g} m and σ = {MM_PER_M * setup.noise:g} mm; bisectors: both markers,"
        " three frames; Reuleaux and helical axis: both markers, first and last frame; other"
        f" methods: one marker, hyper with {setup.frames} frames",
        _indent_table(medians),
        f"Repetition of small angles: median error, mm, after averaging {setup.repeats} repetitions"
        f" at r = {setup.radius:g} m and σ = {MM_PER_M * setup.noise:g} mm",
        _indent_table(repetition),
        "Effect of the radius: 95th percentile of the error, divided by the"
        f" percentile at r = {100 * setup.radii[-1]:g} cm; all at α ="
        f" {np.rad2deg(setup.step):.0f}° and σ = {MM_PER_M * LARGE_NOISE_M:g} mm",
        _indent_table(
            [
                ("r, cm", *(f"{100 * r:g}" for r in RADII_M)),
                ("ratio", *(f"{ratio:.2f}" for ratio in more.radius_effect)),
            ]
        ),
        "Limits",
        "\n".join(f"- {text}" for text in CAVEATS),
    ]
    return "\n\n".join(parts) + "\n"


def _setup(setup: StudySetup) -> str:
    r, s, a = setup.radii, MM_PER_M * setup.noises, np.rad2deg(setup.steps)
    return "\n".join(
        (
            "  points    at angles 0, α, 2α about the center, distance r; independent normal noise"
            " σ on both coordinates",
            f"  r         {r[0]:g} to {r[-1]:g} m, {r.size} values; fixed {setup.radius:g} m",
            f"  σ         {s[0]:g} to {s[-1]:g} mm, {s.size} values; fixed"
            f" {MM_PER_M * setup.noise:g} mm",
            f"  α         {a[0]:.0f} to {a[-1]:.0f}°, {a.size} values; fixed"
            f" {np.rad2deg(setup.step):.0f}°",
            "  F         prediction: root of equation 15",
            f"  A         analytic: three frames, RMS of {setup.repeats} runs",
            f"  G         grid: ±{100 * setup.box:g} cm in steps of {MM_PER_M * setup.node:g} mm, a"
            f" node on the true center, RMS of the first {setup.grid_repeats} runs",
            f"  ours      {setup.frames} frames over the same arc, RMS of {setup.frames_repeats}"
            f" runs; orientation with {np.rad2deg(setup.orientation_noise):.0f}° of white error",
            f"  seed      {setup.seed}",
        )
    )


def _correlations(study: Sequence[PairMaps], grid: str) -> list[tuple[str, ...]]:
    heads = ["raw" if clip is None else f"≤ {100 * clip:g} cm" for clip in CLIPS_M]
    rows: list[tuple[str, ...]] = [("pair", "printed", *heads)]
    for pair in study:
        printed = "/".join(f"{value:.2f}" for value in PRINTED[pair.name])
        cells = []
        for clip in CLIPS_M:
            first, second = correlations(pair, grid, clip)
            mark = "*" if NEAREST[pair.name] == clip and grid == "grid" else ""
            cells.append(f"{first:.2f}/{second:.2f}{mark}")
        rows.append((pair.name, printed, *cells))
    return rows


def correlations(pair: PairMaps, grid: str, clip: float | None) -> tuple[float, float]:
    """Return two correlations between error maps of a pair of quantities.

    The first correlation is between the predicted errors and the errors of the analytic solution,
    the second between the errors of the analytic solution and of the grid search.

    Parameters
    ----------
    pair
        Error maps of the pair, m.
    grid
        Key of the error map of the grid search.
    clip
        Limit to which larger errors are reduced, m; None for no limit.
    """
    analytic = pair.maps["three frames"]
    return (
        correlation(pair.maps["predicted"], analytic, clip),
        correlation(analytic, pair.maps[grid], clip),
    )


def _errors(study: Sequence[PairMaps]) -> list[tuple[str, ...]]:
    pair = next(p for p in study if p.name == "r–α")
    degrees = np.rint(np.rad2deg(pair.columns)).astype(int).tolist()
    rows: list[tuple[str, ...]] = [("α", *_METHODS, "refused")]
    for angle in (a for a in _SHOWN_DEG if a in degrees):
        at = degrees.index(angle)
        errors_m = [float(pair.maps[key][-1, at]) for key in _METHODS]
        cells = (
            "–" if np.isnan(m) else f"{MM_PER_M * m:.3g}" if m < 1.0 else "> 1000" for m in errors_m
        )
        rows.append((f"{angle}°", *cells, f"{100 * pair.refused[-1, at]:.0f} %"))
    return rows


def _indent_table(rows: Sequence[Sequence[str]]) -> str:
    return indent(align_columns(rows, right=range(len(rows[0]))), "  ")


def as_json(setup: StudySetup, study: Sequence[PairMaps], more: StudyExtension) -> dict[str, Any]:
    """Return setup, correlations, maps and other methods in SI units; NaN becomes null."""
    return {
        "setup": {
            "radii_m": setup.radii.tolist(),
            "noises_m": setup.noises.tolist(),
            "steps_rad": setup.steps.tolist(),
            "fixed": {"radius_m": setup.radius, "noise_m": setup.noise, "step_rad": setup.step},
            "repeats": setup.repeats,
            "grid_repeats": setup.grid_repeats,
            "box_m": setup.box,
            "node_m": setup.node,
            "frames": setup.frames,
            "frames_repeats": setup.frames_repeats,
            "seed": setup.seed,
        },
        "caveats": list(CAVEATS),
        "median_error_m": {name: errors.tolist() for name, errors in more.median_errors.items()},
        "repetition": {
            "steps_rad": STEPS_RAD.tolist(),
            "mean_of_centers_m": more.repetition.mean_of_centers.tolist(),
            "center_of_means_m": more.repetition.center_of_means.tolist(),
        },
        "radius": {"radii_m": RADII_M.tolist(), "error_ratio": more.radius_effect.tolist()},
        "pairs": [_pair_json(pair) for pair in study],
    }


def _pair_json(pair: PairMaps) -> dict[str, Any]:
    return {
        "name": pair.name,
        "printed": list(PRINTED[pair.name]),
        "correlations": [
            {
                "clip_m": clip,
                "predicted_analytic": correlations(pair, "grid", clip)[0],
                "analytic_grid": correlations(pair, "grid", clip)[1],
                "analytic_shifted_grid": correlations(pair, "shifted grid", clip)[1],
                "nearest_to_print": NEAREST[pair.name] == clip,
            }
            for clip in CLIPS_M
        ],
        "rows": pair.rows.tolist(),
        "columns": pair.columns.tolist(),
        "rms_m": {key: values.tolist() for key, values in pair.maps.items()},
        "refused_share": pair.refused.tolist(),
    }
