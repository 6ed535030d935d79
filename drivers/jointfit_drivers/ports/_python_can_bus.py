"""A bus of any kind that python-can knows: SocketCAN on its descriptor, others as they can.

Law: nothing of python-can leaves this module: whatever goes wrong becomes ``DeviceLostError``
(may heal)
or ``DeviceMisconfiguredError`` (cannot). Frames carry the kernel's stamp where there is one
(SocketCAN),
else the time of the read.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import socket
import struct
import threading
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import can

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_daemon.nearest_name import unknown_name
from jointfit_drivers.ports._kernel_stamps import KernelStamps
from jointfit_protocols.can import EXTENDED_MAX, STANDARD_MAX, CanFrame, host_dropped

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from jointfit_daemon.driver import CanBusSettings

log = logging.getLogger(__name__)
# It reports each failed opening as an error, once a second while an interface is away; we raise it.
logging.getLogger("can.interfaces.socketcan").setLevel(logging.CRITICAL)

_BATCH = 64  # frames a wake-up, so that a flood on one bus does not starve the rest
_WAITING = 64  # batches that a pump thread may be ahead of the loop
_PUMP_S = 0.05  # how long a pump thread sleeps in one receive: bounds the time to close
_RECEIVE_BYTES = 1 << 20  # holds about 1 400 frames; the default of 212 992 keeps 278
_DROPS_EVERY_NS = 250_000_000
_SO_RCVBUFFORCE, _SO_MEMINFO = 33, 55
_MEMINFO = struct.Struct("9I")
_DROPS = 8


class PythonCanBus:
    """One bus, for ``can_bus.SharedBus``.

    Parameters
    ----------
    settings
        Its ``[can.NAME]`` table; keys we do not know go to python-can as they are.
    """

    def __init__(self, settings: CanBusSettings) -> None:
        self._settings = settings
        self._stamps = KernelStamps(settings.bitrate)
        self._kernel = settings.interface == "socketcan"
        self._bus: can.BusABC | None = None
        self._pump: _Pump | None = None
        self._fd = -1
        self._drops = self._drops_read_ns = 0

    async def open(
        self, deliver: Callable[[int, list[CanFrame]], None], failed: Callable[[Exception], None]
    ) -> None:
        """Open the bus and begin to read.

        Raises
        ------
        DeviceLostError
            The interface is absent or taken.
        DeviceMisconfiguredError
            Unknown kind of interface, missing package, or a kernel without CAN.
        """
        bus = await self._opened()
        self._bus = bus
        try:
            self._fd = bus.fileno()
        except NotImplementedError:  # no descriptor: in-process buses, most vendors' libraries
            self._pump = _Pump(bus, self._frame, deliver, lambda e: failed(self._broken(e)))
            return
        if self._kernel:
            self._enlarge(bus)
        loop, fd = asyncio.get_running_loop(), self._fd

        def readable() -> None:
            try:
                self._drain(bus, deliver)
            except Exception as error:  # noqa: BLE001 - a loop callback's error would only be logged
                loop.remove_reader(fd)  # told once: whoever reads on is deaf for ever
                failed(self._broken(error))

        loop.add_reader(fd, readable)

    def listen(self, ids: Collection[tuple[int, bool]] | None) -> None:
        """Filter in the kernel (or in python-can, where the backend has no filter)."""
        if self._bus is None:
            return
        with suppress(can.CanError, OSError):  # a filter saves work; frames are sorted here as well
            self._bus.set_filters(
                None
                if ids is None
                else [
                    {"can_id": number, "can_mask": EXTENDED_MAX, "extended": True}
                    if extended
                    else {"can_id": number, "can_mask": STANDARD_MAX, "extended": False}
                    for number, extended in ids
                ]
            )

    async def close(self) -> None:
        """Stop reading and close the bus."""
        bus, self._bus = self._bus, None
        if bus is None:
            return
        if self._fd >= 0:
            asyncio.get_running_loop().remove_reader(self._fd)
        pump, self._pump = self._pump, None
        if pump is not None:
            await pump.stop()
        with suppress(can.CanError, OSError):
            bus.shutdown()

    async def _opened(self) -> can.BusABC:
        """Open the bus, off the loop where that may take long; errors as the house names them."""
        try:
            if self._kernel:
                _require_interface(self._settings.channel)  # else python-can leaks a socket
                return self._make()
            if self._settings.interface == "virtual":
                return self._make()
            making = asyncio.create_task(asyncio.to_thread(self._make), name="open CAN bus")
            try:
                return await asyncio.shield(making)
            except asyncio.CancelledError:
                making.add_done_callback(_shut)  # the thread cannot be cancelled: close its bus
                raise
        except Exception as error:  # a missing vendor library gives even NameError
            raise self._refused(error) from error

    def _make(self) -> can.BusABC:
        settings = self._settings
        if settings.interface not in can.VALID_INTERFACES:
            raise can.CanInterfaceNotImplementedError(settings.interface)
        extras: dict[str, Any] = dict(settings.model_extra or {})
        return can.Bus(
            interface=settings.interface,
            channel=settings.channel,
            bitrate=settings.bitrate,
            ignore_config=True,
            **extras,
        )

    def _enlarge(self, bus: can.BusABC) -> None:
        """Make room for a stall of the loop: a full queue drops silently."""
        sock = self._socket(bus)
        try:
            sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _RECEIVE_BYTES)
        except OSError:  # not privileged: the kernel cuts this one to net.core.rmem_max
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BYTES)

    def _socket(self, bus: can.BusABC) -> socket.socket:
        sock: socket.socket = bus.socket  # type: ignore[attr-defined]  # SocketCAN's own
        return sock

    def _drain(self, bus: can.BusABC, deliver: Callable[[int, list[CanFrame]], None]) -> None:
        """Read up to 64 frames and hand them on, also those before an error."""
        frames: list[CanFrame] = []
        self._stamps.pair()
        try:
            for _ in range(_BATCH):
                message = bus.recv(0)
                if message is None:
                    break
                if not message.is_fd:  # no device of ours sends CAN FD
                    frames.append(self._frame(message))
        finally:
            now = time.monotonic_ns()  # not before the reads: see `_frame`
            if self._kernel and now - self._drops_read_ns > _DROPS_EVERY_NS:
                self._drops_read_ns = now
                frames += self._dropped(bus, now)
            if frames:
                deliver(now, frames)

    def _dropped(self, bus: can.BusABC, now: int) -> list[CanFrame]:
        """Return a note of the frames the kernel threw away since the last one."""
        raw = self._socket(bus).getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size)
        drops = _MEMINFO.unpack(raw)[_DROPS]
        lost, self._drops = (drops - self._drops) % 2**32, drops
        return [host_dropped(now, lost)] if lost else []

    def _frame(self, message: can.Message) -> CanFrame:
        """Return the frame just read, stamped: by now, unless the kernel did.

        A time from before its read would stamp what came meanwhile too early, and clocks rest on
        the earliest.
        """
        data, extended = bytes(message.data[:8]), message.is_extended_id
        t_ns = time.monotonic_ns()
        if self._kernel:
            t_ns = self._stamps.start_ns(message.timestamp, len(data), extended)
        return CanFrame(
            t_ns,
            message.arbitration_id,
            data,
            extended,
            message.is_error_frame,
            message.is_remote_frame,
        )

    def _refused(self, error: Exception) -> DeviceLostError | DeviceMisconfiguredError:
        """Name why the bus does not open: thing, found, expected, remedy."""
        channel, kind = self._settings.channel, self._settings.interface
        if isinstance(error, (NotImplementedError, ImportError)):
            return DeviceMisconfiguredError(f"{channel}: {_unknown(kind, error)}")
        if isinstance(error, (can.CanError, OSError)):
            return self._numbered(error)
        said = f"{type(error).__name__}: {error}"
        return DeviceMisconfiguredError(
            f"{channel}: cannot be opened as {kind} ({said}): check its [can] table, and the "
            "vendor's library"
        )

    def _broken(self, error: Exception) -> Exception:
        """Name why the bus stopped; bugs stay what they are."""
        if isinstance(error, (can.CanError, OSError, ValueError)):  # ValueError: a backend's parser
            return self._numbered(error)
        return error

    def _numbered(self, error: Exception) -> DeviceLostError | DeviceMisconfiguredError:
        """Decide by the kernel's error number."""
        channel = self._settings.channel
        number = getattr(error, "error_code", None) or getattr(error, "errno", None)
        if number == errno.EAFNOSUPPORT:
            return DeviceMisconfiguredError(
                f"{channel}: no CAN in this kernel, or not allowed to this service: load the "
                "modules can and can_raw, allow AF_CAN, or use an adapter with "
                'interface = "slcan"'
            )
        if number in {errno.ENODEV, errno.ENXIO}:
            return DeviceLostError(f"{channel}: no such CAN interface: plug it in (see `ip link`)")
        if number == errno.ENETDOWN:
            return DeviceLostError(
                f"{channel}: the interface is down: `ip link set {channel} up type can bitrate "
                f"{self._settings.bitrate}`"
            )
        return DeviceLostError(f"{channel} ({self._settings.interface}): {error}")


def _require_interface(name: str) -> None:
    """Raise the OSError that binding a socket to `name` would."""
    socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    try:
        socket.if_nametoindex(name)  # not if_nameindex: that asks netlink, which the unit refuses
    except OSError as error:  # CPython gives it no number
        raise OSError(errno.ENODEV, "no such interface") from error


def _unknown(kind: str, error: Exception) -> str:
    """Say why the interface `kind` cannot be had."""
    return unknown_kind(kind) or f"interface {kind!r} cannot be loaded: {error}"


def unknown_kind(kind: str) -> str | None:
    """Return why no bus of this kind can be opened here, or None."""
    if kind == "slcan" or kind in can.VALID_INTERFACES:
        return None
    return unknown_name("CAN interface", kind, sorted({*can.VALID_INTERFACES, "slcan"}))


def _shut(making: asyncio.Future[can.BusABC]) -> None:
    """Close a bus that was opened for nobody any more."""
    if not making.cancelled() and making.exception() is None:
        making.result().shutdown()


class _Pump:
    """A thread that reads a bus without descriptor and hands batches to the loop."""

    def __init__(
        self,
        bus: can.BusABC,
        convert: Callable[[can.Message], CanFrame],
        deliver: Callable[[int, list[CanFrame]], None],
        failed: Callable[[Exception], None],
    ) -> None:
        self._bus, self._convert, self._deliver, self._failed = bus, convert, deliver, failed
        self._loop = asyncio.get_running_loop()
        self._room = threading.Semaphore(_WAITING)  # a stalled loop leaves frames to the backend
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="can pump", daemon=True)
        self._thread.start()

    async def stop(self) -> None:
        """End the thread; takes about 0.1 s at most."""
        self._stopped.set()
        await asyncio.to_thread(self._thread.join)

    def _run(self) -> None:
        try:
            while not self._stopped.is_set():
                message = self._bus.recv(_PUMP_S)
                if message is not None:
                    self._hand_on(message)
        except Exception as error:  # noqa: BLE001 - handed to whoever awaits the bus
            if not self._stopped.is_set():
                self._call(self._failed, error)

    def _hand_on(self, message: can.Message | None) -> None:
        frames: list[CanFrame] = []
        while message is not None:
            if not message.is_fd:
                frames.append(self._convert(message))
            message = self._bus.recv(0) if len(frames) < _BATCH else None
        now = time.monotonic_ns()
        while not self._room.acquire(timeout=_PUMP_S):
            if self._stopped.is_set():
                return
        self._call(self._took, now, frames)

    def _took(self, now: int, frames: list[CanFrame]) -> None:
        self._room.release()
        if not self._stopped.is_set():
            self._deliver(now, frames)

    def _call(self, function: Callable[..., None], *arguments: object) -> None:
        with suppress(RuntimeError):  # the loop is closed: nobody listens any more
            self._loop.call_soon_threadsafe(function, *arguments)
