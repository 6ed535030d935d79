"""One connection to a VRPN server, from its start until it is lost or silent.

1. The session opens a TCP connection to the server. With ``connection = "classic"``, it announces
   itself by UDP twice, 2 s apart, and the server connects back.
2. Both sides send a cookie that contains their version. The session refuses a server whose major
   version differs from its own.
3. With ``transport = "udp"``, the session sends the UDP port for poses.
4. Poses follow. After half of `silence_s` without a pose, the session sends pings, at
   intervals of at most 1 s. The error message can then name the cause: no server, or no visible
   body.

Invariant: every chunk is emitted in the order of arrival, so that a replay has the same input.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_drivers.motion_capture import ServerOutput
from jointfit_drivers.ports.tcp_connection import TcpConnection, TcpListener
from jointfit_drivers.ports.udp_socket import UdpSocket
from jointfit_drivers.vrpn._link import VrpnLink
from jointfit_protocols import vrpn

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit
    from jointfit_daemon.model import Chunk
    from jointfit_drivers.motion_capture import Route
    from jointfit_drivers.vrpn._settings import VrpnSettings

CONNECT_S = 3.0
"""Longest wait for the connection, and for the cookie, s."""
ANNOUNCE_S, ANNOUNCEMENTS = 2.0, 2
"""Interval between the announcements of a classic connection, s, and number of announcements."""
_PING_S = 1.0
_TYPES = {vrpn.PING: 0, vrpn.PONG: 1}
_SENDER = 0


class VrpnSession:
    """One connection. After a loss, the driver creates a new session.

    Parameters
    ----------
    settings : VrpnSettings
        The ``[mocap]`` table.
    route : Route
        Numeric addresses of the server and of this host's network card.
    emit : Emit
        Function that receives every chunk from the server.
    output : ServerOutput, optional
        Output that is shared with the earlier connections.
    """

    def __init__(
        self, settings: VrpnSettings, route: Route, emit: Emit, output: ServerOutput | None = None
    ) -> None:
        self._settings = settings
        self._route = route
        self._name = f"VRPN server {settings.server}:{settings.port}"
        self._output = output or ServerOutput()
        self._output.begin(emit)
        self._codec = vrpn.VrpnCodec()
        self._cookie: vrpn.Cookie | None = None
        self._foreign = False
        self._pose_ns = self._pong_ns = 0
        self._link: VrpnLink | None = None

    async def run(self) -> None:
        """Connect and read until cancelled. The errors are those of `VrpnMocap.run`."""
        classic = self._settings.connection == "classic"
        connection = await (self._announce() if classic else self._connect())
        with VrpnLink(self._name, connection, _TYPES, self._take) as link:
            self._link = link
            link.send(vrpn.Cookie())
            await self._await_cookie(link)
            for name, number in _TYPES.items():
                link.send(vrpn.TypeDescription(number, name))
            if self._settings.transport == "udp":
                port = link.open_udp(self._route)
                link.send(vrpn.UdpChannel(port, self._route.local))
            await self._stream(link)

    # --- connection ---------------------------------------------------------------------------

    async def _connect(self) -> TcpConnection:
        host, local = self._route
        try:
            return await TcpConnection.open(
                host, self._settings.port, local=local, within_s=CONNECT_S
            )
        except ConnectionRefusedError as error:
            raise DeviceLostError(
                f"{self._name}: no program listens on this TCP port: start the VRPN server in the "
                'camera software, or set connection = "classic" if it accepts no direct connection'
            ) from error
        except TimeoutError as error:
            raise DeviceLostError(
                f"{self._name}: no answer within {CONNECT_S:g} s: check server, port and firewalls"
            ) from error
        except OSError as error:
            raise DeviceLostError(
                f"{self._name}: {error.strerror or error}: check network cable, address of the "
                "network card, and server"
            ) from error

    async def _announce(self) -> TcpConnection:
        """Request the server by UDP to connect back, and return its connection."""
        host, local = self._route
        listener = TcpListener(local)
        try:
            port = UdpSocket(local, 0, sender=host)
            try:
                announcement = vrpn.Announcement(local, listener.port)
                for _ in range(ANNOUNCEMENTS):
                    port.send(vrpn.encode_announcement(announcement), (host, self._settings.port))
                    connection = await listener.accept(host, ANNOUNCE_S)
                    if connection is not None:
                        return connection
            except OSError as error:
                raise DeviceLostError(
                    f"{self._name}: {error.strerror or error}: start the VRPN server in the camera "
                    "software, and check server and port"
                ) from error
            finally:
                port.close()
        finally:
            listener.close()
        raise DeviceLostError(
            f"{self._name}: did not connect back within {ANNOUNCE_S * ANNOUNCEMENTS:g} s: a "
            'firewall of this host drops the connection, or the server is off; connection = "tcp" '
            "needs no connection back"
        )

    async def _await_cookie(self, link: VrpnLink) -> None:
        """Wait for the cookie with the version of the server.

        Raises
        ------
        DeviceLostError
            The server sends nothing.
        DeviceMisconfiguredError
            The answering program is not a VRPN server, or its major version differs.
        """
        until = time.monotonic() + CONNECT_S
        while self._cookie is None and not self._foreign and time.monotonic() < until:
            await link.pause(until - time.monotonic())

        if self._foreign:
            raise DeviceMisconfiguredError(
                f"{self._name}: the program that answers is not a VRPN server: check server and "
                f"port ({vrpn.DEFAULT_PORT} unless changed)"
            )
        if self._cookie is None:
            raise DeviceLostError(
                f"{self._name}: accepts connections, but sends nothing within {CONNECT_S:g} s: "
                "restart the camera software, and check that `port` belongs to its VRPN server"
            )
        major, minor, _ = self._cookie
        if major != vrpn.MAJOR:
            raise DeviceMisconfiguredError(
                f"{self._name}: uses VRPN {major:02d}.{minor:02d}, expected "
                f"{vrpn.MAJOR:02d}.xx: install a server of version {vrpn.MAJOR}"
            )

    # --- received chunks ----------------------------------------------------------------------

    def _take(self, chunk: Chunk) -> None:
        """Emit one chunk, and store its cookie and the times of its poses and pongs."""
        emit = self._output.emit_answer
        for message in self._codec.feed(chunk.data):
            match message:
                case vrpn.TrackerPose():
                    self._pose_ns, emit = chunk.t_ns, self._output.emit_frame
                case vrpn.Pong():
                    self._pong_ns = chunk.t_ns
                case vrpn.Cookie():
                    self._cookie = message
        self._foreign |= self._cookie is None

        emit(chunk)
        if self._link is not None and (self._pose_ns == 0 or self._codec.lost):
            self._link.wake()

    async def _stream(self, link: VrpnLink) -> None:
        """Wait, and raise the error that ends the stream: silence, or an invalid message."""
        began_ns = time.monotonic_ns()
        silence_s, pinged = self._settings.silence_s, False
        while True:
            if self._codec.lost:
                raise DeviceLostError(
                    f"{self._name}: sent a message of impossible length: connecting again"
                )
            quiet_s = (time.monotonic_ns() - max(self._pose_ns, began_ns)) / 1e9
            if quiet_s >= silence_s:
                raise self._silence()

            # Only a server without recent data is queried, because some servers do not answer.
            if quiet_s >= silence_s / 2:
                if not pinged and self._codec.senders:
                    # The first sender is the connection itself, which does not answer pings.
                    name = next(reversed(self._codec.senders.values()))
                    link.send(vrpn.SenderDescription(_SENDER, name))
                    pinged = True
                if pinged:
                    link.send(vrpn.Ping(time.time_ns() // 1000, _SENDER))
            await link.pause(min(_PING_S, silence_s / 4))

    def _silence(self) -> DeviceLostError:
        """Return the error for a server that sends no poses, with the probable cause."""
        self._output.silent = True
        if self._pong_ns > self._pose_ns:
            cause = "it answers, but sends no pose: bring the bodies into view, or start streaming"
        elif not self._codec.senders:
            cause = "it has described no body: create rigid bodies and start streaming"
        else:
            cause = "bring the bodies into view, and start streaming in the camera software"
        if self._settings.transport == "udp" and not self._pose_ns:
            cause += '; or a firewall drops the datagrams: set transport = "tcp"'
        return DeviceLostError(f"{self._name}: no pose for {self._settings.silence_s:g} s: {cause}")
