"""Slip, magnetic disturbance and heading drift: detection, correction and uncertainty."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jointfit_daemon.calibration.phases import fit_static
from jointfit_daemon.calibration.phases._static_pose import fit_static_only
from jointfit_daemon.fusion import LimbFuser
from jointfit_daemon.fusion.faults._consistency_monitor import compared_pairs
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import Calibration
from tests.calibration.synthetic_limb import (
    CHAIN,
    SETTINGS,
    Imperfections,
    Subject,
    motion,
    record,
)
from tests.fusion.calibrated_limb import calibrated

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.model import LimbState

Array = np.ndarray
SUBJECT = Subject(21, flaws=Imperfections(sensor_deg=0.2, tissue_deg=3.0, skin_m=0.003))
SEGMENT = {"S1": 0, "S2": 0, "S3": 1, "S4": 1}


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return calibrated(SUBJECT)


@pytest.fixture(scope="module")
def walk() -> tuple[Array, dict[str, Array], dict[str, Array]]:
    """Return times (s), sensor orientations and bone orientations of two minutes at 25 Hz."""
    moving = motion(SUBJECT, 120.0, 200.0)
    tracks = record(SUBJECT, moving, 31, cameras=False).sensors
    t_s = tracks["S1"].t_ns[::4] * 1e-9
    bones = {
        name: moving.q[name].as_quat(scalar_first=True)[:: 200 // 25][: len(t_s)]
        for name in CHAIN.segments
    }
    return t_s, {name: track.q_world_sensor[::4] for name, track in tracks.items()}, bones


def play(
    fuser: LimbFuser, t_s: Array, measured: Mapping[str, Array]
) -> tuple[list[LimbState], list[tuple[float, str, str]]]:
    """Fuse a movement; return the states, and time (s), id and state of each report."""
    rows = {name: [tuple(q) for q in array.tolist()] for name, array in measured.items()}
    states, reported = [], []
    for k, t in enumerate(t_s):
        t_ns = round(t * 1e9)
        states.append(fuser.fuse(t_ns, t_ns, k, {name: rows[name][k] for name in rows}))
        reported += [(t, reports.id, reports.state) for reports in fuser.pop_reports(t_ns)]
    return states, reported


@pytest.fixture(scope="module")
def healthy(
    calibration: Calibration, walk: tuple[Array, dict[str, Array], dict[str, Array]]
) -> tuple[list[LimbState], list[tuple[float, str, str]]]:
    """Return states and reports of the walk without a fault."""
    t_s, measured, _ = walk
    return play(LimbFuser(CHAIN, calibration), t_s, measured)


def slipped(t_s: Array, q: Array, degrees: float, at_s: float) -> Array:
    """Return the orientations of a sensor that slips on its segment within 0.3 s."""
    share = np.clip((t_s - at_s) / 0.3, 0.0, 1.0)
    slide = Rotation.from_rotvec(np.radians(degrees) * np.outer(share, [0.6, -0.5, 0.62]))
    return np.asarray((Rotation.from_quat(q, scalar_first=True) * slide).as_quat(scalar_first=True))


def drifting(t_s: Array, q: Array, degrees_a_minute: float) -> Array:
    """Return the orientations of a sensor whose world rotates about the vertical."""
    turn = rotation.heading(np.radians(degrees_a_minute) * t_s / 60)
    return rotation.multiply(turn, q)


def oriented(states: list[LimbState], segment: int) -> Array:
    return np.array([state.segments[segment].q_world_segment for state in states])


def joint_error(states: list[LimbState], bones: Mapping[str, Array]) -> Array:
    """Return the angle between the estimated and the true joint rotation, deg."""
    measured = rotation.multiply(rotation.conjugate(oriented(states, 0)), oriented(states, 1))
    true = rotation.multiply(rotation.conjugate(bones["thigh"]), bones["shank"])
    return np.asarray(np.degrees(rotation.angle_between(measured, true)))


def test_healthy_sensors_are_neither_reported_nor_changed(
    calibration: Calibration,
    walk: tuple[Array, dict[str, Array], dict[str, Array]],
    healthy: tuple[list[LimbState], list[tuple[float, str, str]]],
) -> None:
    t_s, measured, bones = walk
    states, reported = healthy
    assert reported == []
    assert {flag for s in states for flag in s.flags} == set()
    unwatched = play(LimbFuser(CHAIN, replace(calibration, links=())), t_s, measured)[0]
    watched, plain = (np.sqrt(np.mean(joint_error(x, bones) ** 2)) for x in (states, unwatched))
    assert watched < plain + 0.3


@pytest.mark.parametrize("name", ["S1", "S4"])
@pytest.mark.parametrize("degrees", [12.0, 30.0])
def test_slip_is_reported_within_2_s_and_covered_by_the_standard_deviation(
    calibration: Calibration,
    walk: tuple[Array, dict[str, Array], dict[str, Array]],
    healthy: tuple[list[LimbState], list[tuple[float, str, str]]],
    name: str,
    degrees: float,
) -> None:
    t_s, measured, _ = half_minute(walk)
    before = healthy[0][: len(t_s)]
    faulty = measured | {name: slipped(t_s, measured[name], degrees, 12.0)}
    states, reported = play(LimbFuser(CHAIN, calibration), t_s, faulty)
    i = SEGMENT[name]
    segment = CHAIN.segments[i]
    assert [(name, state) for _, name, state in reported] == [(segment, "pair_disagrees")]
    assert 12.0 < reported[0][0] < 14.0
    assert f"pair_disagrees:{segment}" in states[-1].flags
    claimed = np.array([s.segments[i].sd or 0.0 for s in states])
    moved = rotation.angle_between(oriented(before, i), oriented(states, i))
    assert np.max(moved / (np.sqrt(3) * claimed)) < 1.5


def test_end_of_a_slip_is_reported(
    calibration: Calibration, walk: tuple[Array, dict[str, Array], dict[str, Array]]
) -> None:
    t_s, measured, _ = walk
    wrong = slipped(t_s, measured["S2"], 25.0, 10.0)
    corrected = np.where((t_s < 20.0)[:, None], wrong, measured["S2"])
    part = slice(0, 25 * 30)
    faulty = {s: q[part] for s, q in (measured | {"S2": corrected}).items()}
    states, reported = play(LimbFuser(CHAIN, calibration), t_s[part], faulty)
    assert [state for _, _, state in reported] == ["pair_disagrees", "agrees"]
    assert states[-1].flags == ()


def disturbed(t_s: Array, q: Array, degrees: float) -> Array:
    """Return orientations with a heading error that begins at 8 s and ends at 23 s, in 3 s each."""
    away = np.clip((t_s - 8.0) / 3.0, 0.0, 1.0) - np.clip((t_s - 20.0) / 3.0, 0.0, 1.0)
    return rotation.multiply(rotation.heading(np.radians(degrees) * away), q)


def half_minute(
    walk: tuple[Array, dict[str, Array], dict[str, Array]],
) -> tuple[Array, dict[str, Array], dict[str, Array]]:
    t_s, measured, bones = walk
    part = slice(0, 25 * 30)
    return (
        t_s[part],
        {name: q[part] for name, q in measured.items()},
        {name: q[part] for name, q in bones.items()},
    )


@pytest.mark.parametrize(("name", "degrees"), [("S2", 30.0), ("S3", -40.0)])
def test_magnetic_disturbance_is_reported_corrected_and_its_end_reported(
    calibration: Calibration,
    walk: tuple[Array, dict[str, Array], dict[str, Array]],
    healthy: tuple[list[LimbState], list[tuple[float, str, str]]],
    name: str,
    degrees: float,
) -> None:
    t_s, measured, bones = half_minute(walk)
    fuser, segment = LimbFuser(CHAIN, calibration), CHAIN.segments[SEGMENT[name]]
    states, reported = play(fuser, t_s, measured | {name: disturbed(t_s, measured[name], degrees)})
    assert [(name, state) for _, name, state in reported] == [
        (segment, "pair_disagrees"), (segment, "agrees"),
    ]  # fmt: skip
    assert 8.0 < reported[0][0] < 11.0
    assert 20.0 < reported[1][0] < 28.0
    lasting = (t_s > 11.0) & (t_s < 20.0)
    disturbed_error, without = (
        np.sqrt(np.mean(joint_error(x, bones)[lasting] ** 2))
        for x in (states, healthy[0][: len(t_s)])
    )
    assert disturbed_error < without + 1.0
    assert states[-1].flags == ()


def test_disturbed_sensor_is_named(
    calibration: Calibration, walk: tuple[Array, dict[str, Array], dict[str, Array]]
) -> None:
    t_s, measured, _ = walk
    fuser, reports = LimbFuser(CHAIN, calibration), []
    faulty = measured | {"S1": disturbed(t_s, measured["S1"], 35.0)}
    for k, t in enumerate(t_s[:300]):
        t_ns = round(t * 1e9)
        fuser.fuse(t_ns, t_ns, k, {name: tuple(q[k].tolist()) for name, q in faulty.items()})
        reports += fuser.pop_reports(t_ns)
    assert reports[0].data["turned"] == "S1"
    assert "heading of S1" in reports[0].text


def test_disturbed_segment_preserves_joint_angles_and_makes_headings_uncertain(
    calibration: Calibration, walk: tuple[Array, dict[str, Array], dict[str, Array]]
) -> None:
    t_s, measured, bones = half_minute(walk)
    faulty = measured | {name: disturbed(t_s, measured[name], 30.0) for name in ("S3", "S4")}
    states, reported = play(LimbFuser(CHAIN, calibration), t_s, faulty)
    assert [(name, state) for _, name, state in reported] == [
        ("shank", "heading_disagrees"), ("shank", "agrees"),
    ]  # fmt: skip
    assert 8.0 < reported[0][0] < 11.0
    lasting = (t_s > 12.0) & (t_s < 20.0)
    assert np.sqrt(np.mean(joint_error(states, bones)[lasting] ** 2)) < 5.0
    during = [state for state, now in zip(states, lasting, strict=True) if now]
    assert all("heading_disagrees:knee" in state.flags for state in during)
    for i, name in enumerate(CHAIN.segments):
        claimed = np.sqrt(3.0) * np.array([s.segments[i].sd for s in states], dtype=float)
        error = rotation.angle_between(oriented(states, i), bones[name])
        assert np.mean((error < 1.61 * claimed)[lasting]) > 0.95
    assert states[-1].flags == ()


def test_the_number_of_compared_pairs_grows_with_that_of_the_sensors() -> None:
    groups = [[f"S{i}" for i in range(count)] for count in (2, 5, 6, 16, 32)]
    assert [len(compared_pairs(group)) for group in groups] == [1, 10, 10, 30, 62]
    for group in groups[2:]:
        # Every sensor is in at least two pairs, even if one other sensor is lost.
        for lost in (None, *group):
            partners = Counter(
                n for pair in compared_pairs(group) if lost not in pair for n in pair
            )
            assert min(partners.values()) >= 2


@pytest.mark.parametrize("thigh", [("S1", "S2", "S3"), ("S1", "S2", "S3", "S5", "S6", "S7", "S8")])
def test_slipped_sensor_of_several_is_identified_and_excluded(thigh: tuple[str, ...]) -> None:
    chain = replace(CHAIN, sensors=(thigh, ("S4",)))
    rng = np.random.default_rng(5)
    t_s = np.arange(0.0, 20.0, 0.04)
    swing = Rotation.from_rotvec(np.outer(0.5 * np.sin(4 * t_s), [1.0, 0.0, 0.0]))
    mounted = {}
    for group, share in zip(chain.sensors, (1.0, -0.6), strict=True):
        for name in group:
            scatter = Rotation.from_rotvec(np.radians(0.5) * rng.normal(size=(len(t_s), 3)))
            q = swing**share * scatter if share < 1 else swing * scatter
            mounted[name] = q.as_quat(scalar_first=True)
    static = record(SUBJECT, motion(SUBJECT, 6.0, 400.0, still=True), 1, cameras=False)
    more = dict.fromkeys(thigh, static.sensors["S1"])
    static = replace(static, sensors=more | dict(static.sensors))
    pose = fit_static(static, SETTINGS, chain)
    calibration = fit_static_only(pose, None, chain)
    bias = {s: item.q_sensor_segment for s, item in calibration.sensor.items()}
    measured = {s: rotation.multiply(q, rotation.conjugate(bias[s])) for s, q in mounted.items()}
    faulty = measured | {"S2": slipped(t_s, measured["S2"], 60.0, 8.0)}
    states, reported = play(LimbFuser(chain, calibration), t_s, faulty)
    assert {name for _, name, _ in reported} == {"thigh"}
    assert reported[0][0] < 10.0
    assert "slipped:S2" in states[-1].flags
    assert states[-1].segments[0].used == tuple(name for name in thigh if name != "S2")
    clean = play(LimbFuser(chain, calibration), t_s, measured)[0]
    apart = rotation.angle_between(oriented(states, 0)[-1], oriented(clean, 0)[-1])
    assert np.degrees(apart) < 1.0


@pytest.mark.parametrize(
    "rates",
    [{"S3": 8.0, "S4": 8.0}, {"S1": -4.0, "S2": -4.0, "S3": 4.0, "S4": 4.0}, {"S4": 10.0}],
    ids=["shank", "both", "one"],
)
def test_heading_drift_is_corrected(
    calibration: Calibration,
    walk: tuple[Array, dict[str, Array], dict[str, Array]],
    healthy: tuple[list[LimbState], list[tuple[float, str, str]]],
    rates: dict[str, float],
) -> None:
    t_s, measured, bones = walk
    faulty = measured | {s: drifting(t_s, measured[s], rate) for s, rate in rates.items()}
    fuser = LimbFuser(CHAIN, calibration)
    plain = LimbFuser(CHAIN, calibration)
    plain.consistency = None
    last = slice(25 * 90, None)
    with_, without, unaffected = (
        np.sqrt(np.mean(joint_error(states, bones)[last] ** 2))
        for states in (play(fuser, t_s, faulty)[0], play(plain, t_s, faulty)[0], healthy[0])
    )
    assert with_ < unaffected + 1.0
    assert without > unaffected + 2.0


def test_reload_preserves_drift_corrections(
    calibration: Calibration, walk: tuple[Array, dict[str, Array], dict[str, Array]]
) -> None:
    t_s, measured, _ = walk
    rates = {"S3": 10.0, "S4": 10.0}
    faulty = measured | {s: drifting(t_s, measured[s], rate) for s, rate in rates.items()}
    half, rest = slice(None, 25 * 90), slice(25 * 90, 25 * 92)
    fuser, same = LimbFuser(CHAIN, calibration), LimbFuser(CHAIN, calibration)
    for each in (fuser, same):
        play(each, t_s[half], {name: q[half] for name, q in faulty.items()})
    # A calibration from the store is an equal object, but not the same object.
    stored = Calibration.from_dict(calibration.to_dict())
    reloaded, fresh = LimbFuser(CHAIN, stored), LimbFuser(CHAIN, stored)
    reloaded.resume(fuser)
    left = {name: q[rest] for name, q in faulty.items()}
    continued, _ = play(same, t_s[rest], left)
    after, _ = play(reloaded, t_s[rest], left)
    restarted, _ = play(fresh, t_s[rest], left)
    assert [s.segments for s in after] == [s.segments for s in continued]
    assert np.max(rotation.angle_between(oriented(restarted, 1), oriented(continued, 1))) > 0.05


def test_new_static_pose_resets_the_consistency_monitor(calibration: Calibration) -> None:
    turned = replace(calibration.sensor["S1"], q_sensor_segment=(0.0, 1.0, 0.0, 0.0))
    moved = replace(calibration, sensor={**calibration.sensor, "S1": turned})
    before, after = LimbFuser(CHAIN, calibration), LimbFuser(CHAIN, moved)
    monitor = after.consistency
    after.resume(before)
    assert after.consistency is monitor


def test_joint_that_is_no_hinge_gives_no_heading(
    calibration: Calibration, walk: tuple[Array, dict[str, Array], dict[str, Array]]
) -> None:
    loose = tuple(
        replace(link, spread=np.radians(9.0)) if link.kind == "joint" else link
        for link in calibration.links
    )
    t_s, measured, _ = walk
    fuser = LimbFuser(CHAIN, replace(calibration, links=loose))
    play(
        fuser, t_s[:500], {s: drifting(t_s, q, 8.0 * (s > "S2"))[:500] for s, q in measured.items()}
    )
    assert fuser.consistency is not None
    assert fuser.consistency.health()["headings"] == {"knee": {"drift_deg": None, "sd_deg": None}}


def test_links_are_stored_exactly(calibration: Calibration) -> None:
    assert len(calibration.links) == 6
    assert Calibration.from_dict(calibration.to_dict()) == calibration
    old = {key: value for key, value in calibration.to_dict().items() if key != "links"}
    assert Calibration.from_dict(old).links == ()


def test_unobserved_drift_increases_the_standard_deviation(
    calibration: Calibration,
    walk: tuple[Array, dict[str, Array], dict[str, Array]],
    healthy: tuple[list[LimbState], list[tuple[float, str, str]]],
) -> None:
    t_s, measured, _ = walk
    sensors = frozenset(measured)
    states, _ = play(LimbFuser(CHAIN, calibration, drifting=sensors), t_s, measured)
    north, _ = healthy
    for k in (0, 1):
        grown = [s.segments[k].sd or 0.0 for s in (states[25], states[-1])]
        assert grown[1] > grown[0] + np.radians(2.0)
        assert (north[-1].segments[k].sd or 0.0) < grown[1]
    assert states[-1].joints[1].angle_sd == north[-1].joints[1].angle_sd  # observable by the hinge
    assert (states[-1].joints[2].position_sd or 0.0) >= (north[-1].joints[2].position_sd or 0.0)
    assert "heading_unseen" in states[-1].flags
    loose = tuple(link for link in calibration.links if link.kind == "pair")
    fuser = LimbFuser(CHAIN, replace(calibration, links=loose), drifting=sensors)
    blind, _ = play(fuser, t_s, measured)
    assert (blind[-1].joints[1].angle_sd or 0.0) > (north[-1].joints[1].angle_sd or 9.0) * 1.2
