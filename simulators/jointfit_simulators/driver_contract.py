"""Conformance suite for drivers, which tests each driver with its simulated device.

Invariant: the suite uses only the driver interface. It names no driver and no device, and does not
import pytest.

Use
---
Derive a class whose name starts with ``Test``. Its methods return the driver and the device. pytest
then collects all tests of the suite::

    from jointfit_simulators.driver_contract import DriverContract

    class TestXbus(DriverContract):
        registered_as = "xbus"                      # name of its entry point

        def make_device(self, folder, wire_noise):  # plugged in, not running
            return XbusDevice(folder / "imu", wire_noise=wire_noise)

        def make_driver(self, folder):              # a new driver for this device
            return XbusImu(XbusSettings(..., port=str(folder / "imu"), silence_s=0.5))

        def make_wrong_device(self, folder):        # optional: a device of another kind
            return WrongDevice(folder / "imu")

`folder` is an empty directory for each test. A device needs the methods ``push``, ``run``,
``unplug`` and ``plug``; if the class overrides ``send``, the device needs no ``push``. The
attribute ``rate_hz`` of a device, if it exists, is the rate of its samples. If the driver yields
another type than ``ImuSample``, override ``measurement``, ``send`` and ``matches``. Line speed and
time limits are class attributes. Some features are optional: ``make_wrong_device`` may return
``None``, ``baud`` may be None, and ``has_noise`` and ``has_plug`` may be False. The corresponding
tests are then skipped with a reason.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
import time
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar
from unittest import SkipTest

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError, Settings
from jointfit_daemon.model import Chunk, Corrupt, ImuSample
from jointfit_daemon.units import NS_PER_S
from jointfit_simulators._contract_fixtures import (
    DecodingReceiver,
    SwitchableNoise,
    cancel_and_wait,
    content_of,
    content_text,
    count_descriptors,
    expected_text,
    find_installed,
    orientation,
    require,
    require_error,
    serve_device,
)
from jointfit_simulators._late_start_contract import LateStartContract
from jointfit_simulators.imu_device import clean_wire

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from jointfit_daemon.driver import Driver
    from jointfit_simulators.imu_device import WireNoise

_BITS = 10
"""Number of bits per byte on a serial line (8N1)."""
_INCOMPLETE = 3
"""Number of missing bytes of an incomplete message; every message is longer."""
_DELIVERY_S = 0.05
"""Time in which the kernel delivers written bytes to the reader, s."""
_PAUSE_NS = 200_000_000
"""Longest pause within a message on a busy host, ns."""
_SILENCE_NS = 60 * NS_PER_S
"""Time without bytes after which an incomplete message is lost at any line speed, ns."""


class DriverContract(LateStartContract, ABC):
    """Tests that every driver must pass."""

    registered_as: ClassVar[str | None] = None
    """Name of the entry point; None for an unregistered driver."""
    measurement: ClassVar[type] = ImuSample
    """Type of the measurements that the decoder returns."""
    starts_within_s: ClassVar[float] = 10.0
    """Longest time from the start of ``run`` to the first sample, s."""
    lost_within_s: ClassVar[float] = 1.0
    """Longest time from the disconnection or the last byte to DeviceLostError, s."""
    refused_within_s: ClassVar[float] = 15.0
    """Longest time from the start with a wrong device to DeviceMisconfiguredError, s."""
    rate_hz: ClassVar[float] = 100.0
    """Sample rate in device time, Hz, for a device without ``rate_hz``."""
    pace_s: ClassVar[float] = 0.002
    """Host time between two samples, s. It is shorter than their interval in device time, so that
    the tests end sooner."""
    baud: ClassVar[int | None] = 115_200
    """Line speed in the driver's settings, bit/s; None if transmission takes no time (USB, TCP)."""
    has_noise: ClassVar[bool] = True
    has_plug: ClassVar[bool] = True

    # --- to be implemented or overridden for a driver -----------------------------------------

    @abstractmethod
    def make_device(self, folder: Path, wire_noise: WireNoise) -> Any:
        """Return the simulated device, which is connected but not running."""

    @abstractmethod
    def make_driver(self, folder: Path) -> Driver:
        """Return a new driver for this device, with ``silence_s`` at most 0.5."""

    def make_wrong_device(self, folder: Path) -> Any:  # noqa: ARG002 - for overriding methods
        """Return a device of another type at the same port; None if drivers cannot detect it."""
        return None

    def send(self, device: Any, number: int) -> None:
        """Make the device send sample `number` now."""
        device.push(self.device_ns(device, number), orientation(number))

    def device_ns(self, device: Any, number: int) -> int:
        """Return the device time of sample `number`, ns, from the rate of the device.

        The rate may change during the handshake. Device time never decreases.
        """
        rate_hz = getattr(device, "rate_hz", None) or self.rate_hz
        last, last_ns = self.__dict__.setdefault("_device_times", {}).get(id(device), (-1, 0))
        t_ns = int(last_ns + max(1, number - last) * NS_PER_S / rate_hz)
        self.__dict__["_device_times"][id(device)] = number, t_ns
        return t_ns

    def matches(self, number: int, measurement: Any) -> bool:
        """Return whether `measurement` is sample `number`; the default tolerance is 0.03 rad."""
        w, x, y, z = orientation(number)
        a, b, c, d = measurement.q_world_sensor
        return bool(abs(a * w + b * x + c * y + d * z) > 1 - 1e-4)

    # --- tests --------------------------------------------------------------------------------

    def test_settings_are_frozen_and_reject_unknown_keys(self, tmp_path: Path) -> None:
        """Settings are immutable, and a misspelled key of rig.toml is an error."""
        kind = type(self.make_driver(tmp_path))
        require(issubclass(kind.Settings, Settings), "Settings must derive from driver.Settings")
        require(kind.Settings.model_config.get("frozen") is True, "Settings must be frozen")
        require(
            kind.Settings.model_config.get("extra") == "forbid", "Settings must reject unknown keys"
        )
        require(kind.wire in {"stream", "datagram", "can"}, "wire must be stream, datagram or can")

    def test_entry_point_finds_the_driver(self, tmp_path: Path) -> None:
        """The daemon finds drivers by name."""
        if self.registered_as is None:
            raise SkipTest("not registered")
        found = find_installed(self.registered_as)
        require(
            found is type(self.make_driver(tmp_path)),
            f"entry point {self.registered_as} must name the driver; it names {found}",
        )

    def test_driver_opens_configures_and_streams_every_sample(self, tmp_path: Path) -> None:
        """All samples arrive once and in order, with plausible arrival times."""

        async def scene() -> None:
            began_ns = time.monotonic_ns()
            device = self.make_device(tmp_path, clean_wire)
            async with self.streaming(device, self.make_driver(tmp_path)) as (receiver, first):
                numbers = await self._send_all(device, receiver, first, 50)

            received = receiver.measurements[-len(numbers) :]
            for number, item in zip(numbers, received, strict=True):
                self._require_sent(item, numbers, expected_text(item, number))
                require(self.matches(number, item), "every sample must arrive once and in order")

            stamps = [item.arrival_ns for item in received]
            require(stamps == sorted(stamps), "arrival times must not decrease")
            require(
                began_ns < stamps[0] <= time.monotonic_ns(),
                "arrival times must be host CLOCK_MONOTONIC",
            )

            require(
                receiver.decoder.messages >= len(numbers), "the decoder must count its messages"
            )
            require(
                receiver.decoder.discarded_bytes == 0,
                "the decoder must not discard bytes of a clean wire",
            )

        asyncio.run(scene())

    def test_samples_do_not_depend_on_the_split_of_the_stream(self, tmp_path: Path) -> None:
        """One chunk, and single bytes of a stream, yield the same samples as the original chunks.

        CAN frames are not split. Datagrams are neither split nor joined.
        """

        async def scene() -> None:
            device, driver = self.make_device(tmp_path, clean_wire), self.make_driver(tmp_path)
            async with self.streaming(device, driver) as (receiver, first):
                await self._send_all(device, receiver, first, 20)

            data = b"".join(chunk.data for chunk in receiver.chunks)
            t_ns = receiver.chunks[-1].t_ns
            splits = {
                "stream": [[data], [bytes((byte,)) for byte in data]],
                "can": [[data]],
                "datagram": [[chunk.data for chunk in receiver.chunks]],
            }
            for pieces in splits[driver.wire]:
                again = DecodingReceiver(driver, self.measurement)
                for piece in pieces:
                    again.emit(Chunk(t_ns, piece))
                require(
                    list(map(content_of, again.measurements))
                    == list(map(content_of, receiver.measurements)),
                    f"{len(pieces)} pieces must give the same samples as the original chunks",
                )
                require(
                    again.decoder.discarded_bytes == receiver.decoder.discarded_bytes,
                    f"{len(pieces)} pieces must give the same number of discarded bytes",
                )

        asyncio.run(scene())

    def test_replay_returns_the_same_events(self, tmp_path: Path) -> None:
        """The output of a decoder depends on the chunks only, not on a clock or shared state."""

        async def scene() -> None:
            device, driver = self.make_device(tmp_path, clean_wire), self.make_driver(tmp_path)
            async with self.streaming(device, driver) as (receiver, first):
                await self._send_all(device, receiver, first, 20)

            again = DecodingReceiver(driver, self.measurement)
            for chunk in receiver.chunks:
                again.emit(chunk)
            require(
                repr(again.events) == repr(receiver.events), "a replay must give the same events"
            )

        asyncio.run(scene())

    def test_arrival_stamps_are_those_of_the_first_byte(self, tmp_path: Path) -> None:
        """The arrival of a sample is that of the first byte, also within a chunk of many bytes."""

        async def scene() -> None:
            driver, data, t_ns, _ = await self._record(tmp_path)
            byte_ns = _BITS * NS_PER_S / (self.baud or NS_PER_S)

            # The same bytes arrive twice: one by one at the line speed, and in one chunk.
            single = DecodingReceiver(driver, self.measurement)
            late_ns = []
            for number, byte in enumerate(data, 1):
                before, at_ns = len(single.measurements), t_ns + round(number * byte_ns)
                single.emit(Chunk(at_ns, bytes((byte,))))
                late_ns += [at_ns - item.arrival_ns for item in single.measurements[before:]]
            whole = DecodingReceiver(driver, self.measurement)
            whole.emit(Chunk(t_ns + round(len(data) * byte_ns), data))

            require(
                min(late_ns) > _INCOMPLETE * byte_ns,
                "the arrival of a sample must be that of the first byte of its message, "
                "not of the last",
            )
            errors_ns = [
                abs(one.arrival_ns - other.arrival_ns)
                for one, other in zip(single.measurements, whole.measurements, strict=True)
            ]
            require(
                max(errors_ns) <= 2 * byte_ns,
                "the arrival of a sample must be back-dated by the bytes behind it in its chunk, "
                f"{_BITS} bits each at {self.baud} baud; one time is wrong by {max(errors_ns)} ns",
            )

        asyncio.run(scene())

    def test_silence_discards_an_incomplete_message(self, tmp_path: Path) -> None:
        """A long silence discards an incomplete message; a short pause does not."""

        async def scene() -> None:
            driver, data, t_ns, whole = await self._record(tmp_path)

            again = DecodingReceiver(driver, self.measurement)
            again.emit(Chunk(t_ns, data[:-_INCOMPLETE]))
            again.emit(Chunk(t_ns + _PAUSE_NS, data[-_INCOMPLETE:]))
            require(
                len(again.measurements) == len(whole),
                f"a pause of {_PAUSE_NS // 1_000_000} ms inside a message shows a busy host and "
                "must not discard the message",
            )

            again = DecodingReceiver(driver, self.measurement)
            again.emit(Chunk(t_ns, data[:-_INCOMPLETE]))
            before = again.decoder.discarded_bytes
            again.emit(Chunk(t_ns + _SILENCE_NS, data[:1]))
            require(
                again.decoder.discarded_bytes > before,
                "the first chunk after a long silence must discard an incomplete message: flush "
                "the codec before feeding it",
            )

        asyncio.run(scene())

    def test_input_from_before_the_opening_is_discarded(self, tmp_path: Path) -> None:
        """The driver discards older bytes in the system's buffer; their time is unknown."""

        async def scene() -> None:
            device, driver = self.make_device(tmp_path, clean_wire), self.make_driver(tmp_path)
            async with serve_device(device):
                async with self._reading(device, driver, 0) as (_, number):
                    pass
                stale = range(number, number + 10)
                for number in stale:
                    self.send(device, number)
                await asyncio.sleep(_DELIVERY_S)
                async with self._reading(device, driver, stale.stop) as (receiver, end):
                    received = receiver.measurements

            for item in received:
                self._require_sent(item, range(end))
                require(
                    any(self.matches(number, item) for number in range(stale.stop, end)),
                    "samples from before the opening must not arrive: discard the buffered input",
                )

        asyncio.run(scene())

    def test_random_bytes_never_raise(self, tmp_path: Path) -> None:
        """Random bytes raise no error; at most the received bytes are counted as corrupt."""
        noise = random.Random(11)  # noqa: S311 - the same bytes in every run
        decoder = self.make_driver(tmp_path).decoder()
        fed = lost = 0
        for t_ns in range(0, 400_000_000, 1_000_000):
            data = noise.randbytes(noise.randrange(200))
            fed += len(data)
            events = decoder.feed(Chunk(t_ns, data))
            lost += sum(event.discarded for event in events if isinstance(event, Corrupt))

        lost += sum(event.discarded for event in decoder.flush() if isinstance(event, Corrupt))
        require(lost <= fed, f"{lost} bytes reported as corrupt, but only {fed} received")
        require(
            decoder.discarded_bytes <= fed,
            f"{decoder.discarded_bytes} bytes counted as discarded, but only {fed} received",
        )

    def test_line_noise_affects_only_damaged_samples(self, tmp_path: Path) -> None:
        """On a noisy line, at least half of the samples arrive, and all of these are unchanged."""
        if not self.has_noise:
            raise SkipTest("this wire detects damage itself, or does not allow its detection")

        async def scene() -> None:
            noise = SwitchableNoise()
            device = self.make_device(tmp_path, noise)
            async with self.streaming(device, self.make_driver(tmp_path)) as (receiver, first):
                before = len(receiver.measurements)
                noise.on = True
                for number in range(first, first + 200):
                    self.send(device, number)
                    await asyncio.sleep(self.pace_s)
                noise.on = False

                # After a silence, the decoder discards a message with a damaged length field.
                await asyncio.sleep(0.3)
                self.send(device, first + 200)
                await receiver.settle()
                clean = await self._send_all(device, receiver, first + 201, 10)

            received = receiver.measurements[before:]
            numbers = range(first, clean[-1] + 1)
            require(
                len(received) >= len(numbers) // 2,
                f"at least half of the {len(numbers)} samples must arrive; {len(received)} did",
            )
            for item in received:
                self._require_sent(item, numbers)
            require(receiver.decoder.discarded_bytes > 0, "the decoder must count damaged bytes")

        asyncio.run(scene())

    def test_silence_raises_device_lost(self, tmp_path: Path) -> None:
        """The driver reports a silent device as lost."""

        async def scene() -> None:
            device, driver = self.make_device(tmp_path, clean_wire), self.make_driver(tmp_path)
            async with serve_device(device):
                receiver = DecodingReceiver(driver, self.measurement)
                task = asyncio.create_task(driver.run(receiver.emit))
                first = await self._send_first(device, receiver, task)
                await self._send_all(device, receiver, first, 5)
                await require_error(DeviceLostError, task, self.lost_within_s)

        asyncio.run(scene())

    def test_driver_detects_unplugging_and_runs_again_after_plugging(self, tmp_path: Path) -> None:
        """Unplugging raises DeviceLostError. After plugging, the same driver runs again."""
        if not self.has_plug:
            raise SkipTest("this wire cannot be unplugged")

        async def scene() -> None:
            device, driver = self.make_device(tmp_path, clean_wire), self.make_driver(tmp_path)
            async with serve_device(device):
                receiver = DecodingReceiver(driver, self.measurement)
                task = asyncio.create_task(driver.run(receiver.emit))
                first = await self._send_first(device, receiver, task)
                require(hasattr(device, "plug"), "the simulated device must have unplug and plug")
                device.unplug()
                await require_error(DeviceLostError, task, self.lost_within_s)

                task = asyncio.create_task(driver.run(receiver.emit))
                await require_error(DeviceLostError, task, self.starts_within_s)

                device.plug()
                async with self._reading(device, driver, first) as (receiver, number):
                    await self._send_all(device, receiver, number, 10)

        asyncio.run(scene())

    def test_absent_device_raises_device_lost(self, tmp_path: Path) -> None:
        """The driver reports an absent device as lost, so the supervisor tries again."""
        if not self.has_plug:
            raise SkipTest("this wire cannot be unplugged")

        async def scene() -> None:
            device, driver = self.make_device(tmp_path, clean_wire), self.make_driver(tmp_path)
            device.unplug()
            task = asyncio.create_task(driver.run(lambda _: None))
            await require_error(DeviceLostError, task, self.starts_within_s)

        asyncio.run(scene())

    def test_wrong_device_raises_device_misconfigured(self, tmp_path: Path) -> None:
        """With a device of another type, the driver raises an error with a message for the user."""
        device = self.make_wrong_device(tmp_path)
        if device is None:
            raise SkipTest("this wire does not allow detection of a wrong device")

        async def scene() -> None:
            async with serve_device(device):
                task = asyncio.create_task(self.make_driver(tmp_path).run(lambda _: None))
                await require_error(DeviceMisconfiguredError, task, self.refused_within_s)

        asyncio.run(scene())

    def test_exception_of_emit_reaches_the_caller(self, tmp_path: Path) -> None:
        """An exception of the receiver is not reported as a lost device."""

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
                        await asyncio.sleep(self.pace_s)
                await require_error(ZeroDivisionError, task, self.starts_within_s)

        asyncio.run(scene())

    def test_cancelling_closes_all_descriptors_and_tasks(self, tmp_path: Path) -> None:
        """If ``run`` is cancelled at its start or while reading, no descriptor or task remains."""

        async def scene() -> None:
            device, driver = self.make_device(tmp_path, clean_wire), self.make_driver(tmp_path)
            async with serve_device(device):
                # The first run creates objects that live as long as the process (executors,
                # caches).
                async with self._reading(device, driver, 0):
                    pass

                before, tasks = count_descriptors(), asyncio.all_tasks()
                for pause_s in (0.0, 0.001, 0.02):
                    task = asyncio.create_task(driver.run(lambda _: None))
                    await asyncio.sleep(pause_s)
                    await cancel_and_wait(task)
                for _ in range(2):
                    async with self._reading(device, driver, 0):
                        pass
                require(asyncio.all_tasks() == tasks, "run must not leave tasks")
                require(count_descriptors() == before, "run must not leave open descriptors")

        asyncio.run(scene())

    def _require_sent(self, item: Any, numbers: range, expected: str = "") -> None:
        require(
            any(self.matches(number, item) for number in numbers),
            f"every sample must arrive unchanged; {content_text(item)} was not sent{expected}",
        )

    # --- driver and device at work ------------------------------------------------------------

    @contextlib.asynccontextmanager
    async def streaming(
        self, device: Any, driver: Driver
    ) -> AsyncIterator[tuple[DecodingReceiver, int]]:
        """Run device and driver; yield the receiver and the next sample number."""
        async with serve_device(device), self._reading(device, driver, 0) as state:
            yield state

    async def _record(self, tmp_path: Path) -> tuple[Driver, bytes, int, list[Any]]:
        """Record a short time; return driver, bytes, time of the last chunk, and measurements."""
        if self.make_driver(tmp_path).wire != "stream" or self.baud is None:
            raise SkipTest("bytes of this wire take no time")
        device, driver = self.make_device(tmp_path, clean_wire), self.make_driver(tmp_path)
        async with self.streaming(device, driver) as (receiver, first):
            await self._send_all(device, receiver, first, 20)
        data = b"".join(chunk.data for chunk in receiver.chunks)
        return driver, data, receiver.chunks[-1].t_ns, receiver.measurements

    @contextlib.asynccontextmanager
    async def _reading(
        self, device: Any, driver: Driver, number: int
    ) -> AsyncIterator[tuple[DecodingReceiver, int]]:
        """Run the driver on a running device; yield the same values as `streaming`."""
        receiver = DecodingReceiver(driver, self.measurement)
        task = asyncio.create_task(driver.run(receiver.emit))
        try:
            yield receiver, await self._send_first(device, receiver, task, number)
        finally:
            await cancel_and_wait(task)

    async def _send_first(
        self, device: Any, receiver: DecodingReceiver, task: asyncio.Task[None], number: int = 0
    ) -> int:
        """Send until a sample arrives, then wait for the rest; return the next sample number."""
        async with asyncio.timeout(self.starts_within_s):
            while not receiver.measurements:
                if task.done():
                    task.result()  # raises the exception of the task, if any
                    require(False, "run must read until it is cancelled")
                self.send(device, number)
                number += 1
                await asyncio.sleep(self.pace_s)
        await receiver.settle()
        return number

    async def _send_all(
        self, device: Any, receiver: DecodingReceiver, first: int, count: int
    ) -> range:
        """Send `count` samples and wait for all of them; return their numbers."""
        before = len(receiver.measurements)
        for number in range(first, first + count):
            self.send(device, number)
            await asyncio.sleep(self.pace_s)
        await receiver.wait_for(before + count, self.lost_within_s / 2)
        received = len(receiver.measurements) - before
        require(received == count, f"all {count} samples must arrive; {received} did")
        return range(first, first + count)
