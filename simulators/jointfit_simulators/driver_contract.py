"""The conformance suite: what every driver owes the daemon, tried against its simulated device.

Law: no driver and no device is named here, and nothing but the driver interface is used. The suite
needs pytest to collect it but imports none of it.

Use
---
Derive a class whose name starts with ``Test``, name the driver and the device, and pytest runs
the whole suite::

    from jointfit_simulators.driver_contract import DriverContract

    class TestXbus(DriverContract):
        registered_as = "xbus"                      # its entry point

        def make_device(self, folder, wire_noise):  # not running yet; plugged in
            return XbusDevice(folder / "imu", wire_noise=wire_noise)

        def make_driver(self, folder):              # a fresh driver for that device
            return XbusImu(XbusSettings(..., port=str(folder / "imu"), silence_s=0.5))

        def make_wrong_device(self, folder):        # optional: what is no such device
            return WrongDevice(folder / "imu")

`folder` is empty and fresh for every test. A device needs ``push`` (or override ``send``), ``run``,
``unplug`` and ``plug``. For a driver that yields no ``ImuSample`` override ``measurement``,
``send`` and ``matches``. Numbers that differ on slow wires are class attributes. Where a wire
cannot do something, return ``None`` from ``make_wrong_device``, or set ``has_noise`` or
``has_plug`` to False: those tests are then skipped and say so.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
import time
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar
from unittest import SkipTest

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError, Settings, find_driver
from jointfit_daemon.model import Chunk, Corrupt, ImuSample
from jointfit_simulators._contract_fixtures import (
    DecodingReceiver,
    SwitchableNoise,
    cancel_and_wait,
    content_of,
    count_descriptors,
    orientation,
    require,
    require_error,
    run_scene,
    serve_device,
)
from jointfit_simulators.imu_device import clean_wire

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from jointfit_daemon.driver import Driver
    from jointfit_simulators.imu_device import WireNoise

_STEP_NS = 10_000_000  # device time between two samples
_PACE_S = 0.002  # host time between two samples: faster than real, so that the suite is short


class DriverContract(ABC):
    """All tests every driver must pass; derive, name driver and device, done."""

    registered_as: ClassVar[str | None] = None
    """Entry point name; None while it has none."""
    measurement: ClassVar[type] = ImuSample
    """What its decoder yields for a sample."""
    starts_within_s: ClassVar[float] = 10.0
    lost_within_s: ClassVar[float] = 1.0
    """From unplugging, or from the last byte, to DeviceLostError."""
    refused_within_s: ClassVar[float] = 15.0
    """From meeting a wrong device to DeviceMisconfiguredError."""
    has_noise: ClassVar[bool] = True
    has_plug: ClassVar[bool] = True

    # --- what a driver names ------------------------------------------------------------------

    @abstractmethod
    def make_device(self, folder: Path, wire_noise: WireNoise) -> Any:
        """Return the simulated device, plugged in, not running."""

    @abstractmethod
    def make_driver(self, folder: Path) -> Driver:
        """Return a fresh driver for that device; ``silence_s`` at most 0.5."""

    def make_wrong_device(self, folder: Path) -> Any:  # noqa: ARG002 - for those who override
        """Return another kind of device in the same place; None if that cannot be told apart."""
        return None

    def send(self, device: Any, number: int) -> None:
        """Have the device send sample `number` now."""
        device.push(number * _STEP_NS, orientation(number))

    def matches(self, number: int, measurement: Any) -> bool:
        """Whether `measurement` is sample `number`: within 0.03 rad by default."""
        w, x, y, z = orientation(number)
        a, b, c, d = measurement.q_world_sensor
        return bool(abs(a * w + b * x + c * y + d * z) > 1 - 1e-4)

    # --- the suite ----------------------------------------------------------------------------

    def test_settings_are_frozen_typed_and_refuse_unknown_keys(self, tmp_path: Path) -> None:
        """A typo in rig.toml must not pass."""
        kind = type(self.make_driver(tmp_path))
        require(issubclass(kind.Settings, Settings), "Settings derives from driver.Settings")
        require(kind.Settings.model_config.get("frozen") is True, "Settings are frozen")
        require(kind.Settings.model_config.get("extra") == "forbid", "unknown keys are refused")
        require(kind.wire in {"stream", "datagram", "can"}, "wire says how chunks are cut")

    def test_the_entry_point_finds_the_driver(self, tmp_path: Path) -> None:
        """The daemon knows drivers by name only."""
        if self.registered_as is None:
            raise SkipTest("not registered")
        found = find_driver(self.registered_as)
        require(found is type(self.make_driver(tmp_path)), f"entry point names {found}")

    def test_it_opens_configures_and_streams_every_sample(self, tmp_path: Path) -> None:
        """What was sent arrives whole, in order, stamped with a plausible arrival."""

        async def scene() -> None:
            began_ns = time.monotonic_ns()
            device = self.make_device(tmp_path, clean_wire)
            async with self._streaming(device, self.make_driver(tmp_path)) as (heard, first):
                numbers = await self._send_all(device, heard, first, 50)
            got = heard.measurements[-len(numbers) :]
            require(all(map(self.matches, numbers, got)), "every sample arrives once and in order")
            stamps = [item.arrival_ns for item in got]
            require(stamps == sorted(stamps), "arrivals do not run backwards")
            require(began_ns < stamps[0] <= time.monotonic_ns(), "arrival is host monotonic time")
            require(heard.decoder.messages >= len(numbers), "messages are counted")
            require(heard.decoder.discarded_bytes == 0, "a clean wire discards nothing")

        run_scene(scene())

    def test_the_cut_of_the_stream_does_not_matter(self, tmp_path: Path) -> None:
        """Byte at a time, or all at once: the same samples. Datagrams are cut by the sender."""

        async def scene() -> None:
            device, driver = self.make_device(tmp_path, clean_wire), self.make_driver(tmp_path)
            async with self._streaming(device, driver) as (heard, first):
                await self._send_all(device, heard, first, 20)
            wire = b"".join(chunk.data for chunk in heard.chunks)
            t_ns = heard.chunks[-1].t_ns
            cuts = {
                "stream": [[wire], [bytes((byte,)) for byte in wire]],
                "can": [[wire]],
                "datagram": [[chunk.data for chunk in heard.chunks]],
            }
            for pieces in cuts[driver.wire]:
                again = DecodingReceiver(driver, self.measurement)
                for piece in pieces:
                    again.emit(Chunk(t_ns, piece))
                same = list(map(content_of, again.measurements))
                require(
                    same == list(map(content_of, heard.measurements)),
                    f"{len(pieces)} pieces give the same samples",
                )
                require(
                    again.decoder.discarded_bytes == heard.decoder.discarded_bytes,
                    "and the same losses",
                )

        run_scene(scene())

    def test_a_replay_gives_the_same_events(self, tmp_path: Path) -> None:
        """A decoder is a function of its chunks: no clock, no chance, no shared state."""

        async def scene() -> None:
            device, driver = self.make_device(tmp_path, clean_wire), self.make_driver(tmp_path)
            async with self._streaming(device, driver) as (heard, first):
                await self._send_all(device, heard, first, 20)
            again = DecodingReceiver(driver, self.measurement)
            for chunk in heard.chunks:
                again.emit(chunk)
            require(repr(again.events) == repr(heard.events), "the same events")

        run_scene(scene())

    def test_any_bytes_give_events_and_never_an_exception(self, tmp_path: Path) -> None:
        """Corruption is an event; what waits for more is bounded."""
        noise, decoder = random.Random(11), self.make_driver(tmp_path).decoder()  # noqa: S311 - as above
        fed = lost = 0
        for t_ns in range(0, 400_000_000, 1_000_000):
            data = noise.randbytes(noise.randrange(200))
            fed += len(data)
            events = decoder.feed(Chunk(t_ns, data))
            lost += sum(event.discarded for event in events if isinstance(event, Corrupt))
        lost += sum(event.discarded for event in decoder.flush() if isinstance(event, Corrupt))
        require(lost <= fed, "no more bytes are reported lost than came")
        require(decoder.discarded_bytes <= fed, "no more bytes are counted lost than came")

    def test_noise_on_the_line_costs_only_what_it_hit(self, tmp_path: Path) -> None:
        """The driver keeps running, good samples come through, bad ones never look good."""
        if not self.has_noise:
            raise SkipTest("this wire has its own error detection")

        async def scene() -> None:
            noise = SwitchableNoise()
            device = self.make_device(tmp_path, noise)
            async with self._streaming(device, self.make_driver(tmp_path)) as (heard, first):
                before = len(heard.measurements)
                noise.on = True
                for number in range(first, first + 200):
                    self.send(device, number)
                    await asyncio.sleep(_PACE_S)
                noise.on = False
                await asyncio.sleep(0.3)  # silence ends what a broken length still waits for
                self.send(device, first + 200)
                await heard.settle()
                clean = await self._send_all(device, heard, first + 201, 10)
            got = heard.measurements[before:]
            numbers = range(first, clean[-1] + 1)
            require(len(got) >= len(numbers) // 2, f"most samples survive, {len(got)} did")
            require(
                all(any(self.matches(number, item) for number in numbers) for item in got),
                "what comes through was sent",
            )
            require(heard.decoder.discarded_bytes > 0, "losses are counted")

        run_scene(scene())

    def test_silence_is_a_lost_device(self, tmp_path: Path) -> None:
        """A device that stops talking is lost, not waited for."""

        async def scene() -> None:
            device = self.make_device(tmp_path, clean_wire)
            driver, heard = self.make_driver(tmp_path), None
            async with serve_device(device):
                heard = DecodingReceiver(driver, self.measurement)
                task = asyncio.create_task(driver.run(heard.emit))
                first = await self._first(device, heard, task)
                await self._send_all(device, heard, first, 5)
                await require_error(DeviceLostError, task, self.lost_within_s)

        run_scene(scene())

    def test_unplugging_is_noticed_and_replugging_heals(self, tmp_path: Path) -> None:
        """Unplugged: DeviceLostError in time. Plugged in again: the same driver runs again."""
        if not self.has_plug:
            raise SkipTest("this wire cannot be unplugged")

        async def scene() -> None:
            device = self.make_device(tmp_path, clean_wire)
            driver = self.make_driver(tmp_path)
            async with serve_device(device):
                heard = DecodingReceiver(driver, self.measurement)
                task = asyncio.create_task(driver.run(heard.emit))
                first = await self._first(device, heard, task)
                device.unplug()
                await require_error(DeviceLostError, task, self.lost_within_s)
                await require_error(
                    DeviceLostError,
                    asyncio.create_task(driver.run(heard.emit)),
                    self.starts_within_s,
                )
                device.plug()
                async with self._reading(device, driver, first) as (heard, number):
                    await self._send_all(device, heard, number, 10)

        run_scene(scene())

    def test_a_device_that_is_not_there_may_come(self, tmp_path: Path) -> None:
        """Absent is DeviceLostError: the supervisor tries again."""
        if not self.has_plug:
            raise SkipTest("this wire cannot be unplugged")

        async def scene() -> None:
            device, driver = self.make_device(tmp_path, clean_wire), self.make_driver(tmp_path)
            device.unplug()
            task = asyncio.create_task(driver.run(lambda _: None))
            await require_error(DeviceLostError, task, self.starts_within_s)

        run_scene(scene())

    def test_a_wrong_device_is_named_not_retried(self, tmp_path: Path) -> None:
        """What can never work is DeviceMisconfiguredError, with words to act on."""
        device = self.make_wrong_device(tmp_path)
        if device is None:
            raise SkipTest("a wrong device cannot be told apart on this wire")

        async def scene() -> None:
            async with serve_device(device):
                task = asyncio.create_task(self.make_driver(tmp_path).run(lambda _: None))
                await require_error(DeviceMisconfiguredError, task, self.refused_within_s)

        run_scene(scene())

    def test_a_bug_in_the_daemon_is_not_taken_for_a_lost_device(self, tmp_path: Path) -> None:
        """What ``emit`` raises reaches the caller of ``run`` as it is."""

        async def scene() -> None:
            device = self.make_device(tmp_path, clean_wire)

            def emit(_: Chunk) -> None:
                raise ZeroDivisionError

            async with serve_device(device):
                task = asyncio.create_task(self.make_driver(tmp_path).run(emit))
                async with asyncio.timeout(self.starts_within_s):
                    number = 0
                    while not task.done():
                        self.send(device, number)
                        number += 1
                        await asyncio.sleep(_PACE_S)
                await require_error(ZeroDivisionError, task, self.starts_within_s)

        run_scene(scene())

    def test_cancelling_closes_everything(self, tmp_path: Path) -> None:
        """Five times over: no descriptor and no task is left, before, while and after opening."""

        async def scene() -> None:
            device, driver = self.make_device(tmp_path, clean_wire), self.make_driver(tmp_path)
            async with serve_device(device):
                async with self._reading(device, driver, 0):
                    pass  # whatever is made once (executors, caches) is made now
                before, tasks = count_descriptors(), asyncio.all_tasks()
                for pause_s in (0.0, 0.001, 0.02):
                    task = asyncio.create_task(driver.run(lambda _: None))
                    await asyncio.sleep(pause_s)
                    await cancel_and_wait(task)
                for _ in range(2):
                    async with self._reading(device, driver, 0):
                        pass
                require(asyncio.all_tasks() == tasks, "no task is left")
                require(count_descriptors() == before, "no descriptor is left")

        run_scene(scene())

    # --- scenery ------------------------------------------------------------------------------

    @contextlib.asynccontextmanager
    async def _streaming(
        self, device: Any, driver: Driver
    ) -> AsyncIterator[tuple[DecodingReceiver, int]]:
        """Device and driver at work; yields the listener and the next sample number."""
        async with serve_device(device), self._reading(device, driver, 0) as state:
            yield state

    @contextlib.asynccontextmanager
    async def _reading(
        self, device: Any, driver: Driver, number: int
    ) -> AsyncIterator[tuple[DecodingReceiver, int]]:
        """Driver at work on a device that runs; yields as ``_streaming``; cancels at the end."""
        heard = DecodingReceiver(driver, self.measurement)
        task = asyncio.create_task(driver.run(heard.emit))
        try:
            yield heard, await self._first(device, heard, task, number)
        finally:
            await cancel_and_wait(task)

    async def _first(
        self, device: Any, heard: DecodingReceiver, task: asyncio.Task[None], number: int = 0
    ) -> int:
        """Send until the first sample arrives, then let the rest arrive; return the next number."""
        async with asyncio.timeout(self.starts_within_s):
            while not heard.measurements:
                if task.done():
                    task.result()  # raises what ended it
                    raise AssertionError("not so: run reads until cancelled")
                self.send(device, number)
                number += 1
                await asyncio.sleep(_PACE_S)
        await heard.settle()
        return number

    async def _send_all(
        self, device: Any, heard: DecodingReceiver, first: int, count: int
    ) -> range:
        """Send `count` samples and wait for all of them."""
        before = len(heard.measurements)
        for number in range(first, first + count):
            self.send(device, number)
            await asyncio.sleep(_PACE_S)
        await heard.wait_for(before + count, self.lost_within_s / 2)
        got = len(heard.measurements) - before
        require(got == count, f"{count} samples sent, {got} arrived")
        return range(first, first + count)
