"""Driver of IMUs on a serial port whose messages rig.toml describes.

The driver sends nothing, because a table does not describe how a device is configured. If the
received data contain no message, the table or the speed is wrong. The error then describes the
received bytes.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, ClassVar

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_drivers.ports.serial_port import SerialPort
from jointfit_drivers.serial_table._decoder import SerialTableDecoder, open_codec
from jointfit_drivers.serial_table._findings import explain_bytes
from jointfit_drivers.serial_table._settings import SerialTableSettings

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit, Wire
    from jointfit_daemon.model import Chunk

log = logging.getLogger(__name__)

_UNKNOWN_BYTES = 4096
"""Number of bytes without a message after which the table counts as wrong."""
_UNKNOWN_S = 2.0
"""Time since the first byte after which the table counts as wrong if no message with measurements
has arrived, s."""
_RAW_CHUNKS = 20
"""Number of chunks logged at debug level, so that the log contains raw data of a device."""


class SerialTableImu:
    """One device that sends frames or lines as its table describes."""

    Settings: ClassVar[type[SerialTableSettings]] = SerialTableSettings
    wire: ClassVar[Wire] = "stream"

    def __init__(self, settings: SerialTableSettings) -> None:
        self._settings = settings

    def decoder(self) -> SerialTableDecoder:
        """Return the decoder from chunks to samples, for live data and replay."""
        settings = self._settings
        return SerialTableDecoder(
            settings.wire_format(), settings.sample_form(), settings.line_baud
        )

    async def run(self, emit: Emit) -> None:
        """Open the port and read until cancelled.

        Raises
        ------
        DeviceLostError
            The port is absent, in use, unplugged, or silent for ``lost_after_s``. A retry may
            succeed.
        DeviceMisconfiguredError
            The file is not a serial port, or the received bytes contain no message that the table
            describes.
        """
        settings = self._settings
        with SerialPort(settings.port, settings.baud) as port:
            port.flush_input()
            for chunk in await self._first_message(port):
                emit(chunk)
            await port.pump(emit, settings.lost_after_s)

    async def _first_message(self, port: SerialPort) -> list[Chunk]:
        """Return the chunks up to and including the first message with measurements."""
        wire, silence_s = self._settings.wire_format(), self._settings.lost_after_s
        codec, chunks = open_codec(wire), []
        received = 0
        while codec.messages == codec.skipped:
            chunk = await port.receive(silence_s)
            if chunk is None:
                raise DeviceLostError(
                    f"{port.path}: silent for {silence_s:g} s: check power and cable, and that the "
                    "device sends without a request"
                )
            chunks.append(chunk)
            received += len(chunk.data)
            if len(chunks) <= _RAW_CHUNKS:
                log.debug("%s: %s", self._settings.id, chunk.data.hex(" "))
            codec.feed(chunk.data)

            waited_s = (chunk.t_ns - chunks[0].t_ns) * 1e-9
            unknown = codec.messages == 0 and received >= _UNKNOWN_BYTES
            if codec.messages == codec.skipped and (unknown or waited_s >= _UNKNOWN_S):
                data = b"".join(each.data for each in chunks)
                found = explain_bytes(data, wire)
                raise DeviceMisconfiguredError(
                    f"{port.path}: {received} bytes at {self._settings.baud} baud contain no "
                    f"message that the table describes: {found}"
                )
        return chunks
