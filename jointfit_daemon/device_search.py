"""Optional abilities of drivers: to find devices, and to name the cause of missing data.

A driver class that has a method of this module is asked by ``jointfit probe``, ``jointfit doctor``
and ``jointfit init``. A driver without it works as before, and is not asked.

Invariant: this module names no device.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

Level = Literal["ok", "note", "warning", "error", "unknown"]
"""Level of a finding; ``unknown``: it could not be checked."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One result of a diagnosis."""

    check: str
    """Subject of the check: ``serial``, ``can``, ``mocap``, ``broker``, ``clock``, ``disk`` and so
    on."""
    id: str
    """Name of the device, interface or file; empty if the subject is the host."""
    level: Level
    text: str
    """The state that was found, and the expected one."""
    remedy: str = ""
    """Command or setting that removes the cause; empty if there is nothing to do."""


@dataclass(frozen=True, slots=True)
class FoundServer:
    """One server of motion capture that answered."""

    driver: str
    """Driver that uses it."""
    server: str
    """Numeric address of the server."""
    port: int
    interface: str
    """Address of this host's network card at which the answer arrived."""
    application: str
    version: str
    """Version of the application."""
    protocol: str
    """Name and version of the protocol, such as ``NatNet 3.1``."""
    transport: str
    """``unicast`` or ``multicast``."""
    bodies: tuple[str, ...] = ()
    """Names of its rigid bodies, if it was asked for them."""
    markers: tuple[str, ...] = ()
    """Names of its labeled markers, if it was asked for them."""


class StreamSearch(Protocol):
    """Ability of a driver with byte streams."""

    usual_bauds: ClassVar[tuple[int, ...]]
    """Speeds at which its devices send, the most frequent first, baud."""


class CanSearch(Protocol):
    """Ability of a driver with CAN frames."""

    @classmethod
    def candidate_tables(cls, seen: Mapping[tuple[int, bool], int]) -> Iterable[Mapping[str, Any]]:
        """Return keys of ``[[imu]]`` tables that may fit, the most probable first.

        Parameters
        ----------
        seen
            Number of data bytes of each identifier that was received, by number and whether it
            has 29 bits.
        """


class ServerSearch(Protocol):
    """Ability of a driver of motion capture to find servers."""

    @classmethod
    async def find_servers(
        cls, hosts: Sequence[str], *, broadcast: bool, port: int | None, wait_s: float
    ) -> list[FoundServer]:
        """Return the servers that answer within `wait_s`.

        Parameters
        ----------
        hosts
            Names or addresses to ask; each answers with its rigid bodies and markers, too.
        broadcast
            Whether to ask all hosts in the networks of this host.
        port
            Command port; None for the usual one.

        Raises
        ------
        OSError
            A host is unknown, or the network cannot be used.
        """


class Diagnosis(Protocol):
    """Ability of a driver to name the cause of missing data."""

    @classmethod
    async def diagnose(cls, settings: Any, wait_s: float) -> list[Finding]:
        """Return the findings for a table of rig.toml; `wait_s` limits the wait for data.

        The search opens the device as the daemon does, and raises no error of the device.
        """
