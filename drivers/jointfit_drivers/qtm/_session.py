"""One connection to a QTM server, from its start until it is lost or silent.

1. QTM sends a greeting. The session then sends ``Version`` for each version from 1.25 down to 1.19,
   until QTM accepts one.
2. The session sends ``GetState``, and then ``GetParameters`` every second until QTM has parameters.
3. The session sends ``StreamFrames``, which has no answer. Frames follow, or "no more data" while
   QTM waits for a measurement.

Every packet is emitted in the order of arrival, so that a replay has the same input. The receiver
of the chunks decodes the frames. Once per second this module decodes one frame, to check that it
fits the settings.

Invariant: at most one command waits for its answer. Events, errors and frames may arrive before the
answer.
"""

from __future__ import annotations

import time
from functools import partial
from typing import TYPE_CHECKING

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_daemon.model import Chunk
from jointfit_drivers.motion_capture import ServerOutput, TcpLink
from jointfit_drivers.ports.udp_socket import UdpSocket
from jointfit_protocols import qtm
from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.qtm import ComponentType, PacketType, QtmEvent

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit
    from jointfit_drivers.motion_capture import Route
    from jointfit_drivers.ports.tcp_connection import ReceivedBytes
    from jointfit_drivers.qtm._settings import QtmSettings

ANSWER_S = 3.0
"""Longest wait for the answer to a command, s."""
RETRY_S = 1.0
"""Interval between requests for parameters, and between checks of complete frames, s."""
RESUME_S = 2.0
"""Time after the start of a measurement after which missing frames are requested again, s."""
VERSIONS = tuple(f"1.{minor}" for minor in range(25, 18, -1))
"""Versions of the protocol that the driver requests, in order of preference."""
GREETING = "QTM RT Interface connected"
START = "start QTM, and a new measurement or the preview"
_DATA_TYPES = {PacketType.DATA, PacketType.NO_MORE_DATA}
_SETTINGS_EVENTS = {
    QtmEvent.CAPTURE_STARTED, QtmEvent.CAPTURE_STOPPED, QtmEvent.CALIBRATION_STARTED,
    QtmEvent.CALIBRATION_STOPPED, QtmEvent.RT_FROM_FILE_STARTED, QtmEvent.RT_FROM_FILE_STOPPED,
    QtmEvent.CAMERA_SETTINGS_CHANGED,
}  # fmt: skip
_STARTING_EVENTS = {QtmEvent.CAPTURE_STARTED, QtmEvent.RT_FROM_FILE_STARTED}


class QtmSession:
    """One connection. After a loss, the driver creates a new session.

    Parameters
    ----------
    settings : QtmSettings
        The ``[mocap]`` table.
    route : Route
        Addresses of the server and of this host's network card.
    emit : Emit
        Function that receives every packet of the server.
    output : ServerOutput, optional
        Output that is shared with the earlier connections.
    """

    def __init__(
        self, settings: QtmSettings, route: Route, emit: Emit, output: ServerOutput | None = None
    ) -> None:
        self._settings = settings
        self._route = route
        self._output = output or ServerOutput()
        self._output.begin(emit)
        self.version: str | None = None
        """Protocol version in use."""
        self._name = f"QTM server {settings.server}:{settings.command_port}"
        self._link = TcpLink(self._name, f"{START}, and check command_port", self._read)
        self._stream = qtm.QtmStream()
        self._answers: list[qtm.Message] = []
        self._greeted = False
        self._described: qtm.QtmSettingsXml | None = None
        self._parameters_wanted = True
        self._waiting = False
        self._started_ns: int | None = None
        self._frame_ns = self._next_check_ns = 0

    async def run(self) -> None:
        """Connect and read until cancelled. The errors are those of `QtmMocap.run`."""
        with self._link as link:
            # The data port must be bound before QTM is requested to send to it.
            udp_port = None
            if self._settings.transport == "udp":
                port = self._settings.data_port or 0
                try:
                    udp = UdpSocket(self._route.local, port, sender=self._route.host)
                except OSError as error:
                    raise DeviceLostError(
                        f"{self._name}: cannot receive at UDP port {port} "
                        f"({error.strerror or error}): another program uses it; remove data_port"
                    ) from error
                link.watch(udp, partial(self._read_udp, udp))
                udp_port = udp.port

            await link.open(self._route, self._settings.command_port)
            await self._greet()
            await self._negotiate()
            await self._ask("GetState", qtm.Event)
            await self._stream_frames(udp_port)

    # --- received packets ---------------------------------------------------------------------

    def _read(self, segment: ReceivedBytes) -> None:
        for packet in self._stream.feed(segment.data):
            if not isinstance(packet, CorruptBytes):
                self._take(Chunk(segment.t_ns, packet))
            elif self._greeted:
                raise DeviceLostError(f"{self._name}: invalid packet size: connecting again")
            elif GREETING.encode() in segment.data:
                port = self._settings.command_port
                raise DeviceMisconfiguredError(
                    f"{self._name}: this port sends big-endian: set command_port = {port - 1}, the "
                    "little-endian port (base port of QTM plus 1)"
                )
            else:
                raise _not_qtm(self._name)

    def _read_udp(self, udp: UdpSocket) -> None:
        try:
            arrivals = udp.receive()
        except OSError:  # an ICMP refusal is forged, because this socket sends nothing
            return
        for arrival in arrivals:
            if arrival.host == self._route.host and _packet_type(arrival.data) in _DATA_TYPES:
                self._take(Chunk(arrival.t_ns, arrival.data))

    def _take(self, chunk: Chunk) -> None:
        kind = _packet_type(chunk.data)
        if kind == PacketType.DATA:
            self._waiting, self._started_ns = False, None
            self._output.emit_frame(chunk)
            self._check_frame(chunk)
            return

        self._output.emit_answer(chunk)
        match qtm.decode(chunk.data):
            case qtm.NoMoreData():
                self._waiting = True
            case qtm.Event(number) as event:
                self._parameters_wanted |= number in _SETTINGS_EVENTS
                if number in _STARTING_EVENTS:
                    self._started_ns = chunk.t_ns
                self._answers.append(event)
                if number == QtmEvent.SHUTTING_DOWN:
                    self._link.fail(DeviceLostError(f"{self._name}: QTM shuts down: {START}"))
            case qtm.SettingsReply(xml) as reply:
                self._described = qtm.parse_settings(xml)
                self._answers.append(reply)
            case qtm.Command() | qtm.ErrorReply() as reply:
                self._answers.append(reply)
            case _:
                return
        self._link.wake()

    def _check_frame(self, chunk: Chunk) -> None:
        """Decode one frame per second.

        If it does not fit the settings, request the settings again.
        """
        self._frame_ns = chunk.t_ns
        described = self._described
        if chunk.t_ns < self._next_check_ns or described is None:
            return
        self._next_check_ns = chunk.t_ns + int(RETRY_S * 1e9)
        frame = qtm.decode(chunk.data)
        if not isinstance(frame, qtm.DataFrame):
            return
        bodies = described.bodies or ()
        counts = {
            ComponentType.MARKERS_RESIDUAL: {len(described.labels or ())},
            ComponentType.BODIES_RESIDUAL: {len(bodies), sum(body.enabled for body in bodies)},
        }
        self._parameters_wanted |= any(
            isinstance(part, qtm.ItemsComponent)
            and len(part.items) not in counts.get(ComponentType(part.type), {len(part.items)})
            for part in frame.components
        )

    # --- commands -----------------------------------------------------------------------------

    async def _greet(self) -> None:
        try:
            greeting = await self._answer((qtm.Command, qtm.ErrorReply), GREETING)
        except DeviceLostError as error:
            raise DeviceLostError(
                f"{self._name}: connected, but no greeting: check server and command_port (QTM: "
                "Project Options, Real-Time Output, base port plus 1)"
            ) from error
        if isinstance(greeting, qtm.ErrorReply):
            raise DeviceLostError(
                f"{self._name} refuses the connection: {greeting.text!r}: close other clients"
            )
        if not isinstance(greeting, qtm.Command) or not greeting.text.startswith(GREETING):
            raise _not_qtm(self._name)
        self._greeted = True

    async def _negotiate(self) -> None:
        for version in VERSIONS:
            answer = await self._ask(f"Version {version}", qtm.Command, qtm.ErrorReply)
            if isinstance(answer, qtm.Command) and answer.text.lower().startswith("version set"):
                self.version = version
                return
        found = await self._ask("QTMVersion", qtm.Command, qtm.ErrorReply)
        program = f" ({found.text})" if isinstance(found, qtm.Command) else ""
        raise DeviceMisconfiguredError(
            f"{self._name}{program} supports none of the protocol versions {VERSIONS[-1]} to "
            f"{VERSIONS[0]}: if it is older than QTM 2019, update it; if it is newer than this "
            "program, update jointfitd"
        )

    async def _ask(self, command: str, *kinds: type) -> qtm.Message:
        """Send a command; return its answer: the first message whose type is in `kinds`."""
        self._answers.clear()
        self._link.send(qtm.encode(qtm.Command(command)))
        return await self._answer(kinds, command)

    async def _answer(self, kinds: tuple[type, ...], command: str) -> qtm.Message:
        until = time.monotonic() + ANSWER_S
        while True:
            while self._answers:
                answer = self._answers.pop(0)
                if isinstance(answer, kinds):
                    return answer
            if time.monotonic() >= until:
                raise DeviceLostError(
                    f"{self._name}: no answer to {command!r} within {ANSWER_S:g} s: restart the "
                    "real-time output of QTM"
                )
            try:
                await self._link.pause(until - time.monotonic())
            except DeviceLostError:
                if not self._answers:  # a refusal arrives before the end of the connection
                    raise

    def _request_frames(self, udp_port: int | None) -> None:
        # This command has no answer. Frames follow, or "no more data", or an error.
        to = "" if udp_port is None else f"UDP:{udp_port} "
        parts = "6DRes 3DRes Timecode" + " Skeleton:global" * self._settings.skeleton
        self._link.send(qtm.encode(qtm.Command(f"StreamFrames AllFrames {to}{parts}")))

    async def _stream_frames(self, udp_port: int | None) -> None:
        began_ns = time.monotonic_ns()
        ask_at, requested = 0.0, False
        self._answers.clear()
        while True:
            now_ns, now = time.monotonic_ns(), time.monotonic()
            if self._parameters_wanted and now >= ask_at:
                self._parameters_wanted = False
                parts = "General 3D 6D" + " Skeleton:global" * self._settings.skeleton
                command = f"GetParameters {parts}"
                answer = await self._ask(command, qtm.SettingsReply, qtm.ErrorReply)
                if not isinstance(answer, qtm.SettingsReply):
                    self._parameters_wanted, self._waiting = True, True
                ask_at = time.monotonic() + RETRY_S
            if not requested and self._described is not None:
                self._request_frames(udp_port)
                requested, began_ns = True, time.monotonic_ns()

            started_ns = self._started_ns
            if started_ns is not None and now_ns - started_ns > RESUME_S * 1e9:
                self._started_ns = now_ns
                self._request_frames(udp_port)

            refusals = [a.text for a in self._answers if isinstance(a, qtm.ErrorReply)]
            self._answers.clear()
            if refusals and not self._frame_ns:
                raise DeviceMisconfiguredError(
                    f"{self._name} refuses to stream: {refusals[0]!r}: check its version and "
                    "options"
                )
            self._check_alive(max(self._frame_ns, began_ns), udp_port)
            wait_s = self._settings.silence_s / 4
            await self._link.pause(min(wait_s, RETRY_S / 2) if self._parameters_wanted else wait_s)

    def _check_alive(self, last_ns: int, udp_port: int | None) -> None:
        """Raise DeviceLostError if no frames arrive, except while QTM waits for a measurement."""
        if self._waiting or (time.monotonic_ns() - last_ns) / 1e9 < self._settings.silence_s:
            return
        self._output.silent = True
        hint = "" if udp_port is None else ", and allow UDP in firewalls or set transport = 'tcp'"
        raise DeviceLostError(
            f"{self._name}: no frame for {self._settings.silence_s:g} s: {START}{hint}, or let "
            "`jointfit doctor` name the cause"
        )


def _packet_type(packet: bytes) -> int | None:
    return qtm.HEADER.unpack_from(packet)[1] if len(packet) >= qtm.HEADER.size else None


def _not_qtm(name: str) -> DeviceMisconfiguredError:
    return DeviceMisconfiguredError(
        f"{name}: the program that answers is not QTM: check server and command_port (QTM: Project "
        "Options, Real-Time Output, base port plus 1)"
    )
