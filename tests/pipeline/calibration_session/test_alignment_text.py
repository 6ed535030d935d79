"""Status text after the align phase: deviations from the plate, lags, and sensors without lag."""

from __future__ import annotations

from math import radians
from typing import Any

import pytest

from jointfit_daemon.pipeline.calibration_session._alignment_text import alignment_text


def of(rms_deg: float, lag_ms: float | None) -> dict[str, Any]:
    lag_ns = None if lag_ms is None else round(lag_ms * 1e6)
    return {"kind": "full", "rms_rad": radians(rms_deg), "lag_ns": lag_ns}


@pytest.mark.parametrize(
    ("quality", "text"),
    [
        ({}, "worlds aligned"),
        (
            {"S1": of(0.8, 2.04), "S2": of(1.13, 0.96)},
            "worlds aligned: sensors follow the plate within 0.8 to 1.1 deg RMS; "
            "lags 1.0 to 2.0 ms",
        ),
        (
            {"S1": of(3.0, 3.8), "S2": of(3.02, None)},
            "worlds aligned: sensors follow the plate within 3.0 deg RMS; lags 3.8 ms; "
            "lag of S2 unknown",
        ),
    ],
)
def test_the_text_contains_deviations_and_lags(quality: dict[str, Any], text: str) -> None:
    assert alignment_text(quality) == text
