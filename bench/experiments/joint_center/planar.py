"""Centers of rotation in the plane: equations, Cramér-Rao bound, other libraries, and time.

The numbers of equations are those of Akbarifar et al. 2021.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

from bench.baselines.circle_theory import (
    arbitrary_error,
    circle_bound,
    circle_rms_bound,
    combine,
    triangle_error,
)
from bench.framework.experiment import Experiment, Result
from bench.framework.material import SEEDED
from bench.subjects.planar_arcs import (
    arc_points,
    runs_on,
    share_covered,
    upper_rms,
)
from jointfit_daemon.center_of_rotation.planar import (
    CircleLimits,
    RunningCircle,
    circle_estimate,
    equal_step_error,
    fit_circle,
    fit_circles,
    geometric_estimate,
    three_frame_center,
    three_frame_mean_squares,
)

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from jointfit_daemon.arrays import Array

WIDE = CircleLimits(0.0, (0.0, np.inf), 0.0, np.inf)


def three_frames(_: Path) -> list[Result]:
    """Compare the closed form with the solution of the linear equations for the center.

    The second result is the error of equation 11 as printed, with its misprint.
    """
    rng = np.random.default_rng(1)
    p = rng.uniform(-1.0, 1.0, (30_000, 3, 2))
    u, v = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    area = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2
    longest = np.maximum.reduce([(w**2).sum(axis=1) for w in (u, v, u - v)])
    p = p[area >= 0.01 * longest][:10_000]
    normals = 2.0 * (p[:, 1:] - p[:, :1])
    heights = (p[:, 1:] ** 2).sum(axis=2) - (p[:, :1] ** 2).sum(axis=2)
    solved = np.linalg.solve(normals, heights[..., None])[..., 0]
    off = float(np.abs(three_frame_center(p) - solved).max())
    return [
        Result("largest difference", off, 1e-12, unit="m"),
        Result("RMS with equation 11 as printed", _as_printed(rng), np.inf, 1.0, "m"),
    ]


def _as_printed(rng: np.random.Generator) -> float:
    """Return the RMS error of equation 11 as printed, m: steps of 60°, noise of 1 mm.

    In the denominator, the publication prints (x1 - x2) in place of (x1 - x3).
    """
    p = arc_points(np.deg2rad(60.0) * np.arange(3), 0.2) + rng.normal(0, 0.001, (20_000, 3, 2))
    x, y, s = p[..., 0], p[..., 1], (p**2).sum(axis=-1)
    above = (s[:, 1] - s[:, 0]) * (y[:, 2] - y[:, 0]) - (s[:, 2] - s[:, 0]) * (y[:, 1] - y[:, 0])
    wrong = (x[:, 0] - x[:, 1]) * (y[:, 0] - y[:, 1]) - (x[:, 0] - x[:, 1]) * (y[:, 0] - y[:, 2])
    return float(np.sqrt(np.mean((above / (2.0 * wrong)) ** 2)))


def equal_steps(_: Path) -> list[Result]:
    """Compare the predicted error of equal steps (equation 15) with 200 000 simulated runs."""
    figures = []
    for step in (45, 60, 90, 120, 150):
        rng = np.random.default_rng(step)
        alpha = np.deg2rad(step)
        p = arc_points(alpha * np.arange(3), 0.2) + rng.normal(0.0, 0.001, (200_000, 3, 2))
        rms = float(np.sqrt((three_frame_center(p) ** 2).sum(axis=1).mean()))
        ratio = rms / float(equal_step_error(alpha, 0.001))
        figures.append(
            Result(f"{step}°: simulated error divided by predicted", ratio, 1.01, 0.99, "")
        )
    return figures


SIX_NOISES_M = 1e-3 * np.array([[0.3, 1.2], [0.8, 0.4], [1.5, 0.6]])
"""Standard deviations of x and y in three frames, m."""


def unequal_noise(_: Path) -> list[Result]:
    """Compare simulated with predicted errors for unequal noise.

    The noise has six standard deviations (x and y in three frames), or one per frame.
    """
    t = np.array([0.3, 1.4, 2.9])
    drawn = np.random.default_rng(5).normal(size=(400_000, 3, 2))
    figures = []
    for label, noise in (("six", SIX_NOISES_M), ("one per frame", SIX_NOISES_M[:, :1])):
        squares = (three_frame_center(arc_points(t, 0.2) + noise * drawn) ** 2).mean(axis=0)
        ratios = np.sqrt(squares / three_frame_mean_squares(t, noise))
        figures += [
            Result(f"{label}, {axis}: simulated / predicted", float(ratio), 1.01, 0.99, "")
            for axis, ratio in zip("xy", ratios, strict=True)
        ]
    return figures


def forms(_: Path) -> list[Result]:
    """Compare two forms of equation 14, by angles and by side lengths, and the Cramér-Rao bound."""
    rng = np.random.default_rng(3)
    t = np.sort(rng.uniform(0.0, 2.0 * np.pi, (500, 3)), axis=1)
    t = t[np.diff(t, axis=1).min(axis=1) > 0.2]
    angles = arbitrary_error(t, 0.001)
    sides = triangle_error(arc_points(t, 0.3), 0.001)
    bound = np.array([circle_rms_bound(row, 0.001) for row in t])
    return [
        Result("from side lengths", float(np.abs(sides / angles - 1.0).max()), 1e-10, unit=""),
        Result("Cramér-Rao", float(np.abs(bound / angles - 1.0).max()), 1e-10, unit=""),
    ]


CASES = ((100, 90, 0.002), (100, 45, 0.005), (100, 20, 0.0005), (100, 20, 0.002), (500, 30, 0.002))


def plain_hyper(_: Path) -> list[Result]:
    """Compare the published Hyper fit and the Kåsa fit with the bound."""
    figures = []
    for n, arc, noise in CASES:
        goal = 1.2 if (n, arc, noise) == (100, 20, 0.002) else 1.05
        for method, limit in (("hyper", goal), ("kasa", np.inf)):
            found = runs_on(n, arc, noise, runs=4000, method=method, tempered=False)
            label = f"{method}, n = {n}, {arc}°, {1000 * noise:g} mm"
            figures.append(Result(label, found.rms / found.bound, limit, unit="× bound"))
    return figures


def streaming(_: Path) -> list[Result]:
    """Compare streaming fits, with forgetting or a window, with batch fits; measure their time."""
    rng = np.random.default_rng(5)
    n = 2000
    swing = 0.6 * np.sin(np.arange(n) * 0.05)
    p = arc_points(swing, 0.3) + np.array([0.7, -0.7]) + rng.normal(0.0, 0.002, (n, 2))
    figures = []
    for name, forgetting, window in (
        ("all", 1.0, None),
        ("forgetting", 0.995, None),
        ("window", 1.0, 300),
    ):
        running = RunningCircle(forgetting=forgetting, window=window)
        for x, y in p.tolist():
            running.feed(x, y)
        weights = forgetting ** np.arange(n - 1, -1, -1.0)
        last = slice(-window if window else None, None)
        batch, live = circle_estimate(p[last], weights[last]), running.estimate()
        off = np.abs(batch.center - live.center).max()
        figures.append(Result(f"{name}: center", float(off), 1e-9, unit="m"))
        off_sd = abs(batch.rms_error - live.rms_error)
        figures.append(Result(f"{name}: predicted error", float(off_sd), 1e-9, unit="m"))
    running, began = RunningCircle(), time.thread_time()
    for x, y in p.tolist():
        running.feed(x, y)
        running.circle()
    took = (time.thread_time() - began) / n
    return [*figures, Result("time per frame, center included", 1e6 * took, 40.0, unit="µs")]


def claims(_: Path) -> list[Result]:
    """Measure the ratio of predicted to actual error, and which share of short arcs is accepted."""
    figures = []
    for n, arc, noise in ((100, 22, 0.002), (100, 30, 0.002), *CASES[:3], CASES[4]):
        found = runs_on(n, arc, noise, runs=8000)
        label = f"n = {n}, {arc}°, {1000 * noise:g} mm: predicted / actual"
        figures.append(Result(label, found.claimed / found.rms, 1.15, 0.85, ""))
    for arc, goal in ((10, 0.01), (15, 0.05)):
        share = float(runs_on(100, arc, 0.002, runs=8000).published.mean())
        figures.append(Result(f"{arc}°, 2 mm: share accepted", share, goal, unit=""))
    return figures


def several(_: Path) -> list[Result]:
    """Measure the errors with four markers at different angles about the joint, arc of 20°."""
    rng = np.random.default_rng(7)
    t = np.linspace(-0.5, 0.5, 100) * np.deg2rad(20.0)
    offsets, radii = np.array([0.0, 0.25, -0.3, 0.6]), np.array([0.30, 0.35, 0.20, 0.28])
    turned = t[:, None] + offsets
    truth = np.stack((radii * np.cos(turned), radii * np.sin(turned)), axis=-1)
    information = [np.linalg.inv(circle_bound(turned[:, k], 0.002)) for k in range(4)]
    bound = float(np.sqrt(np.trace(np.linalg.inv(np.sum(information, axis=0)))))
    weighted, joint = [], []
    for _run in range(400):
        p = truth + rng.normal(0.0, 0.002, truth.shape)
        each = [circle_estimate(p[:, k], limits=WIDE) for k in range(4)]
        weighted.append(combine(each)[0])
        joint.append(geometric_estimate(p, robust=False, limits=WIDE).center)
    return [
        Result("one fit per marker, combined", _rms(weighted) / bound, 1.2, unit="× bound"),
        Result("one fit of all markers", _rms(joint) / bound, 1.2, unit="× bound"),
    ]


def _rms(centers: list[Array]) -> float:
    return float(np.sqrt((np.array(centers) ** 2).sum(axis=1).mean()))


def at_the_bound(_: Path) -> list[Result]:
    """Measure the upper 95 % limit of the RMS error of all 20 000 circles, divided by the bound."""
    figures = []
    for arc, goal in ((20, 1.15), (30, 1.15), (45, 1.03), (60, 1.03), (90, 1.03), (180, 1.03)):
        found = runs_on(100, arc, 0.002)
        figures.append(
            Result(f"{arc}°: Hyper, shrunk", upper_rms(found) / found.bound, goal, unit="× bound")
        )
        plain = runs_on(100, arc, 0.002, tempered=False)
        ratio = upper_rms(plain) / plain.bound
        figures.append(Result(f"{arc}°: Hyper", ratio, max(goal, 1.16), unit="× bound"))
    return figures


ELLIPSES: tuple[tuple[int, float, float, float], ...] = (
    *((100, arc, 0.002, 0.3) for arc in (17, 18, 19, 20, 22, 25, 30, 45, 90, 180, 360)),
    *((500, arc, 0.002, 0.3) for arc in (12, 13.5, 15, 45)),
    *((30, arc, 0.002, 0.3) for arc in (27, 30, 60)),
    *((15, arc, 0.002, 0.3) for arc in (33, 45, 90)),
    *((100, arc, 0.01, 0.3) for arc in (45, 60, 120)),
    *((100, arc, 0.001, 0.1) for arc in (26, 40, 90)),
    *((60, arc, 0.02, 0.45) for arc in (60, 90, 200)),
)


def ellipses(_: Path) -> list[Result]:
    """Measure the share of accepted centers whose 95 % ellipse contains the true center."""
    figures = []
    for n, arc, noise, radius in ELLIPSES:
        found = runs_on(n, arc, noise, radius=radius, runs=10_000, correlated=True)
        share = share_covered(found, n)
        label = f"n = {n}, {arc:g}°, noise {1000 * noise:g} mm, radius {100 * radius:g} cm"
        accepted = f"{100 * float(found.published.mean()):.0f} % accepted"
        figures.append(Result(label, share, 0.97, 0.93, "", note=accepted))
    return figures


def peers(_: Path) -> list[Result]:
    """Compare accuracy and time with the packages circle-fit and SciPy, at 45° and 5 mm."""
    from circle_fit import hyperLSQ, hyperSVD, lm, taubinSVD  # noqa: PLC0415 - only here
    from scipy.optimize import least_squares  # noqa: PLC0415 - slow to import

    rng = np.random.default_rng(9)
    p = arc_points(np.linspace(-0.5, 0.5, 100) * np.deg2rad(45.0), 0.3)
    sets = p + rng.normal(0.0, 0.005, (300, 100, 2))

    def by_scipy(x: Array) -> Array:
        start = np.array([*x.mean(axis=0), 0.3])

        def off(z: Array) -> Array:
            return np.asarray(np.linalg.norm(x - z[:2], axis=1) - z[2])

        found = least_squares(off, start)
        return np.asarray(found.x)

    others: dict[str, Callable[[Array], object]] = {
        "circle-fit hyperSVD": hyperSVD,
        "circle-fit hyperLSQ": hyperLSQ,
        "circle-fit taubinSVD": taubinSVD,
        "circle-fit lm": lambda x: lm(x, np.array([*x.mean(axis=0), 0.3])),
        "scipy least_squares": by_scipy,
    }
    mine, error = _timed(fit_circle, sets)
    judged, drawn_in = _timed(lambda x: circle_estimate(x, limits=WIDE).center, sets)
    began = time.thread_time()
    fit_circles(sets)
    many = (time.thread_time() - began) / len(sets)
    figures = [
        Result("jointfit: circle only", 1e6 * mine, np.inf, unit="µs"),
        Result("jointfit: with covariance and acceptance", 1e6 * judged, np.inf, unit="µs"),
        Result("jointfit: 300 circles at once", 1e6 * many, np.inf, unit="µs"),
        Result("jointfit: RMS error, shrinkage over plain", drawn_in / error, 1.0, unit=""),
    ]
    for name, fit in others.items():
        took, off = _timed(fit, sets)
        figures.append(Result(f"{name}: time ratio of jointfit", mine / took, 1.0, unit=""))
        figures.append(Result(f"{name}: RMS error ratio of jointfit", error / off, 1.005, unit=""))
    return figures


def _timed(fit: Callable[[Array], object], sets: Array) -> tuple[float, float]:
    fit(sets[0])
    began = time.thread_time()
    centers = [np.asarray(fit(x))[:2] for x in sets]
    took = (time.thread_time() - began) / len(sets)
    return took, float(np.sqrt((np.array(centers, dtype=np.float64) ** 2).sum(axis=1).mean()))


EXPERIMENTS = (
    Experiment(
        "circle-three-frames",
        "Circle through three frames, compared with the solution by Cramer's rule, 10 000 runs",
        three_frames,
        SEEDED,
    ),
    Experiment(
        "circle-error-prediction",
        "Predicted error of three frames at equal angles, compared with 200 000 simulated runs",
        equal_steps,
        SEEDED,
    ),
    Experiment(
        "circle-unequal-noise",
        "Predicted errors along x and y for unequal noise, compared with 400 000 simulated runs",
        unequal_noise,
        SEEDED,
    ),
    Experiment(
        "circle-error-formulas",
        "Predicted error: largest relative difference from the formula with angles, 500 runs",
        forms,
        SEEDED,
    ),
    Experiment(
        "circle-cramer-rao",
        "RMS error of circle fits divided by the Cramér-Rao bound, 4000 runs",
        plain_hyper,
        SEEDED,
    ),
    Experiment(
        "circle-streaming",
        "Difference between a circle updated frame by frame and the batch fit",
        streaming,
        SEEDED,
    ),
    Experiment(
        "circle-claimed-error",
        "Predicted error divided by actual error, and share of accepted estimates, 8000 runs",
        claims,
        SEEDED,
    ),
    Experiment(
        "circle-several-markers",
        "Centre from four markers on a 20° arc: RMS error divided by the Cramér-Rao bound, 400 "
        "runs",
        several,
        SEEDED,
    ),
    Experiment(
        "circle-published-estimates",
        "Upper 95 % limit of the RMS error, divided by the Cramér-Rao bound, 20 000 runs",
        at_the_bound,
        SEEDED,
        headline=True,
    ),
    Experiment(
        "circle-ellipse-coverage",
        "Coverage of the 95 % ellipses of accepted estimates, 10 000 runs each",
        ellipses,
        SEEDED,
        long=True,
    ),
    Experiment(
        "circle-other-libraries",
        "Comparison with circle-fit and SciPy in one run, 300 arcs",
        peers,
        SEEDED,
        packages=("circle_fit", "scipy"),
    ),
)
