"""Decoder of the NatNet driver: datagrams in, optical frames and clock echoes out.

A capture contains datagrams of both directions. Those of a client have no effect, except that the
arrival of an echo request is the sending time of its answer. A frame that arrives before its model
is counted in `unpublished` and dropped. Every number is checked against its range before use.

Invariant: a function of the chunks fed; no clock, no socket.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, cast

from jointfit_daemon.model import ClockEcho, Corrupt, DeviceEvent, MocapFrame, TickClock
from jointfit_drivers.natnet._binding import bind_model
from jointfit_drivers.natnet._bitstream import BitstreamTracker
from jointfit_drivers.natnet._continuity import NatNetContinuity
from jointfit_drivers.natnet._frame_time import FrameTime
from jointfit_drivers.natnet._poses import PoseConverter
from jointfit_drivers.natnet._server_checks import bitstream_response, same_instance, usable_hz
from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.natnet import (
    FRAME_BITSTREAM_CHANGED,
    FRAME_EDIT_MODE,
    FRAME_MODEL_CHANGED,
    CommandResponse,
    EchoRequest,
    EchoResponse,
    FrameOfData,
    ModelDefinition,
    NatNetMessageId,
    ServerInfo,
    is_versioned,
    supported,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.model import Chunk, Decoded
    from jointfit_drivers.natnet._binding import Binding
    from jointfit_drivers.natnet._settings import NatNetSettings
    from jointfit_protocols.natnet import Message

_ECHO_LIMIT_NS = 10**9
"""Age of an echo answer, ns, after which it is useless for the clock."""
_PENDING_ECHOES = 8
_NAMED_UNKNOWN = 16
"""Unknown ids that are listed in warnings; further ones are only counted."""
_MOST_SECONDS = 2**63 // 10**9
"""Largest plausible stamp, s: its nanoseconds still fit 64 bits."""
_MOST_LISTED = 200
"""Names of markers or bodies that an event lists; the count in its text is exact."""
_FRAME = int(NatNetMessageId.FRAMEOFDATA).to_bytes(2, "little")
_ANNOUNCED = {
    FRAME_MODEL_CHANGED: "the model list changed",
    FRAME_BITSTREAM_CHANGED: "the bitstream version changed",
}


class NatNetDecoder:
    """Decoder of one NatNet server.

    Parameters
    ----------
    settings : NatNetSettings
        Names in rig.toml, up axis, and latency of cameras without exposure stamp.
    """

    def __init__(self, settings: NatNetSettings) -> None:
        self._bitstream = BitstreamTracker(settings.wanted_version)
        self._latency_ms = settings.latency_ms
        self._time = FrameTime(settings)
        self._wanted_markers = {
            name: f"markers.{part}" for part, names in settings.markers.items() for name in names
        }
        bodies = {name: f"rigid_body.{part}" for part, name in settings.rigid_body.items()}
        self._wanted_bodies = bodies | ({settings.plate: "plate"} if settings.plate else {})
        self._poses = PoseConverter(settings.up_axis)
        self._continuity = NatNetContinuity()
        self._info: ServerInfo | None = None
        self._hz: int | None = None
        self._binding: Binding | None = None
        self._asked: dict[int, int] = {}
        self._announced = 0
        self._live = self._stamped = True
        self._named_unknown: set[int] = set()
        self._messages = self._discarded = 0
        self.unpublished = 0
        """Frames that arrived before the model or the server's version was known."""
        self.unknown_ids = 0
        """Markers and bodies dropped because the model has no such id."""
        self.suspicious = 0
        """Poses, stamps and echoes rejected because their numbers are implausible."""
        self._handlers: dict[type, Callable[[Chunk, Message], list[Decoded]]] = {
            ServerInfo: self._server,
            ModelDefinition: self._model,
            EchoRequest: self._echo_request,
            EchoResponse: self._echo,
            CommandResponse: self._response,
        }

    @property
    def tick_clock(self) -> TickClock | None:
        """The server's high-resolution counter, once its frequency is known and plausible.

        UNIX time where cameras on PTP stamp the frames.
        """
        if self._time.precise:
            return self._time.tick_clock
        return TickClock(0, None, self._hz) if self._hz else None

    @property
    def messages(self) -> int:
        """Well-formed messages of any kind so far."""
        return self._messages

    @property
    def discarded_bytes(self) -> int:
        """Bytes of datagrams that contained no message."""
        return self._discarded

    @property
    def duplicates(self) -> int:
        """Frames dropped because their number was that of the last one."""
        return self._continuity.duplicates

    @property
    def late(self) -> int:
        """Frames dropped because a later one had arrived."""
        return self._continuity.late

    def feed(self, chunk: Chunk) -> list[Decoded]:
        """Return the content of one datagram; never raises."""
        before = self._bitstream.version
        message = self._bitstream.decode(chunk.data)
        if isinstance(message, CorruptBytes):
            return self._unreadable(chunk, message)

        self._messages += 1
        adopted = [] if self._bitstream.version == before else self._adopted()
        if type(message) is FrameOfData:
            return adopted + self._frame(chunk, message)
        handler = self._handlers.get(type(message))
        return adopted if handler is None else adopted + handler(chunk, message)

    def flush(self) -> list[Decoded]:
        """Return nothing: datagrams are complete."""
        return []

    def _unreadable(self, chunk: Chunk, corrupt: CorruptBytes) -> list[Decoded]:
        """Count a datagram as corrupt, unless the bitstream is not known yet."""
        if not self._bitstream.known and is_versioned(chunk.data):
            self._messages += 1
            self.unpublished += chunk.data.startswith(_FRAME)
            return []
        self._discarded += corrupt.discarded
        return [Corrupt(corrupt.discarded, corrupt.reason)]

    # --- who and what -------------------------------------------------------------------------

    def _server(self, _: Chunk, message: Message) -> list[Decoded]:
        info, before = cast("ServerInfo", message), self._info
        if info == before:
            return []

        # An implausible frequency would make every stamp of the frames wrong.
        self._info, self._hz = info, usable_hz(info)
        out: list[Decoded] = [_server_event(info, self._hz)]
        if before is None or same_instance(info, before):
            self._bitstream.announce(info.bitstream)
        else:
            self._bitstream.restart(info.bitstream)
            self._binding = None
            self._continuity.forget()
            out.append(DeviceEvent("restart", f"another server answers: {info.application}"))

        if not supported(info.bitstream):
            name = "{}.{}".format(*info.bitstream)
            text = f"the server uses NatNet {name}, 3.0 or newer is required"
            out.append(DeviceEvent("error", text, {"bitstream": name}))
        return out

    def _adopted(self) -> list[Decoded]:
        name = "{}.{}".format(*self._bitstream.version)
        return [DeviceEvent("setting", f"bitstream changed to {name}", {"bitstream": name})]

    def _response(self, _: Chunk, message: Message) -> list[Decoded]:
        """Process the answer to ``Bitstream,x.y``; other answers are ignored."""
        version = bitstream_response(cast("CommandResponse", message).text)
        if version is not None:
            self._bitstream.confirm(version)
        return []

    def _model(self, _: Chunk, message: Message) -> list[Decoded]:
        model = cast("ModelDefinition", message)
        binding = bind_model(model, self._wanted_markers, self._wanted_bodies)
        before, self._binding = self._binding, binding
        if before is not None and before.layout == binding.layout:
            self._binding = binding = _share_layout(binding, before)
        if before is not None and before.warnings == binding.warnings:
            warnings: tuple[str, ...] = ()
        else:
            warnings = binding.warnings

        out: list[Decoded] = []
        if before is None or before.layout is not binding.layout:
            out.append(_model_event(binding, self.unpublished))

        if not model.complete:
            out.append(
                DeviceEvent("warning", "the model list ends at a description of unknown type")
            )
        unknown = {
            "unknown": list(binding.unknown),
            "known": list(binding.layout.markers[:_MOST_LISTED]),
        }
        self._named_unknown.clear()
        return out + [DeviceEvent("warning", text, unknown) for text in warnings]

    # --- time ---------------------------------------------------------------------------------

    def _echo_request(self, chunk: Chunk, message: Message) -> list[Decoded]:
        """Store the sending time of a recorded client's request."""
        if len(self._asked) >= _PENDING_ECHOES:
            del self._asked[next(iter(self._asked))]
        self._asked[cast("EchoRequest", message).stamp] = chunk.t_ns
        return []

    def _echo(self, chunk: Chunk, message: Message) -> list[Decoded]:
        stamp, ticks = cast("EchoResponse", message)
        sent_ns = self._asked.pop(stamp, stamp)
        if self._time.precise or not 0 <= chunk.t_ns - sent_ns <= _ECHO_LIMIT_NS:
            return []
        if self._hz is not None and ticks > _MOST_SECONDS * self._hz:
            self.suspicious += 1
            return []
        return [ClockEcho(sent_ns, chunk.t_ns, ticks)]

    # --- frames -------------------------------------------------------------------------------

    def _frame(self, chunk: Chunk, frame: FrameOfData) -> list[Decoded]:
        step = self._continuity.frame(frame.number, frame.transmit, chunk.t_ns)
        if not step.use:
            return []
        out: list[Decoded] = []

        if step.restarted:
            out.append(DeviceEvent("restart", f"frame numbers restarted at {frame.number}"))
        elif step.lost:
            out.append(DeviceEvent("gap", f"{step.lost} frames lost", {"lost": step.lost}))
        if frame.params != self._announced:
            out += self._announce(frame.params)

        binding = self._binding
        if binding is None:
            self.unpublished += 1
            return out

        self._time.report_timecode(frame, out)
        found = self._poses.columns(frame, binding)
        if found.suspicious or found.unknown:
            out += self._unknown_id_warning(found.suspicious, found.unknown)
        out.append(
            MocapFrame(
                chunk.t_ns,
                frame.number,
                self._instant(frame, out),
                binding.layout,
                found.markers,
                found.body_positions,
                found.body_orientations,
                self._live,
            )
        )
        return out

    def _instant(self, frame: FrameOfData, out: list[Decoded]) -> int | None:
        """Return the exposure in ticks of the clock in use."""
        if self._time.precise:
            return self._time.unix_ns(frame, out)
        if self._hz is not None and max(frame.exposure, frame.transmit) > _MOST_SECONDS * self._hz:
            self.suspicious += 1
            return None
        return frame.exposure or self._exposure(frame, out)

    def _exposure(self, frame: FrameOfData, out: list[Decoded]) -> int | None:
        """Return the exposure from the configured latency, where the cameras do not stamp it."""
        hz = self._hz
        if hz is None or not frame.transmit:
            return None
        if self._stamped:
            self._stamped = False
            text = f"no exposure stamps (USB cameras?): {self._latency_ms:g} ms before transmission"
            out.append(DeviceEvent("warning", text, {"latency_ms": self._latency_ms}))
        return max(0, frame.transmit - round(self._latency_ms * hz / 1000))

    def _announce(self, params: int) -> list[Decoded]:
        """Return events for newly set flags of the frame."""
        risen, self._announced = params & ~self._announced, params
        events: list[Decoded] = [
            DeviceEvent("setting", text) for bit, text in _ANNOUNCED.items() if risen & bit
        ]

        live = not params & FRAME_EDIT_MODE
        if live != self._live:
            self._live = live
            text = "live again" if live else "edit mode: the frames are a recording"
            events.append(DeviceEvent("setting", text, {"live": live}))
        return events

    def _unknown_id_warning(self, suspicious: int, unknown: tuple[int, ...]) -> list[Decoded]:
        self.suspicious += suspicious
        self.unknown_ids += len(unknown)
        new = [i for i in unknown if i not in self._named_unknown]
        if not new or len(self._named_unknown) >= _NAMED_UNKNOWN:
            return []

        self._named_unknown.update(new)
        names = ", ".join(f"{i >> 16}:{i & 0xFFFF}" for i in new[:_NAMED_UNKNOWN])
        text = f"ids that are not in the model list are dropped: {names}"
        return [DeviceEvent("warning", text, {"ids": new[:_NAMED_UNKNOWN]})]


def _share_layout(binding: Binding, before: Binding) -> Binding:
    """Return `binding` with the equal layout object of `before`."""
    return replace(binding, layout=before.layout)


def _server_event(info: ServerInfo, hz: int | None) -> DeviceEvent:
    firmware = ".".join(map(str, info.application_version))
    natnet = ".".join(map(str, info.natnet_version))
    transport = "multicast" if info.multicast else "unicast"
    text = f"{info.application} {firmware}, NatNet {natnet}, {transport}"
    data = {
        "model": info.application,
        "firmware": firmware,
        "natnet": natnet,
        "transport": transport,
        "clock_hz": hz,
        "data_port": info.data_port,
        "group": info.group,
    }
    return DeviceEvent("info", text, data)


def _model_event(binding: Binding, unpublished: int) -> DeviceEvent:
    layout = binding.layout
    text = f"{len(layout.markers)} markers, {len(layout.bodies)} bodies"
    data = {
        "markers": list(layout.markers[:_MOST_LISTED]),
        "bodies": list(layout.bodies[:_MOST_LISTED]),
        "unpublished": unpublished,
    }
    return DeviceEvent("info", text, data)
