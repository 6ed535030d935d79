"""The request `physical-test`: one test at a time, as in `jointfit probe --physical-test`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from jointfit_daemon.model import Chunk
from jointfit_daemon.outputs.payload_models import ANSWERS
from jointfit_daemon.pipeline.events import ChunkArrived, SourceClosed
from jointfit_daemon.supervisor import _physical_test_handler
from jointfit_daemon.supervisor._physical_test_handler import LONGEST_S, RunningPhysicalTest
from tests.physical_test.turned_sensor import guided_chunks, turned_source
from tests.supervisor.request_gateway import gateway_fixture  # noqa: F401 - a fixture

if TYPE_CHECKING:
    import pytest

    from tests.fake_drivers import FakeImu
    from tests.supervisor.request_gateway import Running


def asked(action: str, device: str = "S1") -> dict[str, Any]:
    return {"device": device, "action": action}


async def test_a_complete_test_is_judged_and_its_answer_fits_the_model() -> None:
    running = RunningPhysicalTest(turned_source("world_to_sensor"))
    assert (await running.state())["state"] == "opening"
    for chunk in guided_chunks():
        running.event(ChunkArrived("S2", chunk))  # chunks of another sensor
    assert (await running.state())["state"] == "opening"
    for chunk in guided_chunks():
        running.event(ChunkArrived("S1", chunk))

    answer: Any = await running.state()
    ANSWERS["physical-test"].model_validate(answer)
    assert (answer["state"], answer["step"]) == ("finished", 4)
    assert answer["result"]["rig_toml"] == ('direction = "sensor_to_world"',)
    running.event(SourceClosed(0, "S1", "lost", "unplugged"))  # after the end of the test
    assert (await running.state())["state"] == "finished"


async def test_a_lost_sensor_ends_the_test_in_words() -> None:
    running = RunningPhysicalTest(turned_source())
    running.event(SourceClosed(0, "S1", "lost", "/dev/ttyUSB0: unplugged"))
    answer = await running.state()
    assert (answer["state"], answer["text"]) == ("failed", "/dev/ttyUSB0: unplugged")


async def test_a_test_that_is_never_completed_ends_and_releases_its_chunks() -> None:
    running = RunningPhysicalTest(turned_source())
    first = next(iter(guided_chunks()))
    after_ns = round((LONGEST_S + 1.0) * 1e9)
    for chunk in (first, Chunk(first.t_ns + after_ns, first.data)):
        running.event(ChunkArrived("S1", chunk))
    answer = await running.state()
    assert (answer["state"], answer["text"]) == (
        "failed",
        "not completed within 5 minutes: start the test again",
    )
    assert not running.test.has_orientation


async def test_the_sensor_is_opened_again_and_the_test_follows_it_until_stopped(
    gateway: Running, fakes: type[FakeImu]
) -> None:
    async with gateway.run():
        await gateway.until(lambda: fakes.started == ["S1", "S2"])
        idle = await gateway.ask("physical-test", asked("status"))
        assert idle.error is not None
        assert '"action":"start"' in str(idle.error["message"])

        assert (await gateway.ask("physical-test", asked("start"))).data["state"] == "opening"
        await gateway.until(lambda: fakes.started == ["S1", "S2", "S1"])
        sinks = len(gateway.daemon._core._sinks)
        await gateway.ask("physical-test", asked("start", "S2"))  # ends the first test
        assert len(gateway.daemon._core._sinks) == sinks
        other = await gateway.ask("physical-test", asked("status"))
        assert other.status == "error"
        assert (await gateway.ask("physical-test", asked("stop", "S2"))).data["state"] == "stopped"
        assert len(gateway.daemon._core._sinks) == sinks - 1


async def test_an_unknown_sensor_and_a_running_phase_refuse_the_test(
    gateway: Running, fakes: type[FakeImu]
) -> None:
    async with gateway.run():
        await gateway.until(lambda: fakes.started == ["S1", "S2"])
        unknown = await gateway.ask("physical-test", asked("start", "S9"))
        assert unknown.error is not None
        assert "expected a sensor of rig.toml: S1, S2" in str(unknown.error["message"])
        await gateway.ask("static", {"seconds": 60.0})
        refused = await gateway.ask("physical-test", asked("start"))
        assert refused.error is not None
        assert "phase static is running" in str(refused.error["message"])
        assert fakes.started == ["S1", "S2"]


async def test_an_abandoned_test_ends_by_itself(
    gateway: Running, fakes: type[FakeImu], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_physical_test_handler, "ABANDONED_S", 0.05)
    async with gateway.run():
        await gateway.until(lambda: fakes.started == ["S1", "S2"])
        sinks = len(gateway.daemon._core._sinks)
        await gateway.ask("physical-test", asked("start"))
        await gateway.until(lambda: len(gateway.daemon._core._sinks) == sinks)
