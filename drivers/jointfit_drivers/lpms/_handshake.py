"""Start of an LPMS sensor: the driver makes it stream, or raises an error with the cause.

The driver reads the settings of the sensor and writes only settings that differ from rig.toml. It
then reads them again, because old firmware acknowledges nothing. The sensor stores the settings in
flash only with ``persist``.

Some commands have different meanings in the two generations of sensors. Before the first such
command, the driver sends a query that changes no setting in either generation. The reply shows the
generation.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, NoReturn

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_drivers.lpms._conversation import LpBusConversation
from jointfit_drivers.lpms._decoder import TEXT_REMEDY, is_text
from jointfit_drivers.silence import find_other_speed
from jointfit_protocols.lpms.configuration import (
    TABLES,
    LpmsCommand,
    LpmsConfiguration,
    decode_configuration,
    identify_generation,
    set_command,
)

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit
    from jointfit_drivers.lpms._settings import LpmsSettings
    from jointfit_drivers.ports.serial_port import SerialPort

log = logging.getLogger(__name__)

LINE_SPEEDS = (115_200, 921_600, 460_800, 230_400, 57_600, 38_400, 19_200, 9_600)
"""Line speeds for the search, bit/s: factory settings and usual speeds first."""
_LISTEN_S = 0.15
"""Longest wait for an answer at each speed, s."""
_QUIET_S = 1.2
"""Silence, s, after which the earlier bytes count as noise. It is longer than one second, because a
device that is not an LPMS sensor may send only once a second."""
_STORE_S = 3.0
"""Longest wait for the acknowledgement of a flash write, s."""
_FIRST_S, _FIRST_PERIODS = 1.0, 5
"""Longest wait for the first data packet: the longer of a time, s, and a number of periods."""


class LpmsHandshake:
    """Makes one sensor stream.

    Parameters
    ----------
    port, emit : SerialPort, Emit
        Open port, and function that receives the sensor's bytes.
    settings : LpmsSettings
        Table of the device in rig.toml.
    hunt : bool
        Whether to search at other speeds if no byte arrived. If bytes arrived that cannot be
        decoded, the other speeds are always searched.
    """

    def __init__(
        self, port: SerialPort, emit: Emit, settings: LpmsSettings, *, hunt: bool = True
    ) -> None:
        self._port = port
        self._settings = settings
        self._table = settings.table
        self._hunt = hunt
        self._conversation = LpBusConversation(port, emit, settings.sensor_id)
        self._path = settings.port

    async def ensure_streaming(self) -> None:
        """Return when the sensor streams with the configured settings.

        Raises
        ------
        DeviceLostError
            The sensor does not answer, was unplugged, or stopped answering.
        DeviceMisconfiguredError
            The speed, generation or address differs from the settings, the device is not an LPMS
            sensor, or it does not accept the settings.
        """
        settings = self._settings
        settings.require_line_speed("the speed of the sensor")

        self._conversation.reset()
        if not await self._conversation.enter_command_mode():
            await self._explain_silence()
        await self._ensure_generation()
        await self._conversation.read(self._table.read_firmware)  # the decoder needs the reply
        await self._ensure_configuration()
        await self._start()

    async def _ensure_generation(self) -> None:
        """Reject a sensor of the generation that is not configured.

        A later command could erase the settings of this sensor.
        """
        reply = await self._conversation.read(LpmsCommand.IDENTIFY)
        found = None if reply is None else identify_generation(reply)
        if found is None:
            log.warning(
                "%s: the sensor does not report its generation; using generation = %d",
                self._settings.id,
                self._table.generation,
            )
        elif found != self._table.generation:
            raise DeviceMisconfiguredError(
                f"{self._path}: the sensor has generation {found} ({TABLES[found].models}), "
                f"expected generation {self._table.generation}: set generation = {found}. Nothing "
                "was written: the commands of one generation erase settings of the other"
            )

    async def _ensure_configuration(self) -> None:
        """Set outputs, rate and precision if they differ from the settings."""
        settings = self._settings
        wanted = LpmsConfiguration(
            self._table.quaternion, int(settings.rate_hz), settings.precision == "float32"
        )

        part = _differing(await self._read_configuration(), wanted)
        if part == LpmsConfiguration():
            return
        log.info("%s: setting %s", settings.id, self._describe(part))
        for command, data in set_command(self._table, part):
            if await self._conversation.write(command, data) is False:
                raise DeviceMisconfiguredError(
                    f"{self._path}: the sensor refuses {self._describe(part)} (command "
                    f"0x{command:02X}): change `rate_hz` or `precision`, or update the firmware"
                )

        left = _differing(await self._read_configuration(), wanted)
        if left.outputs is not None or left.rate_hz is not None:
            raise DeviceMisconfiguredError(
                f"{self._path}: the sensor does not accept {self._describe(left)}: change "
                "`rate_hz`, or update the firmware"
            )
        if settings.persist:
            log.warning("%s: storing the settings in the flash of the sensor", settings.id)
            await self._conversation.write(self._table.store, wait_s=_STORE_S)

    async def _read_configuration(self) -> LpmsConfiguration:
        """Return the settings of the sensor. The precision is None if it cannot be read."""
        found = LpmsConfiguration()
        for command in self._table.reads:
            data = await self._conversation.read(command)
            part = None if data is None else decode_configuration(self._table, command, data)
            if part is not None:
                found = found.merge(part)
        if found.outputs is None or found.rate_hz is None:
            raise DeviceLostError(
                f"{self._path}: the sensor does not answer the read commands of generation "
                f"{self._table.generation}: check `generation` and the wire from host to sensor"
            )
        return found

    def _describe(self, part: LpmsConfiguration) -> str:
        """Return the known settings in `part` as text."""
        texts = []
        if part.outputs is not None:
            texts.append(f"outputs {' + '.join(self._table.names(part.outputs))}")
        if part.rate_hz is not None:
            texts.append(f"{part.rate_hz} Hz")
        if part.floats is not None:
            texts.append("float32" if part.floats else "int16")
        return ", ".join(texts)

    async def _start(self) -> None:
        """Start the stream and wait for its first data packet."""
        started = await self._conversation.start_stream()
        if started is None:
            raise self._settings.stopped_answering()
        if not started:
            raise DeviceMisconfiguredError(
                f"{self._path}: the sensor refuses to stream: change `rate_hz` or `baud`"
            )
        self._conversation.last_bytes = b""
        wait_s = max(_FIRST_S, _FIRST_PERIODS / self._settings.rate_hz)
        if await self._conversation.wait_for_data(wait_s):
            return
        if is_text(self._conversation.last_bytes):
            raise DeviceMisconfiguredError(f"{self._path}: the sensor sends text: {TEXT_REMEDY}")
        raise DeviceLostError(
            f"{self._path}: the sensor accepts the settings but sends no data: check the sensor "
            "with LpmsControl"
        )

    async def _explain_silence(self) -> NoReturn:
        """Raise the error for a device that does not enter command mode."""
        conversation, settings = self._conversation, self._settings
        others = sorted(conversation.ids - {settings.sensor_id})
        if others:
            raise DeviceMisconfiguredError(
                f"{self._path}: the sensor has sensor id {others[0]}, expected "
                f"{settings.sensor_id}: set sensor_id = {others[0]}"
            )
        if conversation.ids:
            raise DeviceLostError(
                f"{self._path}: the sensor streams but does not answer: check the wire from host "
                "to sensor"
            )
        received, sends_text = conversation.received, is_text(conversation.last_bytes)

        speed = await self._other_speed() if self._hunt or received else None
        if speed is not None:
            raise DeviceMisconfiguredError(
                f"{self._path}: {settings.baud} baud, but no message can be decoded; the sensor "
                f"answers at {speed}: set baud = {speed}"
            )
        if not received:
            raise DeviceLostError(
                f"{self._path}: the sensor is silent: check its power, and that TX and RX are not "
                "swapped. A sensor of generation 1 that was put to sleep needs a power cycle"
            )
        if sends_text:
            raise DeviceMisconfiguredError(
                f"{self._path}: the device sends text: correct `port` or `driver`, or, if it is an "
                f"LPMS sensor, {TEXT_REMEDY}"
            )

        self._port.set_baud(settings.baud)
        conversation.reset()
        await conversation.wait_for_data(_QUIET_S)
        if not conversation.received:
            raise DeviceLostError(
                f"{self._path}: some bytes of noise, then silence: check its power and cable, and "
                "`port`"
            )
        raise DeviceMisconfiguredError(
            f"{self._path}: the device on this port is not LPMS: it sends bytes, but no LP-BUS "
            "message at any common speed: correct `port` or `driver`; `jointfit probe` recognizes "
            "the device on a port"
        )

    async def _other_speed(self) -> int | None:
        """Return the speed, bit/s, at which the sensor answers; None if no speed is found.

        A sensor that answered continues to stream.
        """

        async def answers() -> bool:
            entered = await self._conversation.enter_command_mode(tries=1, wait_s=_LISTEN_S)
            if entered:
                await self._conversation.start_stream()
            return entered

        return await find_other_speed(
            self._port, self._conversation, LINE_SPEEDS, self._settings.baud, answers
        )


def _differing(found: LpmsConfiguration, wanted: LpmsConfiguration) -> LpmsConfiguration:
    """Return the settings of `wanted` that differ in `found` or are unknown in `found`."""
    return LpmsConfiguration(
        wanted.outputs if found.outputs != wanted.outputs else None,
        wanted.rate_hz if found.rate_hz != wanted.rate_hz else None,
        wanted.floats if found.floats != wanted.floats else None,
    )
