"""Simulated program that sends motion capture to the Lab Streaming Layer (LSL) with liblsl.

Invariant: coordinates of an occluded marker or body have the value `LslServerOptions.absent`.
The stamp of a sample is its exposure time on the clock of LSL, plus the clock difference of the
simulated sender.
"""

from __future__ import annotations

import asyncio
import math
import os
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from jointfit_daemon.units import NS_PER_S
from jointfit_simulators.devices._natnet_frames import axes_from_z_up
from jointfit_simulators.devices._natnet_options import same_clock

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_simulators.devices._natnet_frames import Axis, Bodies, Markers

_UNITS = {"m": (1.0, "meters"), "cm": (100.0, "centimeters"), "mm": (1000.0, "millimeters")}
_AXES, _TURN = "XYZ", "ABCD"


@dataclass(frozen=True, slots=True)
class LslServerOptions:
    """Constant properties of a stream."""

    markers: tuple[str, ...] = ()
    bodies: tuple[str, ...] = ()
    stream: str = "Simulated cameras"
    stream_type: str = "MoCap"
    source_id: str = ""
    """Identifier of the source; the default is unique for this process and object."""
    rate_hz: float = 100.0
    """Nominal rate, Hz; 0 is an irregular rate."""
    up_axis: Axis = "y"
    unit: Literal["m", "cm", "mm"] = "m"
    description: Literal["mocap", "labels", "none"] = "mocap"
    """Description of the channels: marker, object, type and unit (``mocap``), only labels
    (``labels``), or no description (``none``)."""
    channel_format: Literal["float32", "double64", "string"] = "double64"
    absent: float = math.nan
    """Value in every channel of an occluded marker or body; the default is NaN."""
    device_ns: Callable[[int], int] = same_clock
    """Conversion from host CLOCK_MONOTONIC to the clock of the stamps, both in ns."""


class LslServer:
    """Simulated sender. Its stream exists from the start.

    Attributes
    ----------
    ready : asyncio.Event
        Event that is set while `run` is active.
    number : int
        Number of the next frame. LSL does not send this number.
    sent : int
        Number of sent frames.
    command_port : int
        Always 0, because liblsl selects the ports.

    Raises
    ------
    ValueError
        The package pylsl is not installed.
    """

    def __init__(self, options: LslServerOptions | None = None) -> None:
        try:
            import pylsl  # noqa: PLC0415 - an extra
        except ModuleNotFoundError as missing:
            raise ValueError(
                "cameras of driver lsl-markers: the package pylsl is missing: pip install "
                "'jointfitd[lsl]'"
            ) from missing
        self._lsl = pylsl
        self.options = options or LslServerOptions()
        self.ready = asyncio.Event()
        self.number = self.sent = self.command_port = 0
        self.source_id = self.options.source_id or f"simulated-{os.getpid()}-{id(self)}"
        self._place, self._turn = axes_from_z_up(self.options.up_axis)
        self._scale = _UNITS[self.options.unit][0]
        self._difference_s = pylsl.local_clock() - time.monotonic()
        self._outlet: Any = None
        self.plug()

    async def run(self) -> None:
        """Wait until cancelled, because liblsl sends in its own threads."""
        self.ready.set()
        try:
            await asyncio.Event().wait()
        finally:
            self.ready.clear()

    def unplug(self) -> None:
        """End the stream, as when the program is closed."""
        self._outlet = None

    def plug(self) -> None:
        """Begin the stream again."""
        self._outlet = self._lsl.StreamOutlet(self._info(), chunk_size=1, max_buffered=10)

    def restart(self) -> None:
        """End the stream, and begin it again."""
        self.unplug()
        self.plug()
        self.number = 0

    def push(self, exposure_host_ns: int, markers: Markers, bodies: Bodies) -> None:
        """Send one frame now; see `NatNetServer.push`."""
        if self._outlet is None:
            return

        # Occluded markers and bodies have the value `absent` in every channel.
        absent = self.options.absent
        values: list[float] = []
        for name in self.options.markers:
            at = markers.get(name)
            values += self._scale_values(at) if at is not None else (absent,) * 3
        for name in self.options.bodies:
            pose = bodies.get(name)
            values += (
                (*self._scale_values(pose[0]), *self._turn(*pose[1])) if pose else (absent,) * 7
            )

        exposed_ns = exposure_host_ns or time.monotonic_ns()
        stamp_s = self.options.device_ns(exposed_ns) / NS_PER_S + self._difference_s
        row = (
            [str(value) for value in values] if self.options.channel_format == "string" else values
        )
        self._outlet.push_sample(row, stamp_s)
        self.number += 1
        self.sent += 1

    def _scale_values(self, at: tuple[float, float, float]) -> tuple[float, ...]:
        return tuple(self._scale * value for value in self._place(*at))

    def _info(self) -> Any:
        """Return the description of the stream."""
        options = self.options
        count = 3 * len(options.markers) + 7 * len(options.bodies)
        info = self._lsl.StreamInfo(
            options.stream,
            options.stream_type,
            count,
            options.rate_hz,
            options.channel_format,
            self.source_id,
        )
        if options.description == "none":
            return info

        # The LSL convention for motion capture requires label, type and owner of each channel.
        channels = info.desc().append_child("channels")
        for name in options.markers:
            for axis in _AXES:
                self._describe(channels, name, axis, f"Position{axis}", is_object=False)
        for name in options.bodies:
            for axis in _AXES:
                self._describe(channels, name, axis, f"Position{axis}", is_object=True)
            for letter, axis in zip(_TURN, "wxyz", strict=True):
                self._describe(channels, name, f"q{axis}", f"Orientation{letter}", is_object=True)

        info.desc().append_child("acquisition").append_child_value("manufacturer", "jointfit")
        return info

    def _describe(self, channels: Any, name: str, part: str, kind: str, *, is_object: bool) -> None:
        channel = channels.append_child("channel")
        channel.append_child_value("label", f"{name}_{part}")
        if self.options.description == "labels":
            return
        channel.append_child_value("object" if is_object else "marker", name)
        channel.append_child_value("type", kind)
        if kind.startswith("Position"):
            channel.append_child_value("unit", _UNITS[self.options.unit][1])
