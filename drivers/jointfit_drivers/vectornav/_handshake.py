"""Start of a VectorNav device: the driver makes it stream, or raises an error with the cause.

The driver reads registers, and writes only registers that differ from rig.toml. Written values are
volatile: without ``persist``, the device returns to its stored values at the next power-up. A fault
that may end without a change of the settings raises `DeviceLostError`. All other faults raise
`DeviceMisconfiguredError`. Before it raises this error, the driver requests the device to resume
its stream. Registers that were already written keep their new values until the next power-up.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from jointfit_daemon.driver import DeviceMisconfiguredError
from jointfit_drivers.serial_conversation import SerialConversation
from jointfit_drivers.silence import explain_silence
from jointfit_protocols.vectornav import (
    TextMessage,
    VectorNavCodec,
    VectorNavMessage,
    encode_text,
    error_text,
)
from jointfit_protocols.vectornav.registers import (
    BOTH_PORTS,
    BinaryOutput,
    Register,
    decode_output,
    encode_output,
)

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit
    from jointfit_drivers.ports.serial_port import SerialPort
    from jointfit_drivers.vectornav._settings import VectorNavSettings

log = logging.getLogger(__name__)

LINE_SPEEDS = (115_200, 921_600, 460_800, 230_400, 128_000, 57_600, 38_400, 19_200, 9_600)
"""Line speeds for the search, bit/s: factory setting and usual speeds first."""
_REPLY_S, _STORE_S = 0.5, 3.0
"""Longest wait for a reply, and until all registers are stored, s."""
_IMU_RATES = {"VN-3": 400}
_IMU_RATE = 800
"""Internal rates of the IMU, Hz: of models whose name contains a key of `_IMU_RATES`, and of all
other models."""


class VectorNavHandshake:
    """Makes one device stream.

    Parameters
    ----------
    port, emit : SerialPort, Emit
        Open port, and function that receives the device's bytes.
    settings : VectorNavSettings
        Table of the device in rig.toml.
    hunt : bool
        Whether to search for a silent device at other speeds. If the device's bytes cannot be
        decoded, the other speeds are always searched.
    """

    def __init__(
        self, port: SerialPort, emit: Emit, settings: VectorNavSettings, *, hunt: bool = True
    ) -> None:
        self._port = port
        self._settings = settings
        self._hunt = hunt
        self._conversation = SerialConversation[VectorNavMessage](port, emit, VectorNavCodec)
        self._path = settings.port
        self._model = "the device"

    async def ensure_streaming(self) -> None:
        """Return when the device streams with the configured settings.

        Raises
        ------
        DeviceLostError
            The device does not answer, was unplugged, or stopped answering.
        DeviceMisconfiguredError
            The device uses another speed, is not a VectorNav device, or cannot send the orientation
            at this rate.
        """
        settings = self._settings
        settings.require_line_speed()

        self._conversation.reset()
        if await self._ask("VNASY,0", tries=3) is None:
            await explain_silence(
                self._port,
                self._conversation,
                baud=settings.baud,
                speeds=LINE_SPEEDS,
                hunt=self._hunt,
                family="VectorNav",
                pause=lambda wait_s: self._ask("VNASY,0", tries=1, wait_s=wait_s),
                resume=lambda wait_s: self._ask("VNASY,1", tries=1, wait_s=wait_s),
            )

        try:
            await self._configure()
        except DeviceMisconfiguredError:  # resume; registers that were written remain
            await self._ask("VNASY,1", tries=1)
            raise
        self._refuse(await self._answer("VNASY,1"), "refuses to stream")

    async def _configure(self) -> None:
        """Write the registers that differ from rig.toml; the device must be paused."""
        model = await self._answer(f"VNRRG,{Register.MODEL}")
        if model.error is None and len(model.values) > 1:
            self._model = model.values[1]
        for register in (Register.SERIAL, Register.FIRMWARE, Register.ROTATION):
            await self._answer(f"VNRRG,{register}")  # the decoder reports the replies

        changed = await self._ensure_output()
        changed |= await self._ensure_no_text()
        if changed and self._settings.persist:
            self._refuse(
                await self._answer("VNWNV", wait_s=_STORE_S),
                "refuses to store its registers",
                "persist = false",
            )

    async def _ensure_output(self) -> bool:
        """Make the device send the required fields; return whether the register was written."""
        register = Register.BINARY_OUTPUT + self._settings.output - 1
        wanted = BinaryOutput(BOTH_PORTS, self._divisor(), self._settings.required)
        found = await self._read_output(register)
        if _is_sufficient(found, wanted):
            return False
        log.warning(
            "%s: writing register %d: %s instead of %s",
            self._settings.id,
            register,
            encode_output(wanted),
            "unknown fields" if found is None else encode_output(found) if found.fields else "none",
        )

        reply = await self._answer(f"VNWRG,{register},{encode_output(wanted)}")
        self._refuse(reply, f"refuses binary output {self._settings.output}")
        left = await self._read_output(register)
        if not _is_sufficient(left, wanted):
            raise DeviceMisconfiguredError(
                f"{self._path}: {self._model} does not accept register {register} = "
                f"{encode_output(wanted)}: correct `rate_hz`, or update the firmware of the device"
            )
        return True

    async def _read_output(self, register: int) -> BinaryOutput | None:
        reply = await self._answer(f"VNRRG,{register}")
        self._refuse(reply, f"has no register {register}", "`output`")
        return decode_output(reply.values[1:])

    async def _ensure_no_text(self) -> bool:
        """Switch off the ASCII output, which takes time on the line; return whether it was on."""
        reply = await self._answer(f"VNRRG,{Register.TEXT_OUTPUT}")
        if reply.error is not None or reply.values[1:2] == ("0",):
            return False
        log.warning("%s: switching its ASCII output off", self._settings.id)
        reply = await self._answer(f"VNWRG,{Register.TEXT_OUTPUT},0")
        self._refuse(reply, "refuses to switch its ASCII output off")
        return True

    def _divisor(self) -> int:
        """Return the divisor for the requested rate."""
        imu_hz = next((hz for name, hz in _IMU_RATES.items() if name in self._model), _IMU_RATE)
        return self._settings.rate_divisor(imu_hz, self._model)

    async def _ask(
        self, request: str, *, tries: int, wait_s: float = _REPLY_S
    ) -> TextMessage | None:
        """Return the reply to a request, or the device's error message; None if neither arrives."""
        command, _, rest = request.partition(",")
        register = int(rest.split(",")[0]) if command in {"VNRRG", "VNWRG"} else None

        def is_reply(message: VectorNavMessage) -> bool:
            if not isinstance(message, TextMessage):
                return False
            same = message.command == command and message.register == register
            return same or message.command == "VNERR"

        found = await self._conversation.ask(
            encode_text(request), is_reply, tries=tries, wait_s=wait_s
        )
        return found if isinstance(found, TextMessage) else None

    async def _answer(self, request: str, *, wait_s: float = _REPLY_S) -> TextMessage:
        """Return the reply to a request that the device must answer; the reply may be an error."""
        reply = await self._ask(request, tries=3, wait_s=wait_s)
        if reply is None:
            raise self._settings.stopped_answering()
        return reply

    def _refuse(self, reply: TextMessage, what: str, change: str = "`rate_hz` or `baud`") -> None:
        if reply.error is not None:
            raise DeviceMisconfiguredError(
                f"{self._path}: {self._model} {what} ({error_text(reply.error)}): "
                f"set or change {change}"
            )


def _is_sufficient(found: BinaryOutput | None, wanted: BinaryOutput) -> bool:
    """Return whether an output has the wanted ports and rate, and contains all wanted fields."""
    if found is None or found[:2] != wanted[:2]:
        return False
    return set(wanted.fields) <= set(found.fields)
