"""Start of a MIP device: the driver makes it stream, or raises an error with the cause.

The driver reads the settings of the device, and writes only settings that differ from rig.toml.
Written settings are volatile: without ``persist``, the device returns to its stored settings at the
next power-up.

A fault that may end without a change of the settings raises `DeviceLostError`. All other faults
raise `DeviceMisconfiguredError`. If this error is raised during the configuration, the driver
requests the device to resume its stream. Settings that were already written keep their new values
until the next power-up.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from jointfit_daemon.driver import DeviceMisconfiguredError
from jointfit_drivers.mip._conversation import MipConversation, MipReply
from jointfit_drivers.silence import explain_silence
from jointfit_protocols.mip import commands
from jointfit_protocols.mip.commands import (
    Base,
    CommandSet,
    FilterSetup,
    FormatEntry,
    Function,
    Setup,
)
from jointfit_protocols.mip.data import DataSet

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit
    from jointfit_drivers.mip._settings import MipSettings
    from jointfit_drivers.ports.serial_port import SerialPort
    from jointfit_protocols.mip.commands import Family, StreamCommands

log = logging.getLogger(__name__)

LINE_SPEEDS = (115_200, 921_600, 460_800, 230_400, 57_600, 38_400, 19_200, 9_600)
"""Line speeds for the search, bit/s: factory setting and usual speeds first."""
_SAVE_S = 3.0
"""Longest wait until settings are saved, s."""
_READ = bytes((Function.READ,))
_FORMAT_OF_ANY_SET = CommandSet.SETUP << 8 | Setup.FORMAT
_LEGACY_SERIES = ("GX3", "GX4", "GX5", "CX5", "CV5", "RQ1", "GQ4")
"""Parts of model names by which legacy models are recognized."""


class MipHandshake:
    """Makes one device stream.

    Parameters
    ----------
    port, emit : SerialPort, Emit
        Open port, and function that receives the device's bytes.
    settings : MipSettings
        Table of the device in rig.toml.
    hunt : bool
        Whether to search at other speeds if no byte arrived. If bytes arrived that cannot be
        decoded, the other speeds are always searched.
    """

    def __init__(
        self, port: SerialPort, emit: Emit, settings: MipSettings, *, hunt: bool = True
    ) -> None:
        self._port = port
        self._settings = settings
        self._hunt = hunt
        self._conversation = MipConversation(port, emit)
        self._path = settings.port
        self._model = "the device"
        self._required = settings.required

    async def ensure_streaming(self) -> None:
        """Return when the device streams with the configured settings.

        Raises
        ------
        DeviceLostError
            The device does not answer, was unplugged, or stopped answering.
        DeviceMisconfiguredError
            The device uses another speed, is not a MIP device, or cannot send the orientation at
            this rate.
        """
        settings = self._settings
        settings.require_line_speed()

        self._conversation.reset()
        if await self._conversation.command(CommandSet.BASE, Base.IDLE) is None:
            await explain_silence(
                self._port,
                self._conversation,
                baud=settings.baud,
                speeds=LINE_SPEEDS,
                hunt=self._hunt,
                family="MIP",
                pause=lambda wait_s: self._once(Base.IDLE, wait_s),
                resume=lambda wait_s: self._once(Base.RESUME, wait_s),
            )

        try:
            await self._configure()
        except DeviceMisconfiguredError:  # resume; settings that were written remain
            await self._conversation.command(CommandSet.BASE, Base.RESUME, tries=1)
            raise
        self._refuse(await self._answer(CommandSet.BASE, Base.RESUME), "refuses to resume")

    async def _configure(self) -> None:
        """Write the settings that differ from rig.toml; the device must be idle."""
        reply = await self._answer(CommandSet.BASE, Base.DEVICE_INFO)
        info = commands.decode_info(reply.data(Base.DEVICE_INFO_REPLY))
        if info is not None and info.model_name:
            self._model = info.model_name

        supported = await self._descriptors()
        family = self._family(supported)
        fields = self._required.with_time(family)
        self._refuse_missing(fields, supported)

        # From the reply, the decoder reports a stored transform. Models that do not support this
        # command refuse it.
        if family == "current":
            await self._answer(CommandSet.SETUP, Setup.TRANSFORM, _READ)
        else:
            await self._answer(CommandSet.FILTER, FilterSetup.ROTATION, _READ)

        stream = commands.stream_commands(family, self._required.data_set)
        wanted = await self._outputs(stream, fields)
        changed = await self._ensure_format(stream, wanted)
        changed |= await self._ensure_stream(stream)
        if changed and self._settings.persist:
            save = bytes((Function.SAVE,))
            saved = await self._conversation.command(
                CommandSet.SETUP, Setup.STARTUP_SETTINGS, save, wait_s=_SAVE_S
            )
            if saved is None:
                raise self._settings.stopped_answering()
            self._refuse(saved, "refuses to save its settings", "persist = false")

    async def _descriptors(self) -> frozenset[int]:
        """Return the commands and fields that the device lists; empty if it lists none."""
        found: frozenset[int] = frozenset()
        for command, reply in (
            (Base.DESCRIPTORS, Base.DESCRIPTORS_REPLY),
            (Base.MORE_DESCRIPTORS, Base.MORE_DESCRIPTORS_REPLY),
        ):
            answer = await self._answer(CommandSet.BASE, command)
            if answer.is_ok:
                found |= commands.decode_descriptors(answer.data(reply))
        return found

    def _family(self, supported: frozenset[int]) -> Family:
        """Return the command family, from the settings, or from the device's commands or model."""
        if self._settings.family != "auto":
            return self._settings.family
        if supported:
            return "current" if _FORMAT_OF_ANY_SET in supported else "legacy"
        return "legacy" if any(name in self._model for name in _LEGACY_SERIES) else "current"

    def _refuse_missing(self, fields: tuple[int, ...], supported: frozenset[int]) -> None:
        """Raise an error if the device lists its fields and a required field is missing."""
        data_set = self._required.data_set
        missing = [field for field in fields if data_set << 8 | field not in supported]
        if not missing or not any(one >> 8 >= DataSet.SENSOR for one in supported):
            return
        names = ", ".join(f"0x{data_set:02X},0x{field:02X}" for field in missing)
        raise DeviceMisconfiguredError(
            f"{self._path}: {self._model} does not measure {names}: set {self._alternatives()}"
        )

    def _alternatives(self) -> str:
        """Return alternative settings, which require other fields, for the error message."""
        settings = self._settings
        if settings.orientation == "gateway":
            return "magnetometer = false" if settings.magnetometer else 'orientation = "device"'
        other = "sensor" if settings.estimator == "filter" else "filter"
        return f'estimator = "{other}" or orientation = "gateway"'

    async def _outputs(
        self, stream: StreamCommands, fields: tuple[int, ...]
    ) -> tuple[FormatEntry, ...]:
        """Return the message format with the required fields at the configured rate."""
        reply = await self._answer(CommandSet.SETUP, stream.base_rate, stream.prefix)
        self._refuse(reply, "does not report its base rate", self._alternatives())
        base_hz = commands.decode_rate(stream.prefix, reply.data(stream.base_rate_reply))
        if not base_hz:
            raise DeviceMisconfiguredError(
                f"{self._path}: {self._model} has no outputs in data set "
                f"0x{self._required.data_set:02X}: set {self._alternatives()}"
            )

        decimation = self._settings.rate_divisor(base_hz, self._model)
        return tuple(FormatEntry(field, decimation) for field in fields)

    async def _ensure_format(self, stream: StreamCommands, wanted: tuple[FormatEntry, ...]) -> bool:
        """Make the device send the fields `wanted`; return whether the format was written.

        If the device sends `wanted` and further fields, the format is not written. A written format
        contains only `wanted`.
        """
        found = await self._format(stream)
        if set(wanted) <= set(found):
            return False
        log.warning(
            "%s: writing the message format of data set 0x%02X: %s instead of %s",
            self._settings.id,
            self._required.data_set,
            _describe(wanted),
            _describe(found),
        )

        data = bytes((Function.WRITE,)) + commands.encode_outputs(stream.prefix, wanted)
        reply = await self._answer(CommandSet.SETUP, stream.format, data)
        self._refuse(
            reply,
            f"refuses the fields {_describe(wanted)}",
            f"`rate_hz`, or {self._alternatives()}",
        )
        left = await self._format(stream)
        if not set(wanted) <= set(left):
            raise DeviceMisconfiguredError(
                f"{self._path}: {self._model} sends {_describe(left)}, expected "
                f"{_describe(wanted)}: correct `rate_hz`, or update the firmware of the device"
            )
        return True

    async def _format(self, stream: StreamCommands) -> tuple[FormatEntry, ...]:
        reply = await self._answer(CommandSet.SETUP, stream.format, _READ + stream.prefix)
        return commands.decode_outputs(stream.prefix, reply.data(stream.format_reply)) or ()

    async def _ensure_stream(self, stream: StreamCommands) -> bool:
        """Switch the stream on if it is off; return whether it was off."""
        selector = bytes((stream.selector,))
        reply = await self._answer(CommandSet.SETUP, Setup.STREAM, _READ + selector)
        if reply.data(Setup.STREAM_REPLY) == selector + b"\x01":
            return False
        log.warning("%s: switching the stream of the device on", self._settings.id)
        data = bytes((Function.WRITE,)) + selector + b"\x01"
        reply = await self._answer(CommandSet.SETUP, Setup.STREAM, data)
        self._refuse(reply, "refuses to stream", self._alternatives())
        return True

    async def _once(self, command: Base, wait_s: float) -> MipReply | None:
        """Send a command once, and return its reply."""
        return await self._conversation.command(CommandSet.BASE, command, tries=1, wait_s=wait_s)

    async def _answer(self, command_set: int, command: int, data: bytes = b"") -> MipReply:
        """Return the reply to a command that the device must answer; the reply may be a refusal."""
        reply = await self._conversation.command(command_set, command, data)
        if reply is None:
            raise self._settings.stopped_answering()
        return reply

    def _refuse(self, reply: MipReply, what: str, change: str = "`family`") -> None:
        if not reply.is_ok:
            raise DeviceMisconfiguredError(
                f"{self._path}: {self._model} {what} ({commands.code_text(reply.code)}): "
                f"set or change {change}"
            )


def _describe(outputs: tuple[FormatEntry, ...]) -> str:
    """Return text that lists fields with their decimations."""
    return ", ".join(f"0x{one.field:02X}/{one.decimation}" for one in outputs) or "nothing"
