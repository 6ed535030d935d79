"""Kernel models are restored from JSON; damaged data are rejected."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import numpy as np
import pytest

from jointfit_daemon.limb_model import SegmentModel

EXPERT: dict[str, Any] = {
    "width": 0.5,
    "tilted": False,
    "coefficients": [[0.01] * 13] * 3,
    "centers": [[0.1] * 6],
    "leverage": np.eye(12).tolist(),
    "hull_leverage": 0.2,
    "carried": [1.0, 1.0, 1.0],
}
TILTED = EXPERT | {
    "tilted": True,
    "coefficients": [[0.01] * 16] * 3,
    "centers": [[0.1] * 9],
    "leverage": np.eye(15).tolist(),
}
MODEL: dict[str, Any] = {
    "kind": "kernel",
    "sensors": 2,
    "plain": EXPERT,
    "tilted": TILTED,
    "trend": [[0.0] * 10] * 2,
    "spread": {"inside": [1e-4] * 3, "outside": [1e-4] * 3},
    "residual_sd": 0.02,
    "mean_sd": 0.03,
}


def test_a_kernel_model_is_restored_from_its_json_form() -> None:
    assert SegmentModel.from_dict(MODEL).to_dict() == MODEL


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("width", 0.0),
        ("width", 1e-300),
        ("hull_leverage", 0.0),
        ("hull_leverage", 1e-320),
        ("centers", [[1e200] * 6]),
    ],
)
def test_numbers_out_of_range_are_rejected_without_a_warning(key: str, value: object) -> None:
    damaged = deepcopy(MODEL)
    damaged["plain"][key] = value
    with pytest.raises(ValueError, match="out of range"):
        SegmentModel.from_dict(damaged)
