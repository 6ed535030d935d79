"""A CAN bus of any type that python-can supports.

A thread reads the buses that have no file descriptor. Frames of SocketCAN get the kernel's stamp,
and other frames get the time of the read.

Invariant: no exception of python-can leaves this module. A fault that may end without a change of
the settings raises `DeviceLostError`. Any other fault raises `DeviceMisconfiguredError`.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import socket
import struct
import threading
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import can
from can.typechecking import CanFilter

from jointfit_daemon.driver import (
    CanBusError,
    DeviceAbsentError,
    DeviceLostError,
    DeviceMisconfiguredError,
)
from jointfit_drivers.ports._bus_faults import bus_faults, cannot_load
from jointfit_drivers.ports._bus_opening import open_in_thread, require_socketcand
from jointfit_drivers.ports._kernel_stamps import KernelStamps
from jointfit_protocols.can import EXTENDED_MAX, STANDARD_MAX, CanFrame, host_dropped

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from jointfit_daemon.driver import CanBusSettings

log = logging.getLogger(__name__)
# python-can logs each failed opening, which happens once a second for an absent interface. This
# module raises the error instead.
logging.getLogger("can.interfaces.socketcan").setLevel(logging.CRITICAL)
# python-can also logs a bus whose opening failed halfway. `_opening_error` reports the cause.
logging.getLogger("can.bus").setLevel(logging.ERROR)
# The socketcand client logs every byte that it cannot use, and every attempt to connect.
logging.getLogger("can.interfaces.socketcand").setLevel(logging.CRITICAL)

_BATCH = 64
"""Largest number of frames per wake-up, so that a flood on one bus does not delay other buses."""
_WAITING = 64
"""Largest number of batches by which a reading thread may be ahead of the event loop."""
_PUMP_S = 0.05
"""Longest receive call of a reading thread, s. It limits the time to close the bus."""
_RECEIVE_BYTES = 1 << 20
"""Size of the receive buffer, bytes, for about 1400 frames. The default of 212 992 bytes holds 278
frames."""
_DROPS_EVERY_NS = 250_000_000
"""Interval between two readings of the kernel's drop counter, ns."""
_SO_RCVBUFFORCE, _SO_MEMINFO = 33, 55
_MEMINFO = struct.Struct("9I")
_DROPS = 8
"""Index of the drop counter in SO_MEMINFO."""


class PythonCanBus:
    """One bus for `can_bus.SharedBus`.

    Parameters
    ----------
    settings : CanBusSettings
        Table ``[can.NAME]`` of rig.toml. Keys that `CanBusSettings` does not define are passed to
        python-can unchanged.
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
        """Open the bus and start reading.

        Raises
        ------
        DeviceLostError
            The interface is absent or in use.
        DeviceMisconfiguredError
            The type of interface is unknown, a package is missing, or the kernel does not support
            CAN.
        """
        bus = await self._open_bus()
        self._bus = bus
        try:
            self._fd = bus.fileno()
        except NotImplementedError:  # no descriptor: virtual buses and most vendor libraries
            self._pump = _Pump(
                bus, self._convert_frame, deliver, lambda e: failed(self._receive_error(e))
            )
            return

        if self._kernel:  # a full receive buffer drops frames without notice
            sock = _socket(bus)
            try:
                sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _RECEIVE_BYTES)
            except OSError:  # without privileges, net.core.rmem_max is the limit
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BYTES)

        loop, fd = asyncio.get_running_loop(), self._fd

        def readable() -> None:
            try:
                self._drain(bus, deliver)
            except Exception as error:  # noqa: BLE001 - a loop callback's error would only be logged
                loop.remove_reader(fd)  # one report is enough; a further read would block
                failed(self._receive_error(error))

        loop.add_reader(fd, readable)

    def listen(self, ids: Collection[tuple[int, bool]] | None) -> None:
        """Filter frames in the kernel, or in python-can if the backend has no filter."""
        if self._bus is None:
            return
        filters: list[CanFilter] | None = None
        if ids is not None:
            filters = [
                CanFilter(
                    can_id=number,
                    can_mask=EXTENDED_MAX if extended else STANDARD_MAX,
                    extended=extended,
                )
                for number, extended in ids
            ]
        # The filter only saves time. `SharedBus` selects the frames in any case.
        with suppress(can.CanError, OSError):
            self._bus.set_filters(filters)

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

    async def _open_bus(self) -> can.BusABC:
        """Open the bus and convert errors. Slow openings run in a thread."""
        settings = self._settings
        try:
            if self._kernel:
                _require_interface(settings.channel)  # otherwise python-can leaks a socket
            if self._kernel or settings.interface == "virtual":
                return self._make()
            name = f"{settings.channel} ({settings.interface})"
            return await open_in_thread(settings.model_dump_json(), name, self._make)
        except (DeviceLostError, DeviceMisconfiguredError):
            raise
        except Exception as error:  # a missing vendor library may raise even NameError
            raise self._opening_error(error) from error

    def _make(self) -> can.BusABC:
        settings = self._settings
        if faults := bus_faults(settings):
            raise can.CanInterfaceNotImplementedError(str(CanBusError(faults)))
        keys: dict[str, Any] = settings.model_dump(exclude={"baud", "transport"})
        if settings.interface == "socketcand":
            require_socketcand(settings.channel, keys["host"], keys["port"])
        return can.Bus(**keys, ignore_config=True)

    def _drain(self, bus: can.BusABC, deliver: Callable[[int, list[CanFrame]], None]) -> None:
        """Read up to 64 frames, and deliver them even if an error follows."""
        frames: list[CanFrame] = []
        self._stamps.pair()
        try:
            for _ in range(_BATCH):
                message = bus.recv(0)
                if message is None:
                    break
                if not message.is_fd:  # no supported device sends CAN FD
                    frames.append(self._convert_frame(message))
        finally:
            now = time.monotonic_ns()  # must follow the reads: see `_convert_frame`
            if self._kernel and now - self._drops_read_ns > _DROPS_EVERY_NS:
                self._drops_read_ns = now
                raw = _socket(bus).getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size)
                before, self._drops = self._drops, _MEMINFO.unpack(raw)[_DROPS]
                if self._drops != before:
                    frames.append(host_dropped(now, (self._drops - before) % 2**32))
            if frames:
                deliver(now, frames)

    def _convert_frame(self, message: can.Message) -> CanFrame:
        """Convert a frame that was just read. It gets the kernel's stamp, or else the current time.

        A time from before the read would be too early for frames that arrived in the meantime. This
        would cause an error, because clocks are fitted to the earliest arrivals.
        """
        data, extended = bytes(message.data[:8]), message.is_extended_id
        t_ns = time.monotonic_ns()
        if self._kernel:
            t_ns = self._stamps.start_ns(message.timestamp, len(data), extended)
        kind = (extended, message.is_error_frame, message.is_remote_frame)
        return CanFrame(t_ns, message.arbitration_id, data, *kind)

    def _opening_error(self, error: Exception) -> DeviceLostError | DeviceMisconfiguredError:
        """Return the error for a bus that cannot be opened, including the remedy."""
        channel, kind = self._settings.channel, self._settings.interface
        if isinstance(error, (NotImplementedError, ImportError)):
            faults = bus_faults(self._settings)
            reason = str(CanBusError(faults)) if faults else cannot_load(kind, error)
            return DeviceMisconfiguredError(f"{channel}: {reason}")
        if isinstance(error, (can.CanError, OSError)):
            return self._error_by_number(error)
        reason = f"{type(error).__name__}: {error}"
        return DeviceMisconfiguredError(
            f"{channel}: cannot be opened as {kind} ({reason}): check its [can] table, and the "
            "vendor's library"
        )

    def _receive_error(self, error: Exception) -> Exception:
        """Return the error for a bus that stopped. Programming errors are returned unchanged."""
        cause = error.__cause__
        if getattr(error, "error_code", None) is None and isinstance(cause, OSError):
            error = cause  # python-can puts its traceback into some messages
        if isinstance(error, (can.CanError, OSError, ValueError)):  # ValueError: a backend's parser
            return self._error_by_number(error)
        return error

    def _error_by_number(self, error: Exception) -> DeviceLostError | DeviceMisconfiguredError:
        """Return the error that corresponds to the kernel's error number."""
        channel = self._settings.channel
        number = getattr(error, "error_code", None) or getattr(error, "errno", None)
        if number == errno.EAFNOSUPPORT:
            return DeviceMisconfiguredError(
                f"{channel}: no CAN in this kernel, or not permitted for this service: load the "
                "modules can and can_raw, copy the drop-in jointfitd-can.conf of the service, or "
                'use an adapter with interface = "slcan"'
            )

        if number in {errno.ENODEV, errno.ENXIO}:
            return DeviceAbsentError(
                f"{channel}: no such CAN interface: plug it in, or correct `channel` (`ip link` "
                "lists them)"
            )

        if number == errno.ENETDOWN:
            return DeviceLostError(
                f"{channel}: the interface is down: `ip link set {channel} up type can bitrate "
                f"{self._settings.bitrate}`"
            )
        found = os.strerror(number) if isinstance(number, int) and number > 0 else str(error)
        hint = "plug it in" if number == errno.ENOENT else "check the adapter and its cable"
        if self._settings.interface == "socketcand":
            hint = "check the server and the network"
        return DeviceLostError(
            f"{channel} ({self._settings.interface}): {found}: {hint}, or correct `channel`"
        )


def _socket(bus: can.BusABC) -> socket.socket:
    sock: socket.socket = bus.socket  # type: ignore[attr-defined]  # SocketCAN only
    return sock


def _require_server(bus: can.BusABC) -> None:
    """Raise `DeviceLostError` if a socketcand server has closed the connection.

    python-can does not report this: its receive function returns None at once, without an error. It
    also gives no public access to the socket.
    """
    sock: socket.socket | None = getattr(bus, "_SocketCanDaemonBus__socket", None)
    try:
        closed = sock is not None and not sock.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
    except OSError:  # no data; the next read reports other errors
        return
    if closed:
        raise DeviceLostError(
            f"{bus.channel_info}: the server closed the connection: start it again, and check the "
            "network"
        )


def _require_interface(name: str) -> None:
    """Raise the OSError that binding a socket to `name` would raise."""
    socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    try:
        socket.if_nametoindex(name)  # if_nameindex needs netlink, which the systemd unit forbids
    except OSError as error:  # CPython sets no error number here
        raise OSError(errno.ENODEV, "no such interface") from error


class _Pump:
    """A thread that reads a bus without file descriptor, and delivers batches to the event loop."""

    def __init__(
        self,
        bus: can.BusABC,
        convert: Callable[[can.Message], CanFrame],
        deliver: Callable[[int, list[CanFrame]], None],
        failed: Callable[[Exception], None],
    ) -> None:
        self._bus, self._convert, self._deliver, self._failed = bus, convert, deliver, failed
        self._loop = asyncio.get_running_loop()
        # While the event loop is delayed, frames stay in the backend.
        self._room = threading.Semaphore(_WAITING)
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="can pump", daemon=True)
        self._thread.start()

    async def stop(self) -> None:
        """End the thread, which takes at most about 0.1 s."""
        self._stopped.set()
        await asyncio.to_thread(self._thread.join)

    def _run(self) -> None:
        try:
            while not self._stopped.is_set():
                message = self._bus.recv(_PUMP_S)
                if message is None:
                    _require_server(self._bus)
                    continue

                frames: list[CanFrame] = []
                while message is not None:
                    if not message.is_fd:
                        frames.append(self._convert(message))
                    message = self._bus.recv(0) if len(frames) < _BATCH else None
                now = time.monotonic_ns()
                while not self._room.acquire(timeout=_PUMP_S):
                    if self._stopped.is_set():
                        return
                self._call_in_loop(self._accept, now, frames)
        except Exception as error:  # noqa: BLE001 - passed to the task that awaits the bus
            if not self._stopped.is_set():
                self._call_in_loop(self._failed, error)

    def _accept(self, now: int, frames: list[CanFrame]) -> None:
        self._room.release()
        if not self._stopped.is_set():
            self._deliver(now, frames)

    def _call_in_loop(self, function: Callable[..., None], *arguments: object) -> None:
        with suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(function, *arguments)
