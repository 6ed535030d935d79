"""Decoder of VRPN servers: converts messages to optical frames.

The poses of one instant form a frame (`FrameAssembler`). The name of a body is the name of its
tracker. The name is known when the server has described the tracker. Earlier reports of the tracker
are dropped. Names in rig.toml that are still unknown after half a second are reported.

Invariant: the output depends only on the chunks fed. The decoder reads no clock and no socket.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from jointfit_daemon.model import Corrupt, DeviceEvent, MocapFrame, TickClock
from jointfit_drivers.backlog import BacklogDelay
from jointfit_drivers.motion_capture import (
    ABSENT,
    NO_POSITION,
    ColumnBinding,
    ModelEntry,
    UnitCheck,
    bind_columns,
    renew_columns,
    rows_array,
    unit_quaternion,
    wanted_names,
    world_rotation,
)
from jointfit_drivers.newer_firmware import NewerFirmwareDetector, NewestKnown
from jointfit_drivers.vrpn._frame_assembler import FrameAssembler, ReportedFrame
from jointfit_protocols import vrpn
from jointfit_protocols.corrupt import CorruptBytes

if TYPE_CHECKING:
    from collections.abc import Iterable

    from jointfit_daemon.model import Chunk, Decoded, Quaternion, Vector
    from jointfit_drivers.motion_capture import ColumnKey
    from jointfit_drivers.vrpn._settings import VrpnSettings

_STEP_US = 100_000
"""Smallest difference between elapsed server time and elapsed arrival time that counts as a step of
the server's clock, µs."""
_PACE_US = 250_000
"""Time with messages at the server's own rate after which their delay is known, µs."""
_LATEST_US = 1_000_000
"""Longest delay of the first messages of a connection, µs."""
_SETTLED_US = 500_000
"""Time after the first report after which missing names are reported, µs."""
_FARTHEST_M = 1_000.0
"""Largest plausible coordinate, m. Some servers send larger values for bodies that are not
visible."""
_MOST_BODIES = 2000
"""Largest number of bodies per server. Further bodies are dropped, because each takes memory."""
_DESCRIBING = (vrpn.Cookie, vrpn.SenderDescription, vrpn.TypeDescription)
_MOST_DESCRIBED_BYTES = 1_000_000
"""Largest size of the stored chunks that describe the connection, bytes."""
_NEWEST = NewestKnown((vrpn.MAJOR, vrpn.MINOR), "the camera software", "VRPN")
_CLOCKS = {"server": TickClock(1000, None), "utc": TickClock(1000, None, None, "unix")}


class VrpnDecoder:
    """Decoder of one VRPN server.

    Parameters
    ----------
    settings : VrpnSettings
        The ``[mocap]`` table with names, unit, up axis and clock.
    """

    def __init__(self, settings: VrpnSettings) -> None:
        self._codec = vrpn.VrpnCodec()
        self._assembler = FrameAssembler()
        self._newer = NewerFirmwareDetector(_NEWEST, sightings=1)
        self._clock = _CLOCKS[settings.time]
        self._wanted_markers, self._wanted_bodies = wanted_names(settings)
        self._place, self._turn = world_rotation(settings.up_axis)
        self._scale = 0.001 if settings.unit == "mm" else 1.0
        self._unit_check = UnitCheck(settings.unit)
        self._bodies: dict[tuple[str, int], None] = {}
        """Bodies that have sent a report, in the order of their first report."""
        self._described: list[bytes] = []
        self._binding: ColumnBinding | None = None
        self._stale_binding = True
        self._settled = False
        self._number = 0
        self._first_us: int | None = None
        self._last: tuple[int, int] | None = None  # time and arrival of the last frame, µs
        self._delay = BacklogDelay()
        self._named_unknown: set[int] = set()
        self.unknown_ids = 0
        """Number of reports dropped because the server has not described their sender, or has too
        many bodies."""
        self.suspicious = 0
        """Number of poses rejected because of implausible numbers."""

    @property
    def tick_clock(self) -> TickClock:
        """Clock of the server: UNIX time in µs."""
        return self._clock

    @property
    def messages(self) -> int:
        """Number of well-formed messages of any kind so far."""
        return self._codec.messages

    @property
    def discarded_bytes(self) -> int:
        """Number of bytes so far that belong to no message."""
        return self._codec.discarded

    @property
    def late_reports(self) -> int:
        """Number of reports dropped because their frame had ended or a later report had arrived."""
        return self._assembler.late

    @property
    def repeated_reports(self) -> int:
        """Number of reports dropped because their body had already reported at the same time."""
        return self._assembler.duplicates

    def feed(self, chunk: Chunk) -> list[Decoded]:
        """Return the frames that `chunk` completes, and events; never raise."""
        out: list[Decoded] = []
        messages = self._codec.feed(chunk.data)
        if any(isinstance(message, _DESCRIBING) for message in messages):
            self._keep_description(chunk.data, messages)
        for message in messages:
            match message:
                case vrpn.TrackerPose():
                    self._report(message, chunk.t_ns, out)
                case CorruptBytes():
                    out.append(Corrupt(message.discarded, message.reason))
                case vrpn.Cookie():
                    # A new connection begins, so the state of the server is discarded.
                    version = f"{message.major:02d}.{message.minor:02d}"
                    out.append(DeviceEvent("info", f"VRPN {version}", {"vrpn": version}))
                    if message.major != vrpn.MAJOR:
                        text = f"the server uses VRPN {version}, expected {vrpn.MAJOR:02d}.xx"
                        out.append(DeviceEvent("error", text, {"vrpn": version}))
                    else:
                        out += self._newer.take_version(version)
                    self._assembler.forget()
                    self._named_unknown.clear()
                    self._stale_binding = True
                case vrpn.SenderDescription():
                    self._stale_binding = True
                case vrpn.Disconnect():
                    out.append(DeviceEvent("info", "the server ended the connection"))
        return out

    def _keep_description(self, data: bytes, messages: Iterable[object]) -> None:
        if any(isinstance(message, vrpn.Cookie) for message in messages):
            self._described = []
        if sum(map(len, self._described)) + len(data) <= _MOST_DESCRIBED_BYTES:
            self._described.append(data)

    @property
    def description(self) -> tuple[bytes, ...]:
        """Chunks with the cookie of the connection and the names of senders and types."""
        return tuple(self._described)

    def flush(self) -> list[Decoded]:
        """Return the unfinished frame, and discard an incomplete message."""
        out: list[Decoded] = []
        for frame in self._assembler.flush():
            self._frame(frame, out)
        out += [Corrupt(item.discarded, item.reason) for item in self._codec.flush()]
        return out

    # --- reports ------------------------------------------------------------------------------

    def _report(self, report: vrpn.TrackerPose, arrival_ns: int, out: list[Decoded]) -> None:
        """Add the pose of one body; append the frames that this report completes."""
        name = self._codec.senders.get(report.sender)
        if name is None:
            self.unknown_ids += 1
            if report.sender not in self._named_unknown and not self._named_unknown:
                self._named_unknown.add(report.sender)
                text = f"poses of sender {report.sender}, which has no name yet, are dropped"
                out.append(DeviceEvent("warning", text, {"ids": [report.sender]}))
            return

        key = (name, report.sensor)
        if key not in self._bodies:
            if len(self._bodies) >= _MOST_BODIES:
                self.unknown_ids += 1
                return
            self._bodies[key] = None
            self._stale_binding = True
        for frame in self._assembler.feed(key, report, arrival_ns):
            self._frame(frame, out)

    def _frame(self, frame: ReportedFrame, out: list[Decoded]) -> None:
        """Append one frame after the events that it causes."""
        self._check_clock(frame, out)
        if self._first_us is None:
            self._first_us = frame.time_us
        if not self._settled and frame.time_us - self._first_us >= _SETTLED_US:
            self._settled = self._stale_binding = True
        binding = self._bind(out)

        poses: dict[ColumnKey, tuple[Vector, Quaternion | None]] = {}
        scale = self._scale
        for key, report in frame.reports.items():
            x, y, z = scale * report.x, scale * report.y, scale * report.z
            if abs(x) <= _FARTHEST_M and abs(y) <= _FARTHEST_M and abs(z) <= _FARTHEST_M:
                turn = unit_quaternion(report.qw, report.qx, report.qy, report.qz)
                poses[key] = self._place(x, y, z), None if turn is None else self._turn(*turn)
            else:
                self.suspicious += 1
            if (text := self._unit_check.feed(report.x, report.y, report.z)) is not None:
                out.append(DeviceEvent("warning", text))

        places = [poses.get(key, ABSENT) for key in binding.bodies]
        whole = [(position, turn) if turn is not None else ABSENT for position, turn in places]
        self.suspicious += sum(turn is None for _, turn in places)
        self._number += 1
        out.append(
            MocapFrame(
                frame.arrival_ns,
                self._number,
                frame.time_us,
                binding.layout,
                rows_array([poses.get(k, (NO_POSITION,))[0] for k in binding.markers], 3),
                rows_array([position for position, _ in whole], 3),
                rows_array([turn for _, turn in whole], 4),
                counted=False,
            )
        )

    def _check_clock(self, frame: ReportedFrame, out: list[Decoded]) -> None:
        """Report a step of the server's clock that delayed messages do not explain."""
        last, now_us = self._last, frame.arrival_ns // 1000
        self._last = (frame.time_us, now_us)
        if last is None:
            return
        advance_us, elapsed_us = frame.time_us - last[0], now_us - last[1]
        delay_us = self._delay.limit(_PACE_US, _LATEST_US)
        # If less server time than arrival time elapsed, the network delayed the message. A decrease
        # of server time is always a step.
        if 0 <= advance_us <= elapsed_us + delay_us + _STEP_US:
            self._delay.feed(advance_us, elapsed_us)
            return

        self._delay = BacklogDelay()
        self._first_us = frame.time_us
        step_s = (advance_us - elapsed_us) / 1e6
        text = f"clock of the server stepped by {step_s:+.3f} s"
        out.append(DeviceEvent("restart", text, {"step_s": step_s}))

    # --- names --------------------------------------------------------------------------------

    def _bind(self, out: list[Decoded]) -> ColumnBinding:
        """Return the columns, which change after a new name; append the events of changes."""
        before = self._binding
        if before is not None and not self._stale_binding:
            return before

        # The columns are the bodies that have sent reports, and the described bodies that rig.toml
        # names.
        wanted = {**self._wanted_markers, **self._wanted_bodies}
        described = set(self._codec.senders.values())
        keys = dict(self._bodies)
        for name in wanted:
            tracker, _, sensor = name.rpartition("#")
            key = (tracker, int(sensor)) if tracker and sensor.isdecimal() else (name, 0)
            if key[0] in described:
                keys.setdefault(key)
        entries = []
        for tracker, number in keys:
            numbered = f"{tracker}#{number}"
            plain = numbered if number or numbered in wanted else tracker
            entries.append(ModelEntry((tracker, number), "", plain, number + 1))

        # Trackers that rig.toml lists as markers are markers. All others are bodies.
        markers = [entry for entry in entries if entry.name in self._wanted_markers]
        others = [entry for entry in entries if entry.name not in self._wanted_markers]
        binding = bind_columns(markers, others, self._wanted_markers, self._wanted_bodies)
        if not self._settled:
            binding = replace(binding, warnings=(), unknown=())
        binding, events = renew_columns(before, binding)
        out += events
        self._binding, self._stale_binding = binding, False
        return binding
