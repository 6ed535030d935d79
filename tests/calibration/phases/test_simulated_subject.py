"""Offline calibration of the simulated subject of the demo."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from bench.experiments.fusion.simulated_leg import people

if TYPE_CHECKING:
    from jointfit_daemon.limb_model import Method

pytestmark = pytest.mark.experiment


@pytest.mark.timeout(180)
def test_the_subject_of_the_demo_is_measured_to_three_degrees() -> None:
    methods: tuple[Method, ...] = ("anchored", "patent12", "mean")
    errors = {method: people(method, (1,))[0] for method in methods}
    assert errors["anchored"].knee <= 3.0
    assert errors["anchored"].thigh < errors["patent12"].thigh < errors["mean"].thigh
    assert errors["anchored"].within_2_sd >= 0.9
    assert max(errors["anchored"].centers_mm.values()) < 25.0
