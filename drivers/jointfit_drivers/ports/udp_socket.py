"""UDP sockets that return the arrival time of every datagram.

The kernel stamps datagrams at their arrival, and `SocketStamps` converts the stamps. The datagram
endpoint of asyncio does not return these stamps (ancillary data), so this module reads the sockets
itself.
"""

from __future__ import annotations

import array
import contextlib
import fcntl
import socket
import struct
import time
from typing import NamedTuple

from jointfit_drivers.ports._socket_stamps import ANCILLARY_BYTES, SocketStamps

MAX_DATAGRAM = 65_507
"""Largest payload of a UDP datagram over IPv4, bytes."""
DRAIN = 64
"""Largest number of datagrams read per wake-up. Further datagrams stay in the queue, so that other
sockets are read as well."""
RECEIVE_BUFFER = 1 << 20
"""Requested size of the receive buffer, bytes. It holds half a second of large frames while the
host is busy."""

_IP_RECVERR = 11
"""Socket option with which an ICMP refusal becomes an error of this socket, whether or not the
socket is connected."""
_IP_MULTICAST_ALL = 49
"""Socket option. The value 0 restricts reception to the groups that this socket joined."""
_SIOCGIFADDR = 0x8915
_ATTACH_FILTER = getattr(socket, "SO_ATTACH_FILTER", 26)
_INSTRUCTION = struct.Struct("@HBBI")
_PROGRAM = struct.Struct("@HL")
_LOAD_WORD, _JUMP_IF_EQUAL, _RETURN = 0x20, 0x15, 0x06  # classic BPF
_SOURCE_ADDRESS = 0xFFF00000 + 12
"""Offset of the source address in packet filters: SKF_NET_OFF plus the offset in the IP header."""
_WHOLE_PACKET = 0xFFFFFFFF


class Datagram(NamedTuple):
    """One received datagram."""

    t_ns: int
    """CLOCK_MONOTONIC at the datagram's arrival in the kernel, ns."""
    data: bytes
    host: str
    """Source address of the datagram."""
    port: int
    """Source port of the datagram."""


class UdpSocket:
    """A non-blocking UDP socket that returns the arrival time of every datagram.

    Parameters
    ----------
    address, port : str, int
        Local address and port to which the socket is bound.
    sender : str
        Numeric address of the sender. The kernel drops datagrams of other senders, so a flood of
        them costs the daemon no time.
    shared : bool
        Whether other programs of this host may bind the same address and port.
    """

    def __init__(self, address: str, port: int, *, sender: str, shared: bool = False) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            self._stamps = SocketStamps(self._socket)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
            self._socket.setsockopt(socket.IPPROTO_IP, _IP_RECVERR, 1)
            if shared:
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)

            # The kernel drops datagrams of other senders. The reader checks the sender again.
            (source,) = struct.unpack("!I", socket.inet_aton(sender))
            program = array.array(
                "B",
                _INSTRUCTION.pack(_LOAD_WORD, 0, 0, _SOURCE_ADDRESS)
                + _INSTRUCTION.pack(_JUMP_IF_EQUAL, 0, 1, source)
                + _INSTRUCTION.pack(_RETURN, 0, 0, _WHOLE_PACKET)
                + _INSTRUCTION.pack(_RETURN, 0, 0, 0),
            )
            start, size = program.buffer_info()
            described = _PROGRAM.pack(size // _INSTRUCTION.size, start)
            with contextlib.suppress(OSError):  # a kernel without socket filters
                self._socket.setsockopt(socket.SOL_SOCKET, _ATTACH_FILTER, described)

            self._socket.bind((address, port))
        except OSError:
            self._socket.close()
            raise

    @classmethod
    def in_group(cls, group: str, port: int, local: str, *, sender: str) -> UdpSocket:
        """Open a socket that receives one multicast group at the network card with address `local`.

        The socket is bound to the group itself, which excludes other groups on the same port.
        """
        opened = cls(group, port, sender=sender, shared=True)
        try:
            opened._socket.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
            member = socket.inet_aton(group) + socket.inet_aton(local)
            opened._socket.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
        except OSError:
            opened.close()
            raise
        return opened

    def fileno(self) -> int:
        """Return the file descriptor, for ``loop.add_reader``."""
        return self._socket.fileno()

    @property
    def port(self) -> int:
        """Local port to which the socket is bound."""
        return int(self._socket.getsockname()[1])

    def close(self) -> None:
        """Close the socket, which also leaves its multicast group."""
        self._socket.close()

    def send(self, data: bytes, address: tuple[str, int]) -> None:
        """Send one datagram. It is dropped if the queue of the network card is full."""
        with contextlib.suppress(BlockingIOError):
            self._socket.sendto(data, address)

    def receive(self) -> list[Datagram]:
        """Return the datagrams that have arrived, at most `DRAIN`.

        Raises
        ------
        OSError
            The socket failed. In particular, ConnectionRefusedError means that no program listens
            at the destination of a datagram that was sent.
        """
        self._stamps.pair()
        found: list[Datagram] = []
        for _ in range(DRAIN):
            try:
                data, ancillary, _, address = self._socket.recvmsg(MAX_DATAGRAM, ANCILLARY_BYTES)
            except BlockingIOError:
                break
            except OSError:
                self._drop_errors()
                if found:  # a refusal together with datagrams is forged or stale
                    break
                raise

            now_ns = time.monotonic_ns()
            found.append(Datagram(self._stamps.arrival(ancillary, now_ns), data, *address))

        if not found:
            self._drop_errors()  # woken by a refusal that `send` has already reported
        return found

    def _drop_errors(self) -> None:
        """Empty the error queue of the socket, which otherwise stays readable."""
        with contextlib.suppress(OSError):
            while True:
                self._socket.recvmsg(1, 0, socket.MSG_ERRQUEUE)


def local_address(server: str, interface: str | None) -> str:
    """Return the IPv4 address of the network card to use.

    Parameters
    ----------
    server : str
        Numeric address of the server.
    interface : str, optional
        Address or name of the card. None selects the card that the kernel uses for the server.

    Raises
    ------
    OSError
        The card does not exist, or there is no route to the server.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        if interface is None:
            probe.connect((server, 9))  # sends no packet: reads the routing table
            return str(probe.getsockname()[0])
        try:
            return socket.inet_ntoa(socket.inet_aton(interface))
        except OSError:
            name = struct.pack("256s", interface.encode()[:15])
            return socket.inet_ntoa(fcntl.ioctl(probe, _SIOCGIFADDR, name)[20:24])
