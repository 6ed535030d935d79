"""Centers between two bodies whose poses are fitted to noisy markers."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from bench.experiments.joint_center.noisy_bodies import measure_gate
from bench.subjects.noisy_bodies import Subject
from bench.subjects.simulated_joints import covers
from jointfit_daemon.center_of_rotation import Movement, estimate_center
from jointfit_daemon.center_of_rotation.spatial import fit_score
from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array


def subject(seed: int = 0, markers: int = 4) -> Subject:
    return Subject.random(np.random.default_rng(seed), markers)


def plain_center(seen: Movement) -> Array:
    assert seen.parent is not None
    assert seen.child is not None
    return fit_score(seen.parent, seen.child).center


def test_noise_of_distant_clusters_does_not_bias_the_center() -> None:
    rng, person = np.random.default_rng(1), subject(3, 3)
    trials = [person.observe(rng, 20.0, 2e-3) for _ in range(25)]
    found = [estimate_center(trial) for trial in trials]
    assert {e.method for e in found} == {"score"}
    mean = np.mean([e.center for e in found], axis=0)
    allowed = 4.0 * np.sqrt(np.mean([np.trace(e.covariance) for e in found]) / len(found))
    assert np.linalg.norm(mean) < allowed
    # without the markers, the centers of the same trials are biased
    assert np.linalg.norm(np.mean([plain_center(trial) for trial in trials], axis=0)) > allowed


@pytest.mark.parametrize("rom", [20.0, 90.0])
def test_the_ellipsoid_covers_the_center_in_small_and_large_movements(rom: float) -> None:
    rng = np.random.default_rng(2)
    held = [
        covers(estimate_center(subject(k, 3 + k % 2).observe(rng, rom, 1e-3))) for k in range(40)
    ]
    assert sum(held) >= 33  # expected: 38 of 40, with a standard deviation of 1.4


def test_the_noise_of_a_marker_is_recovered() -> None:
    rng = np.random.default_rng(3)
    found = [estimate_center(subject(k).observe(rng, 45.0, 1e-3)).noise for k in range(6)]
    assert np.mean(found) == pytest.approx(1e-3, rel=0.03)


def adjusted_center(person: Subject, above: Array, below: Array, start: Array) -> Array:
    """Return the center in the parent from a fit of poses and center to all markers, by SciPy."""
    n = len(above)

    def residuals(x: Array) -> Array:
        c1, c2, rest = x[:3], x[3:6], x[6:].reshape(n, 9)
        R1 = rotation.to_matrix(rotation.exp(rest[:, :3]))
        R2 = R1 @ rotation.to_matrix(rotation.exp(rest[:, 3:6]))
        t1 = rest[:, 6:]
        t2 = R1 @ c1 + t1 - R2 @ c2
        up = np.einsum("nij,kj->nki", R1, person.parent) + t1[:, None] - above
        down = np.einsum("nij,kj->nki", R2, person.child) + t2[:, None] - below
        return 1000.0 * np.concatenate((up.ravel(), down.ravel()))

    return np.asarray(least_squares(residuals, start, x_scale="jac").x[:3])


def test_center_agrees_with_an_adjustment_of_all_markers() -> None:
    rng, person = np.random.default_rng(4), subject(5)
    n = 16
    seen = person.observe(rng, 45.0, 1e-3)
    assert seen.parent is not None
    assert seen.child is not None
    assert seen.points is not None
    parts = slice(0, 300, 19)
    parent = type(seen.parent)(seen.parent.q[parts], seen.parent.t[parts])
    child = type(seen.child)(seen.child.q[parts], seen.child.t[parts])
    found = fit_score(parent, child, robust=False, markers=(person.parent, person.child))

    # These markers have exactly the poses of the trial.
    above = rotation.rotate(parent.q[:, None], person.parent) + parent.t[:, None]
    below = rotation.rotate(child.q[:, None], person.child) + child.t[:, None]
    turned = rotation.log(rotation.multiply(rotation.conjugate(parent.q), child.q))
    poses = np.concatenate((rotation.log(parent.q), turned, parent.t), axis=1)
    exact = adjusted_center(person, above, below, np.concatenate((np.zeros(6), poses.ravel())))
    assert len(above) == n
    assert np.linalg.norm(found.center - exact) < 0.05 * found.rms_error


@given(
    st.tuples(*3 * [st.floats(-3.0, 3.0)]),
    st.tuples(*3 * [st.floats(-1.0, 1.0)]),
    st.integers(0, 5),
)
@settings(max_examples=5, deadline=None)
def test_another_origin_and_other_axes_of_the_parent_move_the_estimate_along(
    turn: tuple[float, ...], shift: tuple[float, ...], seed: int
) -> None:
    """The center is the same point for any choice of origin and axes of the parent."""
    person = subject(seed)
    seen = person.observe(np.random.default_rng(seed), 45.0, 1e-3)
    q, d = rotation.exp(np.array(turn)), np.array(shift)
    assert seen.parent is not None
    assert seen.points is not None
    moved = Movement(
        rotation.rotate(q, seen.points) + d,
        type(seen.parent)(
            rotation.multiply(seen.parent.q, rotation.conjugate(q)),
            seen.parent.t
            - rotation.rotate(rotation.multiply(seen.parent.q, rotation.conjugate(q)), d),
        ),
        seen.child,
        parent_markers=rotation.rotate(q, person.parent) + d,
    )
    here, there = estimate_center(seen), estimate_center(moved)
    assert there.center == pytest.approx(rotation.rotate(q, here.center) + d, abs=1e-6)
    assert there.rms_error == pytest.approx(here.rms_error, rel=1e-4)


def test_a_joint_at_rest_between_noisy_clusters_is_refused() -> None:
    rng = np.random.default_rng(6)
    for rom in (0.0, 1.0):
        found = estimate_center(subject(1).observe(rng, rom, 2e-3))
        assert found.refused is not None
        assert re.search("move the joint|increase the range of motion", found.refused)


def test_the_artefact_that_repeats_with_posture_widens_the_error() -> None:
    rng = np.random.default_rng(7)
    found = estimate_center(subject(2).observe(rng, 60.0, 3e-4, 1e-3))
    assert "residuals_repeat" in found.flags
    assert found.rms_error > 5.0 * found.bound
    assert covers(found)


def test_a_wrong_pose_in_some_frames_hardly_moves_the_center() -> None:
    """In 20 frames, the child pose is wrong by 0.3 m per axis, as with exchanged markers."""
    rng, person = np.random.default_rng(8), subject(4)
    seen = person.observe(rng, 60.0, 1e-3)
    assert seen.child is not None
    seen.child.t[50:70] += 0.3
    markers = person.parent, person.child
    assert seen.parent is not None
    assert np.linalg.norm(fit_score(seen.parent, seen.child, markers=markers).center) < 5e-3


def test_a_limit_of_the_predicted_error_selects_biased_centers() -> None:
    """A limit of 20 mm for the predicted error reduces the coverage and increases the bias."""
    by_name = {result.name: result.value for result in measure_gate(600)}
    free, limited = "without limit", "limit of 20 mm"
    assert by_name[f"{free}: coverage"] > by_name[f"{limited}: coverage"]
    bias = "mean error along the radius"
    assert abs(by_name[f"{free}: {bias}"]) < 4.0 < abs(by_name[f"{limited}: {bias}"])
