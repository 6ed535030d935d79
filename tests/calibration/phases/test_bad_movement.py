"""Calibration with faulty movements: a rejection with the reason, or a correct fit."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest

from jointfit_daemon.calibration import (
    CalibrationError,
    CalibrationTrial,
    OpticalTrack,
    SensorTrack,
)
from jointfit_daemon.calibration.phases import PlateAlignment, fit_calibration, fit_plate_alignment
from tests.calibration.synthetic_limb import (
    CHAIN,
    OWNER,
    SETTINGS,
    Imperfections,
    Subject,
    motion,
    plate_trial,
    record,
    static_and_functional,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.limb_model import Calibration

SUBJECT = Subject(12, flaws=Imperfections(sensor_deg=0.3, tissue_deg=4.0, heading_deg=90.0))
LEARNING = replace(SETTINGS, refine_markers=False)
QUICK = replace(LEARNING, method="mean")


@cache
def trials() -> tuple[CalibrationTrial, CalibrationTrial, PlateAlignment]:
    static, functional, _ = static_and_functional(SUBJECT, 12.0)
    return static, functional, fit_plate_alignment(plate_trial(SUBJECT), SETTINGS)


def fit(
    change: Callable[[CalibrationTrial], CalibrationTrial] = lambda trial: trial,
    *,
    still: bool = False,
    learning: bool = False,
) -> Calibration:
    """Return a calibration from a changed movement and, with `still`, a changed static pose."""
    static, functional, alignment = trials()
    pose = change(static) if still else static
    settings = LEARNING if learning else QUICK
    return fit_calibration(pose, change(functional), alignment, settings, CHAIN)


def unplugged(after: float) -> Callable[[CalibrationTrial], CalibrationTrial]:
    """Return a function that removes the data of S2 after the fraction `after` of a trial."""

    def change(trial: CalibrationTrial) -> CalibrationTrial:
        track = trial.sensors["S2"]
        count = round(after * len(track.t_ns))
        left = SensorTrack(track.t_ns[:count], track.q_world_sensor[:count])
        return replace(trial, sensors={**trial.sensors, "S2": left})

    return change


def hidden(share: float) -> Callable[[CalibrationTrial], CalibrationTrial]:
    """Return a function that hides all markers for a fraction of the time, in parts of 0.25 s."""

    def change(trial: CalibrationTrial) -> CalibrationTrial:
        optical = trial.optical
        assert isinstance(optical, OpticalTrack)
        positions = optical.positions.copy()
        period = np.arange(len(positions)) // 30
        positions[(period * share) % 1.0 < share - 1e-9] = np.nan
        return replace(trial, optical=replace(optical, positions=positions))

    return change


def one_device_twice(trial: CalibrationTrial) -> CalibrationTrial:
    return replace(trial, sensors={**trial.sensors, "S2": trial.sensors["S1"]})


def mixed_signs(trial: CalibrationTrial) -> CalibrationTrial:
    rng = np.random.default_rng(3)
    return replace(
        trial,
        sensors={
            name: SensorTrack(
                track.t_ns, track.q_world_sensor * rng.choice([-1.0, 1.0], (len(track.t_ns), 1))
            )
            for name, track in trial.sensors.items()
        },
    )


def test_q_and_minus_q_mixed_at_random_change_nothing() -> None:
    straight, mixed = fit(learning=True), fit(mixed_signs, still=True, learning=True)
    for kind in ("segments", "flexion"):
        before, after = (found.quality["holdout"][kind] for found in (straight, mixed))
        for name, figures in before.items():
            for method in ("anchored", "patent12", "patent6", "markley", "mean", "single"):
                assert after[name][method] == pytest.approx(figures[method], abs=1e-6), method


def test_trial_without_movement_names_the_joint_and_the_remedy() -> None:
    still = record(SUBJECT, motion(SUBJECT, 12.0, 400.0, still=True), 7)
    with pytest.raises(CalibrationError, match=r"flex and extend it \(squats\)"):
        fit(lambda _: still)


def test_sensor_unplugged_half_way_is_reported_and_the_rest_is_fitted() -> None:
    found = fit(unplugged(0.5))
    assert any(note.startswith("S2: no data in 50 % of the movement") for note in found.notes)
    assert found.quality["holdout"]["frames"] < 0.25 * 12 * 120
    assert not any("S1: no data" in note for note in found.notes)


@pytest.mark.parametrize("after", [0.0, 0.05])
def test_a_sensor_unplugged_from_the_start_is_refused_by_name(after: float) -> None:
    with pytest.raises(CalibrationError) as caught:
        fit(unplugged(after))
    assert caught.value.reasons[0].startswith(f"S2: no data in {100 * (1 - after):.0f} %")
    assert "check its connector" in caught.value.reasons[0]


def test_one_device_under_two_names_is_fitted_and_reported() -> None:
    found = fit(one_device_twice, still=True, learning=True)
    told = [note for note in found.notes if "do not move relative to each other" in note]
    assert [note[:9] for note in told] == ["S1 and S2"]
    figures = found.quality["holdout"]["segments"]["thigh"]
    assert figures["anchored"] < np.deg2rad(5.0)
    assert not [note for note in fit().notes if "do not move relative" in note]


def test_a_reference_missing_two_fifths_of_the_time_is_enough() -> None:
    found = fit(hidden(0.4), learning=True)
    assert found.quality["holdout"]["segments"]["thigh"]["anchored"] < np.deg2rad(4.0)
    for name in OWNER:
        assert np.isfinite(found.sensor[name].q_sensor_segment).all()


def test_a_reference_missing_most_of_the_time_is_refused_with_its_share() -> None:
    with pytest.raises(
        CalibrationError, match=r"thigh: at least three markers were visible in 4\d"
    ):
        fit(hidden(0.55))
