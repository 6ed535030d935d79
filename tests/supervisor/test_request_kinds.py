"""Every request has the effect in docs/mqtt.md, once; a faulty request has no effect.

The faulty requests are generated from the JSON Schemas of the arguments.
"""

from __future__ import annotations

import asyncio
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import orjson
import pytest

from jointfit_daemon.config import Rig, parse_rig
from jointfit_daemon.outputs.mqtt import Incoming, sign_request
from jointfit_daemon.outputs.payload_models import ANSWERS
from jointfit_daemon.outputs.recording import open_recording
from jointfit_daemon.pipeline.events import (
    CalibrationSelected,
    Configured,
    Request,
)
from jointfit_daemon.supervisor import _calibration_store, _self_test
from jointfit_daemon.supervisor.requests import REQUESTS
from jointfit_daemon.supervisor.requests._dispatcher import MEMORY_NS
from tests.limb_model.plain_calibration import plain_calibration
from tests.outputs.recording.recorded_events import after_recording
from tests.supervisor.request_gateway import BASE, Running, gateway_fixture  # noqa: F401 - a fixture

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from tests.fake_drivers import FakeImu

VALID: dict[str, dict[str, Any]] = {
    "calibrate": {"phase": "abort"},
    "static": {"seconds": 5.0},
    "mark": {"text": "heel strike"},
    "record": {"action": "status"},
    "reload": {},
    "restart-device": {"device": "S1"},
    "rate": {"hz": 50.0},
    "calibrations": {},
    "use-calibration": {"version": 1},
    "selftest": {},
    "physical-test": {"device": "S1", "action": "stop"},
}


# --- faulty requests, generated from the schemas ------------------------------------------------

WRONG: dict[str, tuple[Any, ...]] = {
    "string": (5, None, ["a"], True),
    "number": ("5", True, {}, None),
    "integer": ("5", 1.5, [], None),
    "boolean": ("true", 1, None),
}
"""Values of other types, for each JSON type."""


def faulty(name: str) -> Iterator[tuple[dict[str, Any], str]]:
    """Yield arguments with one fault, and the key of the fault."""
    schema, valid = REQUESTS[name].model.model_json_schema(), VALID[name]
    for key, field in schema["properties"].items():
        kinds = {option.get("type") for option in field.get("anyOf", [field])}
        for value in WRONG[next(kind for kind in WRONG if kind in kinds)]:
            if not (value is None and "null" in kinds):
                yield valid | {key: value}, key
        for option in field.get("anyOf", [field]):
            for limit, change in _LIMITS.items():
                if limit in option:
                    yield valid | {key: change(option[limit])}, key
            if "enum" in option:
                yield valid | {key: "no such word"}, key
        if key in schema.get("required", ()):
            yield {k: v for k, v in valid.items() if k != key}, key
    yield valid | {"no_such_key": 1}, "no_such_key"


_LIMITS: dict[str, Callable[[Any], Any]] = {
    "minimum": lambda limit: limit - 1,
    "maximum": lambda limit: limit + 1,
    "exclusiveMinimum": lambda limit: limit,
    "maxLength": lambda limit: "x" * (limit + 1),
    "minLength": lambda limit: "x" * (limit - 1),
}


def test_every_request_has_an_example_in_this_module() -> None:
    assert VALID.keys() == REQUESTS.keys() == ANSWERS.keys()
    for name, arguments in VALID.items():
        REQUESTS[name].model.model_validate(arguments)


async def test_a_faulty_request_changes_nothing_and_the_error_names_the_key(
    gateway: Running,
) -> None:
    async with gateway.run():
        before, count = gateway.state(), 0
        for name in REQUESTS:
            for arguments, key in faulty(name):
                reply = await gateway.ask(name, arguments)
                assert reply.status == "error", arguments
                assert reply.error is not None
                fault = cast("Any", reply.error["faults"])[0]
                assert key in fault["key"], (arguments, reply.error)
                assert len(fault["message"]) > 20
                count += 1
        assert count > 60
        assert gateway.state() == before


@pytest.mark.parametrize(
    ("payload", "message"),
    [
        (b"{", "expected a JSON object"),
        (b"\xff\xfe", "expected a JSON object"),
        (b"[]", "expected a JSON object"),
        (b'{"a":' + b"[" * 100 + b"]" * 100 + b"}", "expected a flat JSON object"),
        (orjson.dumps({"text": "x" * 5000}), "expected at most 4096"),
        (orjson.dumps({f"k{n}": n for n in range(20)}), "expected at most 16"),
    ],
)
async def test_malformed_and_oversize_requests_change_nothing(
    gateway: Running, payload: bytes, message: str
) -> None:
    async with gateway.run():
        before = gateway.state()
        for name in REQUESTS:
            reply = await gateway.ask(name, payload)
            assert reply.error is not None
            assert message in str(reply.error["message"])
        unknown = await gateway.ask("restart_device", b"{}")
        assert unknown.error is not None
        assert "did you mean 'restart-device'?" in str(unknown.error["message"])
        assert gateway.state() == before


async def test_expired_and_unsigned_requests_change_nothing(gateway: Running) -> None:
    old_us = time.time_ns() // 1000 - 31_000_000
    async with gateway.run():
        before = gateway.state()
        for name, arguments in VALID.items():
            reply = await gateway.ask(name, arguments | {"t_us": old_us})
            assert reply.error is not None
            assert "send the request again" in str(reply.error["message"])
        assert gateway.state() == before

    key = gateway.folder / "key"
    key.write_bytes(b"k" * 32)
    gateway.table["mqtt"]["request_key_file"] = str(key)
    gateway.replies.clear()
    async with gateway.run():
        before = gateway.state()
        for name, arguments in VALID.items():
            topic = f"{BASE}/bridge/request/{name}"
            forged = sign_request(b"another key, long enough", topic, arguments)
            reply = await gateway.ask(name, arguments)
            assert reply.error is not None
            assert "signed requests only" in str(reply.error["message"])
            reply = await gateway.ask(name, forged)
            assert reply.error is not None
            assert "made with another key" in str(reply.error["message"])
        assert gateway.state() == before

        right = sign_request(b"k" * 32, f"{BASE}/bridge/request/mark", {"text": "a"})
        assert (await gateway.ask("mark", right)).status == "ok"
        assert "nonce: used already" in str((await gateway.ask("mark", right)).error)


async def test_a_repeated_request_gets_the_same_answer_and_changes_nothing(
    gateway: Running,
) -> None:
    async with gateway.run():
        await gateway.until(lambda: gateway.daemon._core.core.health(0).version == 2)
        for name, arguments in VALID.items():
            asked = arguments | {"transaction": f"t-{name}"}
            first = await gateway.ask(name, asked)
            assert first.status in ("ok", "accepted"), first
            ANSWERS[name].model_validate(first.data)
            await asyncio.sleep(0.05)  # the new calibration is stored meanwhile
            before = gateway.state()
            assert await gateway.ask(name, asked) == first
            assert gateway.state() == before
            if name == "static":
                await gateway.ask("calibrate", {"phase": "abort"})

        other = await gateway.ask("mark", {"text": "b", "transaction": "t-mark"})
        assert other.error is not None
        assert "use a new text for every request" in str(other.error["message"])

        for known in gateway.daemon._requests._known.values():
            known.request = replace(known.request, t_ns=known.request.t_ns - MEMORY_NS)
        again = await gateway.ask("mark", {"text": "b", "transaction": "t-mark"})
        assert again.data["number"] == 2


async def test_a_repetition_during_the_request_is_answered_at_its_end(gateway: Running) -> None:
    async with gateway.run():
        asked = orjson.dumps({"transaction": "a"})
        for client in ("one", "two"):
            gateway.daemon._receive_request(
                Incoming(
                    f"{BASE}/bridge/request/selftest", asked, retained=False,
                    response_topic=f"{BASE}/bridge/response/selftest/{client}",
                )
            )  # fmt: skip
        await gateway.until(lambda: len(gateway.replies) == 2)
        assert {topic.rpartition("/")[2] for topic in gateway.topics} == {"one", "two"}
        assert gateway.replies[0].data == gateway.replies[1].data


# --- effects ------------------------------------------------------------------------------------


async def test_a_recording_is_started_and_stopped_once(gateway: Running) -> None:
    async with gateway.run():
        first_start = await gateway.ask("record", {"action": "start"})
        started = await gateway.ask("record", {"action": "start"})
        file = started.data["file"]
        assert first_start.data["file"] == file
        recording_health = gateway.daemon.health().recording
        assert recording_health is not None
        assert recording_health.active
        await gateway.ask("mark", {"text": "start"})
        stopped = await gateway.ask("record", {"action": "stop"})
        again = await gateway.ask("record", {"action": "stop"})
        assert (stopped.data["file"], stopped.data["active"]) == (file, False)
        assert (again.status, again.data) == ("ok", stopped.data)
        recording_health = gateway.daemon.health().recording
        assert recording_health is not None
        assert (recording_health.active, recording_health.file) == (False, file)

    recording = open_recording(Path(str(started.data["directory"])) / str(file))
    first, *rest = recording.events()
    assert isinstance(first, Configured)
    assert not recording.began_with_daemon
    assert any(isinstance(event, Request) and event.command == "mark" for event in rest)


async def test_a_mark_is_an_event_with_its_number(gateway: Running) -> None:
    async with gateway.run():
        await gateway.ask("mark", {"text": "start"})
        reply = await gateway.ask("mark", {"text": "stop"})
        assert (reply.data["number"], reply.data["text"]) == (2, "stop")
        assert abs(cast("int", reply.data["t_us"]) - time.time_ns() // 1000) < 5_000_000
        marks = [notice for notice in gateway.notices if notice.kind == "mark"]
        assert [(mark.text, mark.data["number"]) for mark in marks] == [("start", 1), ("stop", 2)]


async def test_a_faulty_rig_is_refused_with_all_faults_and_a_sound_one_is_loaded(
    gateway: Running,
) -> None:
    async with gateway.run():
        before = gateway.state()[0]
        (gateway.folder / "rig.toml").write_text("[rig]\nnmae = 'x'\n")
        reply = await gateway.ask("reload", {})
        assert reply.error is not None
        assert "did you mean 'name'?" in str(reply.error["message"])
        assert len(cast("Any", reply.error["faults"])) > 1
        assert gateway.state()[0] == before

        gateway.write(gateway.table | {"rig": {"name": "bench-1", "output_rate_hz": 25.0}})
        reply = await gateway.ask("reload", {})
        assert (reply.status, reply.data["devices"]) == ("ok", ["S1", "S2"])
        assert gateway.daemon.rig.output_rate_hz == 25.0


async def test_answer_precedes_the_move_to_another_base(gateway: Running) -> None:
    async with gateway.run():
        mqtt = gateway.table["mqtt"] | {"base": "moved"}
        gateway.write(gateway.table | {"mqtt": mqtt})
        assert (await gateway.ask("reload", {})).status == "accepted"
        assert gateway.topics == [f"{BASE}/bridge/response/reload"]
        await gateway.until(lambda: gateway.daemon.rig.mqtt.base == "moved")


async def test_restart_of_a_device_opens_it_again_alone(
    gateway: Running, fakes: type[FakeImu]
) -> None:
    async with gateway.run():
        await gateway.until(lambda: fakes.started == ["S1", "S2"])
        assert (await gateway.ask("restart-device", {"device": "S1"})).status == "accepted"
        await gateway.until(lambda: fakes.started == ["S1", "S2", "S1"])
        reply = await gateway.ask("restart-device", {"device": "S9"})
        assert reply.error is not None
        assert "expected a device of rig.toml: S1, S2" in str(reply.error["message"])


async def test_the_rate_changes_without_reopening_a_port_until_the_next_reload(
    gateway: Running, fakes: type[FakeImu]
) -> None:
    async with gateway.run():
        await gateway.until(lambda: fakes.started == ["S1", "S2"])
        reply = await gateway.ask("rate", {"hz": 20.0})
        assert reply.data == {"before_hz": 100.0, "output_rate_hz": 20.0}
        core = cast("Any", gateway.daemon._core.core)
        assert core._rig.output_rate_hz == 20.0
        too_fast = await gateway.ask("rate", {"hz": 400.0})
        assert too_fast.error is not None
        assert "at most 100" in str(too_fast.error["message"])

        await gateway.ask("static", {"seconds": 60.0})
        running = await gateway.ask("rate", {"hz": 30.0})
        assert running.error is not None
        assert "wait until it ends" in str(running.error["message"])
        assert core._rig.output_rate_hz == 20.0

        await gateway.ask("reload", {})
        assert core._rig.output_rate_hz == 100.0
        assert fakes.started == ["S1", "S2"]


async def test_stored_calibrations_are_listed_used_and_reverted(gateway: Running) -> None:
    async with gateway.run():
        core = cast("Any", gateway.daemon._core.core)
        listed = (await gateway.ask("calibrations", {})).data
        assert (listed["in_force"], listed["omitted"]) == (2, 0)
        versions = cast("list[dict[str, Any]]", listed["versions"])
        assert [(v["version"], v["method"], v["usable"]) for v in versions] == [
            (2, "markley", True), (1, "mean", True),
        ]  # fmt: skip

        used = await gateway.ask("use-calibration", {"version": 1})
        assert (used.status, used.data["version"]) == ("ok", 1)
        assert core._session.calibration.method == "mean"
        assert not core._session.may_learn
        await gateway.until(lambda: core._session.version == 3)
        stored = _calibration_store.load_latest(gateway.daemon.rig).calibration
        assert stored is not None
        assert (stored.method, stored.quality["restored"]["from_version"]) == ("mean", 1)
        assert stored.created_utc == versions[1]["created_utc"]

        await gateway.ask("use-calibration", {"revert": True})
        await gateway.until(lambda: core._session.version == 4)
        assert core._session.calibration.method == "markley"

        reply = await gateway.ask("use-calibration", {"version": 9})
        assert reply.error is not None
        assert "no such version; stored: 1, 2, 3, 4" in str(reply.error["message"])
        await gateway.ask("static", {"seconds": 60.0})
        reply = await gateway.ask("use-calibration", {"version": 1})
        assert reply.error is not None
        assert "'static' is running" in str(reply.error["message"])


async def test_a_revert_waits_until_the_calibration_in_force_has_its_number(
    gateway: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    save = _calibration_store.save

    def save_and_wait(*words: Any, **more: Any) -> int:
        version = save(*words, **more)
        time.sleep(0.2)  # the file exists, but the daemon has not detected it
        return version

    monkeypatch.setattr(_calibration_store, "save", save_and_wait)
    async with gateway.run():
        await gateway.ask("use-calibration", {"version": 1})
        reverted = await gateway.ask("use-calibration", {"revert": True})
        assert (reverted.status, reverted.data["version"]) == ("ok", 2)


async def test_a_calibration_of_another_limb_is_listed_and_not_used(gateway: Running) -> None:
    rig = parse_rig(gateway.table)
    other = plain_calibration(rig.chain, joints=("shoulder", "elbow", "wrist"))
    _calibration_store.save(rig, other)
    async with gateway.run():
        versions = cast("Any", (await gateway.ask("calibrations", {"count": 1})).data["versions"])
        assert [(v["version"], v["usable"]) for v in versions] == [(3, False)]
        reply = await gateway.ask("use-calibration", {"version": 3})
        assert reply.error is not None
        assert "belongs to another limb" in str(reply.error["message"])


def test_the_recording_repeats_a_selected_calibration_and_a_changed_rate(
    table: dict[str, Any],
) -> None:
    rig: Rig = replace(parse_rig(table), output_rate_hz=20.0)
    (found,) = after_recording([Configured(1, rig, None)])
    assert isinstance(found, Configured)
    assert found.rig == rig

    request = Request(1, "use-calibration", "a", {"version": 1})
    event = CalibrationSelected(2, plain_calibration(rig.chain), 1, 3.0, request)
    assert after_recording([event]) == [event]


async def test_the_self_test_reports_absent_devices_and_a_full_disk_with_remedies(
    gateway: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = _self_test.HostState("No space left on device", 1000, 91.0)
    monkeypatch.setattr("jointfit_daemon.supervisor._request_handlers.read_host", lambda _: full)
    gateway.table["imu"][0]["mood"] = "lost"
    async with gateway.run():
        await gateway.until(lambda: gateway.daemon._core.core.health(0).devices["S2"].online)
        data = cast("Any", (await gateway.ask("selftest", {})).data)
    checks = {(check["check"], check["id"]): check for check in data["checks"]}
    assert data["level"] == "error"
    assert checks["device", "S1"]["level"] == "error"
    assert "/dev/nowhere-S1" in checks["device", "S1"]["remedy"]
    assert checks["device", "S2"]["level"] != "error"  # load lowers its sample rate
    assert [checks[name, ""]["level"] for name in ("store", "disk", "temperature")] == [
        "error", "error", "warning",
    ]  # fmt: skip
    assert all(check["remedy"] or check["level"] == "ok" for check in data["checks"])


async def test_the_rate_of_a_rig_without_sensors_has_no_limit_of_sensors(tmp_path: Path) -> None:
    rig = {
        "rig": {"name": "bench-1"},
        "chain": {
            "joints": ["hip", "knee", "ankle"], "segments": ["thigh", "shank"],
            "proximal": "pelvis", "distal": "foot", "motion": "planar",
        },
        "mocap": {
            "driver": "natnet", "server": "127.0.0.1",
            "markers": {
                "pelvis": ["P1"], "thigh": ["T1", "T2"], "shank": ["C1", "C2"], "foot": ["F1"],
            },
        },
    }  # fmt: skip
    gateway = Running(tmp_path, rig)
    async with gateway.run():
        reply = await gateway.ask("rate", {"hz": 50.0})
        assert reply.data == {"before_hz": 100.0, "output_rate_hz": 50.0}


async def test_a_request_signed_before_a_reload_is_accepted_unless_the_key_changed(
    gateway: Running,
) -> None:
    key = gateway.folder / "key"
    key.write_bytes(b"k" * 32)
    gateway.table["mqtt"]["request_key_file"] = str(key)
    gateway.write(gateway.table)

    def sign(key: bytes) -> Any:
        return sign_request(key, f"{BASE}/bridge/request/mark", {"text": "heel strike"})

    async with gateway.run():
        signed, repeated, other = sign(b"k" * 32), sign(b"k" * 32), sign(b"n" * 32)
        assert (await gateway.ask("mark", repeated)).status == "ok"
        await gateway.daemon.reload()
        assert (await gateway.ask("mark", signed)).status == "ok"
        assert (await gateway.ask("mark", repeated)).status == "error"

        key.write_bytes(b"n" * 32)
        await gateway.daemon.reload()
        assert (await gateway.ask("mark", other)).status == "error"
        assert (await gateway.ask("mark", sign(b"n" * 32))).status == "ok"
