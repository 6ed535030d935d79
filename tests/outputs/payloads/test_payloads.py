"""Encoded payloads equal the payloads in docs/mqtt.md."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import orjson
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jointfit_daemon.config import parse_rig
from jointfit_daemon.model import (
    AngleConvention,
    ChainModelState,
    FusionMode,
    JointAngles,
    JointState,
    LimbState,
    MarkerFitErrors,
    ModelCoordinate,
    OpticalJoint,
    OpticalSegment,
    OpticalState,
    PlanarJoint,
    SegmentState,
    SensorOrientation,
    SensorStates,
    Stick,
    StickFigure,
    SyncState,
)
from jointfit_daemon.outputs.mqtt import LinkHealth, Outbox
from jointfit_daemon.outputs.payloads import (
    BridgeHealth,
    ProcessHealth,
    StateHealth,
    TopicWriter,
    encode_pose,
)
from jointfit_daemon.outputs.payloads._encoding import (
    encode,
    encode_chain,
    encode_joint,
    encode_optical,
    encode_sensors,
    encode_sticks,
)
from jointfit_daemon.outputs.unix_clock import UnixClock
from jointfit_daemon.pipeline.events import (
    CalibrationPhase,
    CalibrationProgress,
    CalibrationStatus,
    DeviceInfo,
    DeviceStatus,
    Notice,
    NoticeKind,
    Reply,
    ReplyAddress,
)
from jointfit_daemon.pipeline.health import CoreHealth

if TYPE_CHECKING:
    from collections.abc import Iterator

UNITS = {"deg", "m", "s", "ms", "us", "hz", "ppm", "pct", "bytes"}

KNEE = JointState(
    "knee",
    (0.0210, 0.1040, 0.4810),
    0.00512,
    JointAngles(math.radians(28.314), math.radians(-1.92), math.radians(3.4)),
    math.radians(151.7),
    math.radians(1.4),
    JointAngles(math.radians(120.004), math.radians(-3.0), 0.0),
)
STATE = LimbState(
    seq=184211,
    t_ns=5_000_123_000,
    completed_ns=5_004_000_000,
    mode=FusionMode.IMU,
    sync=SyncState.LOCKED,
    flags=(),
    segments=(
        SegmentState("thigh", (0.9914, 0.1276, 0.0094, -0.0251), math.radians(0.9), ("S1", "S2")),
        SegmentState("shank", None, None, ()),
    ),
    joints=(JointState("hip", (0.0, 0.0, 0.912), 0.006), KNEE, JointState("ankle", None, None)),
)


@pytest.mark.parametrize(
    ("convention", "names"),
    [
        (AngleConvention.FLEXION, ("flexion", "adduction", "rotation")),
        (AngleConvention.ELEVATION, ("plane", "elevation", "rotation")),
        (AngleConvention.TILT_TORSION, ("flexion", "adduction", "rotation")),
        (AngleConvention.TRUNK, ("flexion", "bending", "rotation")),
    ],
)
def test_angles_have_the_names_of_their_convention(
    convention: AngleConvention, names: tuple[str, ...]
) -> None:
    hip, _, ankle = STATE.joints
    state = STATE._replace(joints=(hip, KNEE._replace(convention=convention), ankle))
    joint = json.loads(encode_pose(state, 0, 0))["joints"]["knee"]
    assert [joint[f"{name}_deg"] for name in names] == [28.31, -1.92, 3.4]
    assert [joint[f"{name}_deg_s"] for name in names] == [120.0, -3.0, 0.0]
    unknown = state._replace(
        joints=(hip, JointState("knee", None, None, convention=convention), ankle)
    )
    flat = json.loads(encode_joint(unknown, 1, 0))
    assert [flat[f"{name}_deg"] for name in names] == [None] * 3
    end = OpticalJoint("hip", None, None, None, None)
    optical = end._replace(
        name="knee",
        angles=KNEE.angles,
        residual=KNEE.angles,
        residual_rms=KNEE.angles,
        convention=convention,
    )
    limb = OpticalState(1, 0, (), (end, optical, end._replace(name="ankle")))
    seen = json.loads(encode_optical(limb, 0))["joints"]["knee"]
    for angles in (seen, seen["residual"], seen["residual_rms"]):
        assert [angles[f"{name}_deg"] for name in names] == [28.31, -1.92, 3.4]


def bent(alpha_deg: float, beta_deg: float, gamma_deg: float) -> LimbState:
    """Return a state whose shank is rotated by Rz(gamma) Ry(beta) Rx(alpha) from the thigh."""
    turn = Rotation.from_euler("ZYX", [gamma_deg, beta_deg, alpha_deg], degrees=True)
    thigh = Rotation.from_quat([0.0094, -0.0251, 0.1276, 0.9914])
    q = [tuple(r.as_quat(scalar_first=True).tolist()) for r in (thigh, thigh * turn)]
    segments = tuple(
        one._replace(q_world_segment=turned) for one, turned in zip(STATE.segments, q, strict=True)
    )
    return STATE._replace(segments=segments)


def test_pose_payload_is_exact() -> None:
    pose = encode_pose(STATE, 1_795_250_055_351_700_000, 5_007_523_000)
    assert json.loads(pose) == {
        "v": 1,
        "seq": 184211,
        "t_us": 1795250060351823,
        "completed_us": 1795250060355700,
        "mono_us": 5000123,
        "age_ms": 7.4,
        "mode": "imu",
        "sync": "locked",
        "flags": [],
        "segments": {
            "thigh": {"q": [0.9914, 0.1276, 0.0094, -0.0251], "sd_deg": 0.9, "used": ["S1", "S2"]},
            "shank": {"q": None, "sd_deg": None, "used": []},
        },
        "joints": {
            "hip": {"p_m": [0.0, 0.0, 0.912], "sd_m": 0.006},
            "knee": {
                "p_m": [0.021, 0.104, 0.481],
                "sd_m": 0.0051,
                "flexion_deg": 28.31,
                "adduction_deg": -1.92,
                "rotation_deg": 3.4,
                "inner_deg": 151.7,
                "sd_deg": 1.4,
                "flexion_deg_s": 120.0,
                "adduction_deg_s": -3.0,
                "rotation_deg_s": 0.0,
                "patent": None,  # the orientation of the shank is unknown
            },
            "ankle": {"p_m": None, "sd_m": None},
        },
    }


def test_joint_payload_contains_scalars_only() -> None:
    assert json.loads(encode_joint(bent(-30.0, 0.0, 0.0), 1, 7)) == {
        "v": 1, "t_us": 7, "x_m": 0.021, "y_m": 0.104, "z_m": 0.481, "sd_m": 0.0051,
        "flexion_deg": 28.31, "adduction_deg": -1.92, "rotation_deg": 3.4, "inner_deg": 151.7,
        "sd_deg": 1.4, "flexion_deg_s": 120.0, "adduction_deg_s": -3.0, "rotation_deg_s": 0.0,
        "patent_alpha_deg": -30.0, "patent_beta_deg": 0.0, "patent_gamma_deg": 0.0,
        "patent_joint_deg": 150.0, "patent_gimbal": False,
    }  # fmt: skip


def test_joint_payload_has_all_keys_while_angles_are_unknown() -> None:
    known = json.loads(encode_joint(bent(-30.0, 0.0, 0.0), 1, 7))
    unknown = json.loads(encode_joint(STATE, 1, 7))
    assert list(known) == list(unknown)
    assert [key for key, value in unknown.items() if value is None] == [
        "patent_alpha_deg", "patent_beta_deg", "patent_gamma_deg", "patent_joint_deg",
        "patent_gimbal",
    ]  # fmt: skip


def test_patent_angles_are_published_beside_anatomical_angles() -> None:
    joints = json.loads(encode_pose(bent(-50.0, 12.0, 7.0), 0, 0))["joints"]
    assert joints["knee"]["patent"] == {
        "alpha_deg": -50.0, "beta_deg": 12.0, "gamma_deg": 7.0, "joint_deg": 130.0, "gimbal": False,
    }  # fmt: skip
    assert "patent" not in joints["hip"]
    assert "patent" not in joints["ankle"]


def test_patent_gimbal_lock_is_flagged() -> None:
    found = json.loads(encode_pose(bent(-20.0, 90.0, 15.0), 0, 0))["joints"]["knee"]["patent"]
    assert found == {
        "alpha_deg": -35.0, "beta_deg": 90.0, "gamma_deg": 0.0, "joint_deg": 145.0, "gimbal": True,
    }  # fmt: skip


def test_unknown_joint_is_null() -> None:
    assert json.loads(encode_joint(STATE, 2, 7)) == {
        "v": 1, "t_us": 7, "x_m": None, "y_m": None, "z_m": None, "sd_m": None,
    }  # fmt: skip


@example(1.797693134862316e304)  # finite in rad, but infinite in hundredths of a degree
@given(st.floats(allow_nan=True, allow_infinity=True))
def test_payload_contains_no_nan_or_infinity(value: float) -> None:
    joint = JointState("knee", (value, value, value), value, JointAngles(value, value, value))
    pose = encode_pose(
        STATE.__class__(1, 0, 0, FusionMode.IMU, SyncState.LOCKED, (), (), (joint,)), 0, 0
    )
    json.loads(pose, parse_constant=lambda word: pytest.fail(f"{word} in a pose"))


def test_large_integers_and_surrogates_are_encoded() -> None:
    payload = {"t_ns": 2**53 + 1, "data": {"name": "a\udcff", "ticks": (-(2**60), 5, True)}}
    assert orjson.loads(encode(payload)) == {
        "t_ns": None,
        "data": {"name": "a?", "ticks": [None, 5, True]},
    }


def test_numpy_values_and_named_tuples_are_encoded() -> None:
    payload = encode({"a": np.float64(0.5), "b": np.arange(2), "c": JointAngles(1, 2, 3)})
    assert payload == b'{"a":0.5,"b":[0,1],"c":[1,2,3]}'


# --- the reporter -------------------------------------------------------------------------------


@pytest.fixture
def outbox() -> Outbox:
    return Outbox("b/bridge/state")


async def sent(outbox: Outbox) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = {}
    while outbox.queued:
        message, done = await outbox.next()
        done()
        text = orjson.loads(message.payload) if message.payload else None
        found.setdefault(message.topic.removeprefix("b/"), []).append(text)
    return found


def rig_table(table: dict[str, Any], **mqtt: Any) -> dict[str, Any]:
    return table | {"mqtt": {"base": "b", **mqtt}}


def numbers(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from numbers(inner, name)
    elif isinstance(value, float):
        yield key, value


async def test_pose_ui_and_joint_rates_are_as_documented(
    table: dict[str, Any], outbox: Outbox
) -> None:
    reporter = TopicWriter(parse_rig(rig_table(table)), outbox, UnixClock())
    await sent(outbox)
    counts: dict[str, int] = {}
    for number in range(1000):
        t_ns = 3_000_000_000 + number * 10_000_000
        reporter.output(
            LimbState(
                number,
                t_ns,
                t_ns,
                FusionMode.IMU,
                SyncState.LOCKED,
                (),
                STATE.segments,
                STATE.joints,
            )
        )
        for topic, payloads in (await sent(outbox)).items():
            counts[topic] = counts.get(topic, 0) + len(payloads)
    assert counts == {
        "pose": 1000, "pose/ui": 100, "joint/hip": 10, "joint/knee": 10, "joint/ankle": 10,
    }  # fmt: skip


async def test_device_topics_start_offline_and_are_cleared_on_removal(
    table: dict[str, Any], outbox: Outbox
) -> None:
    reporter = TopicWriter(parse_rig(rig_table(table)), outbox, UnixClock())
    reporter.output(DeviceStatus("S1", online=True))
    reporter.output(DeviceInfo("S2", {"model": "fake"}))
    found = await sent(outbox)
    assert found["device/S1/availability"] == [{"v": 1, "state": "online"}]
    assert found["device/S2/availability"] == [{"v": 1, "state": "offline"}]
    assert found["device/S2/info"] == [{"v": 1, "model": "fake"}]
    del table["imu"][1]
    reporter.configure(parse_rig(rig_table(table)))
    found = await sent(outbox)
    assert found["device/S2/availability"] == [None]
    assert found["device/S2/info"] == [None]
    assert "device/S1/availability" not in found


HEALTH = BridgeHealth(
    CoreHealth(),
    ProcessHealth(3.0, 1_000_000, None),
    LinkHealth(
        connected=True, connects=1, confirmed=True, denied=[], sent=9, queued=0, dropped=0,
        ignored_requests=0, noise=0,
    ),
    StateHealth(None, None),
)  # fmt: skip


async def test_outputs_are_published_on_their_topics(table: dict[str, Any], outbox: Outbox) -> None:
    reporter = TopicWriter(parse_rig(rig_table(table)), outbox, UnixClock())
    reporter.output(Notice(0, NoticeKind.DEVICE, "S1", "streaming"))
    reporter.output(CalibrationStatus(0, CalibrationPhase.CALIBRATED, "done", 3, {"rms_m": 0.004}))
    reporter.output(
        CalibrationProgress(0, CalibrationPhase.FUNCTIONAL, 0.5, "keep moving", {"arc_deg": 40.0})
    )
    reporter.publish_health(HEALTH)
    reporter.publish_log_line("warning", "x", "hot", 2)
    found = await sent(outbox)
    device, calibration = found["bridge/event"]
    assert (device["kind"], device["id"], device["text"]) == ("device", "S1", "streaming")
    assert (calibration["kind"], calibration["id"]) == ("calibration", "calibrated")
    assert found["calibration"][0]["version"] == 3
    assert found["calibration"][0]["quality"] == {"rms_m": 0.004}
    assert found["calibration/progress"][0]["progress"] == 0.5
    assert found["bridge/health"][0]["process"] == {
        "cpu_pct": 3.0, "rss_bytes": 1_000_000, "loop_delay_p99_ms": None,
    }  # fmt: skip
    assert found["bridge/log"][0]["suppressed"] == 2
    assert found["bridge/info"][0]["joints"] == ["hip", "knee", "ankle"]
    assert found["bridge/info"][0]["angles"] == {"knee": "flexion"}
    for payloads in found.values():
        for payload in payloads:
            for key, _ in numbers(payload):
                assert key.rpartition("_")[2] in UNITS | {"progress"}, key


async def test_reply_is_published_on_the_requested_topic(
    table: dict[str, Any], outbox: Outbox
) -> None:
    reporter = TopicWriter(parse_rig(rig_table(table)), outbox, UnixClock())
    await sent(outbox)
    reply = Reply("calibrate", "7", "accepted", {"phase": "static"})
    reporter.output(reply)
    reporter.output(replace(reply, reply_to=ReplyAddress("my/answers", b"9")))
    usual, _ = await outbox.next()
    own, _ = await outbox.next()
    assert usual.topic == "b/bridge/response/calibrate"
    assert orjson.loads(usual.payload) == {
        "v": 1, "transaction": "7", "status": "accepted", "data": {"phase": "static"},
        "error": None,
    }  # fmt: skip
    assert (own.topic, own.correlation, own.expiry_s) == ("my/answers", b"9", 30)


def test_sensors_have_their_own_orientation_and_that_of_their_segment() -> None:
    state = SensorStates(
        42,
        5_000_123_000,
        (
            SensorOrientation("S1", (0.70710678, 0.0, -0.70710678, 0.0), (1.0, 0.0, 0.0, 0.0)),
            SensorOrientation("S2", None, None),
        ),
        (("knee", (0.96592583, -0.25881905, 0.0, 0.0)),),
    )
    assert json.loads(encode_sensors(state, 1_000_000)) == {
        "v": 1,
        "seq": 42,
        "t_us": 5_001_123,
        "sensors": {
            "S1": {"q": [0.707107, 0.0, -0.707107, 0.0], "q_segment": [1.0, 0.0, 0.0, 0.0]},
            "S2": {"q": None, "q_segment": None},
        },
        "joints": {"knee": {"q": [0.965926, -0.258819, 0.0, 0.0]}},
    }


def test_optical_pose_has_residuals_beside_what_the_cameras_see() -> None:
    angles = JointAngles(math.radians(26.91), math.radians(-0.52), math.radians(2.71))
    errors = JointAngles(math.radians(0.774), math.radians(-0.19), 0.0)
    state = OpticalState(
        88213,
        5_000_123_000,
        (
            OpticalSegment("thigh", (1.0, 0.0, 0.0, 0.0), math.radians(1.1), math.radians(1.3)),
            OpticalSegment("shank", None, None, None),
        ),
        (
            OpticalJoint("hip", (0.07741, 0.0301, 0.9287), 0.00414, None, None),
            OpticalJoint("knee", None, None, 0.0087, 0.0092, angles, 2.5, errors, errors),
            OpticalJoint("ankle", None, None, None, None),
        ),
    )
    nothing = {"p_m": None, "gap_m": None, "residual_m": None, "residual_rms_m": None}
    residual = {"flexion_deg": 0.77, "adduction_deg": -0.19, "rotation_deg": 0.0}
    assert json.loads(encode_optical(state, 1_000_000)) == {
        "v": 1,
        "t_us": 5_001_123,
        "frame": 88213,
        "segments": {
            "thigh": {"q": [1.0, 0.0, 0.0, 0.0], "residual_deg": 1.1, "residual_rms_deg": 1.3},
            "shank": {"q": None, "residual_deg": None, "residual_rms_deg": None},
        },
        "joints": {
            "hip": nothing | {"p_m": [0.0774, 0.0301, 0.9287], "gap_m": 0.0041},
            "knee": nothing
            | {"residual_m": 0.0087, "residual_rms_m": 0.0092}
            | {"flexion_deg": 26.91, "adduction_deg": -0.52, "rotation_deg": 2.71}
            | {"inner_deg": 143.24, "residual": residual, "residual_rms": residual},
            "ankle": nothing,
        },
    }


def test_optical_chain_has_units_by_coordinate_and_null_for_the_unknown() -> None:
    state = ChainModelState(
        7,
        5_000_123_000,
        "leg",
        True,
        (
            ModelCoordinate("knee", True, math.radians(-27.694), math.radians(1.72)),
            ModelCoordinate("pelvis_tx", False, 0.07812, 0.00441),
            ModelCoordinate("hip", True, None, None),
        ),
        {"T1": 0.01181, "T2": None},
        MarkerFitErrors(0.00944, 0.04181, False),
        None,
        ("lost:T2",),
    )
    assert json.loads(encode_chain(state, 1_000_000)) == {
        "v": 1,
        "t_us": 5_001_123,
        "frame": 7,
        "model": "leg",
        "refined": True,
        "coordinates": {
            "knee": {"value_deg": -27.69, "sd_deg": 1.72},
            "pelvis_tx": {"value_m": 0.0781, "sd_m": 0.0044},
            "hip": {"value_deg": None, "sd_deg": None},
        },
        "error_m": {"T1": 0.0118, "T2": None},
        "fit": {"rms_m": 0.0094, "maximum_m": 0.0418, "accepted": False},
        "recent": None,
        "flags": ["lost:T2"],
    }


def test_covariance_of_a_chain_has_the_units_of_the_coordinates_that_are_known() -> None:
    state = ChainModelState(
        7,
        0,
        "leg",
        False,
        (
            ModelCoordinate("knee", True, 0.5, 0.03),
            ModelCoordinate("hip", True, None, None),
            ModelCoordinate("pelvis_tx", False, 0.1, 0.004),
        ),
        {},
        None,
        None,
        (),
        ((9e-4, -6e-5), (-6e-5, 1.6e-5)),
    )
    payload = json.loads(encode_chain(state, 0))
    assert payload["coordinates"]["knee"]["sd_deg"] == pytest.approx(math.sqrt(2.954), abs=0.005)
    assert payload["covariance"] == {
        "names": ["knee", "pelvis_tx"],
        "rows": [[2.955, -0.003438], [-0.003438, 1.6e-05]],
    }


def test_sticks_have_metres_and_null_with_the_reason() -> None:
    figure = StickFigure(
        7,
        5_000_123_000,
        (0.98712345, 0.16, 0.0),
        0.00214,
        None,
        (
            PlanarJoint("knee", (0.05961, 0.18851, 0.5), 0.00111, math.radians(97.4), None),
            PlanarJoint("ankle", None, None, None, "shank: C4 not visible"),
        ),
        (Stick("shank", ((0.05961, 0.18851, 0.5), None)),),
    )
    assert json.loads(encode_sticks(figure, 1_000_000)) == {
        "v": 1,
        "t_us": 5_001_123,
        "frame": 7,
        "plane": {"normal": [0.9871, 0.16, 0.0], "off_plane_m": 0.0021, "refused": None},
        "joints": {
            "knee": {
                "p_m": [0.0596, 0.1885, 0.5], "error_m": 0.0011, "arc_deg": 97.4, "refused": None,
            },
            "ankle": {
                "p_m": None, "error_m": None, "arc_deg": None, "refused": "shank: C4 not visible",
            },
        },
        "sticks": {"shank": {"ends_m": [[0.0596, 0.1885, 0.5], None]}},
    }  # fmt: skip
