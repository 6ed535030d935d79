"""Which clock a frame is stamped by, and the timecode beside it.

Law: pure; a frame in, ticks out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.model import DeviceEvent, TickClock
from jointfit_protocols.natnet import DECIDING, PrecisionTime, timecode_of

if TYPE_CHECKING:
    from jointfit_daemon.model import Decoded
    from jointfit_drivers.natnet._settings import NatNetSettings
    from jointfit_protocols.natnet import FrameOfData

_NS = 10**9
_UNIX = TickClock(1, None, None, "unix")


class FrameTime:
    """Precision timestamps where rig.toml wants them, and timecodes where there are any.

    Parameters
    ----------
    settings
        Which clock counts.
    """

    def __init__(self, settings: NatNetSettings) -> None:
        self._precise = None if settings.time == "server" else PrecisionTime()
        self._ahead_ns = settings.tai_minus_utc_s * _NS if settings.time == "ptp" else 0
        self._coded = False

    @property
    def precise(self) -> bool:
        """Whether frames are stamped by PTP, and the server's counter means nothing."""
        return self._precise is not None

    @property
    def tick_clock(self) -> TickClock | None:
        """UNIX time in ns, once it is certain how frames tell it."""
        return _UNIX if self._precise is not None and self._precise.decided else None

    def unix_ns(self, frame: FrameOfData, out: list[Decoded]) -> int | None:
        """Return the frame's UNIX time; None where it has none, which is told once."""
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

    def tell_timecode(self, frame: FrameOfData, out: list[Decoded]) -> None:
        """Tell the timecode of the first frame that has one, and when it is gone."""
        code = timecode_of(frame)
        if (code is not None) == self._coded:
            return
        self._coded = code is not None
        text = "no timecode any more" if code is None else f"timecode {code.text}"
        data = {
            "timecode": None if code is None else code.text,
            "timecode_frame": None if code is None else frame.number,
        }
        out.append(DeviceEvent("info", text, data))
