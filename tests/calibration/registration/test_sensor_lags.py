"""Lags of a calibration, from plate and movement weighted by their standard deviations."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from bench.subjects.recorded_knee import load
from jointfit_daemon.calibration.registration import BODY, SensorLag, segment_lags, tracked_lags
from jointfit_daemon.calibration.registration._lags import MARKER_TISSUE_SD_NS, SENSOR_TISSUE_SD_NS
from jointfit_daemon.timing.lag import LagEstimate, estimate_lag

if TYPE_CHECKING:
    from pathlib import Path

MS = 1e6


def said(lag_ms: float, sigma_ms: float, refused: str | None = None) -> LagEstimate:
    return LagEstimate(lag_ms * MS, sigma_ms * MS, 0.9, refused)


def test_a_plate_lag_outweighs_a_movement_lag_and_both_reduce_the_deviation() -> None:
    chosen = segment_lags({"S1": said(9.0, 1.0)}, {"S1": (round(5 * MS), 0.2 * MS)})["S1"]
    assert chosen.source == "plate and movement"
    assert chosen.lag_ns == pytest.approx(5.0 * MS, abs=0.05 * MS)
    assert chosen.sigma_ns is not None
    assert chosen.sigma_ns < 0.2 * MS


def test_soft_tissue_artefact_increases_the_deviation_of_a_lag() -> None:
    chosen = segment_lags({"S1": said(9.0, 0.05)}, {})["S1"]
    assert chosen.source == "movement"
    assert chosen.lag_ns == 9 * MS
    assert chosen.sigma_ns == pytest.approx(
        np.hypot(SENSOR_TISSUE_SD_NS, MARKER_TISSUE_SD_NS), rel=0.01
    )
    assert tracked_lags({"S1": (9 * MS, 0.05 * MS)})["S1"].sigma_ns == pytest.approx(
        chosen.sigma_ns, rel=0.01
    )


def test_a_lag_smaller_than_its_deviation_is_noise_and_not_used() -> None:
    """In recorded squats, one sensor had a lag of 3.6 ± 4.7 ms, and its neighbor no estimate."""
    assert segment_lags({"S1": said(3.6, 4.7)}, {}) == {}
    assert set(segment_lags({"S1": said(3.6, 4.7), "S2": said(15.0, 1.0)}, {})) == {"S2"}
    with_plate = segment_lags({"S1": said(0.5, 4.7)}, {"S1": (100_000, 0.2 * MS)})
    assert with_plate["S1"].source == "plate and movement"


def test_sensor_with_a_plate_lag_corrects_the_soft_tissue_lag_of_its_neighbor() -> None:
    moving = {"S1": said(9.0, 0.5), "S2": said(14.0, 0.5)}
    alone = segment_lags(moving, {})["S2"]
    taught = segment_lags(moving, {"S1": (round(5 * MS), 0.1 * MS)})["S2"]
    assert alone.lag_ns == 14 * MS
    assert 10 * MS < taught.lag_ns < 12 * MS  # S1 has a bias of 4 ms, and S2 a similar one
    assert taught.sigma_ns is not None
    assert alone.sigma_ns is not None
    assert taught.sigma_ns < alone.sigma_ns


def test_rejected_movement_lag_is_replaced_by_the_plate_lag_unless_the_clock_changed() -> None:
    plate = {"S1": (round(5 * MS), 0.1 * MS), "S2": (round(5 * MS), 0.1 * MS)}
    chosen = segment_lags({"S1": said(9.0, 1.0, "no"), "S2": said(40.0, 1.0)}, plate)
    assert chosen["S1"] == SensorLag(round(5 * MS), 0.1 * MS, "plate")
    assert chosen["S2"].source == "movement"
    assert chosen["S2"].lag_ns == 40 * MS
    assert segment_lags({"S1": said(9.0, 1.0, "no")}, {}) == {}


@pytest.mark.parametrize("name", ["squats1", "DJ1"])
def test_lag_errors_on_recorded_skin_are_within_their_deviation(
    name: str, shared_data: Path
) -> None:
    """The true lag is 7 ms by construction; soft tissue biases the estimates by milliseconds."""
    trial = load(shared_data, name)
    period = 20_000_000 if name == "squats1" else 10_000_000
    t_ns = np.arange(len(trial)) * period
    off = []
    for first, bone in ((0, trial.thigh), (2, trial.shank)):
        moving = {
            f"S{k + 1}": estimate_lag(t_ns + 7_000_000, trial.sensors[k], t_ns, bone, BODY)
            for k in (first, first + 1)
        }
        for chosen in segment_lags(moving, {}).values():
            assert chosen.sigma_ns is not None
            off.append(abs(chosen.lag_ns - 7_000_000) / chosen.sigma_ns)
    assert off
    assert max(off) < 3.0
