"""A refinement reports faults of the model and of the trials."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from jointfit_daemon.calibration.marker_refinement import (
    MotionTrial,
    RefinementError,
    RefinementSettings,
    refine_markers,
)
from jointfit_daemon.calibration.marker_refinement._gauge import gauge_of
from jointfit_daemon.kinematics.chains import (
    ChainModel,
    Joint,
    Marker,
    Segment,
    apply_step,
    marker_positions,
    rest_state,
)

if TYPE_CHECKING:
    from jointfit_daemon.calibration.marker_refinement import Refinement

THIGH = ((0.05, 0.0, -0.1), (-0.04, 0.06, -0.2), (0.02, -0.05, -0.3), (0.06, 0.03, -0.35))
PELVIS = ((0.12, 0.05, 0.0), (-0.12, 0.05, 0.0), (0.05, -0.1, 0.02), (-0.05, -0.1, 0.02))


def two_segments() -> ChainModel:
    thigh = Segment("thigh", "pelvis", Joint("ball", (0.1, 0.0, -0.1)))
    markers = [Marker(f"P{k}", "pelvis", at) for k, at in enumerate(PELVIS)]
    markers += [Marker(f"T{k}", "thigh", at) for k, at in enumerate(THIGH)]
    return ChainModel((Segment("pelvis"), thigh), tuple(markers))


def trial(name: str = "walk", rate_hz: float = 100.0) -> MotionTrial:
    model, t = two_segments(), np.linspace(0.0, 2 * np.pi, 50)[:, None]
    move = 0.4 * np.sin(t + np.linspace(0.0, 3.0, model.nq))
    y = marker_positions(model, apply_step(model, rest_state(model, 50), move))
    noise = np.random.default_rng(0).normal(0.0, 0.002, y.shape)
    return MotionTrial(name, y + noise, rate_hz)


def changed(**markers: slice) -> MotionTrial:
    """Return the trial with markers missing in the given frames, by marker name."""
    found = trial()
    for name, frames in markers.items():
        found.targets[frames, two_segments().marker_names.index(name)] = np.nan
    return found


def refused(given: MotionTrial, model: ChainModel | None = None) -> str:
    with pytest.raises(RefinementError) as why:
        refine_markers(model or two_segments(), [given])
    return str(why.value)


def refined(*given: MotionTrial, model: ChainModel | None = None) -> Refinement:
    return refine_markers(model or two_segments(), list(given))


@pytest.mark.parametrize("factor", [1000.0, 0.001])
def test_another_unit_is_named(factor: float) -> None:
    why = refused(replace(trial(), targets=factor * trial().targets))
    assert "walk" in why
    assert "unit" in why


def test_a_model_of_another_size_is_to_be_scaled_first() -> None:
    assert "scale the model" in refused(replace(trial(), targets=1.4 * trial().targets))
    told = refined(replace(trial(), targets=1.15 * trial().targets)).notes
    assert any("1.15 times as large" in note for note in told)


def exchanged(a: str, b: str, frames: slice) -> MotionTrial:
    given, names = trial(), two_segments().marker_names
    i, j = names.index(a), names.index(b)
    given.targets[frames, i], given.targets[frames, j] = (
        given.targets[frames, j].copy(),
        given.targets[frames, i].copy(),
    )
    return given


def test_labels_exchanged_throughout_are_named() -> None:
    assert "T0 and T2 look exchanged" in refused(exchanged("T0", "T2", slice(None)))


def three_exchanged(frames: slice) -> MotionTrial:
    given, names = trial(), list(two_segments().marker_names)
    rows = [names.index(name) for name in ("P1", "T3", "T0")]
    given.targets[frames, rows] = given.targets[frames, rows[-1:] + rows[:-1]]
    return given


def test_three_exchanged_labels_are_named_together_each_with_its_place() -> None:
    why = refused(three_exchanged(slice(None)))
    assert "P1, T0 and T3 look exchanged" in why
    assert "P1 is at the place of T0, T0 is at the place of T3, T3 is at the place of P1" in why
    assert why.count("look exchanged") == 1


def test_labels_exchanged_between_segments_are_refused() -> None:
    assert "labels" in refused(exchanged("P1", "T3", slice(None)))


def test_temporarily_exchanged_labels_are_removed_and_reported() -> None:
    found = refined(exchanged("T0", "T2", slice(10, 18)))
    assert any("T0 and T2 look exchanged in 8 frames" in note for note in found.notes)
    moved = np.abs(found.model.positions - refined(trial()).model.positions).max()
    assert moved < 0.001


def test_marker_missing_in_one_trial_is_reported_and_fitted_from_the_other() -> None:
    found = refined(changed(T1=slice(None)), replace(trial(), name="squat"))
    assert any(note == "walk: T1 missing in every frame" for note in found.notes)
    assert not any(found.markers[5].held)


def test_marker_missing_in_all_trials_is_kept_and_reported() -> None:
    found = refined(changed(T1=slice(None)))
    assert any("T1" in note and "kept" in note for note in found.notes)
    np.testing.assert_array_equal(found.model.positions[5], THIGH[1])
    assert found.markers[5].held == (True, True, True)
    assert np.isnan(found.markers[5].rms_after)


def test_only_marker_of_a_segment_is_kept_and_reported() -> None:
    found = refined(changed(T1=slice(None), T2=slice(None), T3=slice(None)))
    assert any(note.startswith("T0: the only marker on thigh") for note in found.notes)
    np.testing.assert_array_equal(found.model.positions[4], THIGH[0])


def test_refinement_without_free_markers_is_rejected() -> None:
    model = two_segments()
    held = model.with_locks(dict.fromkeys(model.marker_names, (True, True, True)))
    assert "all coordinates are locked" in refused(trial(), held)


def test_names_that_are_not_the_models_are_refused() -> None:
    nothing = replace(trial(), targets=np.full_like(trial().targets, np.nan))
    assert "of the model's markers: check their names" in refused(nothing)


def test_all_input_faults_are_reported_together() -> None:
    small = replace(trial("small"), targets=0.001 * trial().targets)
    empty = replace(trial("empty"), targets=np.full_like(trial().targets, np.nan))
    with pytest.raises(RefinementError) as why:
        refine_markers(two_segments(), [small, trial()], None, [empty])
    assert "small" in str(why.value)
    assert "empty" in str(why.value)


def test_many_wrong_labels_are_refused_because_of_the_remaining_error() -> None:
    given = trial()
    given.targets[:] = given.targets[:, [4, 6, 5, 7, 1, 3, 0, 2]]
    assert refused(given)


def test_trials_of_different_rates_are_weighted_by_frames_with_a_note() -> None:
    found = refined(trial(), trial("slow", 50.0))
    assert any("50, 100 Hz" in note for note in found.notes)


def test_gauge_freedom_is_counted_and_named() -> None:
    found = refined(trial())
    assert found.gauge.free == 6  # all markers of a segment may rotate about the hip together
    assert set(found.gauge.involved) <= set(two_segments().marker_names)
    assert found.gauge.fixed_by == "prior"
    unheld = refine_markers(two_segments(), [trial()], RefinementSettings(prior=0.0))
    assert unheld.gauge.fixed_by == "nothing"
    held = dict.fromkeys((*(f"P{k}" for k in range(4)), "T0", "T1", "T2"), (True, True, True))
    bound = refined(trial(), model=two_segments().with_locks(held))
    assert (bound.gauge.free, bound.gauge.fixed_by) == (0, "locks")


def test_a_gauge_of_known_matrices() -> None:
    """A zero eigenvalue is a free direction, and a small eigenvalue a weak direction."""
    S = 10.0 * np.diag([0.0, 0.005, 1.0])
    gauge = gauge_of(S, 10, ["a", "b", "c"], prior=0.0)
    assert (gauge.free, gauge.weak, gauge.involved) == (1, 1, ("a",))
