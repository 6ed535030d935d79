"""Refined markers of a chain model are used in a calibration only if their errors decrease."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest

from jointfit_daemon.calibration import (
    CalibrationSettings,
    CalibrationTrial,
    ChainRefinement,
    FunctionalJob,
    JobControl,
    OpticalTrack,
    RefinementMethod,
)
from jointfit_daemon.calibration.marker_refinement import RefinementSettings, with_locks
from jointfit_daemon.calibration.phases import run_job
from jointfit_daemon.calibration.phases._chain_refinement import ChainOutcome, refine_chain
from jointfit_daemon.calibration.record import calibration_of
from jointfit_daemon.calibration.record._content_check import content_faults
from jointfit_daemon.kinematics.chains import ChainModel, Joint, Marker, Segment
from jointfit_daemon.outputs.payloads._quality_units import quality_payload
from jointfit_daemon.tools.calibrate._report import report
from tests.calibration.synthetic_limb import (
    CHAIN,
    LOCAL,
    MARKERS,
    SETTINGS,
    Subject,
    static_and_functional,
)
from tests.limb_model.plain_calibration import plain_calibration

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

FRAMES = 60


@cache
def trials() -> tuple[CalibrationTrial, CalibrationTrial]:
    return static_and_functional(Subject(3), 18.0)[:2]


def optical() -> OpticalTrack:
    track = trials()[1].optical
    assert track is not None
    return track


def true_model() -> ChainModel:
    """Return the model of the synthetic subject, with the subject's true joint positions."""
    segments = (
        Segment("pelvis"),
        Segment("thigh", "pelvis", Joint("ball")),
        Segment("shank", "thigh", Joint("ball", (0.0, 0.0, -0.42))),
        Segment("foot", "shank", Joint("ball", (0.0, 0.0, -0.40))),
    )
    markers = [
        Marker(name, part, (x, y, z))
        for part, local in LOCAL.items()
        for name, (x, y, z) in zip(MARKERS[part], local, strict=True)
    ]
    return ChainModel(segments, tuple(markers), "leg")


def errors() -> Array:
    """Return the position errors of all markers in the model, m.

    Only thigh and shank markers have an error, except for the locked marker thigh0.
    """
    off = np.random.default_rng(8).normal(0.0, 0.007, (16, 3))
    off[:4] = off[12:] = off[4] = 0.0
    return off


def nominal() -> ChainModel:
    model = true_model()
    locks = ("pelvis0", "pelvis1", "pelvis2", "pelvis3", "thigh0", "foot0", "foot1", "foot2")
    return with_locks(
        model.with_markers(model.positions + errors()), [*locks, "foot3"], "", locked=True
    )


def wanted(model: ChainModel | None = None, limit_s: float = 60.0) -> CalibrationSettings:
    settings = RefinementSettings(frames=FRAMES)
    refinement = ChainRefinement(model or nominal(), settings, limit_s)
    return replace(SETTINGS, chain_refinement=refinement)


@cache
def refined() -> ChainOutcome:
    return refine_chain(trials()[1], wanted(), JobControl())


def test_misplaced_markers_are_found_and_the_held_out_error_falls() -> None:
    found = refined()
    assert found.notes == ()
    assert found.chain is not None
    after = found.chain.apply(nominal())
    assert after is not None
    before_m, after_m = (
        np.linalg.norm(model.positions - true_model().positions, axis=1)[5:12]
        for model in (nominal(), after)
    )
    assert np.sqrt(np.mean(after_m**2)) < 0.5 * np.sqrt(np.mean(before_m**2))

    figures = found.figures
    assert figures is not None
    assert figures.before is not None
    assert figures.after is not None
    assert figures.after.rms_m < 0.5 * figures.before.rms_m
    assert figures.after.maximum_m < figures.before.maximum_m
    assert figures.after.accepted
    assert (figures.frames, figures.judged) == pytest.approx((FRAMES, FRAMES), abs=20)
    assert figures.parts is not None
    assert all(part.refined and part.after_m < part.before_m for part in figures.parts.values())
    assert set(figures.parts) == {"thigh", "shank"}
    assert figures.moved_m is not None
    assert figures.moved_m["thigh0"] == 0.0
    moved = np.linalg.norm(after.positions - nominal().positions, axis=1)
    assert figures.moved_m["shank2"] == pytest.approx(moved[10])


def test_segment_that_fits_worse_on_the_held_out_part_keeps_its_markers() -> None:
    track = optical()
    cut = round(0.6 * len(track.t_ns))
    positions = track.positions.copy()
    column = track.markers.index("shank1")
    # shank1 is displaced in the training part, and at its correct position in the held-out part
    other = track.markers.index("shank3")
    along = positions[:cut, other] - positions[:cut, column]
    positions[:cut, column] += 0.03 * along / np.linalg.norm(along, axis=1)[:, None]
    changed = replace(trials()[1], optical=replace(track, positions=positions))
    model = true_model()
    off = errors()
    off[8:12] = 0.0
    held = with_locks(
        model.with_markers(model.positions + off), MARKERS["pelvis"] + MARKERS["foot"], "",
        locked=True,
    )  # fmt: skip
    found = refine_chain(changed, wanted(held), JobControl())
    assert found.figures is not None
    assert found.figures.parts is not None
    assert not found.figures.parts["shank"].refined
    assert found.figures.parts["thigh"].refined
    assert found.chain is not None
    assert set(found.chain.positions) == set(MARKERS["thigh"])


def test_a_model_that_already_fits_stays_as_it_is() -> None:
    found = refine_chain(trials()[1], wanted(true_model()), JobControl())
    assert found.figures is not None
    assert found.figures.after is not None
    assert found.figures.before is not None
    assert found.figures.after.rms_m <= found.figures.before.rms_m
    assert max((found.figures.moved_m or {"": 0.0}).values()) < 0.001


def test_a_marker_that_would_move_too_far_is_named() -> None:
    model = true_model()
    positions = model.positions.copy()
    positions[6] += (0.0, 0.08, 0.0)
    others = [name for name in model.marker_names if name != "thigh2"]
    held = with_locks(model.with_markers(positions), others, "", locked=True)
    found = refine_chain(trials()[1], wanted(held), JobControl())
    (note,) = [note for note in found.notes if "would move" in note]
    assert note.startswith("chain model 'leg': markers of thigh not refined: thigh2 would move by")
    assert found.figures is not None
    assert found.figures.parts is not None
    assert not found.figures.parts["thigh"].refined


def test_models_that_do_not_fit_are_refused_by_name() -> None:
    scaled = true_model().scaled(dict.fromkeys(LOCAL, 1.6))
    found = refine_chain(trials()[1], wanted(scaled), JobControl())
    assert found.chain is None
    assert found.figures is not None
    assert str(found.figures.refused).count("scale the model first") == 1
    assert found.notes[0].startswith("chain model 'leg': markers not refined: functional: ")

    renamed = tuple(replace(m, name=f"X{m.name}") for m in true_model().markers)
    found = refine_chain(trials()[1], wanted(replace(true_model(), markers=renamed)), JobControl())
    assert "of the model's markers: check their names" in found.notes[0]


def test_size_of_the_model_is_noted_once_for_both_parts_of_the_movement() -> None:
    scaled = true_model().scaled(dict.fromkeys(LOCAL, 1.2))
    found = refine_chain(trials()[1], wanted(scaled), JobControl())
    assert sum("scale the model" in note for note in found.notes) == 1


def test_time_limit_ends_the_iteration_with_the_reason() -> None:
    now = iter(np.arange(0.0, 1e4, 5.0).tolist())
    reported: list[tuple[float, str]] = []
    control = JobControl(lambda: next(now), lambda share, text: reported.append((share, text)))
    found = refine_chain(trials()[1], wanted(limit_s=8.0), control)
    assert found.figures is not None
    assert found.figures.stopped == "stopped after 8 s"
    assert "before it converged" in found.notes[0]
    assert found.chain is not None  # two steps already improve the held-out part
    assert len(reported) == 2
    assert 0.0 < reported[0][0] < reported[1][0] < 1.0
    assert reported[0][1].startswith("refining the markers of the chain model: error ")


def test_search_stops_between_two_coordinates() -> None:
    now = iter(range(10_000))
    settings = wanted(limit_s=3.0)
    refinement = settings.chain_refinement
    assert refinement is not None
    slow = replace(refinement, settings=RefinementSettings("search", frames=20))
    found = refine_chain(
        trials()[1],
        replace(settings, chain_refinement=slow),
        JobControl(lambda: float(next(now))),
    )
    assert found.figures is not None
    assert found.figures.stopped == "stopped after 3 s"


@pytest.mark.parametrize(
    ("method", "remedy"), [("joint", "or set prior"), ("search", "or use method joint or block")]
)
def test_remedy_for_undetermined_markers_is_one_of_the_method(
    method: RefinementMethod, remedy: str
) -> None:
    free = with_locks(nominal(), ["*"], "", locked=False)
    settings = RefinementSettings(method, 0.0, frames=20)
    refinement = ChainRefinement(free, settings, 5.0)
    found = refine_chain(
        trials()[1], replace(wanted(), chain_refinement=refinement), JobControl(lambda: 0.0)
    )
    (note,) = [note for note in found.notes if "not determined by the movement" in note]
    assert note.endswith(remedy)


def test_refinement_is_off_without_a_model_or_with_refine_markers_off() -> None:
    off = replace(wanted(), refine_markers=False)
    assert refine_chain(trials()[1], off, JobControl()) == ChainOutcome()
    assert refine_chain(trials()[1], SETTINGS, JobControl()) == ChainOutcome()


@pytest.mark.timeout(60)
def test_worker_stores_the_refined_markers_and_publishes_the_errors() -> None:
    static, functional = trials()
    job = FunctionalJob(CHAIN, replace(wanted(), method="mean"), static, functional)
    result = run_job(job)
    stored = result.calibration
    assert stored is not None
    assert stored.chain == refined().chain
    assert calibration_of(stored.to_dict()) == stored
    figures = stored.quality["chain"]
    assert figures["after"]["rms_m"] < figures["before"]["rms_m"]
    assert figures["after"]["accepted"] is True
    assert set(figures["moved_m"]) == {*MARKERS["thigh"], *MARKERS["shank"]}
    lines = report(quality_payload(stored.quality))
    (line,) = [one for one in lines if one.startswith("chain model 'leg': marker error ")]
    assert line.endswith("within the accepted errors")
    assert any(one.endswith("from its place in the chain model") for one in lines)


def test_refined_markers_belong_to_one_model_and_damaged_ones_are_refused() -> None:
    chain = refined().chain
    assert chain is not None
    weighted = tuple(replace(m, weight=0.5) for m in nominal().markers)
    assert chain.apply(replace(nominal(), markers=weighted)) is not None
    shorter = nominal().scaled({"thigh": 0.99})
    assert chain.apply(shorter) is None
    stored = replace(plain_calibration(CHAIN), chain=chain)
    assert content_faults(stored) == []
    positions = {**chain.positions, "thigh1": (0.0, np.inf, 0.0)}
    (fault,) = content_faults(replace(stored, chain=replace(chain, positions=positions)))
    assert fault == "chain.positions.thigh1: expected 3 finite numbers"
