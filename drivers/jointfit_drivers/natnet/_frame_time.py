"""Clock of the frame stamps, and the timecode of frames.

Invariant: the module is pure. The result depends only on the frames passed in.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.model import DeviceEvent, TickClock
from jointfit_daemon.units import NS_PER_S
from jointfit_protocols.natnet import DECIDING, PrecisionTime, timecode_of

if TYPE_CHECKING:
    from jointfit_daemon.model import Decoded
    from jointfit_drivers.natnet._settings import NatNetSettings
    from jointfit_protocols.natnet import FrameOfData

_UNIX = TickClock(1, None, None, "unix")


class FrameTime:
    """Reads precision timestamps if rig.toml selects them, and reports timecodes.

    Parameters
    ----------
    settings : NatNetSettings
        The ``[mocap]`` table, which selects the clock.
    """

    def __init__(self, settings: NatNetSettings) -> None:
        self._precise = None if settings.time == "server" else PrecisionTime()
        self._ahead_ns = settings.tai_minus_utc_s * NS_PER_S if settings.time == "ptp" else 0
        self._coded = False

    @property
    def precise(self) -> bool:
        """Whether PTP time stamps of the frames are used and the server's counter is ignored."""
        return self._precise is not None

    @property
    def tick_clock(self) -> TickClock | None:
        """Clock of UNIX time in ns; None until the format of the time in the frames is known."""
        return _UNIX if self._precise is not None and self._precise.decided else None

    def unix_ns(self, frame: FrameOfData, out: list[Decoded]) -> int | None:
        """Return the UNIX time of a frame; None, with one warning, if frames have no timestamp."""
        precise = self._precise
        if precise is None:
            return None

        found = precise.ns(frame.precision)

        if precise.absent == DECIDING:
            text = (
                "frames have no precision timestamp: switch PTP on at the cameras and stream "
                'bitstream 4.1 or newer, or set time = "server"'
            )
            out.append(DeviceEvent("warning", text))
        return None if found is None else found - self._ahead_ns

    def report_timecode(self, frame: FrameOfData, out: list[Decoded]) -> None:
        """Report the first timecode, and each change between frames with and without timecode."""
        code = timecode_of(frame)
        if (code is not None) == self._coded:
            return

        self._coded = code is not None
        text = "timecode lost" if code is None else f"timecode {code.text}"
        data = {
            "timecode": None if code is None else code.text,
            "timecode_frame": None if code is None else frame.number,
        }
        out.append(DeviceEvent("info", text, data))
