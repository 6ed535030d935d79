"""Check of the first messages of a device to which the driver sends no commands."""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import TYPE_CHECKING

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_drivers.ximu3._orientation import is_orientation
from jointfit_protocols.ximu3 import DataKind, XImu3Codec, XImu3Data

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit
    from jointfit_drivers.ports.serial_port import SerialPort
    from jointfit_drivers.ximu3._settings import XImu3Settings

_LISTEN_S = 2.0
"""Longest wait for the first expected message, s. A device at 1 Hz sends two messages in this
time."""


async def ensure_expected_messages(
    port: SerialPort, emit: Emit, settings: XImu3Settings, silence_s: float
) -> None:
    """Emit all bytes, and return at the first message with the expected measurement.

    Raises
    ------
    DeviceLostError
        No byte arrives for `silence_s`.
    DeviceMisconfiguredError
        Bytes arrive, but they contain no messages, or only messages without the expected
        measurement.
    """
    codec, kinds = XImu3Codec(), Counter[str]()
    on_gateway, sends_other = settings.orientation == "gateway", False
    loop = asyncio.get_running_loop()
    until = loop.time() + _LISTEN_S

    while loop.time() < until:
        chunk = await port.receive(silence_s)
        if chunk is None:
            raise DeviceLostError(
                f"{settings.port}: silent for {silence_s:g} s: check power and cable, and `baud`"
            )
        emit(chunk)
        for message in codec.feed(chunk.data):
            if not isinstance(message, XImu3Data):
                continue
            kinds[message.kind] += 1
            inertial, oriented = message.kind == DataKind.INERTIAL, is_orientation(message)
            if inertial if on_gateway else oriented:
                return
            sends_other |= inertial or oriented

    if not kinds:
        raise DeviceMisconfiguredError(
            f"{settings.port}: {codec.fed} bytes at {settings.baud} baud, but no message of "
            "an x-IMU3: correct `baud`, `port` or `driver`"
        )
    if on_gateway:
        needs, other, key = "I (inertial)", "device", "inertial_message_rate_divisor"
    else:
        needs, other = "Q, R or A (orientation)", "gateway"
        key = "ahrs_message_type to 0 and ahrs_message_rate_divisor"
    choice = f'orientation = "{other}", or ' if sends_other else ""
    sent = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))
    raise DeviceMisconfiguredError(
        f"{settings.port}: sends messages {sent}, expected {needs}: set {choice}in the device "
        f"{key} to 400 divided by rate_hz"
    )
