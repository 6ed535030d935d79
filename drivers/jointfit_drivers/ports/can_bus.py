"""CAN buses, each opened once and shared by all devices on it.

Law: this is the only module that knows python-can, and nothing of python-can leaves it. A bus lives
as long as somebody uses it. Every device gets chunks with its own frames only; when a bus fails,
all its devices are lost, each by its own ``DeviceLostError``. No device and no message is named
here.

A bus is drained from ``loop.add_reader`` on its descriptor, up to 64 frames a wake-up; a backend
without descriptor by one thread that hands over batches. python-can's own Notifier would ignore
receive errors, and each error is told once only.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol
from weakref import WeakKeyDictionary

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_daemon.model import Chunk
from jointfit_drivers.ports._python_can_bus import PythonCanBus, unknown_kind
from jointfit_drivers.ports._slcan_bus import SlcanBus
from jointfit_protocols.can import HOST_CORRUPT, CanFrame, pack_frames

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Collection, Mapping

    from jointfit_daemon.driver import CanBusSettings, Emit

__all__ = ["Backend", "CanKey", "SharedBus", "shared_bus", "unknown_kind"]

CanKey = tuple[int, bool]
"""Identifier, and whether it is a 29-bit one."""

_UNCLAIMED = 512  # frames nobody wanted yet: a third of a second of four sensors at 400 Hz
_CLAIM_NS = 300_000_000  # older ones belong to nobody; the devices of a rig begin together
_SEEN = 64  # identifiers that are remembered of those no device claims
_NAMED = 8  # of them in a message
_SAMPLES = 4  # frames of each that are looked at
_EARLY = 16  # chunks that wait for the first frame with data that a device cannot do without


class Backend(Protocol):
    """What reads one bus."""

    async def open(
        self, deliver: Callable[[int, list[CanFrame]], None], failed: Callable[[Exception], None]
    ) -> None:
        """Start reading; pass later errors to `failed`. Raises as `DeviceLostError` describes."""

    def listen(self, ids: Collection[CanKey] | None) -> None:
        """Let these identifiers through; more may come. None: all."""

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
    needed: CanKey
    others: int
    """Frames of all devices that had come when it subscribed."""
    arrived: dict[CanKey, int] = field(default_factory=dict)
    """Which of its identifiers came since it subscribed, and when the last time, ns."""
    early: deque[Chunk] = field(default_factory=lambda: deque(maxlen=_EARLY))

    @property
    def is_complete(self) -> bool:
        """Whether what it cannot do without has come."""
        return self.needed in self.arrived

    def take(self, t_ns: int, frames: list[CanFrame]) -> None:
        """Hand `frames` on; what goes wrong there ends this device's pump and no other's.

        Before the first frame that it needs only errors are handed on: the others wait.
        """
        if self.ended.done():
            return
        keys = {(frame.can_id, frame.extended) for frame in frames if not frame.error}
        self.arrived |= dict.fromkeys(keys, t_ns)
        chunk = Chunk(t_ns, pack_frames(frames))
        if keys and not self.is_complete:
            self.early.append(chunk)
            return
        try:
            while self.is_complete and self.early:
                self.emit(self.early.popleft())
            self.emit(chunk)
        except Exception as error:  # noqa: BLE001 - a loop callback's error would only be logged
            self.ended.set_exception(error)
            return
        if self.needed in keys and not self.limit.expired():
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
        self._others = 0  # frames that devices of the rig got
        self._seen: dict[CanKey, deque[bytes]] = {}  # the last data of identifiers nobody claims
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
        self,
        name: str,
        ids: Mapping[CanKey, str],
        emit: Emit,
        silence_s: float,
        *,
        needed: CanKey,
        resembles: Callable[[bytes], bool] = lambda _: False,
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
            No frame with the identifier `needed` for this long is a lost device, s.
        needed
            The one of `ids` that carries measurements.
        resembles
            Whether the data of a frame look like those of `needed`, for a hint.

        Raises
        ------
        DeviceLostError
            The bus failed, or nothing with the identifier `needed` comes while the bus is well.
        DeviceMisconfiguredError
            Another device of the rig claims one of the identifiers.
        """
        self._refuse_taken(name, ids)
        ended: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        limit = asyncio.timeout(silence_s)
        subscriber = _Subscriber(name, ids, emit, ended, limit, silence_s, needed, self._others)
        if self._failed is not None:
            raise DeviceLostError(str(self._failed))
        self._subscribers.append(subscriber)
        try:
            async with limit:
                self._route()
                self._claim(subscriber)
                self._filter()
                await ended
        except TimeoutError as error:
            if not limit.expired():  # raised by emit: a bug, not silence
                raise
            raise DeviceLostError(self._explain_silence(subscriber, resembles)) from error
        finally:
            self._subscribers.remove(subscriber)
            self._route()
            if ended.done() and not ended.cancelled():
                ended.exception()  # seen, should a cancellation have overtaken it

    def _explain_silence(self, subscriber: _Subscriber, resembles: Callable[[bytes], bool]) -> str:
        """Return what is missing and what comes instead; the same text as long as that is so."""
        ids, needed = subscriber.ids, subscriber.needed
        what = ids[needed]
        since_ns = time.monotonic_ns() - round(subscriber.silence_s * 1e9)
        others = sorted(
            key for key, t_ns in subscriber.arrived.items() if t_ns > since_ns and key != needed
        )
        if subscriber.is_complete and not others:  # its settings are right: it sent all it should
            return (
                f"{subscriber.name} ({self.channel}): silent for {subscriber.silence_s:g} s: "
                "check its power and wiring"
            )
        found = [f"{ids[key]} ({_hex(key)})" for key in others]
        text = f"{subscriber.name} ({self.channel}): no {what} ({_hex(needed)}) comes"
        if found:
            text += f", though {', '.join(found)} {'do' if len(found) > 1 else 'does'}"
        unclaimed = sorted(self._seen)
        if unclaimed:
            named = ", ".join(map(_hex, unclaimed[:_NAMED]))
            more = f" and {len(unclaimed) - _NAMED} more" if len(unclaimed) > _NAMED else ""
            text += f"; identifiers on the bus that no sensor claims: {named}{more}"
        alike = [key for key in unclaimed if all(map(resembles, self._seen[key]))]
        if alike:
            return (
                f"{text}; the data of {_hex(alike[0])} look like a {what}: set `ids.{what}` to it"
            )
        if found or unclaimed:
            return f"{text}: set `ids`, or switch this output on (over UART, Xsens MT Manager)"
        if self._others > subscriber.others:
            return f"{text}, while other sensors send: check its power and wiring, and `ids`"
        return f"{text}, and nothing else on the bus: check power, wiring and bit rate"

    def _refuse_taken(self, name: str, ids: Mapping[CanKey, str]) -> None:
        for key, carries in ids.items():
            other = self._routes.get(key)
            if other is not None:
                raise DeviceMisconfiguredError(
                    f"{name} ({self.channel}): CAN identifier {_hex(key)} ({carries}) is also "
                    f"that of {other.name} ({other.ids[key]}): give each sensor a block of its own "
                    "(over UART, Xsens MT Manager) and set `ids` of both"
                )

    def _route(self) -> None:
        self._routes = {key: each for each in self._subscribers for key in each.ids}
        self._seen = {key: seen for key, seen in self._seen.items() if key not in self._routes}
        self._filter()

    def _filter(self) -> None:
        """Leave frames that no device wants to the kernel, once every device has what it needs."""
        if self._backend is not None and self._failed is None:
            complete = all(each.is_complete for each in self._subscribers)
            self._backend.listen(self._routes if complete else None)

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
                self._remember(frame)
            else:
                shares.setdefault(subscriber, []).append(frame)
        for subscriber, mine in shares.items():
            self._others += len(mine)
            was_complete = subscriber.is_complete
            subscriber.take(t_ns, mine)
            if subscriber.is_complete != was_complete:
                self._filter()

    def _remember(self, frame: CanFrame) -> None:
        """Keep the last data of an identifier that no device claims, for messages."""
        key = (frame.can_id, frame.extended)
        seen = self._seen.get(key)
        if seen is None:
            if len(self._seen) >= _SEEN:
                return
            seen = self._seen[key] = deque(maxlen=_SAMPLES)
        seen.append(frame.data)

    def _fail(self, error: Exception) -> None:
        """End every device's pump; the bus is closed by the first to leave."""
        self._failed = error
        for each in self._subscribers:
            if not each.ended.done():
                lost = isinstance(error, DeviceLostError)
                each.ended.set_exception(DeviceLostError(str(error)) if lost else error)

    async def _close(self) -> None:
        backend, self._backend, self._failed = self._backend, None, None
        if backend is not None:
            await backend.close()


def _hex(key: CanKey) -> str:
    number, extended = key
    return f"0x{number:08X}" if extended else f"0x{number:03X}"


_BUSES: WeakKeyDictionary[asyncio.AbstractEventLoop, dict[str, SharedBus]] = WeakKeyDictionary()


@asynccontextmanager
async def shared_bus(settings: CanBusSettings) -> AsyncIterator[SharedBus]:
    """Yield the bus of this ``[can.NAME]`` table, open, one for all its devices.

    Raises
    ------
    DeviceLostError
        Absent, down or taken: may heal.
    DeviceMisconfiguredError
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
