"""One connection to a NatNet server, from CONNECT to silence.

1. The session sends CONNECT every 0.5 s until SERVERINFO arrives. SERVERINFO determines the data
   socket.
2. It sends REQUEST_MODELDEF every 0.5 s until MODELDEF arrives, because frames cannot be used
   without the model.
3. It receives frames. It sends ten echo requests at intervals of 50 ms, then one every 0.8 to
   1.2 s. In unicast, it also sends one KEEPALIVE per second. Frames before the tenth echo answer
   are not synchronized.

Every accepted datagram is emitted in the order of arrival, so that a replay has the same input. The
receiver of the chunks decodes the frames. This module reads the flags of every frame. Once per
second it also decodes a frame, to check that frames can be decoded and that their ids are known.

Invariant: control messages are accepted only as answers to open requests (`OpenRequests`). If the
frames of a server cannot be decoded, the server counts as lost, as if it sent nothing.
"""

from __future__ import annotations

import contextlib
import random
import struct
import time
from typing import TYPE_CHECKING

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_drivers.motion_capture import ServerOutput
from jointfit_drivers.natnet._bitstream import FRAME_START, BitstreamTracker
from jointfit_drivers.natnet._link import NatNetLink
from jointfit_drivers.natnet._open_requests import OpenRequests
from jointfit_drivers.natnet._server_checks import (
    bitstream_response,
    check_group,
    check_server,
    connect_request,
    is_unicast,
    same_instance,
)
from jointfit_protocols import natnet
from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.natnet import NatNetMessageId

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.driver import Emit
    from jointfit_daemon.model import Chunk
    from jointfit_drivers.motion_capture import Route
    from jointfit_drivers.natnet._settings import NatNetSettings

RETRY_S = 0.5
"""Interval between repetitions of a request, s."""
CONNECT_S = 3.0
"""Longest wait for SERVERINFO, s."""
MODEL_S = 5.0
"""Longest wait for MODELDEF, s."""
FIRST_ECHOES, FIRST_ECHO_S = 10, 0.05
ECHO_S = (0.8, 1.2)
"""Range of the interval between echo requests, s. The interval is random, so that the requests have
no fixed phase relative to the frames."""
EVERY_S = 1.0
"""Interval between keep-alive messages, between requests for a changed model, and between checks of
a whole frame, s."""
MISFITS = 3
"""Number of consecutive undecodable frames after which the session requests the bitstream version
again."""

_PARAMS = struct.Struct("<h")
_PARAMS_FROM_END = 6
"""Distance of the flags from the end of a frame, bytes. From bitstream 2.6 on, the flags and an end
tag are the last parts of a frame."""
_SHORTEST_FRAME = 4 + 50


class NatNetSession:
    """One connection. After a loss, the driver creates a new session.

    Parameters
    ----------
    settings : NatNetSettings
        The ``[mocap]`` table.
    route : Route
        Addresses of the server and of this host's network card.
    emit : Emit
        Function that receives every accepted datagram of the server.
    output : ServerOutput, optional
        Output that is shared with the earlier connections.
    """

    def __init__(
        self, settings: NatNetSettings, route: Route, emit: Emit, output: ServerOutput | None = None
    ) -> None:
        self._settings = settings
        self._name = f"NatNet server {settings.server}:{settings.command_port}"
        self._output = output or ServerOutput()
        self._output.begin(emit)
        self._link = NatNetLink(route, settings.command_port, self._take)
        self._open_requests = OpenRequests()
        self._info: natnet.ServerInfo | None = None
        self._bitstream = BitstreamTracker(settings.wanted_version)
        self._confirmed = False
        self._known: frozenset[int] | None = None
        self._foreign_answers = 0
        self._model_wanted = self._info_wanted = False
        self._misfits = 0
        self._next_check_ns = self._frame_ns = 0

    async def run(self) -> None:
        """Connect and read until cancelled. Raises the same errors as `NatNetMocap.run`."""
        with self._link as link:
            info = await self._connect()
            check_server(self._name, self._settings, info)

            unicast = is_unicast(self._settings, info)
            try:
                if not unicast:
                    port = self._settings.data_port or info.data_port
                    check_group(self._name, info, port)
                    try:
                        link.join(info.group, port)
                    except OSError as error:
                        text = (
                            f"cannot join {info.group}:{port} ({error.strerror or error}): check "
                            "the network card and its address, or set interface to another card"
                        )
                        raise DeviceLostError(f"{self._name}: {text}") from error

                # If the server refuses the requested bitstream, its own bitstream is used.
                if self._settings.wanted_version is not None:
                    asked = natnet.CommandRequest(f"Bitstream,{self._settings.bitstream}")
                    await self._request(asked, RETRY_S, lambda: self._confirmed)

                model = natnet.Bare(NatNetMessageId.REQUEST_MODELDEF)
                await self._request(model, MODEL_S, lambda: self._known is not None)
                if self._known is None:
                    raise DeviceLostError(
                        f"{self._name}: the server answers, but sends no readable list of markers "
                        f"and bodies (MODELDEF) within {MODEL_S:g} s: check the network, and "
                        "restart streaming in the camera software"
                    )
                await self._stream(info, unicast)
            finally:
                # The exception that ended the connection must not be replaced by another one.
                with contextlib.suppress(DeviceLostError):
                    link.send(natnet.Bare(NatNetMessageId.DISCONNECT))

    # --- received messages --------------------------------------------------------------------

    def _take(self, chunk: Chunk) -> None:
        if chunk.data.startswith(FRAME_START):
            self._output.emit_frame(chunk)
            self._frame(chunk)
        elif self._open_requests.accept(chunk.data, chunk.t_ns):
            self._output.emit_answer(chunk)
            self._message(chunk)

    def _frame(self, chunk: Chunk) -> None:
        if len(chunk.data) >= _SHORTEST_FRAME and self._bitstream.version >= natnet.FLAGGED:
            (params,) = _PARAMS.unpack_from(chunk.data, len(chunk.data) - _PARAMS_FROM_END)
            self._model_wanted |= bool(params & natnet.FRAME_MODEL_CHANGED)
            self._info_wanted |= bool(params & natnet.FRAME_BITSTREAM_CHANGED)
        if chunk.t_ns < self._next_check_ns or not self._bitstream.known:
            self._frame_ns = chunk.t_ns
            return

        frame = self._bitstream.decode(chunk.data)
        if isinstance(frame, natnet.FrameOfData):
            self._misfits, self._frame_ns = 0, chunk.t_ns
            self._next_check_ns = chunk.t_ns + int(EVERY_S * 1e9)
            known = self._known
            if known is not None and any(body.id not in known for body in frame.bodies):
                self._model_wanted = True
        else:
            self._misfits += 1
            self._info_wanted |= self._misfits >= MISFITS

    def _message(self, chunk: Chunk) -> None:
        match self._bitstream.decode(chunk.data):
            case natnet.ServerInfo() as info:
                self._model_wanted |= self._info not in (None, info)
                self._info = info
                self._bitstream.announce(info.bitstream)
                self._info_wanted = False
            case natnet.ModelDefinition() as model:
                bodies = (d for d in model.descriptions if isinstance(d, natnet.BodyDescription))
                self._known = frozenset(body.id for body in bodies)
                self._model_wanted = False
            case natnet.EchoResponse():
                pass
            case natnet.CommandResponse() as response:
                version = bitstream_response(response.text)
                if version is not None and version == self._settings.wanted_version:
                    self._bitstream.confirm(version)
                    self._confirmed = True
            case CorruptBytes() | natnet.Connect():
                self._foreign_answers += 1
            case _:
                return
        self._link.wake()

    # --- requests -----------------------------------------------------------------------------

    async def _request(
        self, message: natnet.Message, within_s: float, answered: Callable[[], bool]
    ) -> None:
        """Send `message` every half second until it is answered, for at most `within_s`."""
        until = time.monotonic() + within_s
        while not answered() and time.monotonic() < until:
            self._send(message)
            retry_at = min(until, time.monotonic() + RETRY_S)
            while not answered() and (left := retry_at - time.monotonic()) > 0:
                await self._link.pause(left)

    def _send(self, message: natnet.Message) -> None:
        self._open_requests.register(message, time.monotonic_ns())
        self._link.send(message)

    async def _connect(self) -> natnet.ServerInfo:
        await self._request(
            connect_request(self._settings), CONNECT_S, lambda: self._info is not None
        )
        if self._info is not None:
            return self._info
        if self._foreign_answers:
            raise DeviceMisconfiguredError(
                f"{self._name}: the program that answers is not a NatNet server: check server and "
                "command_port (Motive: Streaming pane, command port, 1510 unless changed)"
            )
        raise DeviceLostError(
            f"{self._name}: no answer within {CONNECT_S:g} s: check that the camera software runs, "
            "and check server, command_port and firewalls; `jointfit doctor` names the cause"
        )

    async def _stream(self, info: natnet.ServerInfo, unicast: bool) -> None:
        began_ns = time.monotonic_ns()
        echo_at = alive_at = ask_at = 0.0
        echoes = 0
        while True:
            now = time.monotonic()
            self._check_alive(info, unicast, max(self._frame_ns, began_ns))

            if info.clock_hz and now >= echo_at:
                self._send(natnet.EchoRequest(time.monotonic_ns()))
                echoes += 1
                usual_s = random.uniform(*ECHO_S)  # noqa: S311 - it need not be secret
                echo_at = now + (FIRST_ECHO_S if echoes < FIRST_ECHOES else usual_s)

            if unicast and now >= alive_at:
                self._link.send(natnet.Bare(NatNetMessageId.KEEPALIVE))
                alive_at = now + EVERY_S

            if now >= ask_at and (self._model_wanted or self._info_wanted):
                ask_at = now + EVERY_S
                if self._info_wanted:
                    self._send(connect_request(self._settings))
                if self._model_wanted:
                    self._send(natnet.Bare(NatNetMessageId.REQUEST_MODELDEF))

            due = [echo_at] * bool(info.clock_hz) + [now + self._settings.silence_s / 4]
            await self._link.pause(min(due + [alive_at] * unicast) - now)

    def _check_alive(self, info: natnet.ServerInfo, unicast: bool, last_ns: int) -> None:
        """Raise DeviceLostError if no decodable frame arrives, or if another server answers."""
        if self._info is not None and not same_instance(self._info, info):
            raise DeviceLostError(
                f"{self._name}: the server restarted, or another server took its address "
                f"({self._info.application} answers): connecting again"
            )

        if (time.monotonic_ns() - last_ns) / 1e9 < self._settings.silence_s:
            return

        # The text must not contain a measured duration, because every different text becomes a new
        # line of the log.
        if self._misfits:
            version = "{}.{}".format(*self._bitstream.version)
            raise DeviceLostError(
                f"{self._name}: frames arrive, but none could be decoded as "
                f"NatNet {version}: check that Motive streams the bitstream it announces"
            )

        self._output.silent, hint = True, ""
        if unicast == info.multicast:
            announced = "multicast" if info.multicast else "unicast"
            hint = f"; it announces {announced}, but transport = {self._settings.transport!r}"
        raise DeviceLostError(
            f"{self._name}: no frame for {self._settings.silence_s:g} s{hint}: start "
            "streaming in the camera software and check the network; `jointfit doctor` names the "
            "cause"
        )
