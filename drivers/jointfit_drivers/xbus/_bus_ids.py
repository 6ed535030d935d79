"""Selection of one device on a line with several devices.

Devices on one line differ in the bus id of their messages. The devices are attached to different
body segments, so only the orientations of one device may be used.

Invariant: the result depends only on the bus ids fed.
"""

from __future__ import annotations

from jointfit_daemon.model import DeviceEvent

_MOST_OTHERS = 64
"""Number of consecutive messages of other devices after which the selected device counts as absent.
No line has that many devices."""
_SIGHTINGS = 10
"""Number of messages of other devices after which an event reports these devices. The checksum may
accept single corrupt messages."""


class BusIdSelection:
    """Selects the device whose measurements are used.

    Parameters
    ----------
    bus_id : int, optional
        Configured device; None: the first device that sends.
    """

    def __init__(self, bus_id: int | None = None) -> None:
        self._configured = self._selected = bus_id
        self._others = self._sightings = 0

    def admits(self, bus_id: int) -> bool:
        """Return whether a measurement with `bus_id` belongs to the selected device."""
        if bus_id == self._selected:
            self._others = 0
            return True
        if self._configured is not None:
            return False
        self._others += 1
        if self._selected is None or self._others > _MOST_OTHERS:
            self._selected, self._others = bus_id, 0
            return True
        return False

    def report(self, bus_id: int) -> list[DeviceEvent]:
        """Return, once, an event about measurements whose `bus_id` is not the selected one."""
        self._sightings += 1
        if self._sightings != _SIGHTINGS or self._selected is None:
            return []
        if self._configured is not None:
            text = f"measurements with bus id {bus_id} arrive; only bus id {self._selected} is used"
            return [DeviceEvent("info", text, {"bus_id": bus_id})]
        text = (
            f"measurements with bus id {bus_id} arrive, too: several devices send on this line. "
            f"Only measurements of bus id {self._selected} are used. Connect each device to a port "
            "of its own, without an Xbus master. In a capture, select the device with `bus_id`"
        )
        return [DeviceEvent("warning", text, {"bus_ids": sorted((self._selected, bus_id))})]
