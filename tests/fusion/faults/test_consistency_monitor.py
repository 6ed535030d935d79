"""Slips and drifting headings: found, told, taken out or doubted, and nobody blamed for skin."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jointfit_daemon.calibration.phases import fit_static
from jointfit_daemon.calibration.phases._static_pose import fit_static_only
from jointfit_daemon.fusion import LimbFuser
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
def worn() -> Calibration:
    return calibrated(SUBJECT)


@pytest.fixture(scope="module")
def walk() -> tuple[Array, dict[str, Array], dict[str, Array]]:
    """Two minutes at 25 frames a second: instants (s), what sensors say, bones."""
    moving = motion(SUBJECT, 120.0, 200.0)
    tracks = record(SUBJECT, moving, 31, cameras=False).sensors
    t_s = tracks["S1"].t_ns[::4] * 1e-9
    bones = {
        name: moving.q[name].as_quat(scalar_first=True)[:: 200 // 25][: len(t_s)]
        for name in CHAIN.segments
    }
    return t_s, {name: track.q_world_sensor[::4] for name, track in tracks.items()}, bones


def play(
    fuser: LimbFuser, t_s: Array, said: Mapping[str, Array]
) -> tuple[list[LimbState], list[tuple[float, str, str]]]:
    """Return states, and time (s), id and state of what was told."""
    rows = {name: [tuple(q) for q in array.tolist()] for name, array in said.items()}
    states, told = [], []
    for k, t in enumerate(t_s):
        t_ns = round(t * 1e9)
        states.append(fuser.fuse(t_ns, t_ns, k, {name: rows[name][k] for name in rows}))
        told += [(t, news.id, news.state) for news in fuser.news(t_ns)]
    return states, told


def slipped(t_s: Array, q: Array, degrees: float, at_s: float) -> Array:
    """Return a sensor that slides on its segment within 0.3 s."""
    share = np.clip((t_s - at_s) / 0.3, 0.0, 1.0)
    slide = Rotation.from_rotvec(np.radians(degrees) * np.outer(share, [0.6, -0.5, 0.62]))
    return np.asarray((Rotation.from_quat(q, scalar_first=True) * slide).as_quat(scalar_first=True))


def drifting(t_s: Array, q: Array, degrees_a_minute: float) -> Array:
    """Return a sensor whose world turns about the vertical."""
    turn = rotation.heading(np.radians(degrees_a_minute) * t_s / 60)
    return rotation.multiply(turn, q)


def oriented(states: list[LimbState], segment: int) -> Array:
    return np.array([state.segments[segment].q_world_segment for state in states])


def joint_error(states: list[LimbState], bones: Mapping[str, Array]) -> Array:
    """Return the angle between the joint's rotation and the true one, deg."""
    said = rotation.multiply(rotation.conjugate(oriented(states, 0)), oriented(states, 1))
    true = rotation.multiply(rotation.conjugate(bones["thigh"]), bones["shank"])
    return np.asarray(np.degrees(rotation.angle_between(said, true)))


def test_healthy_sensors_are_left_alone(
    worn: Calibration, walk: tuple[Array, dict[str, Array], dict[str, Array]]
) -> None:
    t_s, said, bones = walk
    states, told = play(LimbFuser(CHAIN, worn), t_s, said)
    assert told == []
    assert {flag for s in states for flag in s.flags} == set()
    unwatched = play(LimbFuser(CHAIN, replace(worn, links=())), t_s, said)[0]
    watched, plain = (np.sqrt(np.mean(joint_error(x, bones) ** 2)) for x in (states, unwatched))
    assert watched < plain + 0.3


@pytest.mark.parametrize("name", ["S1", "S4"])
@pytest.mark.parametrize("degrees", [12.0, 30.0])
def test_a_slip_is_told_within_two_seconds_and_covered_by_the_deviation(
    worn: Calibration,
    walk: tuple[Array, dict[str, Array], dict[str, Array]],
    name: str,
    degrees: float,
) -> None:
    t_s, said, _ = walk
    part = slice(0, 25 * 30)
    t_s, said = t_s[part], {s: q[part] for s, q in said.items()}
    before, _ = play(LimbFuser(CHAIN, worn), t_s, said)
    spoilt = said | {name: slipped(t_s, said[name], degrees, 12.0)}
    states, told = play(LimbFuser(CHAIN, worn), t_s, spoilt)
    i = SEGMENT[name]
    segment = CHAIN.segments[i]
    assert [(who, what) for _, who, what in told] == [(segment, "pair_disagrees")]
    assert 12.0 < told[0][0] < 14.0
    assert f"pair_disagrees:{segment}" in states[-1].flags
    claimed = np.array([s.segments[i].sd or 0.0 for s in states])
    moved = rotation.angle_between(oriented(before, i), oriented(states, i))
    assert np.max(moved / (np.sqrt(3) * claimed)) < 1.5


def test_a_slip_that_is_set_right_is_told_to_be_over(
    worn: Calibration, walk: tuple[Array, dict[str, Array], dict[str, Array]]
) -> None:
    t_s, said, _ = walk
    wrong = slipped(t_s, said["S2"], 25.0, 10.0)
    mended = np.where((t_s < 20.0)[:, None], wrong, said["S2"])
    part = slice(0, 25 * 30)
    spoilt = {s: q[part] for s, q in (said | {"S2": mended}).items()}
    states, told = play(LimbFuser(CHAIN, worn), t_s[part], spoilt)
    assert [what for _, _, what in told] == ["pair_disagrees", "agrees"]
    assert states[-1].flags == ()


def pulled(t_s: Array, q: Array, degrees: float) -> Array:
    """Return a sensor near iron from 8 to 20 s: its heading takes 3 s either way."""
    away = np.clip((t_s - 8.0) / 3.0, 0.0, 1.0) - np.clip((t_s - 20.0) / 3.0, 0.0, 1.0)
    return rotation.multiply(rotation.heading(np.radians(degrees) * away), q)


def half_minute(
    walk: tuple[Array, dict[str, Array], dict[str, Array]],
) -> tuple[Array, dict[str, Array], dict[str, Array]]:
    t_s, said, bones = walk
    part = slice(0, 25 * 30)
    return (
        t_s[part],
        {name: q[part] for name, q in said.items()},
        {name: q[part] for name, q in bones.items()},
    )


@pytest.mark.parametrize(("name", "degrees"), [("S2", 30.0), ("S3", -40.0)])
def test_a_heading_that_iron_pulls_away_is_told_put_right_and_told_to_be_over(
    worn: Calibration,
    walk: tuple[Array, dict[str, Array], dict[str, Array]],
    name: str,
    degrees: float,
) -> None:
    t_s, said, bones = half_minute(walk)
    fuser, segment = LimbFuser(CHAIN, worn), CHAIN.segments[SEGMENT[name]]
    healthy = play(LimbFuser(CHAIN, worn), t_s, said)[0]
    states, told = play(fuser, t_s, said | {name: pulled(t_s, said[name], degrees)})
    assert [(who, what) for _, who, what in told] == [
        (segment, "pair_disagrees"), (segment, "agrees"),
    ]  # fmt: skip
    assert 8.0 < told[0][0] < 11.0
    assert 20.0 < told[1][0] < 28.0
    lasting = (t_s > 11.0) & (t_s < 20.0)
    with_iron, without = (
        np.sqrt(np.mean(joint_error(x, bones)[lasting] ** 2)) for x in (states, healthy)
    )
    assert with_iron < without + 1.0
    assert states[-1].flags == ()


def test_the_sensor_whose_heading_turned_is_named(
    worn: Calibration, walk: tuple[Array, dict[str, Array], dict[str, Array]]
) -> None:
    t_s, said, _ = walk
    fuser, news = LimbFuser(CHAIN, worn), []
    spoilt = said | {"S1": pulled(t_s, said["S1"], 35.0)}
    for k, t in enumerate(t_s[:300]):
        t_ns = round(t * 1e9)
        fuser.fuse(t_ns, t_ns, k, {name: tuple(q[k].tolist()) for name, q in spoilt.items()})
        news += fuser.news(t_ns)
    assert news[0].data["turned"] == "S1"
    assert "heading of S1" in news[0].text


def test_two_headings_of_one_segment_keep_the_angles_and_make_the_headings_doubtful(
    worn: Calibration, walk: tuple[Array, dict[str, Array], dict[str, Array]]
) -> None:
    t_s, said, bones = half_minute(walk)
    spoilt = said | {name: pulled(t_s, said[name], 30.0) for name in ("S3", "S4")}
    states, told = play(LimbFuser(CHAIN, worn), t_s, spoilt)
    assert [(who, what) for _, who, what in told] == [
        ("shank", "heading_disagrees"), ("shank", "agrees"),
    ]  # fmt: skip
    assert 8.0 < told[0][0] < 11.0
    lasting = (t_s > 12.0) & (t_s < 20.0)
    assert np.sqrt(np.mean(joint_error(states, bones)[lasting] ** 2)) < 5.0
    during = [state for state, now in zip(states, lasting, strict=True) if now]
    assert all("heading_disagrees:knee" in state.flags for state in during)
    for i, name in enumerate(CHAIN.segments):
        claimed = np.sqrt(3.0) * np.array([s.segments[i].sd for s in states], dtype=float)
        error = rotation.angle_between(oriented(states, i), bones[name])
        assert np.mean((error < 1.61 * claimed)[lasting]) > 0.95
    assert states[-1].flags == ()


def test_of_three_sensors_the_one_that_slipped_is_known_and_left_out() -> None:
    chain = replace(CHAIN, sensors=(("S1", "S2", "S3"), ("S4",)))
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
    pose = fit_static(static, SETTINGS, chain)
    calibration = fit_static_only(pose, None, chain)
    bias = {s: item.q_sensor_segment for s, item in calibration.sensor.items()}
    said = {s: rotation.multiply(q, rotation.conjugate(bias[s])) for s, q in mounted.items()}
    spoilt = said | {"S2": slipped(t_s, said["S2"], 60.0, 8.0)}
    states, told = play(LimbFuser(chain, calibration), t_s, spoilt)
    assert {who for _, who, _ in told} == {"thigh"}
    assert told[0][0] < 10.0
    assert "slipped:S2" in states[-1].flags
    assert states[-1].segments[0].used == ("S1", "S3")
    clean = play(LimbFuser(chain, calibration), t_s, said)[0]
    apart = rotation.angle_between(oriented(states, 0)[-1], oriented(clean, 0)[-1])
    assert np.degrees(apart) < 1.0


@pytest.mark.parametrize(
    "rates",
    [{"S3": 8.0, "S4": 8.0}, {"S1": -4.0, "S2": -4.0, "S3": 4.0, "S4": 4.0}, {"S4": 10.0}],
    ids=["shank", "both", "one"],
)
def test_a_drifting_heading_is_taken_out(
    worn: Calibration,
    walk: tuple[Array, dict[str, Array], dict[str, Array]],
    rates: dict[str, float],
) -> None:
    t_s, said, bones = walk
    spoilt = said | {s: drifting(t_s, said[s], rate) for s, rate in rates.items()}
    fuser = LimbFuser(CHAIN, worn)
    plain = LimbFuser(CHAIN, worn)
    plain.links = None
    last = slice(25 * 90, None)
    with_, without, healthy = (
        np.sqrt(np.mean(joint_error(play(f, t_s, q)[0], bones)[last] ** 2))
        for f, q in ((fuser, spoilt), (plain, spoilt), (LimbFuser(CHAIN, worn), said))
    )
    assert with_ < healthy + 1.0
    assert without > healthy + 2.0


def test_a_reload_forgets_no_drift_and_moves_nobodys_leg(
    worn: Calibration, walk: tuple[Array, dict[str, Array], dict[str, Array]]
) -> None:
    t_s, said, _ = walk
    rates = {"S3": 10.0, "S4": 10.0}
    spoilt = said | {s: drifting(t_s, said[s], rate) for s, rate in rates.items()}
    half, rest = slice(None, 25 * 90), slice(25 * 90, 25 * 92)
    fuser, same = LimbFuser(CHAIN, worn), LimbFuser(CHAIN, worn)
    for each in (fuser, same):
        play(each, t_s[half], {name: q[half] for name, q in spoilt.items()})
    stored = Calibration.from_dict(worn.to_dict())  # as read from the store again
    reloaded, fresh = LimbFuser(CHAIN, stored), LimbFuser(CHAIN, stored)
    reloaded.take_over(fuser)
    left = {name: q[rest] for name, q in spoilt.items()}
    gone_on, _ = play(same, t_s[rest], left)
    after, _ = play(reloaded, t_s[rest], left)
    begun, _ = play(fresh, t_s[rest], left)
    assert [s.segments for s in after] == [s.segments for s in gone_on]
    assert np.max(rotation.angle_between(oriented(begun, 1), oriented(gone_on, 1))) > 0.05


def test_a_new_static_pose_begins_with_fresh_headings(worn: Calibration) -> None:
    turned = replace(worn.sensor["S1"], q_sensor_segment=(0.0, 1.0, 0.0, 0.0))
    moved = replace(worn, sensor={**worn.sensor, "S1": turned})
    before, after = LimbFuser(CHAIN, worn), LimbFuser(CHAIN, moved)
    links = after.links
    after.take_over(before)
    assert after.links is links


def test_a_joint_that_is_no_hinge_tells_nothing_of_headings(
    worn: Calibration, walk: tuple[Array, dict[str, Array], dict[str, Array]]
) -> None:
    loose = tuple(
        replace(link, spread=np.radians(9.0)) if link.kind == "joint" else link
        for link in worn.links
    )
    t_s, said, _ = walk
    fuser = LimbFuser(CHAIN, replace(worn, links=loose))
    play(fuser, t_s[:500], {s: drifting(t_s, q, 8.0 * (s > "S2"))[:500] for s, q in said.items()})
    assert fuser.links is not None
    assert fuser.links.health()["headings"] == {"knee": {"drift_deg": None, "sd_deg": None}}


def test_links_survive_storing_to_the_last_bit(worn: Calibration) -> None:
    assert len(worn.links) == 6
    assert Calibration.from_dict(worn.to_dict()) == worn
    old = {key: value for key, value in worn.to_dict().items() if key != "links"}
    assert Calibration.from_dict(old).links == ()


def test_what_nobody_sees_of_sensors_without_north_grows_in_the_deviation(
    worn: Calibration, walk: tuple[Array, dict[str, Array], dict[str, Array]]
) -> None:
    t_s, said, _ = walk
    everyone = frozenset(said)
    states, _ = play(LimbFuser(CHAIN, worn, drifting=everyone), t_s, said)
    north, _ = play(LimbFuser(CHAIN, worn), t_s, said)
    for k in (0, 1):
        grown = [s.segments[k].sd or 0.0 for s in (states[25], states[-1])]
        assert grown[1] > grown[0] + np.radians(2.0)
        assert (north[-1].segments[k].sd or 0.0) < grown[1]
    assert states[-1].joints[1].angle_sd == north[-1].joints[1].angle_sd  # the hinge tells
    assert (states[-1].joints[2].position_sd or 0.0) >= (north[-1].joints[2].position_sd or 0.0)
    assert "heading_unseen" in states[-1].flags
    loose = tuple(link for link in worn.links if link.kind == "pair")
    fuser = LimbFuser(CHAIN, replace(worn, links=loose), drifting=everyone)
    blind, _ = play(fuser, t_s, said)
    assert (blind[-1].joints[1].angle_sd or 0.0) > (north[-1].joints[1].angle_sd or 9.0) * 1.2
