"""Checks of a NatNet server. If the driver cannot work with the server, an error names the remedy.

Invariant: the module is pure. It checks every number of a SERVERINFO that other modules use.
"""

from __future__ import annotations

from ipaddress import IPv4Address
from typing import TYPE_CHECKING

from jointfit_daemon.driver import DeviceMisconfiguredError
from jointfit_drivers.newer_firmware import NewestKnown
from jointfit_protocols.natnet import OLDEST, TICKED, Connect, is_supported

if TYPE_CHECKING:
    from jointfit_drivers.natnet._settings import NatNetSettings
    from jointfit_protocols.natnet import ServerInfo, Version

NEWEST = NewestKnown((4, 2), "Motive", "NatNet")
"""Newest bitstream version with a published description. Sections of later versions are skipped by
their size."""
LEAST_CLOCK_HZ = 1_000
"""Lowest usable frequency of the server's counter, Hz. A slower counter stamps too coarsely."""
MOST_CLOCK_HZ = 100_000_000_000
"""Highest plausible frequency, Hz: ten times the frequency of the fastest processor counter."""
_PLAIN_FORM = 264
_BITSTREAM_FORM = 271
_LONGEST_VERSION = len("99.99")


def connect_request(settings: NatNetSettings) -> Connect:
    """Return the CONNECT message to send, in a form that real servers answer.

    Clients of unicast 4.x servers can select a bitstream version. If the settings name a version,
    the message has the form of the vendor's sample program (271 bytes). Otherwise it has the form
    of the vendor's library NatNetLib 3 (264 bytes).
    """
    wanted = settings.wanted_version
    if wanted is None:
        return Connect(_PLAIN_FORM, "jointfitd", (1, 0, 0, 0), (3, 0, 0, 0))
    return Connect(_BITSTREAM_FORM, "Ping", bitstream=(*wanted, 0, 0))


def is_unicast(settings: NatNetSettings, info: ServerInfo) -> bool:
    """Return whether the frames arrive on the command socket."""
    if settings.transport == "auto":
        # Servers with bitstream 2.x do not announce a transport. The default of Motive was
        # multicast.
        return not info.multicast and info.bitstream >= TICKED
    return settings.transport == "unicast"


def check_server(name: str, settings: NatNetSettings, info: ServerInfo) -> None:
    """Reject a server that cannot work with these settings.

    Raises
    ------
    DeviceMisconfiguredError
        The server is too old or too new, has no clock, or cannot change its bitstream in multicast.
    """
    found = f"{name} ({info.application}) uses NatNet {info.bitstream[0]}.{info.bitstream[1]}"
    if not is_supported(info.bitstream):
        raise DeviceMisconfiguredError(
            f"{found}; {OLDEST[0]}.{OLDEST[1]} or newer is required: update Motive to 1.5 or later"
        )
    if info.bitstream < TICKED:
        return  # frames have no server ticks, so no clock is needed
    if not info.clock_hz:
        raise DeviceMisconfiguredError(
            f"{found} but announces no clock frequency, so its stamps cannot be used: "
            "check that server and command_port lead to Motive"
        )
    if usable_hz(info) is None:
        raise DeviceMisconfiguredError(
            f"{found} and announces a clock frequency of {info.clock_hz} Hz, "
            f"expected {LEAST_CLOCK_HZ} to {MOST_CLOCK_HZ}: "
            "check that server and command_port lead to Motive"
        )
    if info.bitstream[0] > NEWEST.version[0] and settings.wanted_version is None:
        raise DeviceMisconfiguredError(
            f"{found}, which is newer than this driver:"
            " switch Motive to unicast and set bitstream = '4.1'"
        )
    if settings.wanted_version not in (None, info.bitstream) and not is_unicast(settings, info):
        raise DeviceMisconfiguredError(
            f"{found} in multicast, where a client cannot choose the version: remove bitstream ="
            f" {settings.bitstream!r}, or switch Motive to unicast"
        )


def usable_hz(info: ServerInfo) -> int | None:
    """Return the frequency of the server's counter, Hz; None if it is implausible."""
    hz = info.clock_hz
    return hz if hz is not None and LEAST_CLOCK_HZ <= hz <= MOST_CLOCK_HZ else None


def check_group(name: str, info: ServerInfo, port: int) -> None:
    """Reject an invalid multicast address or port.

    Raises
    ------
    DeviceMisconfiguredError
        The server announces an invalid address or port.
    """
    if not IPv4Address(info.group).is_multicast:
        raise DeviceMisconfiguredError(
            f"{name} announces {info.group}, which is not a multicast address:"
            " set Motive's multicast interface, or transport = 'unicast'"
        )
    if not port:
        raise DeviceMisconfiguredError(
            f"{name} announces data port 0: set mocap.data_port to the data port of Motive (1511)"
        )


def same_instance(a: ServerInfo, b: ServerInfo) -> bool:
    """Return whether two answers come from the same server; their bitstream may differ."""
    return a._replace(natnet_version=b.natnet_version) == b


def bitstream_response(text: str) -> Version | None:
    """Return the version in a response ``Bitstream,x.y``; None for any other response."""
    command, *versions = text.split(",")
    if command != "Bitstream" or len(versions) != 1 or len(versions[0]) > _LONGEST_VERSION:
        return None
    major, _, minor = versions[0].partition(".")
    known = major.isascii() and minor.isascii() and major.isdigit() and minor.isdigit()
    return (int(major), int(minor)) if known else None
