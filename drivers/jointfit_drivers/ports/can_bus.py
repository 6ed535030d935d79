"""CAN buses, each opened once and shared by all devices on it.

A bus is open while a device uses it. Every device receives chunks with its own frames only. When a
bus fails, all its devices are lost, each by its own `DeviceLostError`.

A bus is drained from ``loop.add_reader`` on its descriptor, up to 64 frames per wake-up. A backend
without descriptor is read by one thread that delivers batches. python-can's own Notifier is not
used because it ignores receive errors.

Invariant: drivers use python-can only through this module, which knows no device and no message
format.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_daemon.model import Chunk
from jointfit_daemon.name_lists import list_names
from jointfit_drivers.ports._bus_faults import bus_faults
from jointfit_drivers.ports._python_can_bus import PythonCanBus
from jointfit_drivers.ports._silence_timer import SilenceTimer
from jointfit_drivers.ports._slcan_bus import SlcanBus
from jointfit_protocols.can import HOST_CORRUPT, CanFrame, pack_frames

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Mapping

    from jointfit_daemon.driver import CanBusSettings, Emit

__all__ = ["CanKey", "SharedBus", "bus_faults", "shared_bus"]

CanKey = tuple[int, bool]
"""Identifier of a frame, and whether it has 29 bits."""

_UNCLAIMED = 512
"""Stored frames without a subscriber: a third of a second of four sensors at 400 Hz."""
_CLAIM_NS = 300_000_000
"""Age, ns, up to which stored frames are delivered to a new subscriber. The devices of a rig start
together.
"""
_SEEN = 64
"""Number of unclaimed identifiers whose data are stored for error messages."""
_NAMED = 8
"""Number of unclaimed identifiers listed in an error message."""
_SAMPLES = 4
"""Stored frames of each unclaimed identifier."""
_EARLY = 16
"""Chunks that wait for the first frame with the required identifier."""


@dataclass(eq=False, slots=True)
class _Subscriber:
    """One device on a bus."""

    name: str
    ids: Mapping[CanKey, str]
    emit: Emit
    ended: asyncio.Future[None]
    silence_s: float
    needed: CanKey
    others: int
    """Number of frames of all devices that had arrived before its subscription."""
    arrived: dict[CanKey, int] = field(default_factory=dict)
    """Time of the last arrival, ns, of each of its identifiers since its subscription."""
    timer: SilenceTimer | None = None
    """Limits the time without the required identifier, while the device is subscribed."""
    early: deque[Chunk] = field(default_factory=lambda: deque(maxlen=_EARLY))

    @property
    def is_complete(self) -> bool:
        """Whether the required identifier has arrived."""
        return self.needed in self.arrived

    def take(self, t_ns: int, frames: list[CanFrame]) -> None:
        """Emit `frames`; an exception of `emit` ends this device's pump and no other's.

        Until the required identifier arrives only error frames are emitted; the others wait.
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
        if self.needed in keys and self.timer is not None:
            self.timer.note_arrival()


class SharedBus:
    """One bus and the devices on it; created by `shared_bus`."""

    def __init__(self, settings: CanBusSettings) -> None:
        self.channel = settings.channel
        self.foreign = 0
        """Frames that no device of the rig subscribed to."""
        self._settings = settings
        self._backend: SlcanBus | PythonCanBus | None = None
        self._failed: Exception | None = None
        self._unclaimed: deque[tuple[int, CanFrame]] = deque(maxlen=_UNCLAIMED)
        self._others = 0  # frames delivered to devices of the rig
        self._seen: dict[CanKey, deque[bytes]] = {}  # last data of unclaimed identifiers
        self._lock = asyncio.Lock()  # opening and closing take time and must not overlap
        self.users = 0
        """Devices that use the bus."""
        self._subscribers: list[_Subscriber] = []
        self._routes: dict[CanKey, _Subscriber] = {}
        self._ids: dict[str, Mapping[CanKey, str]] = {}
        """Identifiers of every device that has subscribed, also while it waits for a retry."""

    async def enter(self) -> None:
        """Register a user; the first user opens the bus."""
        self.users += 1
        async with self._lock:
            if self._backend is None:
                kind = SlcanBus if self._settings.interface == "slcan" else PythonCanBus
                backend = kind(self._settings)
                await backend.open(self._deliver, self._fail)
                self._backend = backend

    async def leave(self) -> None:
        """Unregister a user; the last user closes the bus."""
        self.users -= 1
        async with self._lock:
            if self.users and self._failed is None:
                return
            backend, self._backend, self._failed = self._backend, None, None
            if backend is not None:
                await backend.close()

    async def pump(
        self,
        name: str,
        ids: Mapping[CanKey, str],
        emit: Emit,
        silence_s: float,
        *,
        needed: CanKey,
        first_s: float | None = None,
        resembles: Callable[[bytes], bool] = lambda _: False,
        worked: bool = False,
        configured_by: str = "with the configuration program of the device",
    ) -> None:
        """Emit every frame with one of `ids`, in chunks of packed frames, until cancelled.

        Error frames are emitted as well, and so are the records with which this host counts dropped
        frames (`host_dropped`) and corrupt bytes (`host_corrupt`). A count of corrupt bytes goes to
        one device only, so that the bytes are counted once.

        Parameters
        ----------
        name : str
            The device, as named in error messages.
        ids : mapping
            Name of the quantity that each identifier carries, for error messages.
        emit : callable
            An exception of `emit` ends the pump and is raised to the caller.
        silence_s : float
            Time without a frame with the identifier `needed`, s, after which the device counts
            as lost.
        needed : CanKey
            Identifier in `ids` of the frames with measurements.
        first_s : float, optional
            Longest wait for the first of these frames, s; default: `silence_s`.
        resembles : callable
            Whether the data of a frame resemble the data of `needed`, for a hint in the error
            message.
        worked : bool
            Whether the device has sent measurements before: its settings are correct.
        configured_by : str
            How its identifiers and outputs are changed, for error messages.

        Raises
        ------
        DeviceLostError
            The bus failed, or no frame with the identifier `needed` arrives while the bus works.
        DeviceMisconfiguredError
            Another device of the rig uses one of the identifiers.
        """
        for key, carries in ids.items():
            other = self._routes.get(key)
            if other is not None:
                raise DeviceMisconfiguredError(
                    f"{self.channel}: CAN identifier {_hex(key)} ({carries}) is also "
                    f"that of {other.name} ({other.ids[key]}): give each sensor a block of its own "
                    f"({configured_by}) and set `ids` of both"
                )

        # ends with the error of the bus or of `emit`; with a result: silence
        ended: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        subscriber = _Subscriber(name, ids, emit, ended, silence_s, needed, self._others)

        def end_silent() -> None:
            if not ended.done():
                ended.set_result(None)

        if self._failed is not None:
            raise DeviceLostError(str(self._failed))
        self._subscribers.append(subscriber)
        self._ids[name] = ids
        timer = subscriber.timer = SilenceTimer(silence_s, end_silent, first_s)
        try:
            self._route()
            self._claim(subscriber)
            self._filter()
            await ended
            text = self._explain_silence(subscriber, resembles, configured_by, worked=worked)
            raise DeviceLostError(text)
        finally:
            timer.cancel()
            self._subscribers.remove(subscriber)
            self._route()
            if ended.done() and not ended.cancelled():
                ended.exception()  # mark as retrieved, in case a cancellation came first

    def _explain_silence(
        self,
        subscriber: _Subscriber,
        resembles: Callable[[bytes], bool],
        configured_by: str,
        *,
        worked: bool,
    ) -> str:
        """Return the missing identifier of a silent device, and those that arrive instead.

        The text is the same as long as the findings are the same.
        """
        ids, needed = subscriber.ids, subscriber.needed
        what = ids[needed]

        since_ns = time.monotonic_ns() - round(subscriber.silence_s * 1e9)
        others = sorted(
            key for key, t_ns in subscriber.arrived.items() if t_ns > since_ns and key != needed
        )

        # Its settings are correct, because all identifiers arrived before. The text contains no
        # duration: it would differ at every attempt, and every different text is a new line of
        # the log.
        if not others and (subscriber.is_complete or (worked and not self._seen)):
            return f"{self.channel}: silent: check its power and wiring"

        found = [f"{ids[key]} ({_hex(key)})" for key in others]
        text = f"{self.channel}: no {what} ({_hex(needed)}) arrives"
        if found:
            text += f", though {', '.join(found)} {'do' if len(found) > 1 else 'does'}"

        unclaimed = sorted(self._seen)
        if unclaimed:
            named = list_names([_hex(key) for key in unclaimed], _NAMED)
            text += f"; identifiers on the bus that no sensor claims: {named}"

        alike = [key for key in unclaimed if all(map(resembles, self._seen[key]))]
        twin = (needed[0], not needed[1])
        if twin in unclaimed or alike:
            return f"{text}; {_advise_id(needed, twin if twin in unclaimed else alike[0], what)}"

        if found or unclaimed:
            return f"{text}: set `ids`, or switch this output on ({configured_by})"
        if self._others > subscriber.others:
            return f"{text}, while other sensors send: check its power and wiring, and `ids`"
        return f"{text}, and nothing else on the bus: check power, wiring and bit rate"

    def _route(self) -> None:
        self._routes = {key: each for each in self._subscribers for key in each.ids}
        self._seen = {key: seen for key, seen in self._seen.items() if not self._belongs(key)}
        self._filter()

    def _belongs(self, key: CanKey) -> bool:
        """Return whether a device of the rig uses the identifier, subscribed or not."""
        return any(key in ids for ids in self._ids.values())

    def _filter(self) -> None:
        """Filter unclaimed frames in the kernel once every device receives its frames."""
        if self._backend is not None and self._failed is None:
            complete = all(each.is_complete for each in self._subscribers)
            self._backend.listen(self._routes if complete else None)

    def _claim(self, subscriber: _Subscriber) -> None:
        """Deliver frames that arrived shortly before this device subscribed.

        The first device of a rig opens the bus, and the frames of the others arrive immediately.
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
        """Deliver every frame to its subscriber."""
        shares: dict[_Subscriber, list[CanFrame]] = {}
        for frame in frames:
            if frame.error:
                for each in self._subscribers[: 1 if frame.can_id == HOST_CORRUPT else None]:
                    shares.setdefault(each, []).append(frame)
                continue

            key = (frame.can_id, frame.extended)
            subscriber = self._routes.get(key)
            if subscriber is not None and not frame.remote:
                shares.setdefault(subscriber, []).append(frame)
                continue

            # Stored for later subscribers, and for error messages.
            self.foreign += 1
            self._unclaimed.append((t_ns, frame))
            if self._belongs(key):
                self._others += 1
            elif key in self._seen or len(self._seen) < _SEEN:
                self._seen.setdefault(key, deque(maxlen=_SAMPLES)).append(frame.data)

        for subscriber, mine in shares.items():
            self._others += len(mine)
            was_complete = subscriber.is_complete
            subscriber.take(t_ns, mine)
            if subscriber.is_complete != was_complete:
                self._filter()

    def _fail(self, error: Exception) -> None:
        """End the pump of every device; the first device that ends closes the bus."""
        self._failed = error
        for each in self._subscribers:
            if not each.ended.done():
                lost = isinstance(error, DeviceLostError)  # one exception each
                each.ended.set_exception(type(error)(str(error)) if lost else error)


def _advise_id(needed: CanKey, arriving: CanKey, what: str) -> str:
    """Return the change of the configuration that accepts the identifier `arriving`."""
    number, extended = arriving
    width = ""
    if extended != needed[1]:
        width = "set `extended_ids = true`" if extended else "remove `extended_ids`"
    if number == needed[0]:
        bits = 29 if extended else 11
        return f"this number arrives as an identifier of {bits} bits: {width}"
    and_width = f", and {width}" if width else ""
    return f"the data of {_hex(arriving)} look like a {what}: set `ids.{what}` to it{and_width}"


def _hex(key: CanKey) -> str:
    number, extended = key
    return f"0x{number:08X}" if extended else f"0x{number:03X}"


_BUSES: WeakKeyDictionary[asyncio.AbstractEventLoop, dict[str, SharedBus]] = WeakKeyDictionary()


@asynccontextmanager
async def shared_bus(settings: CanBusSettings) -> AsyncIterator[SharedBus]:
    """Yield the open bus of this ``[can.NAME]`` table, one instance for all its devices.

    Raises
    ------
    DeviceLostError
        The interface is absent, down or in use; it may recover.
    DeviceMisconfiguredError
        This kind of bus is not available here, or the bus cannot run with these settings.
    """
    buses = _BUSES.setdefault(asyncio.get_running_loop(), {})
    key = settings.model_dump_json()
    bus = buses.setdefault(key, SharedBus(settings))
    try:
        await bus.enter()
        yield bus
    finally:
        await bus.leave()
        if not bus.users and buses.get(key) is bus:
            del buses[key]
