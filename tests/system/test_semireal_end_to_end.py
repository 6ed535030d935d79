"""Recorded squats, sent as bytes through the daemon, reproduce the offline errors.

The only imperfections are those of the recording. The optical system streams the reference bones,
segments have the axes of the static pose, and the daemon calibrates itself on the first 60 %.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from bench.experiments.fusion.knee_segments import KneeModels, Squats
from bench.rigs import recorded_trial

if TYPE_CHECKING:
    from pathlib import Path

    from bench.rigs.recorded_trial import Played
    from jointfit_daemon.limb_model import Method

pytestmark = [pytest.mark.system, pytest.mark.experiment, pytest.mark.timeout(150)]

METHODS: tuple[Method, ...] = ("patent12", "mean")
PUBLISHED = {"patent12": (3.45, 2.81, 2.11), "mean": (9.29, 9.61, 3.21)}


@pytest.fixture(scope="module")
def knee(shared_data: Path) -> Squats:
    return Squats(shared_data)


@pytest.fixture
def played(shared_data: Path) -> dict[tuple[str, Method], Played]:
    return recorded_trial.run(shared_data, METHODS)


def test_recorded_squats_through_the_daemon_match_the_offline_errors(
    knee: Squats, played: dict[tuple[str, Method], Played]
) -> None:
    for method in METHODS:
        live = played["squats", method]
        assert 0.9 * len(knee.held) <= live.frames <= len(knee.held) == 270
        models = KneeModels(method, [knee.training])
        same = live.of(knee.held)
        offline = knee.judge.errors(models.predict(same), same)
        assert live.errors == pytest.approx(offline, abs=0.1), method
        if method == "patent12":  # in the procedure of the patent
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
        if live.frames == len(knee.held):  # otherwise this machine was too slow for some
            assert live.errors == pytest.approx(PUBLISHED[method], abs=0.1)
