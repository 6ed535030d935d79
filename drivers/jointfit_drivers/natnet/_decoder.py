"""Decoder of NatNet servers: converts datagrams to optical frames and clock echoes.

An echo is the server's reply to an echo request. The reply contains the sending time of the request
and the server's time, and thus relates the two clocks.

A network capture contains datagrams in both directions. Datagrams from a client have one effect:
the arrival of an echo request is used as the sending time of the request. A frame that arrives
before the model is dropped and counted in `unpublished`. Every number is checked against its range
before it is used.

Invariant: the output depends only on the chunks fed. The decoder reads no clock and no socket.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from jointfit_daemon.model import ClockEcho, Corrupt, DeviceEvent, MocapFrame, TickClock
from jointfit_drivers.motion_capture import FrameContinuity, renew_columns, wanted_names
from jointfit_drivers.natnet._binding import bind_model
from jointfit_drivers.natnet._bitstream import FRAME_START, BitstreamTracker
from jointfit_drivers.natnet._frame_time import FrameTime
from jointfit_drivers.natnet._poses import PoseConverter
from jointfit_drivers.natnet._server_checks import (
    NEWEST,
    bitstream_response,
    same_instance,
    usable_hz,
)
from jointfit_drivers.newer_firmware import NewerFirmwareDetector
from jointfit_protocols import natnet
from jointfit_protocols.corrupt import CorruptBytes

if TYPE_CHECKING:
    from jointfit_daemon.model import Chunk, Decoded
    from jointfit_drivers.natnet._binding import Binding
    from jointfit_drivers.natnet._settings import NatNetSettings

_ECHO_LIMIT_NS = 10**9
"""Largest round-trip time of an echo that is used for the clock, ns."""
_PENDING_ECHOES = 8
_NAMED_UNKNOWN = 16
"""Largest number of unknown ids in one warning. After this number of unknown ids, further ids are
only counted."""
_MOST_SECONDS = 2**63 // 10**9
"""Largest accepted stamp, s. Its value in nanoseconds fits into 64 bits."""
_ANNOUNCED = {
    natnet.FRAME_MODEL_CHANGED: "the model list changed",
    natnet.FRAME_BITSTREAM_CHANGED: "the bitstream version changed",
}


class NatNetDecoder:
    """Decoder of one NatNet server.

    Parameters
    ----------
    settings : NatNetSettings
        The ``[mocap]`` table: names, up axis, and latency of cameras without exposure stamp.
    """

    def __init__(self, settings: NatNetSettings) -> None:
        self._bitstream = BitstreamTracker(settings.wanted_version)
        self._latency_ms = settings.latency_ms
        self._time = FrameTime(settings)
        self._newer = NewerFirmwareDetector(NEWEST, sightings=1)
        self._wanted_markers, self._wanted_bodies = wanted_names(settings)
        self._poses = PoseConverter(settings.up_axis)
        self._continuity = FrameContinuity()
        self._info: natnet.ServerInfo | None = None
        self._hz: int | None = None
        self._binding: Binding | None = None
        self._described: dict[str, bytes] = {}
        self._asked: dict[int, int] = {}
        self._announced = 0
        self._live = self._stamped = True
        self._named_unknown: set[int] = set()
        self.messages = 0
        """Number of well-formed messages of any kind so far."""
        self.discarded_bytes = 0
        """Number of bytes in datagrams that contain no message."""
        self.unpublished = 0
        """Number of frames that arrived before the model or the server's version was known."""
        self.unknown_ids = 0
        """Number of markers and bodies dropped because the model does not contain their id."""
        self.suspicious = 0
        """Number of poses, stamps and echoes rejected because of implausible numbers."""

    @property
    def tick_clock(self) -> TickClock | None:
        """The server's high-resolution counter; None until a plausible frequency is known.

        The clock is UNIX time if the frames are stamped by cameras that PTP synchronizes.
        """
        if self._time.precise:
            return self._time.tick_clock
        return TickClock(0, None, self._hz) if self._hz else None

    @property
    def description(self) -> tuple[bytes, ...]:
        """Newest messages with the server, its bitstream version and its model list."""
        parts = ("server", "bitstream", "model")
        return tuple(self._described[part] for part in parts if part in self._described)

    @property
    def duplicates(self) -> int:
        """Number of frames dropped because they had the number of the previous frame."""
        return self._continuity.duplicates

    @property
    def late(self) -> int:
        """Number of frames dropped because a later frame had already arrived."""
        return self._continuity.late

    def feed(self, chunk: Chunk) -> list[Decoded]:
        """Return the frames, echoes and events of one datagram; never raise."""
        before = self._bitstream.version
        message = self._bitstream.decode(chunk.data)
        if isinstance(message, CorruptBytes):
            if not self._bitstream.known and natnet.is_versioned(chunk.data):
                self.messages += 1
                self.unpublished += chunk.data.startswith(FRAME_START)
                return []
            self.discarded_bytes += message.discarded
            return [Corrupt(message.discarded, message.reason)]

        self.messages += 1
        out: list[Decoded] = []
        if self._bitstream.version != before:
            name = "{}.{}".format(*self._bitstream.version)
            out.append(DeviceEvent("setting", f"bitstream changed to {name}", {"bitstream": name}))

        self._take(chunk, message, out)
        return out

    def flush(self) -> list[Decoded]:
        """Return an empty list, because datagrams are complete."""
        return []

    def _take(self, chunk: Chunk, message: natnet.Message, out: list[Decoded]) -> None:
        """Append the frame, echo or events of one message. A message of a client adds nothing."""
        match message:
            case natnet.FrameOfData():
                self._frame(chunk, message, out)
            case natnet.ServerInfo() if message != self._info:
                self._described = {"server": chunk.data}
                self._server(message, out)
            case natnet.ModelDefinition():
                self._described["model"] = chunk.data
                self._model(message, out)
            # In a capture, the arrival of a client's echo request is its sending time.
            case natnet.EchoRequest(stamp):
                if len(self._asked) >= _PENDING_ECHOES:
                    del self._asked[next(iter(self._asked))]
                self._asked[stamp] = chunk.t_ns
            case natnet.EchoResponse():
                self._echo(chunk, message, out)
            case natnet.CommandResponse():
                version = bitstream_response(message.text)
                if version is not None:
                    self._described["bitstream"] = chunk.data
                    self._bitstream.confirm(version)

    # --- server and model ---------------------------------------------------------------------

    def _server(self, info: natnet.ServerInfo, out: list[Decoded]) -> None:
        """Append the events of a new or changed server."""
        before = self._info
        # An implausible frequency would make the stamps of all frames wrong.
        self._info, self._hz = info, usable_hz(info)

        firmware = ".".join(map(str, info.application_version))
        version = ".".join(map(str, info.natnet_version))
        transport = "multicast" if info.multicast else "unicast"
        data: dict[str, object] = {
            "model": info.application,
            "firmware": firmware,
            "natnet": version,
            "transport": transport,
            "clock_hz": self._hz,
            "data_port": info.data_port,
            "group": info.group,
        }
        text = f"{info.application} {firmware}, NatNet {version}, {transport}"
        out.append(DeviceEvent("info", text, data))
        out += self._newer.take_version("{}.{}".format(*info.bitstream))

        if before is None or same_instance(info, before):
            self._bitstream.announce(info.bitstream)
        else:
            self._bitstream.restart(info.bitstream)
            self._binding = None
            self._continuity.forget()
            out.append(DeviceEvent("restart", f"another server answers: {info.application}"))

        if not natnet.is_supported(info.bitstream):
            name = "{}.{}".format(*info.bitstream)
            text = f"the server uses NatNet {name}; 2.5 or newer is required"
            out.append(DeviceEvent("error", text, {"bitstream": name}))

    def _model(self, model: natnet.ModelDefinition, out: list[Decoded]) -> None:
        """Assign the columns to a model; append changes of the columns and warnings."""
        binding = bind_model(model, self._wanted_markers, self._wanted_bodies)
        before = None if self._binding is None else self._binding.columns
        columns, events = renew_columns(before, binding.columns, self.unpublished)
        out += events
        self._binding = binding = replace(binding, columns=columns)
        self._bitstream.select_sets(binding.loose_sets)
        self._named_unknown.clear()

        if not model.complete:
            text = "the model list ends at a description of unknown type"
            out.append(DeviceEvent("warning", text))

    # --- time ---------------------------------------------------------------------------------

    def _echo(self, chunk: Chunk, echo: natnet.EchoResponse, out: list[Decoded]) -> None:
        """Append a plausible echo, unless the PTP time stamps of the frames are used."""
        sent_ns = self._asked.pop(echo.stamp, echo.stamp)
        if self._time.precise or not 0 <= chunk.t_ns - sent_ns <= _ECHO_LIMIT_NS:
            return
        if self._hz is not None and echo.ticks > _MOST_SECONDS * self._hz:
            self.suspicious += 1
        else:
            out.append(ClockEcho(sent_ns, chunk.t_ns, echo.ticks))

    # --- frames -------------------------------------------------------------------------------

    def _frame(self, chunk: Chunk, frame: natnet.FrameOfData, out: list[Decoded]) -> None:
        """Append the frame in the columns of the model, after the events that the frame causes."""
        step = self._continuity.frame(frame.number, frame.transmit, chunk.t_ns)
        if not step.use:
            return

        if step.restarted:
            out.append(DeviceEvent("restart", f"frame numbers restarted at {frame.number}"))
        elif step.lost:
            out.append(DeviceEvent("gap", f"{step.lost} frames lost", {"lost": step.lost}))
        if frame.params != self._announced:
            self._announce(frame.params, out)

        binding = self._binding
        if binding is None:
            self.unpublished += 1
            return

        self._time.report_timecode(frame, out)
        found = self._poses.columns(frame, binding)
        self.suspicious += found.suspicious
        if found.unknown:
            # Warn once about each unknown id.
            self.unknown_ids += len(found.unknown)
            new = [i for i in found.unknown if i not in self._named_unknown]
            if new and len(self._named_unknown) < _NAMED_UNKNOWN:
                self._named_unknown.update(new)
                names = ", ".join(f"{i >> 16}:{i & 0xFFFF}" for i in new[:_NAMED_UNKNOWN])
                text = f"markers or bodies with ids outside the model list are dropped: {names}"
                out.append(DeviceEvent("warning", text, {"ids": new[:_NAMED_UNKNOWN]}))
        ticks = self._exposure_ticks(frame, out)
        out.append(
            MocapFrame(
                chunk.t_ns,
                frame.number,
                ticks,
                binding.columns.layout,
                found.markers,
                found.body_positions,
                found.body_orientations,
                self._live,
                residuals=found.residuals,
            )
        )

    def _exposure_ticks(self, frame: natnet.FrameOfData, out: list[Decoded]) -> int | None:
        """Return the instant of exposure in ticks of the clock in use; None if it is unknown.

        If the cameras do not stamp the exposure, it is computed from the configured latency.
        """
        hz = self._hz
        if self._time.precise:
            return self._time.unix_ns(frame, out)
        if hz is not None and max(frame.exposure, frame.transmit) > _MOST_SECONDS * hz:
            self.suspicious += 1
            return None
        if frame.exposure or hz is None or not frame.transmit:
            return frame.exposure or None

        if self._stamped:
            self._stamped = False
            text = (
                "the frames have no exposure stamps (USB cameras?): the exposure is assumed to be "
                f"{self._latency_ms:g} ms before transmission"
            )
            out.append(DeviceEvent("warning", text, {"latency_ms": self._latency_ms}))
        return max(0, frame.transmit - round(self._latency_ms * hz / 1000))

    def _announce(self, params: int, out: list[Decoded]) -> None:
        """Append events for flags that are newly set, and for each change of the edit mode."""
        risen, self._announced = params & ~self._announced, params
        out += [DeviceEvent("setting", text) for bit, text in _ANNOUNCED.items() if risen & bit]

        live = not params & natnet.FRAME_EDIT_MODE
        if live != self._live:
            self._live = live
            text = "live again" if live else "edit mode: the frames are a recording"
            out.append(DeviceEvent("setting", text, {"live": live}))
