"""If labels are exchanged between the phases of a calibration, the refusal names the labels."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest

from jointfit_daemon.calibration import CalibrationError, CalibrationTrial
from jointfit_daemon.calibration.guidance import MovementGuide
from jointfit_daemon.calibration.phases import (
    StaticPose,
    fit_calibration,
    fit_static,
    with_new_static,
)
from jointfit_daemon.model import MocapFrame, MocapLayout
from tests.calibration.synthetic_limb import (
    CHAIN,
    SETTINGS,
    Imperfections,
    Subject,
    static_and_functional,
)
from tests.limb_model.clusters_of_limb import LABELS, cycled

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.limb_model import Calibration

EXCHANGES = [("thigh0", "thigh2"), ("thigh1", "shank3"), ("foot0", "foot1", "foot2")]


@cache
def trials() -> tuple[CalibrationTrial, CalibrationTrial]:
    static, functional, _ = static_and_functional(
        Subject(4, flaws=Imperfections(skin_m=0.004, occluded=0.02)), 20.0
    )
    return static, functional


@cache
def pose() -> StaticPose:
    return fit_static(trials()[0], SETTINGS, CHAIN)


@cache
def calibration() -> Calibration:
    return fit_calibration(pose(), trials()[1], None, replace(SETTINGS, method="mean"), CHAIN)


def exchanged(trial: CalibrationTrial, labels: tuple[str, ...]) -> CalibrationTrial:
    assert trial.optical is not None
    assert trial.optical.markers == LABELS
    positions = cycled(trial.optical.positions, *labels)
    return replace(trial, optical=replace(trial.optical, positions=positions))


def described(labels: tuple[str, ...]) -> list[str]:
    return [
        f"{a} is at the place of {b}" for a, b in zip(labels, labels[1:] + labels[:1], strict=True)
    ]


@pytest.mark.parametrize("labels", EXCHANGES, ids="-".join)
def test_the_functional_phase_names_an_exchange_since_the_static_pose(
    labels: tuple[str, ...],
) -> None:
    with pytest.raises(CalibrationError) as refusal:
        fit_calibration(pose(), exchanged(trials()[1], labels), None, SETTINGS, CHAIN)
    (reason,) = refusal.value.reasons
    assert all(text in reason for text in described(labels))
    assert "correct the labels and repeat the phase" in reason


@pytest.mark.parametrize("labels", EXCHANGES, ids="-".join)
def test_the_guide_names_an_exchange_within_three_seconds(labels: tuple[str, ...]) -> None:
    def missing(positions: Array) -> str:
        guide = MovementGuide(CHAIN, SETTINGS, trials()[0])
        layout, none = MocapLayout(LABELS, ()), np.zeros((0, 3))
        for k, points in enumerate(positions[:360]):
            guide.add_mocap(MocapFrame(0, k, None, layout, points, none, np.zeros((0, 4))))
        return " ".join(guide.update({}, 3.0).missing)

    functional = trials()[1].optical
    assert functional is not None
    text = missing(cycled(functional.positions, *labels))
    assert all(one in text for one in described(labels))
    assert "was displaced" not in text
    assert "look exchanged" not in missing(functional.positions)


@pytest.mark.parametrize("labels", EXCHANGES, ids="-".join)
def test_a_new_static_pose_names_an_exchange_since_the_calibration(labels: tuple[str, ...]) -> None:
    wrong = fit_static(exchanged(trials()[0], labels), SETTINGS, CHAIN)
    with pytest.raises(CalibrationError) as refusal:
        with_new_static(calibration(), wrong)
    assert all(text in str(refusal.value) for text in described(labels))
    with_new_static(calibration(), pose())


def test_a_segment_whose_markers_fit_in_no_way_is_refused_with_the_share_of_frames() -> None:
    optical = trials()[1].optical
    assert optical is not None
    positions = optical.positions.copy()
    rows = [LABELS.index(f"thigh{k}") for k in range(4)]
    positions[:, rows] = positions[:, rows[:1]] + np.random.default_rng(1).normal(0, 0.1, (4, 3))
    functional = replace(trials()[1], optical=replace(optical, positions=positions))
    with pytest.raises(CalibrationError, match=r"thigh: in .* its markers do not fit the static"):
        fit_calibration(pose(), functional, None, SETTINGS, CHAIN)
