"""The core while devices connect, disconnect, restart and change by reloads."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import pytest

from jointfit_daemon.calibration.phases import run_job
from jointfit_daemon.config import parse_rig
from jointfit_daemon.limb_model import Calibration
from jointfit_daemon.model import Chunk
from jointfit_daemon.pipeline.events import (
    CalibrationReady,
    ChunkArrived,
    Configured,
    DeviceStatus,
    FitJob,
    JobFinished,
    Notice,
    Request,
    SourceClosed,
    SourceOpened,
)
from jointfit_protocols.natnet import FrameOfData, encode
from tests.limb_model.plain_calibration import plain_calibration
from tests.pipeline import core_feed
from tests.pipeline.core_feed import (
    BEGIN_NS,
    MS,
    PERIOD_NS,
    SENSORS,
    Bench,
    arrival_ns,
    camera_hello,
    chunk,
    opening,
    table,
    xbus_bytes,
)

if TYPE_CHECKING:
    from collections.abc import Iterable

    from jointfit_daemon.pipeline.events import Event

VERDICTS = ("used", "decimated", "idle", "late", "duplicate", "dropped", "pending")


def samples(names: Iterable[str], first: int, end: int) -> list[Event]:
    found: list[Event] = [chunk(name, number) for name in names for number in range(first, end)]
    return sorted(found, key=arrival_ns)


def at(number: int) -> int:
    return BEGIN_NS + number * PERIOD_NS


def accounted(bench: Bench) -> None:
    for name, device in bench.devices().items():
        assert device["received"] == sum(device[key] for key in VERDICTS), (name, device)


def test_rest_of_a_closed_decoder_does_not_set_the_device_online() -> None:
    bench = Bench()
    bench.feed([*opening(), *samples(SENSORS, 0, 20)])
    # An incomplete message hides a whole message until the decoder discards the incomplete one.
    hiding = b"\xfa\xff\x36\xf0" + xbus_bytes("S1", 20)
    bench.feed([ChunkArrived("S1", Chunk(at(20), hiding)), SourceClosed(at(21), "S1", "lost", "x")])
    assert bench.devices()["S1"]["received"] == 21
    assert bench.devices()["S1"]["online"] is False
    assert [o.online for o in bench.out if isinstance(o, DeviceStatus) and o.id == "S1"] == [
        True,
        False,
    ]
    bench.feed([SourceOpened(at(22), "S1"), *samples(["S1"], 22, 24)])
    assert bench.out[-1] != DeviceStatus("S1", online=False)
    assert [o.online for o in bench.out if isinstance(o, DeviceStatus) and o.id == "S1"][-1] is True


def test_repeated_failure_without_samples_is_reported_once() -> None:
    bench = Bench()
    bench.feed([*opening(), *samples(SENSORS, 0, 20)])
    for number in range(20, 24):
        bench.feed([SourceClosed(at(number), "S1", "misconfigured", "no such speed")])
        bench.feed([SourceOpened(at(number), "S1")])
    bench.feed([*samples(["S1"], 24, 30), SourceClosed(at(31), "S1", "lost", "no such speed")])
    texts = [o.text for o in bench.out if isinstance(o, Notice)]
    assert texts.count("no such speed") == 2, "once, and once more after it had streamed"


def test_counts_agree_after_a_reload_that_changes_a_port() -> None:
    bench = Bench()
    bench.feed([*opening(), *samples((*SENSORS, "mocap"), 0, 20)])
    moved = table()
    moved["imu"][0]["port"] = "/dev/ttyOther"
    moved["mocap"]["server"] = "127.0.0.2"
    bench.feed([SourceClosed(at(21), name, "removed", "stopped") for name in ("S1", "mocap")])
    bench.feed([Configured(at(21), parse_rig(moved), None)])
    bench.feed([SourceOpened(at(21), "S1"), *samples(SENSORS, 22, 40)])
    assert bench.devices()["S1"]["received"] == 38
    accounted(bench)


def test_counts_of_a_device_start_at_0_after_removal_and_return() -> None:
    bench = Bench()
    bench.feed([*opening(), *samples((*SENSORS, "mocap"), 0, 20)])
    without = table()
    del without["imu"][1], without["mocap"]
    bench.feed([SourceClosed(at(21), name, "removed", "stopped") for name in ("S2", "mocap")])
    bench.feed([Configured(at(21), parse_rig(without), None)])
    bench.feed([Configured(at(22), parse_rig(table()), None)])
    bench.feed([SourceOpened(at(22), name) for name in ("S2", "mocap")])
    bench.feed([*camera_hello(at(22)), *samples((*SENSORS, "mocap"), 23, 40)])
    assert bench.devices()["S2"]["received"] == bench.devices()["mocap"]["received"] == 17
    accounted(bench)


# --- shapes of limbs ----------------------------------------------------------------------------


def shaped(worn: dict[str, str], *, mocap: bool = False) -> dict[str, Any]:
    """Return a rig with some of the four sensors on arbitrary segments."""
    rig = table()
    segments = list(dict.fromkeys(worn.values()))
    rig["chain"] = {"joints": [f"J{i}" for i in range(len(segments) + 1)], "segments": segments}
    rig["imu"] = [imu | {"segment": worn[imu["id"]]} for imu in rig["imu"] if imu["id"] in worn]
    if mocap:
        rig["mocap"]["rigid_body"] = {segment: segment.title() for segment in segments}
    else:
        del rig["mocap"]
    return rig


def still(names: Iterable[str], first: int, end: int) -> list[Event]:
    """Return samples of sensors at rest, with constant orientation and increasing counters."""
    turning = core_feed.orientation
    with patch.object(core_feed, "orientation", lambda name, _: turning(name, 0)):
        return samples(names, first, end)


def calibrated_by_standing(rig_table: dict[str, Any]) -> tuple[Bench, Calibration]:
    """Simulate standing without mocap; return the core and the result of the worker."""
    rig, bench = parse_rig(rig_table), Bench()
    names = [source.id for source in rig.sources]
    bench.feed([Configured(BEGIN_NS, rig, None), *(SourceOpened(BEGIN_NS, n) for n in names)])
    bench.feed(still(names, 0, 20))
    bench.feed([Request(at(20), "calibrate", "t", {"phase": "static"})])
    bench.feed(still(names, 20, 700))
    (job,) = [output for output in bench.out if isinstance(output, FitJob)]
    result = run_job(job.work)
    bench.feed([JobFinished(at(700), job.job, result, None)])
    bench.feed(still(names, 701, 720))
    (ready,) = [output for output in bench.out if isinstance(output, CalibrationReady)]
    return bench, ready.calibration


@pytest.mark.parametrize(
    "worn",
    [
        {"S1": "thigh"},
        {"S1": "thigh", "S2": "thigh"},
        {"S1": "thigh", "S3": "shank"},
        {"S1": "thigh", "S2": "shank", "S3": "foot"},
        {"S1": "thigh", "S2": "thigh", "S3": "shank", "S4": "foot"},
    ],
)
def test_static_calibration_of_any_chain(worn: dict[str, str]) -> None:
    bench, _ = calibrated_by_standing(shaped(worn))
    state = bench.states[-1]
    assert state.mode == "imu"
    assert [set(segment.used) for segment in state.segments] == [
        {name for name, on in worn.items() if on == segment.name} for segment in state.segments
    ]
    assert len(state.joints) == len(state.segments) + 1
    accounted(bench)


def test_heading_uncertainty_grows_with_the_age_of_the_calibration() -> None:
    rig = shaped({"S1": "thigh", "S3": "shank"})
    _, calibration = calibrated_by_standing(rig)
    sds = []
    for age_s in (0.0, 86_400.0):
        bench = Bench()
        started = Configured(BEGIN_NS, parse_rig(rig), calibration, 1, age_s)
        bench.feed([started, *(SourceOpened(BEGIN_NS, name) for name in ("S1", "S3"))])
        bench.feed(still(("S1", "S3"), 0, 60))
        sds.append(bench.states[-1].segments[0].sd)
    assert sds[0] is not None
    assert sds[1] is not None
    wandered = math.radians(0.3) * math.sqrt(1440.0 / 3.0)
    assert sds[1] == pytest.approx(math.hypot(sds[0], wandered), rel=1e-3)


def test_reload_preserves_the_consistency_monitor() -> None:
    worn = {"S1": "thigh", "S2": "thigh", "S3": "shank"}
    bench, calibration = calibrated_by_standing(shaped(worn))
    watched = bench.core._fuser.consistency
    assert watched is not None
    bench.feed(
        [
            Configured(
                at(721),
                parse_rig(shaped(worn) | {"rig": {"name": "r", "output_rate_hz": 50}}),
                calibration,
            )
        ]
    )
    assert bench.core._fuser.consistency is watched


@pytest.mark.parametrize(
    ("changed", "kept"),
    [
        ({"pose_ui_hz": 20.0}, (True, True)),
        ({"chain_hz": 5.0}, (False, True)),
        ({"chain_covariance": True}, (False, True)),
        ({"centers_memory_s": 7.0}, (True, False)),
    ],
)
def test_reload_keeps_chain_tracking_and_running_centers_whose_configuration_is_the_same(
    changed: dict[str, float | bool], kept: tuple[bool, bool]
) -> None:
    rig = shaped({"S1": "thigh", "S3": "shank"}, mocap=True)
    rig["mocap"]["markers"] = {"thigh": ["T1", "T2", "T3"], "shank": ["C1", "C2", "C3"]}
    del rig["mocap"]["rigid_body"]
    rig["chain"]["model"] = {
        "segment": [{"name": "femur"}, {"name": "tibia", "parent": "femur", "joint": "hinge"}],
        "marker": [
            {"name": name, "segment": segment, "position": [0.1 * k, 0.0, -0.1]}
            for part, segment in (("thigh", "femur"), ("shank", "tibia"))
            for k, name in enumerate(rig["mocap"]["markers"][part])
        ],
    }

    def state() -> tuple[object, object]:
        return bench.core._chain_tracker, bench.core._moving_centers

    def reload(number: int) -> tuple[object, object]:
        # Make an equal object each time, as after reading the stored file again.
        calibration = Calibration.from_dict(plain_calibration(parse_rig(rig).chain).to_dict())
        bench.feed([Configured(at(number), parse_rig(rig), calibration)])
        assert None not in state()
        return state()

    bench = Bench()
    first = reload(0)
    assert reload(1) == first
    rig["mqtt"] = rig.get("mqtt", {}) | changed
    second = reload(2)
    assert tuple(a is b for a, b in zip(second, first, strict=True)) == kept
    rig["mocap"]["up_axis"] = "z"
    third = reload(3)
    assert not any(a is b for a, b in zip(third, second, strict=True)), "other coordinates"


def reconnected(after: Iterable[Event]) -> tuple[Bench, list[Notice]]:
    """Return a core whose S3 was disconnected for two seconds, and its restart notices."""
    bench, _ = calibrated_by_standing(shaped({"S1": "thigh", "S3": "shank"}))
    begin = len(bench.out)
    bench.feed([SourceClosed(at(721), "S3", "lost", "unplugged"), SourceOpened(at(922), "S3")])
    bench.feed(after)
    notices = [
        output
        for output in bench.out[begin:]
        if isinstance(output, Notice) and output.kind in {"calibration", "clock"}
    ]
    return bench, notices


def test_reconnect_without_restart_preserves_the_pose() -> None:
    bench, notices = reconnected(samples(["S3"], 922, 960))
    assert notices == []
    assert bench.devices()["S3"]["restarts"] == 0
    assert bench.devices()["S3"]["reconnects"] == 1
    assert bench.devices()["S3"]["epoch"] == 0


def test_counter_that_stood_still_while_disconnected_is_no_restart() -> None:
    """During configuration, a device counts no samples, but its time continues."""
    with patch.object(core_feed, "counter", lambda number: number - 60):
        after = samples(["S3"], 922, 960)
    bench, notices = reconnected(after)
    assert notices == []
    assert bench.devices()["S3"]["restarts"] == 0


def moved_samples(begins_at: int) -> list[Event]:
    """Return samples of S3 from number `begins_at` on that arrive after the port was opened."""
    later = at(922) - at(begins_at)
    return [
        ChunkArrived(one.source, Chunk(one.chunk.t_ns + later, one.chunk.data))
        for one in samples(["S3"], begins_at, begins_at + 40)
        if isinstance(one, ChunkArrived)
    ]


def test_device_that_counts_for_longer_than_the_port_was_closed_has_not_restarted() -> None:
    bench, notices = reconnected(moved_samples(850))
    assert notices == []
    assert bench.devices()["S3"]["restarts"] == 0


@pytest.mark.parametrize("begins_at", [0, 5, 600, 1_000])
def test_reconnect_with_changed_time_or_counter_discards_the_pose(
    begins_at: int,
) -> None:
    bench, notices = reconnected(moved_samples(begins_at))
    assert bench.devices()["S3"]["restarts"] == 1
    assert [(notice.id, notice.kind) for notice in notices] == [
        ("S3", "clock"),
        ("S3", "calibration"),
    ]
    assert "and then the static pose" in notices[1].text


@pytest.mark.parametrize(("params", "mode"), [(0, "imu+mocap"), (4, "imu")])
def test_only_live_mocap_frames_give_the_optical_mode(params: int, mode: str) -> None:
    worn = {"S1": "thigh", "S3": "shank"}
    _, calibration = calibrated_by_standing(shaped(worn))
    rig, bench = parse_rig(shaped(worn, mocap=True)), Bench()
    bench.feed([Configured(BEGIN_NS, rig, calibration)])
    bench.feed([SourceOpened(BEGIN_NS, source.id) for source in rig.sources])
    bench.feed(camera_hello(BEGIN_NS))
    frames: list[Event] = []
    for number in range(1, 20):
        ticks = number * 100_000
        frame = FrameOfData(number, 0.0, ticks, ticks + 1, ticks + 2, params)
        frames.append(ChunkArrived("mocap", Chunk(at(number) + 6 * MS, encode(frame, (3, 0)))))
    bench.feed(sorted([*frames, *samples(worn, 0, 20)], key=arrival_ns))
    assert bench.states[-1].mode == mode
