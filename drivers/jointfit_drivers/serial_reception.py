"""Reception of the data of a device on a serial port, across all connection attempts."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_drivers.ports.serial_port import SerialPort

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from jointfit_daemon.driver import Emit
    from jointfit_drivers.serial_imu import SerialImuSettings

    Start = Callable[[SerialPort, bool], Awaitable[None]]

_HUNT_EVERY = 10
"""One in this number of connection attempts also searches at other line speeds. Such an attempt
takes longer than the others."""


class SerialReception:
    """Opens the port of a device, starts the device, and reads its data.

    Parameters
    ----------
    settings : SerialImuSettings
        Table of the device in rig.toml.
    """

    def __init__(self, settings: SerialImuSettings) -> None:
        self._settings = settings
        self._attempts = 0

    async def run(self, emit: Emit, start: Start) -> None:
        """Open the port, start the device, and emit its data until cancelled.

        Parameters
        ----------
        emit : callable
            Function that receives every chunk after the start.
        start : callable
            Function that starts the output of the device on the open port. Its second argument
            states whether the function may search for a silent device at other line speeds.
        """
        settings = self._settings
        with SerialPort(settings.port, settings.baud) as port:
            hunt = self._attempts % _HUNT_EVERY == 0
            self._attempts += 1
            await start(port, hunt)
            self._attempts = 0
            await port.pump(emit, settings.lost_after_s)
