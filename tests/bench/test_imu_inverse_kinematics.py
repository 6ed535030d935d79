"""Joint angles of a recorded walk agree with OpenSim's, an independent implementation."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from bench.experiments.speed import imu_inverse_kinematics

if TYPE_CHECKING:
    from pathlib import Path

LARGEST_DEG = 4.0
"""Largest accepted RMS difference between the joint angles of the fusion and of OpenSim, deg.
OpenSim's knee has one axis, the knee of the fusion has three.
"""


@pytest.mark.experiment
@pytest.mark.timeout(300)
def test_fusion_agrees_with_opensim_on_a_recorded_walk_and_costs_a_fraction(
    shared_data: Path,
) -> None:
    assert (shared_data / "opensense_xsens").is_dir()
    values: dict[str, Any] = {
        each.name: each.value for each in imu_inverse_kinematics.rows(quick=True)
    }
    differences = [value for name, value in values.items() if name.startswith("difference")]
    assert len(differences) == 4
    assert 0.0 < max(differences) < LARGEST_DEG
    fusion_us = values["jointfit: fusion of a frame of 7 sensors"]
    assert fusion_us < 0.1 * values["OpenSim: IMU inverse kinematics of the same frame"]
