"""Centers of rotation in space from markers, spheres and two moving bodies; bounds and coverage."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from bench.framework.experiment import Experiment, Result, median_and_worst, near
from bench.framework.material import SEEDED
from bench.subjects.simulated_joints import (
    CHILD,
    PARENT,
    TEMPLATE_ERROR_M,
    ball_turns,
    carried,
    covers,
    fan,
    hinge_turns,
    joint_bound,
    sphere_bound,
    star_turns,
    watched,
)
from jointfit_daemon.center_of_rotation import fuse_centers
from jointfit_daemon.center_of_rotation.planar import CircleLimits, circle_estimate
from jointfit_daemon.center_of_rotation.spatial import (
    RunningSphere,
    SphereOptions,
    fit_axis,
    fit_running,
    fit_score,
    fit_sphere,
    gamage_lasenby,
    halvorsen,
    relative,
    spatial_noise,
)
from jointfit_daemon.units import MM_PER_M

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from jointfit_daemon.arrays import Array

    Paths = Callable[[np.random.Generator], Array]

NOISE = 1e-3
"""Standard deviation of the noise of every coordinate, m."""


AT_20, AT_45 = (2.15, 2.15, 2.28, 3.26, inf), (0.85, 0.85, 0.91, 1.00, inf)
"""Results of other authors at ranges of motion of 20° and 45°, mm, for the five methods of
`ball_joint` in their order. The last method is not recommended, and its threshold is infinite."""


def rms(errors: list[Array]) -> float:
    return float(np.sqrt(np.mean([e @ e for e in errors])))


def four_markers(_: Path) -> list[Result]:
    """Measure the error of the center: four markers, arc of 20°, noise of 2 mm, 400 runs."""
    rng = np.random.default_rng(7)
    truth, noise = fan(20.0), 2e-3
    bound = np.sqrt(sphere_bound(truth, noise))
    anyhow = CircleLimits(gate=0.0, arc=0.0, rms_error=inf)
    fused, joint = [], []
    for _run in range(400):
        seen = truth + rng.normal(0, noise, truth.shape)
        single = [circle_estimate(seen[:, j], limits=anyhow) for j in range(4)]
        fused.append(fuse_centers(single).center)
        joint.append(fit_running(seen).center)
    return [
        Result(
            "one fit per marker, combined: RMS error divided by bound",
            rms(fused) / bound,
            1.2,
            unit="",
        ),
        Result(
            "one fit of all markers: RMS error divided by bound", rms(joint) / bound, 1.05, unit=""
        ),
    ]


def upper_rms(errors: list[Array]) -> float:
    """Return the upper 95 % confidence limit of the RMS error, m."""
    squares = np.array([e @ e for e in errors])
    return float(np.sqrt(squares.mean() + 1.645 * squares.std() / np.sqrt(len(squares))))


def frame_by_frame(_: Path) -> list[Result]:
    """Compare the streaming sphere fit with the batch fit, for a movement with occluded markers."""
    rng = np.random.default_rng(5)
    points = carried(star_turns(45.0, 1000)) + rng.normal(0, NOISE, (1000, 4, 3))
    points[rng.uniform(size=points.shape[:2]) < 0.1] = np.nan
    stream = RunningSphere(4)
    for frame in points:
        stream.feed(frame)
    live, batch = stream.estimate(), fit_running(points)
    off = float(np.abs(live.center - batch.center).max())
    return [
        Result("center", off, 1e-9, unit="m"),
        Result("predicted error", abs(live.rms_error - batch.rms_error), 1e-9, unit="m"),
    ]


def ball_joint(rom: float, goals: tuple[float, ...], runs: int = 200) -> list[Result]:
    """Compare five methods on two bodies with a noise of 1 mm on all markers.

    Results of fewer than 200 runs vary by chance, and the tolerance allows for this variation. For
    1000 or more runs, the results are upper 95 % confidence limits.
    """
    rng = np.random.default_rng(10)
    errors: dict[str, list[Array]] = {}
    bounds = []
    for _run in range(runs):
        turns = ball_turns(rng, rom)
        seen = watched(rng, turns, template_error=TEMPLATE_ERROR_M)
        bounds.append(joint_bound(carried(turns), NOISE))
        shape = relative(seen.points, PARENT, halvorsen(seen.points).center)
        for name, found in (
            ("sphere", fit_sphere(seen.points, SphereOptions(huber=inf), parent=PARENT)),
            ("running sphere", fit_running(seen.points, shape=shape)),
            ("Halvorsen", halvorsen(seen.points)),
            ("SCoRE", fit_score(seen.parent, seen.child, robust=False)),
            ("Gamage-Lasenby", gamage_lasenby(seen.points)),
        ):
            errors.setdefault(name, []).append(found.center)
    room = 1.15 if runs >= 200 else 1.15 * (1.0 + 1.645 / float(np.sqrt(3.0 * runs)))
    size, kind = (upper_rms, ", upper 95 % confidence limit") if runs >= 1000 else (rms, "")
    return [
        *(
            Result(f"{name}{kind}", MM_PER_M * size(found), room * goal, unit="mm")
            for (name, found), goal in zip(errors.items(), goals, strict=True)
        ),
        Result("Cramér-Rao bound", MM_PER_M * float(np.sqrt(np.mean(bounds))), inf, unit="mm"),
    ]


def _ball_joint(rom: float, goals: tuple[float, ...], runs: int, _: Path) -> list[Result]:
    return ball_joint(rom, goals, runs=runs)


def hinge_axis(_: Path) -> list[Result]:
    """Measure the axis error of a hinge that rotates about z by 45°, in 200 runs."""
    rng = np.random.default_rng(11)
    markers = CHILD[:, [0, 2, 1]]
    off: list[Array] = []
    angle: list[float] = []
    told = 0
    for _run in range(200):
        seen = watched(rng, hinge_turns(45.0), markers=markers)
        found = fit_axis(seen.parent, seen.child)
        if found.axis is None:
            return [Result("rejected", 1.0, 0.0, unit="")]
        off.append(np.array([*found.center[:2], 0.0]))
        tilt = np.arctan2(np.hypot(*found.axis[:2]), abs(found.axis[2]))
        angle.append(float(np.degrees(tilt)))
        told += found.rms_error == inf
    return [
        Result("direction, RMS", float(np.sqrt(np.mean(np.square(angle)))), 0.4),
        *median_and_worst("direction", angle),
        Result("offset, RMS", MM_PER_M * rms(off), 1.6, unit="mm"),
        *median_and_worst("offset", [MM_PER_M * float(np.linalg.norm(e)) for e in off], "mm"),
        near("share with unbounded variance along the axis", told / 200, 1.0, 0.0, unit=""),
    ]


def parent_covariance(_: Path) -> list[Result]:
    """Compare the predicted covariance of a point in a noisy frame with 20 000 simulated frames."""
    rng = np.random.default_rng(12)
    point, noise = CHILD[1], 1e-3
    turns = np.tile(np.eye(3), (20_000, 1, 1))
    seen = watched(rng, turns, markers=CHILD, noise=noise).points[:, 1]
    found = np.cov(seen.T)
    told = spatial_noise(point, PARENT, noise)
    worst = float(np.abs(np.sqrt(np.diag(found) / np.diag(told)) - 1.0).max())
    overall = abs(float(np.trace(found) / np.trace(told)) - 1.0)
    return [
        Result("trace", 100 * overall, 5.0, unit="%"),
        Result("worst standard deviation", 100 * worst, 5.0, unit="%"),
    ]


@dataclass(frozen=True, slots=True)
class Setup:
    """One movement of the markers and one type of noise."""

    name: str
    paths: Paths
    """Function that returns the true paths of k markers in n frames, m, shape (n, k, d)."""
    see: Callable[[np.random.Generator, Array], Array]
    """Function that returns the measured paths, from the true paths."""
    efficient: float = inf
    """Threshold for the ratio of RMS error to the bound."""


def measured(setup: Setup, runs: int, seed: int = 2024) -> list[Result]:
    """Return coverage, RMS error divided by bound, and rejections of the streaming estimator."""
    rng = np.random.default_rng(seed)
    errors, bounds, held, refused = [], [], 0, 0
    for _run in range(runs):
        truth = setup.paths(rng)
        found = fit_running(setup.see(rng, truth), near=np.zeros(truth.shape[2]))
        if found.refused is not None:
            refused += 1
            continue
        across = np.eye(len(found.center)) - found.unseen.T @ found.unseen
        errors.append(across @ found.center)
        held += covers(found)
        if len(found.unseen) == 0:
            bounds.append(sphere_bound(truth, NOISE))
    accepted = runs - refused
    slack = 200.0 * float(np.sqrt(0.95 * 0.05 / accepted)) if runs < 2000 else 0.0
    share = 100 * held / accepted
    figures = [Result(f"{setup.name}: coverage", share, 97 + slack, 93 - slack, "%")]
    if len(bounds) == accepted:
        ratio = rms(errors) / float(np.sqrt(np.mean(bounds)))
        figures.append(
            Result(f"{setup.name}: RMS error divided by bound", ratio, setup.efficient, unit="")
        )
    return [*figures, Result(f"{setup.name}: rejected", 100 * refused / runs, 5.0, unit="%")]


def white(rng: np.random.Generator, truth: Array) -> Array:
    return truth + rng.normal(0, NOISE, truth.shape)


def lasting(rng: np.random.Generator, truth: Array) -> Array:
    """Add noise with a correlation of 0.5 between neighbouring frames."""
    e = rng.normal(0, NOISE, truth.shape)
    for t in range(1, len(e)):
        e[t] = 0.5 * e[t - 1] + np.sqrt(0.75) * e[t]
    return np.asarray(truth + e)


def from_moving_parent(rng: np.random.Generator, _: Array) -> Array:
    return watched(rng, ball_turns(rng, 45)).points


def ball(arc: float, markers: Array = CHILD) -> Paths:
    return lambda rng: carried(ball_turns(rng, arc), markers)


def hinge(arc: float, markers: Array = CHILD) -> Paths:
    return lambda _: carried(hinge_turns(arc, axis=0), markers)


def circling(_: np.random.Generator) -> Array:
    """Return a smooth hip movement of 45° in all directions."""
    return carried(star_turns(45.0, 300))


SETUPS = (
    *(Setup(f"ball {arc}°", ball(arc), white, 1.1) for arc in (10, 20, 45, 90)),
    Setup("one marker, ball 45°", ball(45, CHILD[:1]), white, 1.1),
    *(Setup(f"hinge {arc}°", hinge(arc), white) for arc in (20, 45, 90)),
    Setup("one marker, hinge 45°", hinge(45, CHILD[:1]), white),
    Setup("in a plane 20°", lambda _: fan(20.0), white, 1.1),
    Setup("moving noisy parent", ball(45), from_moving_parent),
    Setup("noise correlated over time, smooth movement", circling, lasting),
    Setup("noise correlated over time, jerky movement", ball(45), lasting),
)


def coverage(runs: int) -> list[Result]:
    return [
        figure for seed, setup in enumerate(SETUPS, 100) for figure in measured(setup, runs, seed)
    ]


BALL_IDS = {20.0: "ball-joint-twenty-degrees", 45.0: "ball-joint-forty-five-degrees"}
EXPERIMENTS = (
    Experiment(
        "sphere-streaming",
        "Difference between a sphere updated frame by frame and the batch fit",
        frame_by_frame,
        SEEDED,
    ),
    Experiment(
        "sphere-several-markers",
        "Centre from four markers at a joint, 20° arc: RMS error divided by the Cramér-Rao bound, "
        "400 runs",
        four_markers,
        SEEDED,
    ),
    *(
        Experiment(
            BALL_IDS[rom],
            f"Ball joint, range of motion {rom:g}°, noise on both bodies, 200 runs: RMS error",
            partial(_ball_joint, rom, goals, 200),
            SEEDED,
            long=True,
            headline=rom == 20.0,
        )
        for rom, goals in ((20.0, AT_20), (45.0, AT_45))
    ),
    *(
        Experiment(
            f"{BALL_IDS[rom]}-limits",
            f"Ball joint, range of motion {rom:g}°, 1000 runs: upper 95 % confidence limits of the "
            "RMS error",
            partial(_ball_joint, rom, goals, 1000),
            SEEDED,
            long=True,
        )
        for rom, goals in ((20.0, AT_20), (45.0, AT_45))
    ),
    Experiment(
        "hinge-axis",
        "Axis of a hinge (SARA), range of motion 45°, 200 runs",
        hinge_axis,
        SEEDED,
    ),
    Experiment(
        "parent-frame-covariance",
        "Covariance due to noise of the proximal frame, compared with 20 000 simulated frames",
        parent_covariance,
        SEEDED,
    ),
    Experiment(
        "sphere-ellipse-coverage",
        "Streaming sphere, 100 runs: Cramér-Rao bound and coverage of the 95 % ellipsoids",
        lambda _: coverage(100),
        SEEDED,
    ),
    Experiment(
        "sphere-ellipse-coverage-long",
        "Streaming sphere, 4000 runs: Cramér-Rao bound and coverage of the 95 % ellipsoids",
        lambda _: coverage(4000),
        SEEDED,
        long=True,
    ),
)
