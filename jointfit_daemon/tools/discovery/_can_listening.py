"""Reception on one CAN network interface, and the sensors that the drivers recognize.

Invariant: no frame is sent and no setting is changed. Independently of this module, a controller in
normal mode acknowledges every frame on the bus.
"""

from __future__ import annotations

import errno
import os
import select
import socket
import struct
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from jointfit_daemon.files.captures import pack_can_frame
from jointfit_daemon.model import Chunk
from jointfit_daemon.tools.discovery._traffic import (
    DecodedDevice,
    decode_frames,
    used_identifiers,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.tools.discovery._traffic import Layouts

_FRAME = struct.Struct("=IB3x8s")
_EXTENDED_FLAG, _REMOTE_FLAG, _ERROR_FLAG = 1 << 31, 1 << 30, 1 << 29
_STANDARD_MASK, _EXTENDED_MASK = 0x7FF, 0x1FFF_FFFF
_SOL_CAN_RAW, _CAN_RAW_ERR_FILTER = 101, 2
_POLL_S = 0.1
_FAULTS = {
    errno.ENODEV: "no such CAN interface: plug the adapter in, or choose one that `jointfit probe`"
    " lists",
    errno.ENXIO: "no such CAN interface: plug the adapter in, or choose one that `jointfit probe`"
    " lists",
    errno.ENETDOWN: "the interface is down: sudo ip link set {name} up type can bitrate 1000000",
    errno.EAFNOSUPPORT: "no CAN in this kernel: sudo modprobe can_raw",
}


@dataclass(frozen=True, slots=True)
class CanIdentifier:
    """One received CAN identifier."""

    id: int
    extended: bool
    """Whether the identifier has 29 bits."""
    data_bytes: int
    """Number of data bytes of the last received frame."""
    frames: int
    rate_hz: float | None
    """Frame rate, Hz; None if fewer than two frames arrived."""
    driver: str | None = None
    """Driver of the sensor that uses this identifier; None if unknown."""


@dataclass(frozen=True, slots=True)
class CanTraffic:
    """Result of the reception on one interface."""

    interface: str
    fault: str | None
    """Reason why the interface cannot be opened, with a remedy; None if it could be opened."""
    identifiers: tuple[CanIdentifier, ...] = ()
    devices: tuple[DecodedDevice, ...] = ()
    error_frames: int = 0
    """Number of error frames of the controller."""


def listen_can(
    interface: str,
    *,
    listen_s: float = 1.5,
    progress: Callable[[float], None] | None = None,
    layouts: Layouts | None = None,
) -> CanTraffic:
    """Receive on a SocketCAN interface, and decode the frames with the installed drivers.

    Parameters
    ----------
    interface
        Name of the network interface.
    listen_s
        Time to listen, s.
    progress
        Callback that receives the completed share, 0 to 1.
    layouts
        Tables to try in addition to the tables that the drivers propose, by driver.
    """
    try:
        received = _receive(interface, listen_s, progress)
    except OSError as error:
        text = _FAULTS.get(error.errno or 0, error.strerror or str(error))
        return CanTraffic(interface, f"{interface}: {text.format(name=interface)}")

    arrivals: dict[tuple[int, bool], list[tuple[int, int]]] = {}
    chunks = []
    errors = 0
    for t_ns, can_id, data in received:
        extended = bool(can_id & _EXTENDED_FLAG)
        number = can_id & (_EXTENDED_MASK if extended else _STANDARD_MASK)
        if can_id & _ERROR_FLAG:
            errors += 1
            continue
        if not can_id & _REMOTE_FLAG:
            arrivals.setdefault((number, extended), []).append((t_ns, len(data)))
            chunks.append(Chunk(t_ns, pack_can_frame(t_ns, number, data, extended=extended)))

    sizes = {key: found[-1][1] for key, found in arrivals.items()}
    devices = tuple(decode_frames(sizes, chunks, layouts=layouts))
    owners = {key: device.driver for device in devices for key in used_identifiers(device.settings)}
    identifiers = []
    for key, found in sorted(arrivals.items()):
        (first_ns, _), (last_ns, size) = found[0], found[-1]
        rate_hz = (len(found) - 1) * 1e9 / (last_ns - first_ns) if last_ns > first_ns else None
        identifiers.append(CanIdentifier(*key, size, len(found), rate_hz, owners.get(key)))
    return CanTraffic(interface, None, tuple(identifiers), devices, errors)


def _receive(
    interface: str, listen_s: float, progress: Callable[[float], None] | None
) -> list[tuple[int, int, bytes]]:
    """Return arrival time, identifier with flags, and data of every received frame."""
    found = []
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as receiver:
        try:
            socket.if_nametoindex(interface)
        except OSError as error:  # CPython sets no errno for this error
            raise OSError(errno.ENODEV, os.strerror(errno.ENODEV)) from error
        receiver.setsockopt(_SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, _EXTENDED_MASK)
        receiver.bind((interface,))
        began = time.monotonic()
        while (passed := time.monotonic() - began) < listen_s:
            if progress is not None:
                progress(passed / listen_s)
            ready, _, _ = select.select([receiver], [], [], min(listen_s - passed, _POLL_S))
            if ready:
                can_id, size, data = _FRAME.unpack(receiver.recv(_FRAME.size))
                found.append((time.monotonic_ns(), can_id, data[:size]))
    return found
