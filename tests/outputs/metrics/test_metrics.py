"""Metrics as Prometheus parses them: names, units and values; and their cost."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import os
import re
import socket
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest
from prometheus_client import parser
from prometheus_client.openmetrics import parser as openmetrics_parser

from jointfit_daemon.config import MetricsSettings, parse_rig
from jointfit_daemon.model import FusionMode, LimbState, SyncState
from jointfit_daemon.outputs.metrics import FrameStatistics, MetricsError, MetricsServer
from jointfit_daemon.outputs.mqtt import LinkHealth
from jointfit_daemon.outputs.payloads import BridgeHealth, ProcessHealth, StateHealth
from jointfit_daemon.pipeline.events import CalibrationPhase, CalibrationReady, Configured
from jointfit_daemon.pipeline.health import (
    ClockHealth,
    CoreHealth,
    DeviceHealth,
    FrameCounts,
    WireCounts,
)
from jointfit_daemon.timing.clock import DelayPercentiles
from tests.broker_fixture import free_port
from tests.limb_model.plain_calibration import plain_calibration
from tests.supervisor.test_daemon import daemon, small

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

PAGE = Path(__file__).resolve().parents[3] / "docs" / "integrations.md"
UNITS = ("seconds", "bytes", "ratio", "hertz")
FOREIGN_UNITS = re.compile(r"_(ms|us|ns|milliseconds|deg|percent|pct|ppm|hz|kb)(_|$)")
CLOCK = ClockHealth(
    state="echo", epoch=1, offset_ns=5, skew_ppm=12.5, sigma_ns=20_000.0, bound_ns=float("inf"),
    latency_ns=0, latency_sd_ns=0, jitter_ns=None,
    delays=DelayPercentiles(p50_ns=1_000_000, p99_ns=3_000_000, max_ns=9_000_000), rate_hz=99.5,
)  # fmt: skip
HEALTH = BridgeHealth(
    CoreHealth(
        devices={
            "S1": DeviceHealth(
                online=True,
                wire=WireCounts(received=1000, corrupt=2, discarded_bytes=30, lost=7, opened=3),
                silent_ns=4_000_000,
                samples={"used": 990, "late": 3, "pending": 7},
                clock=CLOCK,
                sensor="stuck",
            )
        },
        phase=CalibrationPhase.CALIBRATED,
        version=4,
        frames=FrameCounts(500, 2, 1),
    ),
    ProcessHealth(12.0, 50_000_000, 1.5),
    LinkHealth(True, 2, True, [], 1234, 5, 6, 7, 0),
    StateHealth(None, None),
)
FRAME = LimbState(0, 0, 0, FusionMode.IMU, SyncState.LOCKED, (), (), ())


@contextlib.asynccontextmanager
async def serving(frames: FrameStatistics, listen: str = "127.0.0.1:0") -> AsyncIterator[str]:
    server = MetricsServer(MetricsSettings(listen=listen), "r", lambda: HEALTH, frames)
    server.start()
    task = asyncio.create_task(server.run(), name="metrics")
    try:
        yield server.url.removeprefix("http://").removesuffix("/metrics")
    finally:
        task.cancel()
        await asyncio.wait([task])


def fetch(address: str, path: str = "/metrics", **headers: str) -> tuple[int, str]:
    connection = http.client.HTTPConnection(address, timeout=5)
    try:
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.read().decode()
    finally:
        connection.close()


def families_of(text: str) -> list[Any]:
    return list(parser.text_string_to_metric_families(text))


async def scrape(frames: FrameStatistics | None = None) -> dict[tuple[str, str], float]:
    """Return the values by name of the metric and by value of the metric's last label."""
    async with serving(frames or FrameStatistics()) as address:
        status, text = await asyncio.to_thread(fetch, address)
    assert status == 200
    return {
        (sample.name, next(reversed(sample.labels.values()), "")): sample.value
        for family in families_of(text)
        for sample in family.samples
    }


async def test_values_are_in_base_units_and_unknown_ones_are_absent() -> None:
    found = await scrape()
    expected = {
        ("jointfit_device_up", "S1"): 1,
        ("jointfit_device_received_samples_total", "S1"): 1000,
        ("jointfit_device_lost_samples_total", "S1"): 7,
        ("jointfit_device_reconnects_total", "S1"): 2,
        ("jointfit_device_samples_total", "late"): 3,
        ("jointfit_device_sample_rate_hertz", "S1"): 99.5,
        ("jointfit_device_silence_seconds", "S1"): 0.004,
        ("jointfit_device_clock_sd_seconds", "S1"): 20e-6,
        ("jointfit_device_clock_skew_ratio", "S1"): 12.5e-6,
        ("jointfit_device_clock_state", "echo"): 1,
        ("jointfit_device_clock_state", "arrival"): 0,
        ("jointfit_device_delay_seconds", "0.99"): 0.003,
        ("jointfit_sensor_state", "stuck"): 1,
        ("jointfit_sensor_state", "ok"): 0,
        ("jointfit_calibration_phase", "calibrated"): 1,
        ("jointfit_calibration_version", ""): 4,
        ("jointfit_frames_total", ""): 500,
        ("jointfit_mqtt_queued_messages", ""): 5,
        ("jointfit_event_loop_delay_p99_seconds", ""): 0.0015,
        ("jointfit_storage_fault", ""): 0,
    }
    assert {key: found.get(key) for key in expected} == pytest.approx(expected)
    absent = {"jointfit_device_clock_bound_seconds", "jointfit_device_clock_jitter_seconds",
              "jointfit_calibration_created_timestamp_seconds"}  # fmt: skip
    assert absent.isdisjoint(name for name, _ in found)
    assert found["process_resident_memory_bytes", ""] > 1e6
    started_s = os.stat(f"/proc/{os.getpid()}").st_mtime  # noqa: PTH116 - memory only
    assert found["process_start_time_seconds", ""] == pytest.approx(started_s, abs=5.0)
    assert found["process_cpu_seconds_total", ""] == pytest.approx(time.process_time(), abs=5)


async def test_both_text_formats_are_read_by_their_parsers_and_names_follow_the_conventions() -> (
    None
):
    async with serving(FrameStatistics()) as address:
        plain = (await asyncio.to_thread(fetch, address))[1]
        accept = {"Accept": "application/openmetrics-text; version=1.0.0"}
        opened = (await asyncio.to_thread(lambda: fetch(address, **accept)))[1]
    families = families_of(plain)
    assert opened.endswith("# EOF\n")
    assert list(openmetrics_parser.text_string_to_metric_families(opened))  # type: ignore[no-untyped-call]
    for family in families:
        assert family.documentation
        assert family.documentation.endswith(".")
        assert not FOREIGN_UNITS.search(family.name), family.name
        for sample in family.samples:
            is_total = sample.name.endswith("_total")
            assert is_total == (family.type == "counter"), sample.name
    documented = set(re.findall(r"`((?:jointfit|process)_\w+)`", PAGE.read_text("utf-8")))
    names = {
        sample.name.removesuffix("_bucket").removesuffix("_count").removesuffix("_sum")
        for family in families
        for sample in family.samples
    }
    without_value = {
        "jointfit_device_clock_bound_seconds", "jointfit_device_clock_jitter_seconds",
        "jointfit_calibration_created_timestamp_seconds", "jointfit_lag_seconds",
        "jointfit_recording_backlog_bytes",
    }  # fmt: skip
    assert documented == names | without_value


async def test_the_histogram_counts_each_frame_once_in_its_bucket(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    frames, now_ns = FrameStatistics(), 10**9 * 3600
    clock = SimpleNamespace(monotonic_ns=lambda: now_ns)  # fixed: a pause would change the bucket
    monkeypatch.setattr("jointfit_daemon.outputs.metrics._frame_statistics.time", clock)
    for latency_ms in (0, 7, 7, 2000):
        frames.output(FRAME._replace(completed_ns=now_ns - latency_ms * 1_000_000))
    found = await scrape(frames)
    buckets = {
        limit: found["jointfit_frame_latency_seconds_bucket", limit]
        for limit in ("0.005", "0.01", "1.0", "+Inf")
    }
    assert buckets == {"0.005": 1, "0.01": 3, "1.0": 3, "+Inf": 4}
    assert found["jointfit_frame_latency_seconds_count", ""] == 4
    assert found["jointfit_frame_latency_seconds_sum", ""] == pytest.approx(2.014)


async def test_the_date_of_the_calibration_is_that_of_its_file_or_now(
    table: dict[str, Any],
) -> None:
    rig, frames = parse_rig(table), FrameStatistics()
    old = replace(plain_calibration(rig.chain), created_utc="2026-01-01T00:00:00+00:00")
    frames.event(Configured(0, rig, old, 4))
    key = ("jointfit_calibration_created_timestamp_seconds", "")
    assert (await scrape(frames))[key] == 1767225600
    frames.output(CalibrationReady(old))
    assert (await scrape(frames))[key] == pytest.approx(time.time(), abs=5)
    frames.output(CalibrationReady(old, keep_date=True))
    assert (await scrape(frames))[key] == 1767225600
    frames.event(Configured(0, rig, None))
    assert key not in await scrape(frames)


@pytest.mark.parametrize("sends", [b"", b"G"])
async def test_a_slow_client_delays_the_next_scrape_by_at_most_its_time_limit(
    sends: bytes,
) -> None:
    async with serving(FrameStatistics()) as address:
        host, _, port = address.rpartition(":")
        with socket.create_connection((host, int(port))) as slow:

            async def trickle() -> None:
                with contextlib.suppress(OSError):
                    while True:
                        slow.sendall(sends)
                        await asyncio.sleep(0.2)

            task = asyncio.create_task(trickle(), name="slow client")
            began = time.monotonic()
            status, _ = await asyncio.to_thread(fetch, address)
            task.cancel()
        assert status == 200
        assert time.monotonic() - began < 4


async def test_another_path_is_refused() -> None:
    async with serving(FrameStatistics()) as address:
        assert (await asyncio.to_thread(fetch, address, "/"))[0] == 404


async def test_a_port_in_use_and_a_missing_package_are_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        listen = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(MetricsError, match=f"cannot listen on {listen}.*listen"):
            async with serving(FrameStatistics(), listen):
                pass
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    with pytest.raises(MetricsError, match=r"pip install 'jointfitd\[metrics\]'"):
        async with serving(FrameStatistics()):
            pass


@pytest.mark.parametrize("listen", ["9464", "localhost", "a b:1", "127.0.0.1:70000", ":-1"])
def test_an_address_without_host_or_port_is_refused(table: dict[str, Any], listen: str) -> None:
    with pytest.raises(Exception, match=r"metrics\.listen"):
        parse_rig(table | {"metrics": {"listen": listen}})


def test_a_frame_costs_less_than_5_us() -> None:
    frames, frame = FrameStatistics(), FRAME._replace(completed_ns=time.monotonic_ns())

    def duration_ns() -> float:
        began = time.thread_time_ns()
        for _ in range(2000):
            frames.output(frame)
        return (time.thread_time_ns() - began) / 2000

    assert min(duration_ns() for _ in range(5)) < 5000


async def test_the_running_daemon_offers_its_metrics(
    table: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    listen = f"127.0.0.1:{free_port()}"
    rig = small(table, free_port()) | {"metrics": {"listen": listen}}
    async with asyncio.timeout(10), daemon(rig, tmp_path):
        while True:
            with contextlib.suppress(ConnectionRefusedError):
                if (
                    'jointfit_device_up{device="S1"} 1.0'
                    in (await asyncio.to_thread(fetch, listen))[1]
                ):
                    break
            await asyncio.sleep(0.05)
