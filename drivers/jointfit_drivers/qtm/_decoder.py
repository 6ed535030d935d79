"""Decoder of servers of Qualisys Track Manager (QTM): converts packets to optical frames.

Every chunk is one packet, received by TCP or as a datagram. A frame that arrives before QTM's
settings, or that does not fit them, is dropped and counted in `unpublished`.

Invariant: the output depends only on the chunks fed. The decoder reads no clock and no socket.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from jointfit_daemon.model import Corrupt, DeviceEvent, MocapFrame, TickClock
from jointfit_drivers.motion_capture import renew_columns, wanted_names
from jointfit_drivers.newer_firmware import NewerFirmwareDetector
from jointfit_drivers.qtm._binding import bind_settings
from jointfit_drivers.qtm._continuity import TimestampContinuity
from jointfit_drivers.qtm._frame_parts import FrameParts
from jointfit_drivers.qtm._poses import QtmPoseConverter
from jointfit_protocols import qtm
from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.qtm import ComponentType, QtmEvent

if TYPE_CHECKING:
    from jointfit_daemon.model import Chunk, Decoded
    from jointfit_drivers.qtm._binding import QtmBinding
    from jointfit_drivers.qtm._frame_parts import CompleteFrame
    from jointfit_drivers.qtm._settings import QtmSettings

CAMERA_CLOCK = TickClock(100, None)
"""Clock of the cameras, in units of 100 ns."""
MEASUREMENT_CLOCK = TickClock(1000, None)
"""Clock that starts at the beginning of a measurement, in µs."""
_MOST_NS = 2**63
_UP_AXES = {"+X": "x", "-X": "-x", "+Y": "y", "-Y": "-y", "+Z": "z", "-Z": "-z"}
_MISSING_TEXTS = {
    ComponentType.BODIES_RESIDUAL: "frames have no 6DOF bodies: in QTM enable Calculate 6DOF in "
    "Project Options, Processing, Real-time actions",
    ComponentType.MARKERS_RESIDUAL: "frames have no labeled markers: in QTM enable 3D tracking and "
    "an AIM model in Project Options, Processing, Real-time actions",
    ComponentType.TIMECODE: "frames lack the timecode that QTM announces",
}
_VERSION_ANSWER = "version set to "
_EVENTS = frozenset(map(int, QtmEvent))


class QtmDecoder:
    """Decoder of one QTM server.

    Parameters
    ----------
    settings : QtmSettings
        The ``[mocap]`` table with names and up axis.
    """

    def __init__(self, settings: QtmSettings) -> None:
        self._wanted_markers, self._wanted_bodies = wanted_names(settings)
        self._up_axis = settings.up_axis
        self._skeleton = settings.skeleton
        self._poses = QtmPoseConverter("z" if settings.up_axis == "auto" else settings.up_axis)
        self._continuity = TimestampContinuity()
        self._parts = FrameParts()
        self._newer = NewerFirmwareDetector(tool="QTM", sightings=1)
        self._settings: qtm.QtmSettingsXml | None = None
        self._described: dict[str, bytes] = {}
        self._binding: QtmBinding | None = None
        self._clock: TickClock | None = None
        self._clock_before: TickClock | None = None
        self._camera_time = False
        self._reported: tuple[int, ...] = ()
        self._misfits = 0
        self._live = True
        self._waiting = self._coded = False
        self.messages = 0
        """Number of well-formed packets of any kind so far."""
        self.discarded_bytes = 0
        """Number of bytes in packets that contain no message."""
        self.unpublished = 0
        """Number of frames that arrived before the settings, or that did not fit them."""
        self.suspicious = 0
        """Number of poses and stamps rejected because of implausible numbers."""

    @property
    def tick_clock(self) -> TickClock | None:
        """Clock of the frames: camera time if QTM streams it, else the time of the measurement."""
        return self._clock

    @property
    def description(self) -> tuple[bytes, ...]:
        """Newest packets with the version and the settings of QTM."""
        return tuple(self._described.values())

    @property
    def duplicates(self) -> int:
        """Number of frames dropped because they had the stamp of the previous frame."""
        return self._continuity.duplicates

    @property
    def late(self) -> int:
        """Number of frames dropped because a later frame had already arrived."""
        return self._continuity.late

    def feed(self, chunk: Chunk) -> list[Decoded]:
        """Return the content of one packet; never raise."""
        message = qtm.decode(chunk.data)
        if isinstance(message, CorruptBytes):
            self.discarded_bytes += message.discarded
            return [Corrupt(message.discarded, message.reason)]

        self.messages += 1
        out: list[Decoded] = []
        match message:
            case qtm.DataFrame():
                for frame in self._parts.add(chunk.t_ns, message):
                    self._frame(frame, out)
            case qtm.SettingsReply(xml):
                self._described["settings"] = chunk.data
                self._take_settings(xml, out)
            case qtm.Event(number):
                self._event(number, out)
                if number not in _EVENTS:
                    out += self._newer.take_unknown(f"event {number}", chunk.t_ns)
            case qtm.NoMoreData() if not self._waiting:
                self._waiting = True
                text = "no measurement is running: waiting for QTM"
                out.append(DeviceEvent("setting", text, {"waiting": True}))
            case qtm.Command(text) if text.lower().startswith(_VERSION_ANSWER):
                self._described["version"] = chunk.data
                version = text[len(_VERSION_ANSWER) :]
                data = {"model": "QTM", "protocol": version, "transport": "tcp"}
                out.append(DeviceEvent("info", f"QTM, real-time protocol {version}", data))
            case qtm.ErrorReply(text):
                out.append(DeviceEvent("warning", f"QTM reports: {text}"))
            case _:
                pass
        return out

    def flush(self) -> list[Decoded]:
        """Return an empty list, because every chunk is a complete packet."""
        return []

    # --- settings and events ------------------------------------------------------------------

    def _take_settings(self, xml: str, out: list[Decoded]) -> None:
        """Store new settings of QTM and their columns; append events about changes and faults."""
        settings = qtm.parse_settings(xml)
        if settings is None:
            out.append(DeviceEvent("warning", "the settings of QTM are not readable XML"))
            return
        if settings == self._settings:
            return
        self._settings = settings

        axis = _UP_AXES.get(settings.up_axis or "")
        if self._up_axis == "auto" and axis is not None:
            self._poses = QtmPoseConverter(axis)

        binding = bind_settings(settings, self._wanted_markers, self._wanted_bodies)
        before = None if self._binding is None else self._binding.columns
        columns, events = renew_columns(before, binding.columns, self.unpublished)
        out += events
        self._binding = binding = replace(binding, columns=columns)

        self._camera_time = bool(settings.timestamp_enabled) and "camera" in (
            settings.timestamp_type or ""
        ).lower().replace("_", " ")
        self._clock_before = self._clock_before if self._clock is None else self._clock
        self._clock = None
        expected = {
            ComponentType.MARKERS_RESIDUAL: binding.labels > 0,
            ComponentType.BODIES_RESIDUAL: binding.bodies > 0,
            ComponentType.TIMECODE: bool(settings.timestamp_enabled),
            ComponentType.SKELETON: self._skeleton and binding.skeletons > 0,
        }
        self._parts.expect(kind for kind, is_expected in expected.items() if is_expected)
        self._reported, self._misfits = (), 0
        out += self._warnings(settings, axis)

    def _warnings(self, settings: qtm.QtmSettingsXml, axis: str | None) -> list[DeviceEvent]:
        """Return warnings about settings that reduce accuracy or lose data."""
        texts = []
        if not self._camera_time:
            texts.append(
                "frames have no camera time: their stamps begin again with every measurement; in "
                "QTM select camera time in Project Options, Synchronization, Timestamp"
            )
        if settings.tracks_bodies is False and self._wanted_bodies:
            texts.append(
                "QTM does not calculate 6DOF bodies in real time: enable it in Project Options, "
                "Processing, Real-time actions"
            )
        if settings.calibrated == "":
            texts.append("the cameras are not calibrated: calibrate them in QTM")
        if axis is None and self._up_axis == "auto":
            texts.append("QTM announces no vertical axis: z is assumed; set up_axis in [mocap]")
        return [DeviceEvent("warning", text) for text in texts]

    def _event(self, number: int, out: list[Decoded]) -> None:
        """Append the effects of an event that the server sent."""
        if number in (QtmEvent.RT_FROM_FILE_STARTED, QtmEvent.RT_FROM_FILE_STOPPED):
            live = number == QtmEvent.RT_FROM_FILE_STOPPED
            if live != self._live:
                self._live = live
                text = "QTM sends live data again" if live else "QTM plays back a recording"
                out.append(DeviceEvent("setting", text, {"live": live}))
        if number in (QtmEvent.CAPTURE_STARTED, QtmEvent.CAPTURE_STOPPED,
                      QtmEvent.RT_FROM_FILE_STARTED, QtmEvent.RT_FROM_FILE_STOPPED):  # fmt: skip
            restarts = self._continuity.began and not self._camera_time
            self._continuity.forget()
            if restarts:
                out.append(DeviceEvent("restart", "time restarts with the measurement"))
        if number == QtmEvent.CAMERA_SETTINGS_CHANGED:
            out.append(DeviceEvent("setting", "camera settings changed"))

    # --- frames -------------------------------------------------------------------------------

    def _frame(self, frame: CompleteFrame, out: list[Decoded]) -> None:
        """Append the frame in the columns of the settings, after the events that it causes."""
        step = self._continuity.frame(frame.timestamp_us, frame.number)
        if not step.use:
            return
        if step.restarted:
            out.append(DeviceEvent("restart", "time stamps restarted"))
        elif step.lost:
            out.append(DeviceEvent("gap", f"{step.lost} frames lost", {"lost": step.lost}))

        binding = self._binding
        if binding is None:
            self.unpublished += 1
            return
        found = self._poses.columns(frame.components, binding)
        if found is None:
            self.unpublished += 1
            self._misfits += 1
            if self._misfits == 1:
                text = "frames do not fit the settings: waiting for new settings"
                out.append(DeviceEvent("warning", text))
            return

        self._waiting = False
        self.suspicious += found.suspicious

        # Warn about each announced component that does not arrive.
        absent = self._parts.absent
        if absent != self._reported:
            new = [kind for kind in absent if kind not in self._reported]
            self._reported = absent
            texts = [_MISSING_TEXTS.get(ComponentType(kind), "") for kind in new]
            out += [DeviceEvent("warning", text) for text in texts if text]

        ticks = self._ticks(frame, out)
        out.append(
            MocapFrame(
                frame.arrival_ns,
                self._continuity.number,
                ticks,
                binding.columns.layout,
                found.markers,
                found.body_positions,
                found.body_orientations,
                self._live,
                residuals=found.residuals,
            )
        )

    def _ticks(self, frame: CompleteFrame, out: list[Decoded]) -> int | None:
        """Return the exposure time in ticks of the clock in use; None if the frame has none."""
        component = frame.components.get(ComponentType.TIMECODE)
        codes = component.timecodes if isinstance(component, qtm.TimecodeComponent) else ()
        camera = next((t for code in codes if (t := code.camera_ticks) is not None), None)

        # The first frame after new settings selects the clock.
        if self._clock is None:
            self._clock = CAMERA_CLOCK if camera is not None else MEASUREMENT_CLOCK
            if self._clock_before not in (None, self._clock):
                out.append(DeviceEvent("restart", "frames are stamped by another clock"))
        text = next((text for code in codes if (text := code.text) is not None), None)
        if (text is not None) != self._coded:
            self._coded = text is not None
            named = "timecode lost" if text is None else f"timecode {text}"
            data = {"timecode": text, "timecode_frame": frame.number if text else None}
            out.append(DeviceEvent("info", named, data))

        is_camera = self._clock is CAMERA_CLOCK
        ticks = camera if is_camera else frame.timestamp_us
        if ticks is None:
            return None
        if not 0 <= ticks * self._clock.tick_ns < _MOST_NS:
            self.suspicious += 1
            return None
        return ticks
