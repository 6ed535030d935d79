"""CAN buses, each opened once and shared by all devices on it.

Law: this is the only module that knows python-can, and nothing of python-can leaves it. A bus lives
as long as somebody uses it. Every device gets chunks with its own frames only; when a bus fails,
all its devices are lost, each by its own ``DeviceLost``. No device and no message is named here.

A bus is drained from ``loop.add_reader`` on its descriptor, up to 64 frames a wake-up; a backend
without descriptor by one thread that hands over batches. python-can's own Notifier would ignore
receive errors, and each error is told once only.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol
from weakref import WeakKeyDictionary

from jointfit_daemon.driver import DeviceLost, DeviceMisconfigured
from jointfit_daemon.model import Chunk
from jointfit_drivers.python_can_bus import PythonCanBus
from jointfit_drivers.slcan_bus import SlcanBus
from jointfit_protocols.can_frame import HOST_CORRUPT, CanFrame, pack_frames

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Collection, Mapping

    from jointfit_daemon.driver import CanBusSettings, Emit

CanKey = tuple[int, bool]
"""Identifier, and whether it is a 29-bit one."""

_UNCLAIMED = 512  # frames nobody wanted yet: a third of a second of four sensors at 400 Hz
_CLAIM_NS = 300_000_000  # older ones belong to nobody; the devices of a rig begin together


class Backend(Protocol):
    """What reads one bus."""

    async def open(
        self, deliver: Callable[[int, list[CanFrame]], None], failed: Callable[[Exception], None]
    ) -> None:
        """Begin to read; raise DeviceLost or DeviceMisconfigured. Errors later go to `failed`."""

    def listen(self, ids: Collection[CanKey]) -> None:
        """Let these identifiers through; more may come."""

    async def close(self) -> None:
        """Release everything; also after a failure, also twice."""


@dataclass(eq=False, slots=True)
class _Subscriber:
    """One device on a bus."""

    name: str
    ids: Mapping[CanKey, str]
    emit: Emit
    ended: asyncio.Future[None]
    limit: asyncio.Timeout
    silence_s: float

    def take(self, t_ns: int, frames: list[CanFrame]) -> None:
        """Hand `frames` on; what goes wrong there ends this device's pump and no other's."""
        if self.ended.done():
            return
        try:
            self.emit(Chunk(t_ns, pack_frames(frames)))
        except Exception as error:  # noqa: BLE001 - a loop callback's error would only be logged
            self.ended.set_exception(error)
            return
        if not all(frame.error for frame in frames) and not self.limit.expired():
            self.limit.reschedule(asyncio.get_running_loop().time() + self.silence_s)


class SharedBus:
    """One bus and the devices on it; get it from ``shared_bus``."""

    def __init__(self, settings: CanBusSettings) -> None:
        self.channel = settings.channel
        self.foreign = 0
        """Frames that no device of the rig wanted."""
        self._settings = settings
        self._backend: Backend | None = None
        self._failed: Exception | None = None
        self._unclaimed: deque[tuple[int, CanFrame]] = deque(maxlen=_UNCLAIMED)
        self._lock = asyncio.Lock()  # opening and closing take time and must not overlap
        self._users = 0
        self._subscribers: list[_Subscriber] = []
        self._routes: dict[CanKey, _Subscriber] = {}

    @property
    def in_use(self) -> bool:
        """Whether anybody holds the bus."""
        return self._users > 0

    async def enter(self) -> None:
        """Take part: open the bus unless another device did."""
        self._users += 1
        async with self._lock:
            if self._backend is None:
                backend = (SlcanBus if self._settings.interface == "slcan" else PythonCanBus)(
                    self._settings
                )
                await backend.open(self._deliver, self._fail)
                self._backend = backend

    async def leave(self) -> None:
        """Part; the last one out closes the bus."""
        self._users -= 1
        async with self._lock:
            if not self._users or self._failed is not None:
                await self._close()

    async def pump(
        self, name: str, ids: Mapping[CanKey, str], emit: Emit, silence_s: float
    ) -> None:
        """Hand `emit` every frame with one of `ids`, in chunks of records, until cancelled.

        Error frames and the host's notes (``can_frame``) come as well; bytes lost on an adapter's
        line are told to one device only, so that they are counted once.

        Parameters
        ----------
        name
            The device, as messages name it.
        ids
            What each of its identifiers carries, for messages.
        emit
            What it raises ends the pump and reaches the caller.
        silence_s
            No frame of these identifiers for this long is a lost device, s.

        Raises
        ------
        DeviceLost
            The bus failed, or the device is silent while the bus is well.
        DeviceMisconfigured
            Another device of the rig claims one of the identifiers.
        """
        self._refuse_taken(name, ids)
        ended: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        limit = asyncio.timeout(silence_s)
        subscriber = _Subscriber(name, ids, emit, ended, limit, silence_s)
        if self._failed is not None:
            raise DeviceLost(str(self._failed))
        self._subscribers.append(subscriber)
        try:
            async with limit:
                self._route()
                self._claim(subscriber)
                await ended
        except TimeoutError as error:
            if not limit.expired():  # raised by emit: a bug, not silence
                raise
            raise DeviceLost(self._silent(name, ids, silence_s)) from error
        finally:
            self._subscribers.remove(subscriber)
            self._route()
            if ended.done() and not ended.cancelled():
                ended.exception()  # seen, should a cancellation have overtaken it

    def _silent(self, name: str, ids: Mapping[CanKey, str], silence_s: float) -> str:
        listed = ", ".join(f"0x{number:03X}" for number, _ in sorted(ids))
        return (
            f"{name} ({self.channel}): silent for {silence_s:g} s: no frame with identifier "
            f"{listed}; {self.foreign} frames with others came: check power, bit rate and `ids`"
        )

    def _refuse_taken(self, name: str, ids: Mapping[CanKey, str]) -> None:
        for key, carries in ids.items():
            other = self._routes.get(key)
            if other is not None:
                raise DeviceMisconfigured(
                    f"{name} ({self.channel}): CAN identifier 0x{key[0]:03X} ({carries}) is also "
                    f"that of {other.name} ({other.ids[key]}): give each sensor a block of its own "
                    "(over UART, Xsens MT Manager) and set `ids` of both"
                )

    def _route(self) -> None:
        self._routes = {key: each for each in self._subscribers for key in each.ids}
        if self._backend is not None and self._failed is None:
            self._backend.listen(self._routes)

    def _claim(self, subscriber: _Subscriber) -> None:
        """Give a device what came for it just before it began to listen.

        The first device of a rig opens the bus, and the others' frames are there at once.
        """
        waiting, self._unclaimed = self._unclaimed, deque(maxlen=_UNCLAIMED)
        now_ns = time.monotonic_ns()
        for t_ns, frame in waiting:
            if now_ns - t_ns > _CLAIM_NS:
                continue
            if (frame.can_id, frame.extended) in subscriber.ids:
                self.foreign -= 1
                subscriber.take(t_ns, [frame])
            else:
                self._unclaimed.append((t_ns, frame))

    def _deliver(self, t_ns: int, frames: list[CanFrame]) -> None:
        """Give every frame to whom it belongs."""
        shares: dict[_Subscriber, list[CanFrame]] = {}
        for frame in frames:
            if frame.error:
                everyone = self._subscribers[: 1 if frame.can_id == HOST_CORRUPT else None]
                for each in everyone:
                    shares.setdefault(each, []).append(frame)
                continue
            subscriber = self._routes.get((frame.can_id, frame.extended))
            if subscriber is None or frame.remote:
                self.foreign += 1
                self._unclaimed.append((t_ns, frame))
            else:
                shares.setdefault(subscriber, []).append(frame)
        for subscriber, mine in shares.items():
            subscriber.take(t_ns, mine)

    def _fail(self, error: Exception) -> None:
        """End every device's pump; the bus is closed by the first to leave."""
        self._failed = error
        for each in self._subscribers:
            if not each.ended.done():
                lost = isinstance(error, DeviceLost)
                each.ended.set_exception(DeviceLost(str(error)) if lost else error)

    async def _close(self) -> None:
        backend, self._backend, self._failed = self._backend, None, None
        if backend is not None:
            await backend.close()


_BUSES: WeakKeyDictionary[asyncio.AbstractEventLoop, dict[str, SharedBus]] = WeakKeyDictionary()


@asynccontextmanager
async def shared_bus(settings: CanBusSettings) -> AsyncIterator[SharedBus]:
    """Yield the bus of this ``[can.NAME]`` table, open, one for all its devices.

    Raises
    ------
    DeviceLost
        Absent, down or taken: may heal.
    DeviceMisconfigured
        No such kind of bus here, or one that cannot run like this.
    """
    buses = _BUSES.setdefault(asyncio.get_running_loop(), {})
    key = settings.model_dump_json()
    bus = buses.setdefault(key, SharedBus(settings))
    try:
        await bus.enter()
        yield bus
    finally:
        await bus.leave()
        if not bus.in_use and buses.get(key) is bus:
            del buses[key]
