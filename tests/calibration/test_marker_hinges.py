"""A joint of OpenSim's that is no hinge is nearest to one over what the trials use of it."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np
import pytest

from jointfit_daemon.calibration.marker_refinement.hinges import used_ranges
from jointfit_daemon.calibration.marker_refinement.motion import MotionTrial
from jointfit_daemon.files.osim import read_osim
from jointfit_daemon.kinematics.chain_model import ChainModel, Joint, Marker, Segment
from jointfit_daemon.kinematics.chain_motion import apply_step, marker_positions, rest_state

if TYPE_CHECKING:
    from pathlib import Path


def bending(low: float, high: float, name: str = "a") -> tuple[ChainModel, MotionTrial]:
    rng = np.random.default_rng(0)
    shank = Segment("shank", "thigh", Joint("hinge", (0.0, 0.0, -0.4)))
    model = ChainModel(
        (Segment("thigh"), shank),
        tuple(
            Marker(f"{segment}{k}", segment, tuple(at))
            for segment in ("thigh", "shank")
            for k, at in enumerate(rng.normal(0.0, 0.1, (4, 3)).tolist())
        ),
    )
    step = np.zeros((200, model.nq))
    step[:, -1] = np.linspace(low, high, 200)
    y = marker_positions(model, apply_step(model, rest_state(model, 200), step))
    return model, MotionTrial(name, y, 100.0)


def test_the_range_in_use_spans_all_trials_without_their_ends() -> None:
    model, squat = bending(0.2, 1.4)
    walk = bending(-0.1, 1.0)[1]
    used = used_ranges(model, [squat, walk])
    assert used["shank"] == pytest.approx((-0.1, 1.4), abs=0.03)
    assert used["shank"][0] > -0.1
    assert used["shank"][1] < 1.4


def test_a_trial_that_shows_nothing_is_passed_over() -> None:
    model, squat = bending(0.2, 1.4)
    squat.targets[:] = np.nan
    assert used_ranges(model, [squat]) == {}


def off_mm(remarks: tuple[str, ...]) -> float:
    found = re.search(r"knee_r[^\n]*off by ([\d.]+) mm", "\n".join(remarks))
    assert found
    return float(found[1])


def test_a_knee_is_nearer_to_a_hinge_over_a_part_of_its_range(shared_data: Path) -> None:
    path = shared_data / "opensim_gait2354" / "subject01_scaledOnly.osim"
    whole = read_osim(path)
    part = read_osim(path, used={"tibia_r": (-1.1, 0.0)})
    assert off_mm(part.remarks) < 0.7 * off_mm(whole.remarks)
    knees = [m.model.segments[m.model.segment_names.index("tibia_r")].joint for m in (whole, part)]
    assert knees[1].limits == pytest.approx(knees[0].limits, abs=0.02)
