"""The person of the demo, calibrated offline."""

from __future__ import annotations

import pytest

from bench.experiments.fusion.simulated_leg import people

pytestmark = pytest.mark.experiment


@pytest.mark.timeout(180)
def test_the_demos_person_is_measured_to_three_degrees() -> None:
    errors = {method: found[0] for method, found in people((1,)).items()}
    assert errors["anchored"].knee <= 3.0
    assert errors["anchored"].thigh < errors["patent12"].thigh < errors["mean"].thigh
    assert errors["anchored"].within_2_sd >= 0.9
    assert max(errors["anchored"].centers_mm.values()) < 25.0
