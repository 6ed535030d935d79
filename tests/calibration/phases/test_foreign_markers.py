"""The functional phase is refused if a marker list contains a marker of another segment."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest

from bench.subjects.simulated_wearer import Phases, bench_rig, phases_of
from jointfit_daemon.calibration import CalibrationError, CalibrationTrial
from jointfit_daemon.calibration.anatomy import ForeignMarker, foreign_markers
from jointfit_daemon.calibration.phases import fit_calibration, fit_static
from jointfit_simulators.settings import Knobs

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from jointfit_daemon.calibration import CalibrationSettings

LONG = pytest.mark.experiment
RIG = bench_rig()
Lists = dict[str, tuple[str, ...]]
FOUR_AND_THREE: Lists = {"thigh": ("T1", "T2", "T3", "C4"), "shank": ("C1", "C2", "C3")}
FIVE_AND_THREE: Lists = {"thigh": ("T1", "T2", "T3", "T4", "C1"), "shank": ("C2", "C3", "C4")}
THREE_AND_THREE: Lists = {"thigh": ("T1", "T2", "T3"), "shank": ("C1", "C2", "C3")}


@cache
def trials(limb: str = "leg", tissue_mm: float = 5.0) -> Phases:
    return phases_of(Knobs(seed=2, marker_soft_tissue_mm=tissue_mm, occlusion=0.1), limb)


def exchanged(trial: CalibrationTrial, labels: Sequence[str]) -> CalibrationTrial:
    """Return the trial with two labels exchanged."""
    if not labels:
        return trial
    assert trial.optical is not None
    columns = [trial.optical.markers.index(label) for label in labels]
    positions = trial.optical.positions.copy()
    positions[:, columns] = positions[:, columns[::-1]]
    return replace(trial, optical=replace(trial.optical, positions=positions))


def with_lists(lists: Mapping[str, tuple[str, ...]]) -> CalibrationSettings:
    return replace(RIG.calibration, markers={**RIG.calibration.markers, **lists})


def found(
    lists: Mapping[str, tuple[str, ...]],
    labels: Sequence[str] = (),
    *,
    tissue_mm: float = 5.0,
) -> list[ForeignMarker]:
    phases = trials(tissue_mm=tissue_mm)
    static, functional = (exchanged(one, labels) for one in (phases.static, phases.functional))
    assert functional.optical is not None
    pose = fit_static(static, with_lists(lists), RIG.chain)
    return foreign_markers(functional.optical, pose.clusters)


@pytest.mark.parametrize("tissue_mm", [5.0, 10.0])
def test_exchanged_labels_of_two_segments_are_found_on_both(tissue_mm: float) -> None:
    foreign = found({}, ("T1", "C1"), tissue_mm=tissue_mm)
    assert {(one.part, one.marker) for one in foreign} == {("thigh", "T1"), ("shank", "C1")}
    assert {one.part: one.elsewhere for one in foreign} == {
        "thigh": ("shank",),
        "shank": ("thigh",),
    }


@pytest.mark.parametrize("tissue_mm", [5.0, 10.0])
@pytest.mark.parametrize(
    ("lists", "marker"),
    [(FOUR_AND_THREE, "C4"), (FIVE_AND_THREE, "C1")],
    ids=["one of four", "one of five, near the knee"],
)
def test_a_marker_in_the_list_of_another_segment_is_found(
    lists: Lists, marker: str, tissue_mm: float
) -> None:
    (one,) = found(lists, tissue_mm=tissue_mm)
    assert (one.part, one.marker) == ("thigh", marker)
    assert "shank" in one.elsewhere
    assert one.rms > 0.03


def test_an_exchange_between_clusters_of_three_markers_is_found() -> None:
    assert [one.marker for one in found(THREE_AND_THREE, ("T1", "C1"))] == ["C1"]


@pytest.mark.parametrize(
    ("limb", "tissue_mm"),
    [
        ("leg", 5.0),
        ("leg", 10.0),
        *(pytest.param(limb, 10.0, marks=LONG) for limb in ("legs", "arm", "trunk")),
    ],
)
def test_soft_tissue_and_occlusion_are_no_fault(limb: str, tissue_mm: float) -> None:
    phases, rig = trials(limb, tissue_mm), bench_rig(limb=limb)
    assert phases.functional.optical is not None
    pose = fit_static(phases.static, rig.calibration, rig.chain)
    assert foreign_markers(phases.functional.optical, pose.clusters) == []


def test_labels_that_are_wrong_for_a_short_time_are_no_fault() -> None:
    phases = trials()
    optical = phases.functional.optical
    wrong = exchanged(phases.functional, ("T1", "C1")).optical
    assert optical is not None
    assert wrong is not None
    positions = optical.positions.copy()
    positions[1000:1600] = wrong.positions[1000:1600]
    pose = fit_static(phases.static, RIG.calibration, RIG.chain)
    assert foreign_markers(replace(optical, positions=positions), pose.clusters) == []


def test_a_marker_displaced_since_the_static_pose_is_no_fault() -> None:
    phases = trials()
    assert phases.static.optical is not None
    assert phases.functional.optical is not None
    positions = phases.static.optical.positions.copy()
    positions[:, phases.static.optical.markers.index("T1")] += np.array([0.02, 0.02, 0.0])
    static = replace(phases.static, optical=replace(phases.static.optical, positions=positions))
    pose = fit_static(static, RIG.calibration, RIG.chain)
    assert foreign_markers(phases.functional.optical, pose.clusters) == []


@pytest.mark.parametrize(
    ("lists", "labels", "marker", "part"),
    [
        ({}, ("T1", "C1"), "T1", "thigh"),
        pytest.param(FOUR_AND_THREE, (), "C4", "thigh", marks=LONG),
        pytest.param(FIVE_AND_THREE, (), "C1", "thigh", marks=LONG),
    ],
    ids=["exchange", "four", "five"],
)
@pytest.mark.timeout(120)
def test_the_functional_phase_is_refused_with_marker_segment_and_remedy(
    lists: Lists, labels: tuple[str, ...], marker: str, part: str
) -> None:
    phases, settings = trials(), with_lists(lists)
    settings = replace(settings, method="mean", refine_markers=False)
    static, functional = (exchanged(one, labels) for one in (phases.static, phases.functional))
    with pytest.raises(CalibrationError) as refusal:
        fit_calibration(static, functional, None, settings, RIG.chain)
    assert "look exchanged" not in str(refusal.value)
    reason = next(one for one in refusal.value.reasons if one.startswith(f"{part}: {marker} "))
    assert "mm RMS relative to" in reason
    assert "and moves with shank" in reason
    assert reason.endswith(
        f"correct the labels in the camera software or markers.{part} in rig.toml, and repeat "
        "from the static pose"
    )
