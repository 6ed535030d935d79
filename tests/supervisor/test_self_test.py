"""The self-test of the lag: an unknown lag is a fault only if a phase could have estimated it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest

from jointfit_daemon.config import parse_rig
from jointfit_daemon.pipeline.health import LagHealth, LagSource
from jointfit_daemon.supervisor._self_test import _calibration

if TYPE_CHECKING:
    from jointfit_daemon.outputs.payloads import BridgeHealth


@pytest.mark.parametrize(
    ("lag", "level", "text"),
    [
        (
            ("none", None, None),
            "warning",
            "lag behind the cameras unknown: 0 is subtracted from the stamps",
        ),
        (("calibration", 0.0, "none"), "ok", "no lag determined (assumed 0 ms)"),
        (("calibration", 4_200_000.0, "plate"), "ok", "lag 4.2 ms, source: calibration"),
        (("configured", 0.0, None), "ok", "lag 0.0 ms, source: configured"),
    ],
)
def test_the_lag_of_a_sensor_is_reported_with_its_origin(
    table: dict[str, Any], lag: tuple[str, float | None, str | None], level: str, text: str
) -> None:
    source, used_ns, found_by = lag
    lags = {"S1": LagHealth(LagSource(source), used_ns, None, found_by, None, None)}
    core = SimpleNamespace(phase="calibrated", version=1, lags=lags)
    health = SimpleNamespace(core=core, state=SimpleNamespace(not_stored=None))
    (found,) = [
        check
        for check in _calibration(parse_rig(table), cast("BridgeHealth", health))
        if check.check == "lag"
    ]
    assert (found.id, found.level, found.text) == ("S1", level, text)
    assert bool(found.remedy) == (level != "ok")
