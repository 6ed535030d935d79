"""Sync lines of Xbus devices: configuration by rig.toml, and edges decoded as pulses."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from jointfit_daemon.driver import DeviceMisconfiguredError
from jointfit_daemon.model import Chunk, DeviceEvent, ImuSample, SyncPulse
from jointfit_drivers.xbus import XbusImu, XbusSettings
from jointfit_drivers.xbus._sync_lines import (
    XbusSyncSettings,
    describe_entry,
    sync_differences,
    sync_entries,
)
from jointfit_protocols.xbus import XbusMessageId, encode
from jointfit_protocols.xbus import configuration as setup
from jointfit_protocols.xbus.configuration import SyncSetting
from jointfit_protocols.xbus.mtdata2 import Item
from jointfit_simulators._contract_fixtures import orientation
from jointfit_simulators.devices import XbusDevice, XbusDeviceOptions
from jointfit_simulators.devices._xbus_sync_inputs import SyncInputs

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

TRIGGER: dict[str, Any] = {"function": "trigger_indication", "line": "in1", "wire": 3}
CLOCKED: dict[str, Any] = {"function": "clock_bias_estimation", "line": "in1", "period_ms": 1000}
OUT: dict[str, Any] = {
    "function": "interval_transition_measurement", "line": "out1", "pulse_width_ms": 0.5
}  # fmt: skip
STORED = SyncSetting(3, 2, 1)
TOLD = (*XbusDeviceOptions().outputs, (Item.TRIGGER_IN1, setup.MAX_RATE))


def settings(folder: Path, **more: Any) -> XbusSettings:
    table: dict[str, Any] = {"baud": 115_200, "silence_s": 0.5} | more
    return XbusSettings(id="S1", segment="thigh", driver="xbus", port=str(folder / "imu"), **table)


@contextlib.asynccontextmanager
async def serving(folder: Path, **options: Any) -> AsyncIterator[XbusDevice]:
    device = XbusDevice(folder / "imu", options=XbusDeviceOptions(**options))
    task = asyncio.create_task(device.run())
    try:
        yield device
    finally:
        task.cancel()
        await asyncio.wait([task])
        device.unplug()


async def told(driver: XbusImu, device: XbusDevice, samples: int = 30) -> list[Any]:
    """Run the driver with an edge every 30 ms; return the output of its decoder."""
    chunks: list[Chunk] = []
    task = asyncio.create_task(driver.run(chunks.append))
    async with asyncio.timeout(10):
        while not device.streaming:
            await asyncio.sleep(0.005)
            if task.done():
                await task
        for number in range(samples):
            if number % 3 == 0:
                device.edge(number * 10_000_000 - 4_321_000)
            device.push(number * 10_000_000, orientation(number))
            await asyncio.sleep(0.001)
        await asyncio.sleep(0.05)
    task.cancel()
    await asyncio.wait([task])
    decoder = driver.decoder()
    return [item for chunk in chunks for item in decoder.feed(chunk)]


async def test_edges_come_out_as_pulses_at_the_time_of_the_edge(tmp_path: Path) -> None:
    driver = XbusImu(settings(tmp_path, sync=[TRIGGER]))
    async with serving(tmp_path, outputs=TOLD, sync=(STORED,)) as device:
        found = await told(driver, device)
        assert device.flash_writes == 0
    pulses = [item for item in found if isinstance(item, SyncPulse)]
    assert [(p.ticks, p.line, p.number) for p in pulses] == [
        ((30_000_000 * k - 4_321_000) // setup.TICK_NS % 2**32, 3, k) for k in range(10)
    ]
    samples = [item for item in found if isinstance(item, ImuSample)]
    assert len(samples) == 30
    assert {p.arrival_ns for p in pulses} <= {sample.arrival_ns for sample in samples}
    (info,) = [i.data for i in found if isinstance(i, DeviceEvent) and "sync" in i.data]
    assert info["sync"] == ["trigger_indication on in1 rising"]


async def test_unconfigured_sync_lines_are_neither_read_nor_reported(tmp_path: Path) -> None:
    driver = XbusImu(settings(tmp_path))
    async with serving(tmp_path, outputs=TOLD, sync=(STORED,)) as device:
        found = await told(driver, device)
        assert (device.sync, device.flash_writes) == ((STORED,), 0)
    assert not [item for item in found if isinstance(item, SyncPulse)]


async def test_settings_that_differ_are_not_written_unasked(tmp_path: Path) -> None:
    driver = XbusImu(settings(tmp_path, sync=[CLOCKED]))
    async with serving(tmp_path, sync=(STORED,)) as device:
        with pytest.raises(
            DeviceMisconfiguredError, match=r"clock_bias.*it has trigger_ind.*persist"
        ):
            await told(driver, device)
        assert (device.sync, device.flash_writes) == ((STORED,), 0)


async def test_only_changed_sync_settings_are_written(tmp_path: Path) -> None:
    driver = XbusImu(settings(tmp_path, sync=[TRIGGER, OUT], persist=True))
    async with serving(tmp_path) as device:
        found = await told(driver, device)
        assert device.flash_writes == 2  # outputs and sync settings
        assert set(device.sync) == {STORED, SyncSetting(4, 4, 1, pulse_width=5)}
        assert [item for item in found if isinstance(item, SyncPulse)]
        await told(driver, device)
        assert device.flash_writes == 2


async def test_empty_list_disables_all_sync_lines(tmp_path: Path) -> None:
    driver = XbusImu(settings(tmp_path, sync=[], persist=True))
    async with serving(tmp_path, sync=(STORED,)) as device:
        await told(driver, device)
        assert device.sync == ()


def test_sync_request_equals_that_of_the_vendor() -> None:
    asked = sync_entries([XbusSyncSettings(**CLOCKED)], "MTi-630-8A1G6")
    wire = encode(XbusMessageId.SYNC_SETTINGS, setup.encode_sync(asked))
    assert wire.hex() == "faff2c0c0902010000000000000003e8d2"


@pytest.mark.parametrize(("product", "line"), [("MTi-30-2A5G4", 4), ("MTi-630-8A1G6", 7)])
def test_the_output_line_has_the_number_of_its_series(product: str, line: int) -> None:
    (entry,) = sync_entries([XbusSyncSettings(**OUT)], product)
    assert entry.line == line


@pytest.mark.parametrize(
    "wrong",
    [
        OUT | {"line": "in1"},
        TRIGGER | {"line": "out1"},
        TRIGGER | {"line": "clock_in"},
        TRIGGER | {"period_ms": 5},
        CLOCKED | {"period_ms": 0},
        TRIGGER | {"skip_factor": 70_000},
    ],
)
def test_impossible_sync_settings_are_rejected(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        XbusSyncSettings(**wrong)


entries = st.builds(
    SyncSetting,
    st.sampled_from([3, 4, 8, 9, 11, 14]), st.sampled_from([0, 2, 4, 7, 9]), st.integers(1, 3),
    st.integers(0, 1), *[st.integers(0, 2**16 - 1)] * 4,
)  # fmt: skip


@given(st.lists(entries, unique=True, max_size=10), st.randoms())
def test_the_order_of_sync_settings_does_not_matter(stored: list[SyncSetting], dice: Any) -> None:
    shuffled = list(stored)
    dice.shuffle(shuffled)
    assert sync_differences(stored, shuffled) == []
    for one in stored:
        assert sync_differences([e for e in stored if e != one], stored) == [
            f"it does not have {describe_entry(one)}"
        ]


@given(st.integers(0, 20), st.integers(0, 20), st.integers(1, 200))
def test_edges_are_skipped_as_configured(first: int, factor: int, edges: int) -> None:
    lines = SyncInputs([SyncSetting(3, 2, 1, 0, first, factor)])
    told_at = []
    for number in range(edges):
        lines.edge(2, number)
        told_at += [edge.time for edge in lines.next_triggers([Item.TRIGGER_IN1]).values()]
    assert told_at == list(range(first, edges, factor + 1))
