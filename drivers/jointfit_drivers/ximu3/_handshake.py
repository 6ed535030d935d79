"""Start of an x-IMU3: the driver checks the required settings, or raises an error with the cause.

The driver reads the settings of the device. It changes a setting only if the setting differs and
``persist`` permits the change. Every change is permanent, because the device saves its settings
when it is switched off. A fault that may end without a change of the settings raises
`DeviceLostError`. All other faults raise `DeviceMisconfiguredError`.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, NoReturn

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_drivers.silence import find_other_speed
from jointfit_drivers.ximu3._conversation import XImu3Conversation
from jointfit_drivers.ximu3._required_settings import (
    REPORTED,
    WORLD,
    differences,
    rate_hint,
    required_settings,
)

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit
    from jointfit_drivers.ports.serial_port import SerialPort
    from jointfit_drivers.ximu3._settings import XImu3Settings

log = logging.getLogger(__name__)

LINE_SPEEDS = (115_200, 921_600, 460_800, 230_400, 1_000_000, 2_000_000, 57_600, 38_400, 9_600)
"""Line speeds for the search, bit/s: factory setting first."""
_LISTEN_S = 0.2
"""Longest wait for a reply at each speed of the search, s."""
_INTERFACES = {"USB": "usb", "Serial": "uart"}
"""Transport in rig.toml for each name of an interface in the reply to a ping."""
_WORLDS = (0, 1, 2)


class XImu3Handshake:
    """Checks one device, and configures it if this is permitted.

    Parameters
    ----------
    port, emit : SerialPort, Emit
        Open port, and function that receives the device's bytes.
    settings : XImu3Settings
        Table of the device in rig.toml.
    hunt : bool
        Whether to search for a silent device at other speeds. If the device's bytes cannot be
        decoded, the other speeds are always searched.
    """

    def __init__(
        self, port: SerialPort, emit: Emit, settings: XImu3Settings, *, hunt: bool = True
    ) -> None:
        self._port = port
        self._settings = settings
        self._hunt = hunt
        self._conversation = XImu3Conversation(port, emit)
        self._path = settings.port
        self._required = required_settings(settings)

    async def ensure_configured(self) -> None:
        """Return when the device sends the required measurements.

        Raises
        ------
        DeviceLostError
            The device does not answer, was unplugged, or stopped answering.
        DeviceMisconfiguredError
            The device uses another speed or is not an x-IMU3. Or its settings differ and must not
            be written.
        """
        settings = self._settings
        settings.require_line_speed("serial_baud_rate of the device")

        # Bytes are emitted from the first reply on. The decoder must know the world before it
        # receives the first orientation.
        self._conversation.reset()
        world = await self._conversation.request(WORLD)
        ping = None if world is None else await self._conversation.request("ping")
        if ping is None:
            await self._explain_silence()
        interface = ping.value.get("interface") if isinstance(ping.value, dict) else None
        transport = _INTERFACES.get(str(interface))
        if transport not in {None, settings.transport}:
            raise DeviceMisconfiguredError(
                f"{self._path}: the device answers on its interface {interface}, expected "
                f'transport "{settings.transport}": set transport = "{transport}"'
            )

        found = await self._read([*REPORTED, *(key for key, _ in self._required)])
        if found.get(WORLD) not in _WORLDS:
            raise DeviceMisconfiguredError(
                f"{self._path}: {WORLD} is {found.get(WORLD)}, expected 0 (NWU), 1 (ENU) or 2 "
                "(NED): correct it with the x-IMU3 GUI, or update this program"
            )
        await self._ensure_settings(found)

    async def _read(self, keys: list[str]) -> dict[str, object]:
        """Return the values of settings; settings that the device refuses are missing."""
        found: dict[str, object] = {}
        refused = []
        for key in dict.fromkeys(keys):
            reply = await self._conversation.request(key)
            if reply is None:
                raise self._settings.stopped_answering()
            if reply.error is not None:
                refused.append(f"{key} ({reply.error})")
            else:
                found[key] = reply.value
        needed = [text for text in refused if text.partition(" ")[0] not in REPORTED[:2]]
        if needed:
            firmware = found.get("firmware_version", "unknown")
            raise DeviceMisconfiguredError(
                f"{self._path}: firmware {firmware} does not have {', '.join(needed)}: "
                "install another firmware with the x-IMU3 GUI, or set passive = true"
            )
        return found

    async def _ensure_settings(self, found: dict[str, object]) -> None:
        """Compare the settings, and write those that differ if this is permitted."""
        faults = differences(found, self._required)
        if not faults:
            return
        text = "; ".join(faults.values())
        if not self._settings.persist:
            raise DeviceMisconfiguredError(
                f"{self._path}: {text}{rate_hint(found, self._required)}: set persist = true once "
                "to write the settings into the device, or change them with the x-IMU3 GUI"
            )
        log.warning("%s: writing its settings: %s", self._settings.id, text)

        for key, values in self._required:
            if key in faults:
                reply = await self._conversation.request(key, values[0])
                if reply is not None and reply.error is not None:
                    raise DeviceMisconfiguredError(
                        f"{self._path}: refuses {key} = {values[0]} ({reply.error}): correct "
                        "rig.toml, or update the firmware of the device"
                    )
        await self._conversation.request("apply")

        left = differences(
            await self._read(list(faults)),
            tuple(one for one in self._required if one.key in faults),
        )
        if left:
            raise DeviceMisconfiguredError(
                f"{self._path}: does not accept its settings: {'; '.join(left.values())}: correct "
                "rig.toml, or update the firmware of the device"
            )
        await self._conversation.request("save")

    async def _explain_silence(self) -> NoReturn:
        """Raise the error for a device that does not answer a ping."""
        conversation, received = self._conversation, self._conversation.received
        if conversation.understood:
            raise DeviceLostError(
                f"{self._path}: sends measurements but does not answer commands: check the wire "
                "from host to device, or set passive = true for a device that only sends"
            )

        speed = await self._other_speed() if self._hunt or received else None
        if speed is not None:
            raise DeviceMisconfiguredError(
                f"{self._path}: {self._settings.baud} baud, but no message can be decoded; the "
                f"device answers at {speed}: set baud = {speed}"
            )
        if not received:
            raise DeviceLostError(
                f"{self._path}: silent: check its power, and that TX and RX are not swapped. The "
                "serial interface of a new x-IMU3 is disabled: set serial_mode = 1 over USB once"
            )
        raise DeviceMisconfiguredError(
            f"{self._path}: the device on this port is not an x-IMU3: it sends bytes, but none of "
            "its messages at a common speed: correct `port` or `driver`; `jointfit probe` "
            "recognizes the device on a port"
        )

    async def _other_speed(self) -> int | None:
        """Return the speed at which the device answers or sends messages; None if there is none."""

        async def answers() -> bool:
            reply = await self._conversation.request("ping", tries=1, wait_s=_LISTEN_S)
            return reply is not None

        return await find_other_speed(
            self._port, self._conversation, LINE_SPEEDS, self._settings.baud, answers
        )
