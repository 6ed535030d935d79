"""Keys of rig.toml that all motion-capture servers on a network have."""

from __future__ import annotations

import re
from ipaddress import IPv4Address

from pydantic import Field, field_validator

from jointfit_daemon.driver import (
    INTERFACE_NAME_EXPECTED,
    MocapSettings,
    host_fault,
    is_interface_name,
)

_DOTTED = re.compile(r"\d+(\.\d+){2,}")
"""Pattern of text that is probably meant as an IPv4 address."""


def _address(text: str) -> IPv4Address | None:
    try:
        return IPv4Address(text)
    except ValueError:
        return None


class ServerSettings(MocapSettings):
    """A ``[mocap]`` table with the address of a server.

    The tables of device families derive from this class.
    """

    server: str = Field(description="address or name of the PC that runs the camera software")
    interface: str | None = Field(
        None,
        description="IPv4 address or name of this host's network card towards the cameras;"
        " default: the card that routes to the server",
    )
    silence_s: float = Field(
        5.0, gt=0, description="time without a frame after which the server counts as lost, s"
    )

    @field_validator("server")
    @classmethod
    def _server_with_a_name(cls, server: str) -> str:
        """Reject text that is neither an address nor a host name."""
        if ":" in server:
            raise ValueError("expected an IPv4 address or a name, without port")
        if (fault := host_fault(server)) is not None:
            raise ValueError(fault)
        if (address := _address(server)) is not None and (
            address.is_multicast or address.is_unspecified
        ):
            raise ValueError(
                f"{server} is not the address of a host: expected the address of the server"
            )
        return server

    @field_validator("interface")
    @classmethod
    def _interface_that_can_exist(cls, interface: str | None) -> str | None:
        """Reject text that is neither an address nor a name that the kernel permits."""
        if interface is not None and not is_interface_name(interface):
            raise ValueError(f"{INTERFACE_NAME_EXPECTED}; or an IPv4 address")
        if interface is not None and _DOTTED.fullmatch(interface) and not _address(interface):
            raise ValueError("expected four numbers from 0 to 255, such as 192.168.1.2")
        return interface
