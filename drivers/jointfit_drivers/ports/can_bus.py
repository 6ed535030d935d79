"""CAN buses. Each bus is opened once and shared by all devices on it.

A bus is open while a device uses it. Every device receives chunks that contain only its own frames.
If a bus fails, all its devices are lost: `SharedBus.pump` raises a separate `DeviceLostError` for
each device.

The event loop reads a bus through ``loop.add_reader`` on its file descriptor, up to 64 frames per
wake-up. A backend (python-can's class for one type of bus) without file descriptor is read by one
thread, which delivers the frames in batches. python-can's Notifier is not used, because it ignores
receive errors.

Invariant: drivers use python-can only through this module. The module depends on no device and no
message format.
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
"""Largest number of stored frames without subscriber ("unclaimed" frames). Four sensors that send
400 frames per second each fill the store in a third of a second."""
_CLAIM_NS = 300_000_000
"""Largest age of stored frames that are delivered to a new subscriber, ns. The devices of a rig
start at almost the same time, so their first frames may arrive before they subscribe."""
_SEEN = 64
"""Largest number of unclaimed identifiers whose data are stored for error messages."""
_NAMED = 8
"""Largest number of unclaimed identifiers in one error message."""
_SAMPLES = 4
"""Number of stored frames for each unclaimed identifier."""
_EARLY = 16
"""Largest number of chunks that wait for the first frame with the required identifier."""


@dataclass(eq=False, slots=True)
class _Subscriber:
    """One device that is subscribed to a bus."""

    name: str
    ids: Mapping[CanKey, str]
    emit: Emit
    ended: asyncio.Future[None]
    silence_s: float
    needed: CanKey
    others: int
    """Number of frames of the rig's devices that had arrived before the subscription."""
    arrived: dict[CanKey, int] = field(default_factory=dict)
    """Time of the last arrival of each subscribed identifier since the subscription, ns."""
    timer: SilenceTimer | None = None
    """Timer that limits the time without the required identifier while the device is subscribed."""
    early: deque[Chunk] = field(default_factory=lambda: deque(maxlen=_EARLY))

    @property
    def is_complete(self) -> bool:
        """Whether a frame with the required identifier has arrived."""
        return self.needed in self.arrived

    def take(self, t_ns: int, frames: list[CanFrame]) -> None:
        """Emit `frames`. An exception of `emit` ends only the pump of this device.

        Until the required identifier arrives, only error frames are emitted, and other frames wait.
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
    """One bus with its devices. Use `shared_bus` to create it."""

    def __init__(self, settings: CanBusSettings) -> None:
        self.channel = settings.channel
        self.foreign = 0
        """Number of frames to which no device of the rig is subscribed."""
        self._settings = settings
        self._backend: SlcanBus | PythonCanBus | None = None
        self._failed: Exception | None = None
        self._unclaimed: deque[tuple[int, CanFrame]] = deque(maxlen=_UNCLAIMED)
        self._others = 0  # frames of the rig's devices, including devices that wait for a retry
        self._seen: dict[CanKey, deque[bytes]] = {}  # last data of unclaimed identifiers
        self._lock = asyncio.Lock()  # opening and closing take time and must not overlap
        self.users = 0
        """Number of devices that use the bus."""
        self._subscribers: list[_Subscriber] = []
        self._routes: dict[CanKey, _Subscriber] = {}
        self._ids: dict[str, Mapping[CanKey, str]] = {}
        """Identifiers of every device that has subscribed, including devices that wait for a
        retry."""

    async def enter(self) -> None:
        """Register a user of the bus. The first user opens the bus."""
        self.users += 1
        async with self._lock:
            if self._backend is None:
                kind = SlcanBus if self._settings.interface == "slcan" else PythonCanBus
                backend = kind(self._settings)
                await backend.open(self._deliver, self._fail)
                self._backend = backend

    async def leave(self) -> None:
        """Unregister a user. The last user closes the bus.

        If the bus has failed, the first user that leaves closes it.
        """
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
        """Emit every frame whose identifier is in `ids`, until cancelled.

        A chunk contains packed frames. Error frames are emitted as well. So are the records that
        contain the number of dropped frames (`host_dropped`) or of corrupt bytes (`host_corrupt`)
        on this host. A record of corrupt bytes is emitted for one device only, so that the bytes
        are counted once.

        Parameters
        ----------
        name : str
            Name of the device in error messages.
        ids : mapping
            Identifiers of the device, each with the name of its quantity for error messages.
        emit : callable
            Function that receives the chunks. If it raises an exception, the pump ends and raises
            this exception.
        silence_s : float
            Time without a frame with the identifier `needed` after which the device counts as lost,
            s.
        needed : CanKey
            Identifier of the frames with measurements; one of `ids`.
        first_s : float, optional
            Longest wait for the first frame with the identifier `needed`, s. The default is
            `silence_s`.
        resembles : callable
            Function that returns whether the data of a frame resemble the data of `needed` frames.
            The result is used for a hint in the error message.
        worked : bool
            Whether the device has sent measurements before, which means that its settings are
            correct.
        configured_by : str
            Description of how to change the device's identifiers and outputs, for error messages.

        Raises
        ------
        DeviceLostError
            The bus failed, or no frame with the identifier `needed` arrived although the bus works.
        DeviceMisconfiguredError
            Another device of the rig uses one of the identifiers.
        """
        for key, carries in ids.items():
            other = self._routes.get(key)
            if other is not None:
                raise DeviceMisconfiguredError(
                    f"{self.channel}: CAN identifier {_hex(key)} ({carries}) is also "
                    f"used by {other.name} ({other.ids[key]}): give each sensor identifiers of its "
                    f"own ({configured_by}) and set `ids` of both sensors"
                )

        # The future ends with the error of the bus or of `emit`, or with a result after silence.
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
                ended.exception()  # otherwise asyncio logs it after a cancellation

    def _explain_silence(
        self,
        subscriber: _Subscriber,
        resembles: Callable[[bytes], bool],
        configured_by: str,
        *,
        worked: bool,
    ) -> str:
        """Return a text with the missing identifier of a device and the received identifiers.

        The text is the same as long as the findings are the same.
        """
        ids, needed = subscriber.ids, subscriber.needed
        what = ids[needed]

        since_ns = time.monotonic_ns() - round(subscriber.silence_s * 1e9)
        others = sorted(
            key for key, t_ns in subscriber.arrived.items() if t_ns > since_ns and key != needed
        )

        # In this case the required identifier has arrived before, so the settings are correct. The
        # text contains no duration. A duration would differ at every attempt, and every different
        # text becomes a new line of the log.
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
        """Return whether a device of the rig, subscribed or not, uses the identifier."""
        return any(key in ids for ids in self._ids.values())

    def _filter(self) -> None:
        """Make the backend drop unclaimed frames once every required identifier has arrived."""
        if self._backend is not None and self._failed is None:
            complete = all(each.is_complete for each in self._subscribers)
            self._backend.listen(self._routes if complete else None)

    def _claim(self, subscriber: _Subscriber) -> None:
        """Deliver frames that arrived shortly before this device subscribed.

        The first device of a rig opens the bus. Frames of the other devices then arrive before
        these devices subscribe.
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
        """Deliver every frame to the device that subscribed to it."""
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

            # The frame is stored for later subscribers and for error messages.
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
        """End the pump of every device. The first device that leaves the bus closes it."""
        self._failed = error
        for each in self._subscribers:
            if not each.ended.done():
                lost = isinstance(error, DeviceLostError)  # a separate exception for each device
                each.ended.set_exception(type(error)(str(error)) if lost else error)


def _advise_id(needed: CanKey, arriving: CanKey, what: str) -> str:
    """Return the change of settings that accepts `arriving` as the identifier of `what`."""
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
    """Yield the open bus of a ``[can.NAME]`` table; all of its devices get the same object.

    Raises
    ------
    DeviceLostError
        The interface is absent, down or in use; a retry may succeed.
    DeviceMisconfiguredError
        This type of bus is not available on this host, or the bus does not work with these
        settings.
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
