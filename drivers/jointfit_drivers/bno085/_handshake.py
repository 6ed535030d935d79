"""Start of a BNO085: the driver requests the required reports, or raises an error with the cause.

In the mode UART-RVC, the device sends without a request and ignores the host. In the mode
UART-SHTP, it is silent after a reset. The driver reads the settings of the reports, and changes
only settings that differ from rig.toml. The device loses these settings at the next reset, because
the driver does not store them in the device.

Source: BNO08X data sheet 1000-3927, section 1.3.1. Bytes to the device must be separated by 100 us.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, NoReturn

from typing_extensions import override

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_drivers.bno085._settings import RVC_BAUD, SHTP_BAUD
from jointfit_drivers.serial_conversation import SerialConversation
from jointfit_protocols.bno085 import (
    RvcCodec,
    RvcFrame,
    ShtpBufferStatus,
    ShtpChannel,
    ShtpCodec,
    ShtpPacket,
    decode_firmware,
    decode_interval,
    encode_feature,
    encode_shtp,
    encode_status,
    feature_request,
    product_request,
    split_reports,
)

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit
    from jointfit_daemon.model import Chunk
    from jointfit_drivers.bno085._settings import Bno085Settings
    from jointfit_drivers.ports.serial_port import SerialPort

_LISTEN_S = 0.5
"""Longest wait for a UART-RVC frame, s. The device sends fifty frames in this time."""
_REPLY_S = 0.5
"""Longest wait for a reply, s."""
_BYTE_PAUSE_S = 0.0002
"""Pause between two bytes to the device, s."""
_RATE_TOLERANCE = 0.1
"""Largest relative difference between the required interval and the interval of the device."""


class ShtpConversation(SerialConversation[ShtpPacket | ShtpBufferStatus]):
    """Requests to one device in UART-SHTP, and the device's replies."""

    def __init__(self, port: SerialPort, emit: Emit) -> None:
        super().__init__(port, emit, ShtpCodec)
        self._sequence = 0

    @override
    async def send(self, request: bytes) -> None:
        """Send a request, one byte at a time."""
        for byte in request:
            await super().send(bytes((byte,)))
            await asyncio.sleep(_BYTE_PAUSE_S)

    async def control(self, data: bytes, *, tries: int) -> bytes | None:
        """Send a request on the control channel, and return its reply; None if no reply arrives.

        The reply to a request for the product id is the product id. The reply to a request for a
        report is the settings of the report.
        """
        wire = encode_shtp(ShtpChannel.CONTROL, self._sequence, data)
        self._sequence += 1
        reply = await self.ask(
            encode_status(None) + wire,
            lambda message: _reply_to(data, message) is not None,
            tries=tries,
            wait_s=_REPLY_S,
        )
        return None if reply is None else _reply_to(data, reply)


def _reply_to(request: bytes, message: ShtpPacket | ShtpBufferStatus) -> bytes | None:
    """Return the report in `message` that answers `request`; None if no report does."""
    if not isinstance(message, ShtpPacket) or message.channel != ShtpChannel.CONTROL:
        return None
    for report in split_reports(message.payload) or ():
        if request == product_request():
            if decode_firmware(report) is not None:
                return report
        else:
            found = decode_interval(report)
            if found is not None and found[0] == request[1]:
                return report
    return None


async def ensure_rvc(port: SerialPort, emit: Emit, settings: Bno085Settings) -> None:
    """Return when UART-RVC frames arrive.

    Raises
    ------
    DeviceLostError
        No bytes arrive.
    DeviceMisconfiguredError
        The received bytes are not UART-RVC frames.
    """
    conversation = SerialConversation[RvcFrame](port, emit, RvcCodec)
    conversation.reset()
    if await conversation.receive(lambda _: True, _LISTEN_S) is not None:
        return
    if not conversation.received:
        raise DeviceLostError(
            f"{settings.port}: no data: check the device's power, and that PS0 is high and PS1 is "
            f"low (UART-RVC); for UART-SHTP set baud = {SHTP_BAUD}"
        )
    raise DeviceMisconfiguredError(
        f"{settings.port}: {conversation.received} bytes at {RVC_BAUD} baud, but no UART-RVC "
        f"frame: correct `port` or `driver`; for UART-SHTP set baud = {SHTP_BAUD}"
    )


async def ensure_shtp(port: SerialPort, emit: Emit, settings: Bno085Settings) -> None:
    """Return when the device is configured to send the required reports.

    Raises
    ------
    DeviceLostError
        The device does not answer, or has stopped answering.
    DeviceMisconfiguredError
        The device is not a BNO085, is in another mode, or does not accept the rate.
    """
    held: list[Chunk] = []  # received during the configuration; emitted at the end
    conversation = ShtpConversation(port, held.append)
    conversation.reset()
    if await conversation.control(product_request(), tries=3) is None:
        await _explain_silence(port, conversation, settings)

    interval_us = round(1e6 / settings.rate_hz)
    for report in settings.reports:
        found = await _interval(conversation, feature_request(report), settings)
        if abs(found - interval_us) > _RATE_TOLERANCE * interval_us:
            request = encode_feature(report, interval_us)
            found = await _interval(conversation, request, settings)
        if abs(found - interval_us) > _RATE_TOLERANCE * interval_us:
            sent = f"{1e6 / found:.0f} Hz" if found else "off"
            raise DeviceMisconfiguredError(
                f"{settings.port}: report 0x{report:02X} is {sent}, not {settings.rate_hz:g} Hz: "
                "change `rate_hz` or `report`"
            )
    for chunk in held:
        emit(chunk)


async def _interval(
    conversation: ShtpConversation, request: bytes, settings: Bno085Settings
) -> int:
    """Send a request; return the report's interval, us, from the reply; 0 if the report is off."""
    reply = await conversation.control(request, tries=3)
    found = None if reply is None else decode_interval(reply)
    if found is None:
        raise settings.stopped_answering()
    return found[1]


async def _explain_silence(
    port: SerialPort, conversation: ShtpConversation, settings: Bno085Settings
) -> NoReturn:
    """Raise the error that explains why the device does not answer."""
    if conversation.understood:
        raise DeviceLostError(
            f"{settings.port}: the device sends, but does not answer: check the wire from host to "
            "device"
        )

    received = conversation.received
    port.set_baud(RVC_BAUD)
    rvc = SerialConversation[RvcFrame](port, lambda _: None, RvcCodec)
    rvc.reset()
    if await rvc.receive(lambda _: True, _LISTEN_S) is not None:
        raise DeviceMisconfiguredError(
            f"{settings.port}: the device sends UART-RVC: set baud = {RVC_BAUD}, or select "
            "UART-SHTP with PS1 high and PS0 low"
        )

    if received or rvc.received:
        raise DeviceMisconfiguredError(
            f"{settings.port}: {received} bytes at {SHTP_BAUD} baud without an SHTP packet, and "
            f"{rvc.received} bytes at {RVC_BAUD} baud without a UART-RVC frame: correct `port` or "
            "`driver`; `jointfit probe` recognizes the device on a port"
        )
    raise DeviceLostError(
        f"{settings.port}: the device is silent: check its power, that PS1 is high and PS0 is low "
        "(UART-SHTP), and that TX and RX are not swapped"
    )
