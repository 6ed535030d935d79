r"""Monte Carlo study of the circle fits: maps of the error over arc, noise and radius.

A marker at distance r from the center is at the angles 0, α and 2α; each coordinate has independent
noise of standard deviation σ. In each map, two of the quantities r, σ and α vary, and the third is
fixed. A map is a table, and each of its *cells* is one pair of values of the two quantities. For
every cell, the study computes the RMS errors of the methods over many runs, and the predicted error
for three frames,

.. math:: F = \sigma \sqrt{\frac{2 + \cos\alpha}{(1 - \cos\alpha)^2 (1 + \cos\alpha)}}

It also computes the Cramér-Rao bound for many frames spread evenly over the same arc 0 … 2α.
Source: Akbarifar et al. 2021, section 2-2-3, figure 2 and table 1. The source prints only part of
the setup; `StudySetup` documents the assumptions.

Invariant: one seeded generator supplies all random numbers, and each method computes all runs of a
row of cells in one call. The results therefore depend only on the seed and the setup.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.center_of_rotation.planar import (
    GATE,
    Grid,
    equal_step_error,
    fit_circles,
    grid_center,
    three_frame_center,
)
from jointfit_daemon.center_of_rotation.study._oriented_batch import oriented_centers

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from jointfit_daemon.arrays import Array


CLIPS_M = (None, 0.05, 0.15, 0.3, 0.5)
"""Upper limits that are applied to two maps before their correlation is computed, m; None is no
limit.
"""
PRINTED = {"α–σ": (0.99, 0.78), "r–σ": (0.99, 0.98), "r–α": (0.99, 0.94)}
"""Correlations in table 1 of the source. The first number of a pair is the correlation of the
analytic solution with the prediction. The second number is the correlation of the analytic solution
with the grid search.
"""


@dataclass(frozen=True, slots=True)
class StudySetup:
    """Parameters of the study, SI. Defaults reproduce figure 2 of the source."""

    radii: Array = field(default_factory=lambda: np.linspace(0.1, 0.6, 11))
    noises: Array = field(default_factory=lambda: 0.0005 * np.arange(11.0))
    steps: Array = field(default_factory=lambda: np.arange(5.0, 176.0, 5.0) * (np.pi / 180.0))
    """Angles α between successive frames; the poles 0 and π are excluded."""
    radius: float = 0.6
    """Radius r in the map with fixed r, m."""
    noise: float = 0.001
    step: float = np.pi / 3.0
    repeats: int = 1000
    """Number of runs of the three-frame solution in each cell."""
    grid_repeats: int = 150
    """Number of runs with grid searches, which are the first of the `repeats` runs."""
    box: float = 0.05
    """Half width of the grid about the true center, m."""
    node: float = 0.005
    """Distance between nodes, m."""
    frames: int = 100
    """Number of frames, spread evenly over the arc, for the estimators that use all frames."""
    frames_repeats: int = 30
    orientation_noise: float = float(np.deg2rad(1.0))
    """Standard deviation of the white error of the angle for the orientation-aided estimator,
    rad."""
    seed: int = 1


@dataclass(frozen=True, slots=True)
class PairMaps:
    """Error maps over one pair of the quantities r, σ and α."""

    name: str
    """Name of the pair, ``α–σ``, ``r–σ`` or ``r–α``, with the quantity of the rows first."""
    rows: Array
    """Values of the first quantity, SI."""
    columns: Array
    maps: Mapping[str, Array]
    """RMS error by method, m, shape (len(rows), len(columns)). ``predicted``, ``three frames``,
    ``grid`` and ``shifted grid`` use three frames; ``bound``, ``hyper`` and ``oriented`` use all
    frames.
    """
    refused: Array
    """Fraction of the runs in which the Hyper fit is refused: there is no circle, or T is below
    `GATE` (6). T is the radius divided by the largest standard error of the center."""


def correlation(a: Array, b: Array, clip: float | None = None) -> float:
    """Return Pearson's correlation of two maps limited to `clip`; 0 if one map is constant."""
    x, y = (np.minimum(m, np.inf if clip is None else clip).ravel() for m in (a, b))
    x, y = x - x.mean(), y - y.mean()
    scale = float(np.sqrt((x @ x) * (y @ y)))
    return float(x @ y) / scale if scale > 0.0 else 0.0


def run_study(
    setup: StudySetup, on_progress: Callable[[float], None] | None = None
) -> list[PairMaps]:
    """Compute all maps.

    Parameters
    ----------
    setup : StudySetup
    on_progress : callable, optional
        Function that is called after every row of cells with the completed fraction, 0 to 1.

    Returns
    -------
    list of PairMaps
        Maps of the pairs α–σ, r–σ and r–α.
    """
    r, s, a = setup.radii, setup.noises, setup.steps
    fixed = np.array([setup.radius]), np.array([setup.noise]), np.array([setup.step])
    pairs = (
        ("α–σ", a, s, lambda row: (fixed[0], s, np.array([row]))),
        ("r–σ", r, s, lambda row: (np.array([row]), s, fixed[2])),
        ("r–α", r, a, lambda row: (np.array([row]), fixed[1], a)),
    )
    rng = np.random.default_rng(setup.seed)
    total, done = sum(len(rows) for _, rows, _, _ in pairs), 0
    found: list[PairMaps] = []

    for name, rows, columns, cells in pairs:
        lines = []
        for row in rows:
            radius, noise, step = np.broadcast_arrays(*cells(float(row)))

            # Compute all results of one row of cells, each of shape (cells,).
            three = _noisy(rng, radius, noise, step[:, None] * np.arange(3.0), setup.repeats)
            few = three[:, : setup.grid_repeats]
            results = {
                "predicted": equal_step_error(step, noise),
                "three frames": _rms(three_frame_center(three)),
            }

            for word, offset in (("grid", 0.0), ("shifted grid", 0.5 * setup.node)):
                nodes = Grid((offset, offset), setup.box, setup.node)
                results[word] = _rms(grid_center(few, nodes))
            lines.append(results | _all_frames(setup, rng, radius, noise, step))
            done += 1
            if on_progress is not None:
                on_progress(done / total)

        maps = {key: np.array([line[key] for line in lines]) for key in lines[0]}
        refused = maps.pop("refused")
        found.append(PairMaps(name, rows, columns, maps, refused))

    return found


def uniform_arc_rms(arc: float, frames: int, noise: float, *, known_radius: bool = False) -> float:
    r"""Return the Cramér-Rao bound of the RMS error of a circle's center, in closed form, m.

    The points are spread evenly over an arc, and there are many of them. For any points,
    ``bench.baselines.circle_theory`` computes this bound.

    .. math:: E^2 = \frac{\sigma^2}{n} \left[ \frac{2}{1-c} + \frac{2}{1+c-2s^2} \right],
              \quad s = \frac{\sin(\varphi/2)}{\varphi/2}, \quad c = \frac{\sin\varphi}{\varphi}

    where φ is the arc, n the number of frames and σ the noise. If the radius is known, the term 2s²
    is zero. On short arcs E is about 26.8 σ/(√n φ²) for an unknown radius.

    Parameters
    ----------
    arc : float
        Arc φ, rad, above zero.
    frames : int
        Number of frames n.
    noise : float
        Standard deviation of each coordinate, m.
    known_radius : bool
        Whether the radius is known and not estimated.
    """
    s = float(np.sinc(arc / (2.0 * np.pi)))
    c = float(np.sinc(arc / np.pi))
    along = 1.0 + c - (0.0 if known_radius else 2.0 * s**2)
    if not known_radius and arc < 0.05:
        along = arc**4 / 360.0  # series expansion, because the difference cancels there
    if c >= 1.0 or along <= 0.0 or frames <= 0:  # the arc is zero or within rounding
        return float("inf")
    return float(noise * np.sqrt((2.0 / (1.0 - c) + 2.0 / along) / frames))


def _all_frames(
    setup: StudySetup, rng: np.random.Generator, radius: Array, noise: Array, step: Array
) -> dict[str, Array]:
    arc = 2.0 * step
    angles = arc[:, None] * np.linspace(0.0, 1.0, setup.frames)
    many = _noisy(rng, radius, noise, angles, setup.frames_repeats)
    circles = fit_circles(many)
    accepted = circles.valid & (circles.conditioning >= GATE)
    drawn = rng.normal(0.0, setup.orientation_noise, many.shape[:-1])
    aided = oriented_centers(many, angles[:, None] + drawn)
    least = [
        uniform_arc_rms(float(a), setup.frames, float(s)) for a, s in zip(arc, noise, strict=True)
    ]

    return {
        "bound": np.array(least),
        "hyper": _rms(np.where(accepted[..., None], circles.center, np.nan)),
        "oriented": _rms(aided),
        "refused": np.asarray((~accepted).mean(axis=-1)),
    }


def _noisy(
    rng: np.random.Generator, radius: Array, noise: Array, angles: Array, repeats: int
) -> Array:
    """Return measured points about the origin, shape (cells, repeats, frames, 2)."""
    true = radius[:, None, None] * np.stack((np.cos(angles), np.sin(angles)), axis=-1)
    drawn = rng.normal(size=(len(radius), repeats, *true.shape[1:]))
    return np.asarray(true[:, None] + noise[:, None, None, None] * drawn)


def _rms(centers: Array) -> Array:
    """Return the RMS distance from the origin over runs with a result, (cells,); NaN if none."""
    squares = (centers**2).sum(axis=-1)
    answered = np.isfinite(squares)
    total = np.where(answered, squares, 0.0).sum(axis=-1)
    count = answered.sum(axis=-1)
    return np.asarray(np.sqrt(np.where(count > 0, total / np.maximum(count, 1), np.nan)))
