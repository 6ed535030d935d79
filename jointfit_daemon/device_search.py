"""Optional driver methods that find devices or name the cause of missing data.

``jointfit probe``, ``jointfit doctor`` and ``jointfit init`` call these methods. A driver class may
implement any of them; the commands skip drivers without the method.

Invariant: this module contains no code for a particular device model.
"""

from __future__ import annotations

from collections.abc import Mapping  # noqa: TC003 - type of an attribute of a dataclass
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

Level = Literal["ok", "note", "warning", "error", "unknown"]
"""Level of a finding. ``unknown`` means that the check could not be made."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One result of a diagnosis."""

    check: str
    """Subject of the check, such as ``serial``, ``can``, ``mocap``, ``broker``, ``clock`` or
    ``disk``."""
    id: str
    """Name of the device, interface or file; empty if the subject is the host."""
    level: Level
    text: str
    """State that was found, and state that was expected."""
    remedy: str = ""
    """Command or setting that removes the cause; empty if there is nothing to do."""


@dataclass(frozen=True, slots=True)
class FoundServer:
    """One motion-capture server that answered the search."""

    driver: str
    """Name of the driver that reads data from this server."""
    server: str
    """Numeric address of the server."""
    port: int
    interface: str
    """Address of this host's network card at which the answer arrived."""
    application: str
    version: str
    """Version of the server application."""
    protocol: str
    """Name and version of the protocol, such as ``NatNet 3.1``."""
    transport: str
    """``unicast`` or ``multicast``."""
    bodies: tuple[str, ...] = ()
    """Names of the server's rigid bodies; empty if they were not requested."""
    markers: tuple[str, ...] = ()
    """Names of the server's labeled markers; empty if they were not requested."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Further keys of ``[mocap]`` that select this server among others at the same address."""


class StreamSearch(Protocol):
    """Search attributes of a driver whose devices send byte streams."""

    usual_bauds: ClassVar[tuple[int, ...]]
    """Usual speeds of the devices, baud, the most frequent first."""


class CanSearch(Protocol):
    """Search method of a driver whose devices send CAN frames."""

    @classmethod
    def candidate_tables(cls, seen: Mapping[tuple[int, bool], int]) -> Iterable[Mapping[str, Any]]:
        """Return partial ``[[imu]]`` tables that may describe the sender, the most probable first.

        Parameters
        ----------
        seen
            Number of data bytes of the received CAN frames, by identifier. A key of the mapping
            consists of the identifier and a flag, which is true if the identifier has 29 bits.
        """


class ServerSearch(Protocol):
    """Search method of a driver for motion-capture servers."""

    @classmethod
    async def find_servers(
        cls, hosts: Sequence[str], *, broadcast: bool, port: int | None, wait_s: float
    ) -> list[FoundServer]:
        """Return the servers that answer within `wait_s`.

        Parameters
        ----------
        hosts
            Names or addresses of hosts to query. The names of rigid bodies and markers are also
            requested from these hosts.
        broadcast
            Whether to query all hosts in the networks of this host.
        port
            Command port; None for the usual port.

        Raises
        ------
        OSError
            A host is unknown, or the network cannot be used.
        """


class Diagnosis(Protocol):
    """Driver method that names the cause of missing data."""

    @classmethod
    async def diagnose(cls, settings: Any, wait_s: float) -> list[Finding]:
        """Return the findings for the device that one table of rig.toml describes.

        The method opens the device in the same way as the daemon, and waits for at most `wait_s`.
        Errors of the device become findings, not exceptions.
        """
