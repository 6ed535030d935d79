"""Recorded squats, sent as bytes through the daemon, reproduce the errors of the offline session.

The simulation adds no errors to the recording. The optical system streams the reference bones, and
segments have the axes of the static pose. The calibration uses the first 60 % of the squats.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from bench.rigs import recorded_trial

if TYPE_CHECKING:
    from pathlib import Path

    from bench.rigs.recorded_trial import Played
    from jointfit_daemon.limb_model import Method

pytestmark = [pytest.mark.system, pytest.mark.experiment, pytest.mark.timeout(330)]

METHODS: tuple[Method, ...] = ("patent12", "mean")
FRAMES = 270
"""Frames of the last 40 % of the squats."""
PUBLISHED = (3.45, 2.81, 2.11)
"""RMS errors of thigh, shank and knee flexion with the method `patent12` on these frames, deg."""


@pytest.fixture
def played(shared_data: Path) -> dict[tuple[str, Method], Played]:
    return recorded_trial.run(shared_data, METHODS)


def test_recorded_squats_through_the_daemon_match_the_offline_errors(
    played: dict[tuple[str, Method], Played],
) -> None:
    for method in METHODS:
        live = played["squats", method]
        assert live.recorded == FRAMES
        assert live.frames >= 0.9 * FRAMES
        assert live.errors == pytest.approx(live.offline, abs=0.1), method
        if method == "patent12":  # the method with the regression of the patent
            assert live.repeated_deg is not None
            assert live.repeated_deg < 0.01
        else:
            assert live.repeated_deg is None
        devices = live.health["devices"]
        assert {name: device["lost"] for name, device in devices.items()} == dict.fromkeys(
            devices, 0
        )
        assert sum(device["corrupt"] for device in devices.values()) == 0
        assert live.calibration.method == method
        assert live.calibration.joint["knee"].source == "fit"
        if method == "patent12":  # without the correction of headings
            assert live.offline == pytest.approx(PUBLISHED, abs=0.1)
