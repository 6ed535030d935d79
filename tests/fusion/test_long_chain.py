"""Chain of three segments with three, two and one sensors: calibration, fusion and faults."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING
from unittest.mock import patch

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jointfit_daemon.fusion import LimbFuser, OpticalLimb
from jointfit_daemon.kinematics.joint_angles import read_joint
from jointfit_daemon.model import AngleConvention, Chain
from tests.calibration import synthetic_limb
from tests.calibration.synthetic_limb import (
    Imperfections,
    Motion,
    Subject,
    motion,
    record,
)
from tests.fusion.calibrated_limb import calibrated

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jointfit_daemon.model import LimbState, Quaternion

    Frames = list[tuple[int, dict[str, Quaternion]]]

OWNER = dict(zip("ABCDEF", ("thigh", "thigh", "thigh", "shank", "shank", "foot"), strict=True))
CHAIN = Chain(
    joints=("hip", "knee", "ankle", "toe"),
    segments=("thigh", "shank", "foot"),
    sensors=(("A", "B", "C"), ("D", "E"), ("F",)),
    lengths=(None, None, 0.15),
    proximal="pelvis",
)
SUBJECT = Subject(5, flaws=Imperfections(sensor_deg=0.2, tissue_deg=2.0, skin_m=0.002))


@pytest.fixture(scope="module", autouse=True)
def six_sensors() -> Iterator[None]:
    with patch.object(synthetic_limb, "OWNER", OWNER):
        yield


@pytest.fixture(scope="module")
def fuser() -> LimbFuser:
    return LimbFuser(CHAIN, calibrated(SUBJECT, CHAIN))


@pytest.fixture(scope="module")
def walk() -> tuple[Motion, Frames]:
    moving = motion(SUBJECT, 20.0, 400.0)
    tracks = record(SUBJECT, moving, 31, cameras=False).sensors
    rows = {s: [tuple(q) for q in track.q_world_sensor.tolist()] for s, track in tracks.items()}
    stamps = tracks["A"].t_ns.tolist()
    return moving, [(t, {s: rows[s][k] for s in rows}) for k, t in enumerate(stamps)]


def play(fuser: LimbFuser, frames: Frames) -> list[LimbState]:
    return [fuser.fuse(t, t, k, said) for k, (t, said) in enumerate(frames)]


def test_angles_rates_and_positions_agree_with_ground_truth(
    fuser: LimbFuser, walk: tuple[Motion, Frames]
) -> None:
    moving, frames = walk
    states = play(fuser, frames)
    t_s = np.array([s.t_ns for s in states]) * 1e-9
    for joint, column in (("knee", 1), ("ankle", 2)):
        i = CHAIN.joints.index(joint)
        found = [s.joints[i] for s in states]
        said = np.degrees([j.angles.flexion for j in found if j.angles])
        true = np.degrees(np.interp(t_s, moving.t_s, moving.angles[:, column]))
        assert np.sqrt(np.mean((said - true) ** 2)) < 3.0
        rate = np.degrees([j.rates.flexion if j.rates else np.nan for j in found])
        wanted = np.gradient(true, t_s)
        assert np.sqrt(np.nanmean((rate - np.interp(t_s - 0.025, t_s, wanted)) ** 2)) < 15.0
        assert np.max(np.abs(wanted)) > 100.0
    last = states[-1]
    assert [len(s.used) for s in last.segments] == [3, 2, 1]
    assert last.joints[0].angles is None
    assert last.joints[3].angles is None
    places = [np.array(j.position) for j in last.joints]
    assert np.linalg.norm(places[3] - places[2]) == pytest.approx(0.15)
    assert np.linalg.norm(places[2] - places[0]) == pytest.approx(0.82, abs=0.03)
    assert last.flags == ()


def test_sensor_loss_and_slip_on_three_sensors(
    fuser: LimbFuser, walk: tuple[Motion, Frames]
) -> None:
    frames = walk[1]
    slide = Rotation.from_rotvec([0.3, -0.35, 0.2])
    hurt: Frames = []
    for k, (t, said) in enumerate(frames[:1500]):
        changed = {s: q for s, q in said.items() if not (s == "D" and k >= 1000)}
        if k >= 500:
            w, x, y, z = (Rotation.from_quat(said["B"], scalar_first=True) * slide).as_quat(
                scalar_first=True
            )
            changed["B"] = (w, x, y, z)
        hurt.append((t + 10**12, changed))
    states = play(fuser, hurt)
    found = [k for k, s in enumerate(states) if "slipped:B" in s.flags]
    assert 500 < found[0] <= 700
    assert states[-1].segments[0].used == ("A", "C")
    assert states[-1].segments[1].used == ("E",)
    assert "one_sensor:shank" in states[-1].flags
    assert all(j.position is not None for j in states[-1].joints)


def test_configured_convention_reaches_the_state_and_its_optical_reference(
    fuser: LimbFuser, walk: tuple[Motion, Frames]
) -> None:
    tilt = AngleConvention.TILT_TORSION
    chain = replace(CHAIN, conventions=(None, tilt, None, None))
    calibration = fuser._calibration
    assert calibration is not None
    state = play(LimbFuser(chain, calibration), walk[1][:200])[-1]
    assert state.joints[1].convention is tilt
    plain = play(LimbFuser(CHAIN, calibration), walk[1][:200])[-1]
    assert plain.joints[1].convention is AngleConvention.FLEXION
    thigh, shank = (segment.q_world_segment for segment in state.segments[:2])
    assert thigh is not None
    assert shank is not None
    expected = read_joint(thigh, shank, flexion_sign=-1.0, left=False, convention=tilt)
    assert state.joints[1].angles == expected.angles
    assert state.joints[1].angles != plain.joints[1].angles
    limb = OpticalLimb(chain, calibration)
    seen = limb._angles(1, [thigh, shank, None])
    assert seen == expected
