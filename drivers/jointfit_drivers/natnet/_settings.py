"""The ``[mocap]`` table of a NatNet server."""

from __future__ import annotations

import re
from ipaddress import IPv4Address
from typing import Literal

from pydantic import Field, field_validator

from jointfit_daemon.driver import (
    INTERFACE_NAME_EXPECTED,
    MocapSettings,
    host_fault,
    is_interface_name,
)

_DOTTED = re.compile(r"\d+(\.\d+){2,}")
"""Numbers that are meant as an IPv4 address."""


def _address(text: str) -> IPv4Address | None:
    try:
        return IPv4Address(text)
    except ValueError:
        return None


class NatNetSettings(MocapSettings):
    """The ``[mocap]`` table for OptiTrack Motive and other servers of NatNet 3 or 4."""

    server: str = Field(description="address or name of the PC that runs Motive")
    interface: str | None = Field(
        None,
        description="IPv4 address or name of this host's network card towards the cameras;"
        " default: the card that routes to the server",
    )
    transport: Literal["auto", "unicast", "multicast"] = Field(
        "auto", description="transport of the frames; `auto` follows the announcement of the server"
    )
    command_port: int = Field(1510, ge=1, le=65535, description="command port of the server")
    data_port: int | None = Field(
        None, ge=1, le=65535, description="port of multicast frames; default: as announced"
    )
    bitstream: Literal["3.0", "3.1", "4.0", "4.1", "4.2"] | None = Field(
        None, description="bitstream to ask a unicast 4.x server for; default: the server's own"
    )
    latency_ms: float = Field(
        10.0,
        ge=0,
        le=1000,
        description="from exposure to transmission, for cameras without exposure stamp (USB) "
        "or on PTP, ms",
    )
    time: Literal["server", "ptp", "utc"] = Field(
        "server",
        description="clock of the frames: the `server`'s own counter, measured by echoes; or the "
        "precision timestamp of cameras on PTP (bitstream 4.1), if PTP also sets this host's "
        "clock: `ptp` counts as PTP does (TAI), `utc` as UNIX time does",
    )
    tai_minus_utc_s: int = Field(
        37, ge=0, le=100, description="leap seconds by which PTP time is ahead of UTC"
    )
    silence_s: float = Field(5.0, gt=0, description="no frame for this long is a lost server, s")

    @field_validator("server")
    @classmethod
    def _server_with_a_name(cls, server: str) -> str:
        """Refuse text that is neither an address nor a host name."""
        if ":" in server:
            raise ValueError("expected an IPv4 address or a name, without port")
        if (fault := host_fault(server)) is not None:
            raise ValueError(fault)
        if (address := _address(server)) is not None and (
            address.is_multicast or address.is_unspecified
        ):
            raise ValueError(f"{server} is the address of no host: expected that of the server")
        return server

    @field_validator("interface")
    @classmethod
    def _interface_that_can_exist(cls, interface: str | None) -> str | None:
        """Refuse a value that is neither an address nor a name that the kernel allows."""
        if interface is not None and not is_interface_name(interface):
            raise ValueError(f"{INTERFACE_NAME_EXPECTED}; or an IPv4 address")
        if interface is not None and _DOTTED.fullmatch(interface) and not _address(interface):
            raise ValueError("expected four numbers from 0 to 255, such as 192.168.1.2")
        return interface

    @property
    def wanted_version(self) -> tuple[int, int] | None:
        """`bitstream` as numbers."""
        if self.bitstream is None:
            return None
        major, minor = self.bitstream.split(".")
        return int(major), int(minor)

    @property
    def usual_delay_ms(self) -> tuple[float, float] | None:
        """Mean and standard deviation, ms, of the delay from exposure to arrival.

        The value applies to frames stamped by PTP. It is None for frames stamped by the server,
        whose clock is measured by echoes.
        """
        return None if self.time == "server" else (self.latency_ms, self.latency_ms / 2)
