"""Online learning: refitted models are used only if they are better than the current models."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from jointfit_daemon.calibration import CalibrationError, OnlineFrames, RefitJob
from jointfit_daemon.calibration.phases import refit_models, run_job
from jointfit_daemon.calibration.record._content_check import content_faults
from jointfit_daemon.calibration.soft_tissue import join_training, pack, thin_evenly, unpack
from jointfit_daemon.calibration.soft_tissue._training_memory import MOST, postures
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import Calibration
from tests.calibration.calibrated_subject import CHAIN, calibration, fresh, moving


@pytest.fixture(scope="module")
def learned() -> Calibration:
    result = run_job(RefitJob(CHAIN, calibration(), fresh(moving(600, 1.2, 1)))).to_dict()
    return Calibration.from_dict(result["calibration"])


def error(one: Calibration, bend: float) -> float:
    """Return the RMS error of the thigh on a movement that no fit has seen, rad."""
    new = moving(150, bend, 9)
    model = one.segment["thigh"].models["S1+S2|S3"]
    said = model.predict([new.sensors["S1"], new.sensors["S2"]], new.sensors["S3"])
    off = rotation.angle_between(said, new.reference["thigh"])
    return float(np.sqrt(np.mean(off**2)))


def test_large_flexion_is_learned_and_small_flexion_is_not_forgotten(learned: Calibration) -> None:
    assert error(learned, 1.2) < 0.6 * error(calibration(), 1.2)
    assert error(learned, 0.5) < error(calibration(), 0.5) + np.deg2rad(0.3)


def test_only_models_memory_and_figures_change(learned: Calibration) -> None:
    before, after = calibration(), learned
    assert content_faults(after) == []
    blank: dict[str, Any] = {"segment": {}, "quality": {}, "memory": "", "correlations": {}}
    assert replace(before, **blank) == replace(after, **blank)
    assert {n: s.length for n, s in before.segment.items()} == {
        n: s.length for n, s in after.segment.items()
    }
    online = after.quality["online"]
    assert online["rounds"] == 1
    assert online["taught"] == "d"
    assert online["judged"] == 180
    assert all(online["after_rad"][k] <= was for k, was in online["before_rad"].items())


def test_repeated_movement_does_not_change_the_model(learned: Calibration) -> None:
    result = refit_models(learned, fresh(moving(400, 0.5, 3)), CHAIN)
    assert result.calibration is None
    assert "newest frames" in str(result.kept)


def spoilt(kind: str) -> OnlineFrames:
    good = fresh(moving(400, 1.2, 1))
    thigh = good.markers["thigh"].copy()
    if kind == "two names swapped":
        thigh[:, [0, 1]] = thigh[:, [1, 0]]
    elif kind == "a marker knocked off":
        thigh[:, 2] += np.array([0.0, 0.06, 0.0])
    elif kind == "cluster turned":
        q = moving(400, 1.2, 1).reference["thigh"]
        tilted = rotation.multiply(q, rotation.exp(np.array([0.2, 0.0, 0.0])))
        thigh = rotation.rotate(tilted[:, None], np.array(calibration().clusters["thigh"].template))
    else:
        return replace(good, markers={"thigh": good.markers["shank"], "shank": thigh})
    return replace(good, markers={**good.markers, "thigh": thigh})


@pytest.mark.parametrize(
    "kind", ["two names swapped", "a marker knocked off", "cluster turned", "segments swapped"]
)
def test_wrong_camera_data_are_rejected_by_online_learning(kind: str) -> None:
    with pytest.raises(CalibrationError, match="marker"):
        refit_models(calibration(), spoilt(kind), CHAIN)


def test_a_calibration_without_memory_is_refused_with_a_remedy() -> None:
    with pytest.raises(CalibrationError, match="repeat the functional phase"):
        refit_models(replace(calibration(), memory=""), fresh(moving(400, 1.2)), CHAIN)


def test_few_frames_are_refused() -> None:
    with pytest.raises(CalibrationError, match="200 are needed"):
        refit_models(calibration(), fresh(moving(100, 1.2)), CHAIN)


# --- memory -----------------------------------------------------------------------------------


def test_memory_keeps_orientations_to_a_hundredth_of_a_degree() -> None:
    taught = join_training(moving(50, 0.5), moving(40, 1.0))
    again = unpack(CHAIN, pack(CHAIN, taught))
    assert again is not None
    for name, q in {**taught.sensors, **taught.reference}.items():
        found = {**again.sensors, **again.reference}[name]
        assert np.max(rotation.angle_between(q, found)) < np.deg2rad(0.01)
    assert again.trials is not None
    assert again.trials.tolist() == [0] * 50 + [1] * 40


def test_memory_of_another_chain_is_none() -> None:
    other = replace(CHAIN, sensors=(("S1",), ("S3",)))
    assert unpack(other, pack(CHAIN, moving(7, 0.5))) is None
    assert unpack(CHAIN, "") is None


def test_memory_is_bounded_and_retains_rare_postures() -> None:
    rare, common = moving(20, 2.0), moving(5000, 0.3)
    kept = thin_evenly(CHAIN, join_training(rare, common))
    assert len(kept) == MOST
    assert kept.trials is not None
    assert np.count_nonzero(kept.trials == 0) >= 15


def test_memory_retains_the_newest_frames_of_a_posture() -> None:
    long = moving(1000, 0.0)
    assert len(np.unique(postures(CHAIN, long), axis=0)) < 10
    both = join_training(long, long)
    kept = thin_evenly(CHAIN, both, 500)
    assert kept.trials is not None
    assert np.mean(kept.trials == 1) > 0.95


def test_memory_distinguishes_at_most_three_kinds_of_movement() -> None:
    taught = moving(10, 0.5)
    for _ in range(4):
        taught = join_training(taught, moving(10, 0.5))
    assert taught.trials is not None
    assert sorted(set(taught.trials.tolist())) == [0, 1, 2]
    assert taught.trials.tolist() == sorted(taught.trials.tolist())
