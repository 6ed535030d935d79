"""Monte Carlo study of the circle fits: published correlations, exactness and shapes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jointfit_daemon.center_of_rotation.planar import oriented_estimate
from jointfit_daemon.center_of_rotation.study import PairMaps, StudySetup, correlation, run_study
from jointfit_daemon.center_of_rotation.study._oriented_batch import oriented_centers

SHORT = StudySetup(repeats=300, grid_repeats=60, frames_repeats=4, frames=30)


@pytest.fixture(scope="module")
def study() -> dict[str, PairMaps]:
    return {pair.name: pair for pair in run_study(SHORT)}


@pytest.mark.parametrize(
    ("name", "clip", "predicted", "grid"),
    [("α–σ", 0.3, 0.98, 0.81), ("r–σ", None, 1.00, 0.99), ("r–α", 0.15, 0.96, 0.91)],
)
def test_the_correlations_of_the_table_are_reproduced(
    study: dict[str, PairMaps], name: str, clip: float | None, predicted: float, grid: float
) -> None:
    """The tolerances are those of the experiment published-error-maps. This test has fewer runs."""
    maps = study[name].maps
    analytic = maps["three frames"]
    assert correlation(maps["predicted"], analytic, clip) == pytest.approx(predicted, abs=0.03)
    assert correlation(analytic, maps["grid"], clip) == pytest.approx(grid, abs=0.06)


def test_maps_are_as_large_as_their_axes(study: dict[str, PairMaps]) -> None:
    assert {name: pair.maps["grid"].shape for name, pair in study.items()} == {
        "α–σ": (35, 11),
        "r–σ": (11, 11),
        "r–α": (11, 35),
    }
    for pair in study.values():
        for values in pair.maps.values():
            assert values.shape == (len(pair.rows), len(pair.columns))


def test_without_noise_every_method_but_a_shifted_grid_is_exact(
    study: dict[str, PairMaps],
) -> None:
    for pair in (study["α–σ"], study["r–σ"]):
        for key in ("predicted", "three frames", "grid", "oriented"):
            assert np.abs(pair.maps[key][:, 0]).max() < 1e-6
        shift = SHORT.node / np.sqrt(2.0)
        assert pair.maps["shifted grid"][:, 0].min() == pytest.approx(shift, rel=1e-9)


def test_grid_error_is_limited_by_its_box(study: dict[str, PairMaps]) -> None:
    for pair in study.values():
        assert pair.maps["grid"].max() <= np.sqrt(2.0) * SHORT.box + 1e-12


def test_a_seed_gives_the_same_study_and_another_a_different_one() -> None:
    tiny = StudySetup(
        radii=np.array([0.2, 0.4]),
        noises=np.array([0.001]),
        steps=np.deg2rad([40.0, 80.0]),
        repeats=5,
        grid_repeats=2,
        frames_repeats=2,
        frames=12,
    )
    told: list[float] = []
    first, same = run_study(tiny, told.append), run_study(tiny)
    other = run_study(replace(tiny, seed=2))
    for a, b, c in zip(first, same, other, strict=True):
        assert np.array_equal(a.maps["three frames"], b.maps["three frames"])
        assert not np.array_equal(a.maps["three frames"], c.maps["three frames"])
    assert told == sorted(told)
    assert told[-1] == 1.0


def test_a_clip_makes_one_outlier_harmless() -> None:
    a = np.array([[5.0, 2.0], [3.0, 4.0]])
    b = a.copy()
    b[1, 0] = 1e6
    assert correlation(a, b) < 0.0
    assert correlation(a, b, 3.0) == pytest.approx(1.0)


def test_constant_map_has_no_correlation() -> None:
    a = np.array([[1.0, 2.0], [3.0, 4.0]])
    assert correlation(a, a, 0.5) == 0.0


def test_exact_points_and_angles_give_the_exact_center() -> None:
    rng = np.random.default_rng(3)
    center, phase = rng.uniform(-0.5, 0.5, (50, 1, 2)), rng.uniform(-3.0, 3.0, (50, 1))
    angles = np.linspace(0.0, 0.8, 40) + phase
    turned = angles + rng.uniform(-3.0, 3.0, (50, 1))
    points = center + 0.3 * np.stack((np.cos(turned), np.sin(turned)), axis=-1)
    found = oriented_centers(points, angles)
    np.testing.assert_allclose(found, center[:, 0], atol=1e-6)


def test_many_runs_at_once_are_the_estimator_of_one_movement() -> None:
    rng = np.random.default_rng(6)
    angles = np.linspace(0.0, 0.7, 80)
    points = 0.3 * np.stack((np.cos(angles), np.sin(angles)), axis=-1)
    points = points + rng.normal(0.0, 0.001, (12, 80, 2))
    measured = angles + rng.normal(0.0, 0.02, (12, 80))
    together = oriented_centers(points, measured, 0.02)
    for i in range(12):
        alone = oriented_estimate(points[i], measured[i], 0.02)
        np.testing.assert_allclose(together[i], alone.center, atol=0.05 * alone.rms_error)
