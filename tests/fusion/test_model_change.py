"""Models from online learning replace the current models without a jump of the output."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import pytest

from jointfit_daemon.calibration.soft_tissue import fit_models
from jointfit_daemon.fusion import LimbFuser
from jointfit_daemon.kinematics.rotation_scalar import angle_between_one, as_quaternion
from tests.calibration.calibrated_subject import CHAIN, calibration, moving

if TYPE_CHECKING:
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.model import LimbState, Quaternion

MS = 1_000_000
STEP_NS = 10 * MS
HELD = moving(40, 1.2, 1)
ROW = 25
"""Index of a frame with large flexion, in which old and new models differ most."""


@cache
def learned() -> Calibration:
    models = fit_models(CHAIN, moving(400, 1.2), "anchored")
    old = calibration()
    segments = {n: replace(item, models=models[n]) for n, item in old.segment.items()}
    return replace(old, segment=segments)


def fuse(fuser: LimbFuser, k: int, *, without: str = "") -> LimbState:
    measured = {n: as_quaternion(q[ROW].tolist()) for n, q in HELD.sensors.items() if n != without}
    return fuser.fuse(k * STEP_NS, k * STEP_NS, k, measured)


def thigh(state: LimbState) -> Quaternion:
    q = state.segments[0].q_world_segment
    assert q is not None
    return q


def test_new_models_fade_in_within_a_second() -> None:
    fuser = LimbFuser(CHAIN, calibration())
    states = [fuse(fuser, k) for k in range(10)]
    fuser.replace_models(learned())
    states += [fuse(fuser, k) for k in range(10, 130)]
    steps = [angle_between_one(thigh(a), thigh(b)) for a, b in pairwise(states)]
    whole = angle_between_one(thigh(states[0]), thigh(states[-1]))
    assert whole > np.deg2rad(0.5)  # the models differ
    assert max(steps) < 0.012 * whole
    fresh_start = LimbFuser(CHAIN, learned())
    assert angle_between_one(thigh(fuse(fresh_start, 0)), thigh(states[-1])) < 1e-9


@pytest.mark.parametrize("first", [False, True])
def test_sensor_loss_during_the_model_change_causes_no_jump(first: bool) -> None:
    fuser, plain = LimbFuser(CHAIN, calibration()), LimbFuser(CHAIN, calibration())
    last = fuse(plain, 0)
    for k in range(10):
        fuse(fuser, k)
        last = fuse(plain, k)
    fuser.replace_models(learned())
    if first:
        fuse(fuser, 10)
        fuse(plain, 10)
    now = fuse(fuser, 11, without="S2")
    assert angle_between_one(thigh(now), thigh(last)) < np.deg2rad(0.5)


def test_models_replaced_before_the_first_frame_apply_at_once() -> None:
    fuser = LimbFuser(CHAIN, calibration())
    fuser.replace_models(learned())
    right = thigh(fuse(LimbFuser(CHAIN, learned()), 0))
    assert angle_between_one(thigh(fuse(fuser, 0)), right) < 1e-12
