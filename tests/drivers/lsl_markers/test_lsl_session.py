"""Connections to real LSL streams: search, reconnection, clocks, and errors with their remedy."""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
import threading
import time
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_daemon.model import ClockEcho, DeviceEvent, MocapFrame
from jointfit_drivers.lsl_markers import LslMarkersMocap, LslMarkersSettings, _session
from jointfit_simulators._contract_fixtures import count_descriptors
from jointfit_simulators.devices import LslServer, LslServerOptions

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from jointfit_daemon.model import Chunk, Decoded

pytestmark = pytest.mark.real_time

SOURCE = f"session-{os.getpid()}"
"""Identifier of the streams of this process; other processes of this host may have streams."""


def settings(**keys: Any) -> LslMarkersSettings:
    table = {"driver": "lsl-markers", "source_id": SOURCE, "up_axis": "z"} | keys
    return LslMarkersSettings.model_validate({k: v for k, v in table.items() if v is not None})


def server(*markers: str, **options: Any) -> LslServer:
    given = {"markers": markers, "source_id": SOURCE, "up_axis": "z"} | options
    return LslServer(LslServerOptions(**given))


class Reading:
    """A running driver, with one decoder for all connections, as in the daemon."""

    def __init__(self, **keys: Any) -> None:
        self.driver = LslMarkersMocap(settings(**keys))
        self.decoder = self.driver.decoder()
        self.items: list[Decoded] = []

    def take(self, chunk: Chunk) -> None:
        self.items += self.decoder.feed(chunk)

    def of(self, kind: type) -> list[Any]:
        return [item for item in self.items if isinstance(item, kind)]

    @contextlib.asynccontextmanager
    async def connected(self) -> AsyncIterator[asyncio.Task[None]]:
        running = asyncio.create_task(self.driver.run(self.take))
        try:
            yield running
        finally:
            running.cancel()
            await asyncio.wait([running])

    async def frames(self, source: LslServer, count: int, kind: type = MocapFrame) -> None:
        """Send until this number of further items has arrived."""
        wanted = len(self.of(kind)) + count
        async with asyncio.timeout(10):
            while len(self.of(kind)) < wanted:
                source.push(0, dict.fromkeys(source.options.markers, (0.1, 0.2, 0.3)), {})
                await asyncio.sleep(0.01)


async def test_stamps_become_instants_of_this_host_within_the_round_trip(lsl_network: Any) -> None:
    source, reading = server("T1"), Reading()
    async with reading.connected():
        await reading.frames(source, 1, ClockEcho)
        exposed_ns = time.monotonic_ns() - 40_000_000
        source.push(exposed_ns, {"T1": (1.0, 2.0, 3.0)}, {})
        await asyncio.sleep(0.1)
    source.unplug()

    echo, frame = reading.of(ClockEcho)[-1], reading.of(MocapFrame)[-1]
    half_ns = (echo.received_ns - echo.sent_ns) / 2
    assert 0 < half_ns < 5e6
    host_ns = (echo.sent_ns + echo.received_ns) / 2 + frame.ticks - echo.ticks
    assert abs(host_ns - exposed_ns) <= half_ns + 1000


async def test_a_stream_that_returns_with_fewer_channels_is_named(lsl_network: Any) -> None:
    source, reading = server("T1", "T2"), Reading(markers={"thigh": ["T1", "T2"]})
    async with reading.connected() as running:
        await reading.frames(source, 3)
        source.unplug()
        await asyncio.wait([running], timeout=3)
        with pytest.raises(DeviceLostError, match="the sender ended the stream: start it again"):
            running.result()

    source = server("T1")
    async with reading.connected():
        await reading.frames(source, 3)
    source.unplug()
    texts = [event.text for event in reading.of(DeviceEvent) if event.kind == "warning"]
    assert any("had 6 channels and has 3" in text for text in texts)
    assert reading.of(MocapFrame)[-1].layout.markers == ("T1",)


def lsl_threads() -> list[str]:
    return [one.name for one in threading.enumerate() if one.name.startswith("lsl ")]


async def test_ended_connections_leave_no_tasks_threads_and_descriptors(lsl_network: Any) -> None:
    source, reading = server("T1"), Reading()
    async with reading.connected():  # the first one creates permanent objects of liblsl
        await reading.frames(source, 3)
    before, tasks = count_descriptors(), asyncio.all_tasks()
    for pause_s in (0.0, 0.02, 0.35):
        async with reading.connected():
            await asyncio.sleep(pause_s)
    async with reading.connected():
        await reading.frames(source, 3)

    assert asyncio.all_tasks() == tasks
    async with asyncio.timeout(30):  # the outlet detects the end of a connection only when it sends
        while count_descriptors() > before or lsl_threads():
            source.push(0, {}, {})
            await asyncio.sleep(0.05)
    source.unplug()


async def test_two_sources_that_fit_are_listed(lsl_network: Any) -> None:
    name = f"twice {SOURCE}"
    pair = [server("T1", stream=name, source_id=f"{SOURCE}-{n}") for n in (1, 2)]
    with pytest.raises(DeviceMisconfiguredError, match=r"2 streams fit: .*: set source_id in"):
        await LslMarkersMocap(settings(source_id=None, stream=name)).run(lambda _: None)
    for one in pair:
        one.unplug()


async def test_streams_of_one_source_are_not_taken_for_one_stream(lsl_network: Any) -> None:
    pair = [server("T1", stream=f"{kind} {SOURCE}") for kind in ("Markers", "Bodies")]
    with pytest.raises(DeviceMisconfiguredError, match=r"2 streams fit: .*: set stream in"):
        await LslMarkersMocap(settings()).run(lambda _: None)
    for one in pair:
        one.unplug()


async def test_a_missing_stream_has_a_remedy(
    lsl_network: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_session, "SEARCH_S", 0.1)
    monkeypatch.setattr(_session, "search_streams", lambda *_, **__: [])
    with pytest.raises(DeviceLostError, match=r"not found within 0\.1 s: start the program"):
        await LslMarkersMocap(settings(source_id="none")).run(lambda _: None)


async def test_a_missing_stream_is_reported_with_those_of_the_network(
    lsl_network: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_session, "SEARCH_S", 0.1)
    monkeypatch.setattr(_session, "_LISTED", 100)
    source = server("T1", stream=f"Nexus {SOURCE}")
    named = rf"the network has .*'Nexus {SOURCE}' of .* \(type 'MoCap'\).*: set stream in"
    with pytest.raises(DeviceLostError, match=named):
        await LslMarkersMocap(settings(source_id="none")).run(lambda _: None)
    source.unplug()


async def test_search_and_diagnosis_name_the_content(lsl_network: Any) -> None:
    source = server("T1", "T2", bodies=("Thigh",))
    found = await LslMarkersMocap.find_servers([], broadcast=True, port=None, wait_s=0.5)
    mine = [one for one in found if one.markers == ("T1", "T2")]
    assert [one.bodies for one in mine] == [("Thigh",)]
    assert mine[0].application == "LSL stream Simulated cameras"
    for host, known in ((mine[0].server, True), ("127.0.0.1", True), ("192.0.2.7", False)):
        named = await LslMarkersMocap.find_servers([host], broadcast=False, port=None, wait_s=0.3)
        assert any(one.markers == ("T1", "T2") for one in named) == known

    findings = asyncio.create_task(LslMarkersMocap.diagnose(settings(), 0.5))
    while not findings.done():
        source.push(0, {"T1": (1.0, 1.0, 1.0)}, {})
        await asyncio.sleep(0.01)
    source.unplug()
    assert [(one.level, one.text.partition(", ")[2]) for one in findings.result()] == [
        ("ok", "1 rigid bodies, 2 markers")
    ]


async def test_without_pylsl_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pylsl", None)
    with pytest.raises(DeviceMisconfiguredError, match=r"pip install 'jointfitd\[lsl\]'"):
        await LslMarkersMocap(settings()).run(lambda _: None)
    assert await LslMarkersMocap.find_servers([], broadcast=True, port=None, wait_s=0.1) == []
