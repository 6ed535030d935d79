"""Decoder of Vicon DataStream servers: converts packets to optical frames.

Every chunk is one packet, which consists of objects. Static objects describe the scene, such as its
subjects and the frame period. Dynamic objects contain the data of one frame. Device time is the
number of the camera frame times the frame period. The delay that the server announces is subtracted
from the arrivals.

Invariant: the output depends only on the chunks fed. The decoder reads no clock and no socket.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

from jointfit_daemon.model import Corrupt, DeviceEvent, MocapFrame, TickClock
from jointfit_daemon.name_lists import list_names
from jointfit_drivers.motion_capture import FrameContinuity, renew_columns, wanted_names
from jointfit_drivers.newer_firmware import NewerFirmwareDetector
from jointfit_drivers.vicon._binding import bind_subjects
from jointfit_drivers.vicon._latency import AnnouncedLatency
from jointfit_drivers.vicon._poses import ViconPoseConverter
from jointfit_drivers.vicon._scene_state import SceneState
from jointfit_protocols import vicon
from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.vicon import ObjectId

if TYPE_CHECKING:
    from collections.abc import Iterable

    from jointfit_daemon.model import Chunk, Decoded
    from jointfit_drivers.vicon._binding import ViconBinding
    from jointfit_drivers.vicon._settings import ViconSettings

_CLOCK = TickClock(0, None, vicon.TICKS_PER_S)
_LONGEST_PERIOD = 10 * vicon.TICKS_PER_S
"""Longest plausible frame period, ticks."""
_Y_UP = 1
_LATENCY_AFTER = 100
"""Number of frames after which the announced delay is reported."""
_KNOWN_IDS = vicon.STATIC | vicon.DYNAMIC | frozenset(map(int, ObjectId)) | vicon.REQUESTS

_Found = TypeVar("_Found")


class ViconDecoder:
    """Decoder of one DataStream server.

    Parameters
    ----------
    settings : ViconSettings
        The ``[mocap]`` table with names and up axis.
    """

    def __init__(self, settings: ViconSettings) -> None:
        self._wanted_markers, self._wanted_bodies = wanted_names(settings)
        self._up_axis = settings.up_axis
        self._least_quality = settings.least_quality
        self._poses = ViconPoseConverter("z" if settings.up_axis == "auto" else settings.up_axis)
        self._axis = ""
        self._state = SceneState()
        self._newer = NewerFirmwareDetector(tool="the Vicon software", sightings=1)
        self._continuity = FrameContinuity()
        self._latency = AnnouncedLatency()
        self._described: dict[frozenset[type], bytes] = {}
        """Newest packet with each combination of types of static objects."""
        self._binding: ViconBinding | None = None
        self._period: int | None = None
        self._poor: set[int] = set()
        self._offered: frozenset[int] | None = None
        self._frames = self._arrival_ns = 0
        self.messages = 0
        """Number of well-formed packets so far."""
        self.discarded_bytes = 0
        """Number of bytes in packets that could not be decoded."""
        self.unknown_ids = 0
        """Number of markers and segments dropped because they belong to no subject."""
        self.suspicious = 0
        """Number of segments rejected because of an invalid rotation."""

    @property
    def tick_clock(self) -> TickClock | None:
        """Ticks of 1/135 000 000 s; None until the frame period is known."""
        return None if self._period is None else _CLOCK

    @property
    def description(self) -> tuple[bytes, ...]:
        """Newest packets with the static objects, such as subjects and frame period."""
        return tuple(self._described.values())

    @property
    def duplicates(self) -> int:
        """Number of frames dropped because they had the number of the previous frame."""
        return self._continuity.duplicates

    @property
    def late(self) -> int:
        """Number of frames dropped because a later frame had already arrived."""
        return self._continuity.late

    def feed(self, chunk: Chunk) -> list[Decoded]:
        """Return the content of one packet; never raise."""
        packet = vicon.decode(chunk.data)
        if isinstance(packet, CorruptBytes):
            self.discarded_bytes += packet.discarded
            return [Corrupt(packet.discarded, packet.reason)]

        self.messages += 1
        out: list[Decoded] = []
        self._state.add(packet.objects)
        for item in packet.objects:
            if isinstance(item, vicon.ViconPing):
                self._latency.add_ping(item.number, chunk.t_ns)
            elif isinstance(item, vicon.ObjectEnums) and item.ids != self._offered:
                self._offered = item.ids
                data = {"model": "Vicon DataStream", "transport": "tcp"}
                out.append(DeviceEvent("info", "Vicon DataStream", data))
                if newer := sorted(item.ids - _KNOWN_IDS):
                    content = f"objects {list_names(list(map(str, newer)))}"
                    out += self._newer.take_unknown(content, chunk.t_ns)
            elif isinstance(item, vicon.OpaqueObject) and item.id in vicon.OPTIONAL:
                content = f"object {item.id} in a shorter layout"
                out += self._newer.take_unknown(content, chunk.t_ns)
        static = frozenset(type(item) for item in packet.objects if isinstance(item, _STATIC_TYPES))
        if static:
            self._described[static] = chunk.data
            self._take_static(out)
        number = _first(packet.objects, vicon.FrameInfo)
        if number is not None:
            self._frame(chunk, number.number, out)
        return out

    def flush(self) -> list[Decoded]:
        """Return an empty list, because every chunk is a complete packet."""
        return []

    # --- static objects -----------------------------------------------------------------------

    def _take_static(self, out: list[Decoded]) -> None:
        """Apply changes of subjects, axis, period and quality; append their events."""
        application = _first(self._state.static(ObjectId.APPLICATION_INFO), vicon.ApplicationInfo)
        axis = "y" if application is not None and application.orientation == _Y_UP else "z"
        if self._up_axis == "auto" and axis != self._axis:
            self._axis = axis
            self._poses = ViconPoseConverter(axis)

        info = _first(self._state.static(ObjectId.STREAM_INFO), vicon.StreamInfo)
        period = None if info is None or not 0 < info.period <= _LONGEST_PERIOD else info.period
        if period != self._period:
            if self._period is not None:
                out.append(DeviceEvent("restart", "the frame rate changed"))
            self._period = period

        subjects = self._state.subjects
        if self._binding is None or subjects != self._binding.subjects:
            self._bind(subjects, out)
        for item in self._state.static(ObjectId.OBJECT_QUALITY):
            if isinstance(item, vicon.ObjectQuality):
                self._report_quality(item, out)

    def _bind(self, subjects: tuple[vicon.SubjectInfo, ...], out: list[Decoded]) -> ViconBinding:
        """Return the columns for the subjects; append events about changes and faults."""
        binding = bind_subjects(subjects, self._wanted_markers, self._wanted_bodies)
        before = None if self._binding is None else self._binding.columns
        columns, events = renew_columns(before, binding.columns)
        out += events
        self._binding = binding = replace(binding, columns=columns)
        self._poor.clear()
        return binding

    def _report_quality(self, item: vicon.ObjectQuality, out: list[Decoded]) -> None:
        """Append an event when the quality of a subject becomes poor, and when it recovers."""
        poor = not item.quality >= self._least_quality
        if poor == (item.subject in self._poor):
            return
        names = {subject.subject: subject.name for subject in self._state.subjects}
        name = names.get(item.subject, str(item.subject))
        if poor:
            self._poor.add(item.subject)
            text = f"quality of {name!r} is below {self._least_quality:g}"
            out.append(DeviceEvent("warning", text, {"subject": name, "quality": item.quality}))
        else:
            self._poor.discard(item.subject)
            out.append(DeviceEvent("setting", f"quality of {name!r} is sufficient again"))

    # --- frames -------------------------------------------------------------------------------

    def _frame(self, chunk: Chunk, number: int, out: list[Decoded]) -> None:
        """Append the frame in the columns of the subjects, after the events that it causes."""
        state = self._state
        hardware = _first(state.dynamic(ObjectId.HARDWARE_FRAME), vicon.HardwareFrame)
        count = number if hardware is None else hardware.number
        step = self._continuity.frame(number, count, chunk.t_ns)
        if not step.use:
            return
        if step.restarted:
            out.append(DeviceEvent("restart", f"frame numbers restarted at {number}"))
        elif step.lost:
            out.append(DeviceEvent("gap", f"{step.lost} frames lost", {"lost": step.lost}))

        self._latency.add_frame(_first(state.dynamic(ObjectId.LATENCY_INFO), vicon.LatencyInfo))
        self._frames += 1
        if self._frames == _LATENCY_AFTER:
            delay_ms, sd_ms = self._latency.delay_ns / 1e6, self._latency.uncertainty_ns / 1e6
            data = {"delay_ms": delay_ms, "delay_sd_ms": sd_ms}
            text = f"announced delay {delay_ms:.1f} ms ± {sd_ms:.1f} ms"
            announced = DeviceEvent("info", text, data)
            text = "the server announces no latency: set latency_ms in [mocap] to the whole delay"
            out.append(announced if self._latency.announced else DeviceEvent("warning", text))

        binding = self._binding or self._bind(state.subjects, out)
        found = self._poses.columns(state, binding)
        self.suspicious += found.suspicious
        self.unknown_ids += found.unknown
        self._arrival_ns = max(self._arrival_ns, chunk.t_ns - self._latency.delay_ns)
        out.append(
            MocapFrame(
                self._arrival_ns,
                number,
                None if self._period is None else count * self._period,
                binding.columns.layout,
                found.markers,
                found.body_positions,
                found.body_orientations,
            )
        )


_STATIC_TYPES = (
    vicon.StreamInfo,
    vicon.SubjectInfo,
    vicon.ApplicationInfo,
    vicon.ObjectQuality,
)


def _first(items: Iterable[object], kind: type[_Found]) -> _Found | None:
    return next((item for item in items if isinstance(item, kind)), None)
