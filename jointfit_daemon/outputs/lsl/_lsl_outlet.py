"""Two streams of the Lab Streaming Layer (LSL): orientations of segments, and joint angles.

The stamp of a sample is the instant of its frame on the clock of LSL, not the instant of
transmission. Receivers on other hosts correct the offset between their clocks and this clock.

Invariant: a frame costs one call of the library for each stream. The library sends in its own
threads, and drops samples for receivers that do not read.
"""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Any

from jointfit_daemon.model import ANGLE_NAMES, LimbState

if TYPE_CHECKING:
    from jointfit_daemon.config import LslSettings
    from jointfit_daemon.model import JointState, SegmentState
    from jointfit_daemon.pipeline.events import Event, Output

_NAN = math.nan
_NAN_4, _NAN_3 = (_NAN,) * 4, (_NAN,) * 3
_READINGS = 5
"""Number of measurements of the offset between CLOCK_MONOTONIC and the clock of LSL. The shortest
measurement is used."""
_AGAIN_NS = 1_000_000_000
"""Interval between measurements of the clock offset, ns."""
_BUFFER_S = 60
"""Duration of the samples that are buffered for a receiver that does not read, s."""
_Channels = list[tuple[str, str, str]]
"""Label, type and unit of each channel."""


class LslError(Exception):
    """The streams cannot be created; the message states the remedy."""


class LslOutlet:
    """Publishes segments and joints of every frame; a `Sink` of the core.

    Parameters
    ----------
    settings
        Table ``[lsl]``, which contains the names of the streams.
    rig
        Name of the rig.
    rate_hz
        Rate of the frames, Hz.
    """

    def __init__(self, settings: LslSettings, rig: str, rate_hz: float) -> None:
        self._name, self._rig, self._rate_hz = settings.name or rig, rig, rate_hz
        self._lsl: Any = None
        self._outlets: tuple[Any, Any] | None = None
        self._layout: tuple[object, ...] = ()
        self._offset_s = 0.0
        self._compare_ns = -1

    def start(self) -> None:
        """Load the library; the first frame creates the streams.

        Raises
        ------
        LslError
            ``pylsl`` or its library liblsl is not installed.
        """
        try:
            import pylsl  # noqa: PLC0415 - optional package
        except ModuleNotFoundError as missing:
            raise LslError(
                "the package pylsl is missing: pip install 'jointfitd[lsl]'"
            ) from missing
        except (RuntimeError, OSError) as missing:  # pylsl is installed without liblsl
            raise LslError(
                "pylsl finds no library liblsl (packages of pylsl contain it for x86-64 only): "
                "install liblsl (https://github.com/sccn/liblsl) and set PYLSL_LIB to its path"
            ) from missing
        self._lsl = pylsl

    def event(self, event: Event) -> None:
        """Do nothing, because input events are not sent."""

    def output(self, output: Output) -> None:
        """Send the samples of a frame to both streams."""
        if type(output) is not LimbState:
            return
        layout = (
            tuple(segment.name for segment in output.segments),
            tuple((joint.name, joint.convention) for joint in output.joints),
        )
        if layout != self._layout or self._outlets is None:
            self._layout = layout
            self._outlets = (
                self._open("segments", _segment_channels(output.segments)),
                self._open("joints", _joint_channels(output.joints)),
            )
        at_s = output.t_ns * 1e-9 + self._clock_offset_s()
        segments, joints = self._outlets
        segments.push_sample(_segment_values(output.segments), at_s)
        joints.push_sample(_joint_values(output.joints), at_s)

    def _open(self, contents: str, channels: _Channels) -> Any:
        """Return the outlet of a stream, with the channel metadata of motion-capture streams."""
        info = self._lsl.StreamInfo(
            f"{self._name} {contents}",
            "MoCap",
            len(channels),
            self._rate_hz,
            self._lsl.cf_double64,
            f"jointfit-{self._rig}-{contents}",
        )
        description = info.desc()
        description.append_child_value("rig", self._rig)
        listed = description.append_child("channels")
        for label, kind, unit in channels:
            channel = listed.append_child("channel")
            channel.append_child_value("label", label)
            channel.append_child_value("type", kind)
            channel.append_child_value("unit", unit)
        return self._lsl.StreamOutlet(info, max_buffered=_BUFFER_S)

    def _clock_offset_s(self) -> float:
        """Return the LSL clock minus CLOCK_MONOTONIC, s; it is measured once a second."""
        now_ns = time.monotonic_ns()
        if now_ns >= self._compare_ns:
            self._compare_ns = now_ns + _AGAIN_NS
            readings = []
            for _ in range(_READINGS):
                before_ns = time.monotonic_ns()
                lsl_s = self._lsl.local_clock()
                after_ns = time.monotonic_ns()
                middle_s = (before_ns + after_ns) * 0.5e-9
                readings.append((after_ns - before_ns, lsl_s - middle_s))
            self._offset_s = min(readings)[1]
        return self._offset_s


def _segment_channels(segments: tuple[SegmentState, ...]) -> _Channels:
    channels = []
    for segment in segments:
        channels += [(f"{segment.name}_q{x}", f"Orientation{x.upper()}", "") for x in "wxyz"]
        channels.append((f"{segment.name}_sd", "orientation_sd", "rad"))
    return channels


def _segment_values(segments: tuple[SegmentState, ...]) -> list[float]:
    values: list[float] = []
    for segment in segments:
        values += segment.q_world_segment or _NAN_4
        values.append(_NAN if segment.sd is None else segment.sd)
    return values


def _joint_channels(joints: tuple[JointState, ...]) -> _Channels:
    channels = []
    for joint in joints:
        names = ANGLE_NAMES[joint.convention]
        channels += [(f"{joint.name}_{name}", "angle", "rad") for name in names]
        channels.append((f"{joint.name}_angle_sd", "angle_sd", "rad"))
        channels += [(f"{joint.name}_{x}", f"Position{x.upper()}", "meters") for x in "xyz"]
        channels.append((f"{joint.name}_position_sd", "position_sd", "meters"))
    return channels


def _joint_values(joints: tuple[JointState, ...]) -> list[float]:
    values: list[float] = []
    for joint in joints:
        values += joint.angles or _NAN_3
        values.append(_NAN if joint.angle_sd is None else joint.angle_sd)
        values += joint.position or _NAN_3
        values.append(_NAN if joint.position_sd is None else joint.position_sd)
    return values
