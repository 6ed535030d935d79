"""Published regression coefficients: those of the hold-out evaluation, and the stored ones."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from jointfit_daemon.calibration._quality import quality_table
from jointfit_daemon.calibration.soft_tissue import (
    evaluate_methods,
    fit_models,
    regression_quality,
)
from tests.calibration.calibrated_subject import TWO_AND_TWO, moving

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.calibration.soft_tissue import LimbTraining

FRAMES, SHARE = 400, 0.4
FIRST = slice(None, 240)


def least_squares(movement: LimbTraining, part: slice, segment: str) -> NDArray[np.float64]:
    """Return a, b and c of every quaternion component by least squares, shape (4, 3).

    They satisfy a q1 + b q2 + c = q_reference. q1 and q2 are the orientations of the two sensors.
    """
    first, second = dict(zip(TWO_AND_TWO.segments, TWO_AND_TWO.sensors, strict=True))[segment]
    rows = []
    for k in range(4):
        q1, q2 = movement.sensors[first][part, k], movement.sensors[second][part, k]
        A = np.stack((q1, q2, np.ones_like(q1)), axis=1)
        rows.append(np.linalg.solve(A.T @ A, A.T @ movement.reference[segment][part, k]))
    return np.array(rows)


def test_verified_and_stored_coefficients_are_least_squares_of_the_first_part_and_of_all() -> None:
    movement = moving(FRAMES, 1.0, chain=TWO_AND_TWO)
    models = fit_models(TWO_AND_TWO, movement, "patent12")
    found = regression_quality(TWO_AND_TWO, movement, models, SHARE)
    assert found is not None
    for segment, figures in found.items():
        verified = least_squares(movement, FIRST, segment)
        stored = least_squares(movement, slice(None), segment)
        assert np.array(figures.verified) == pytest.approx(verified, abs=1e-5)
        assert np.array(figures.stored) == pytest.approx(stored, abs=1e-5)
        assert np.abs(verified - stored).max() > 1e-3
    assert found["shank"].sensors == ("S3", "S4")


@pytest.mark.parametrize("reading", ["patent12", "patent6"])
def test_holdout_errors_are_those_of_the_verified_coefficients(reading: str) -> None:
    movement = moving(FRAMES, 1.0, chain=TWO_AND_TWO)
    models = fit_models(TWO_AND_TWO, movement, reading)  # type: ignore[arg-type]
    found = regression_quality(TWO_AND_TWO, movement, models, SHARE)
    errors = evaluate_methods(TWO_AND_TWO, movement, reading, SHARE)  # type: ignore[arg-type]
    assert found is not None
    for segment, figures in found.items():
        table = np.array(figures.verified)
        inputs = [movement.sensors[sensor][FIRST.stop :] for sensor in figures.sensors]
        inputs = [q * np.sign(q @ figures.q_sign)[:, None] for q in inputs]
        q = table[:, 0] * inputs[0] + table[:, 1] * inputs[1] + table[:, 2]
        q /= np.linalg.norm(q, axis=1, keepdims=True)
        cosine = np.abs(np.sum(q * movement.reference[segment][FIRST.stop :], axis=1))
        error = np.sqrt(np.mean((2.0 * np.arccos(np.minimum(cosine, 1.0))) ** 2))
        assert getattr(errors.segments[segment], reading) == pytest.approx(error, rel=1e-5)


def test_other_methods_have_no_coefficients() -> None:
    movement = moving(FRAMES, 1.0, chain=TWO_AND_TWO)
    models = fit_models(TWO_AND_TWO, movement, "mean")
    assert regression_quality(TWO_AND_TWO, movement, models, SHARE) is None


def test_coefficients_are_stored_as_json_lists() -> None:
    movement = moving(FRAMES, 1.0, chain=TWO_AND_TWO)
    models = fit_models(TWO_AND_TWO, movement, "patent6")
    found = quality_table(regression_quality(TWO_AND_TWO, movement, models, SHARE))
    assert [type(row) for row in found["thigh"]["stored"]] == [list] * 4
