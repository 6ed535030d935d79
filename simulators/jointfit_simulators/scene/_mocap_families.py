"""Families of motion-capture servers that a scene can create, by driver name.

A new family needs one function and one entry in `MOCAP_FAMILIES`.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

from jointfit_daemon.units import NS_PER_S
from jointfit_simulators.devices import (
    LslServer,
    LslServerOptions,
    NatNetServer,
    NatNetServerOptions,
    QtmServer,
    QtmServerOptions,
    RigidBodyAsset,
    ViconServer,
    ViconServerOptions,
    VrpnServer,
    VrpnServerOptions,
)

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Mapping, Sequence

    from jointfit_simulators.devices import Bodies, Markers, SampleTiming
    from jointfit_simulators.settings import Knobs

_TAI_MINUS_UTC_S = 37


class MocapServer(Protocol):
    """Virtual motion-capture server on the loopback interface. Its port is open from the start."""

    ready: asyncio.Event
    """Event that is set while `run` answers."""
    number: int
    """Number of the next frame."""
    command_port: int
    """Port to which clients connect."""

    @property
    def sent(self) -> int:
        """Number of sent frames, summed over the clients."""

    def push(self, exposure_host_ns: int, markers: Markers, bodies: Bodies) -> None:
        """Send one frame now.

        Parameters
        ----------
        exposure_host_ns : int
            Exposure time, host CLOCK_MONOTONIC, ns. It is independent of the time of sending.
        markers : mapping of str to (x, y, z) or None
            Position in the world (z up), m; None if occluded.
        bodies : mapping of str to (position, quaternion) or None
            Position in the world (z up), m, and q_world_body (w, x, y, z); None if untracked.
        """

    async def run(self) -> None:
        """Answer requests until cancelled."""

    def unplug(self) -> None:
        """Close the port and disconnect all clients."""

    def restart(self) -> None:
        """Close and reopen the server; frame numbers restart."""


@dataclass(frozen=True, slots=True)
class CameraPlace:
    """Camera data that a scene streams through a server."""

    knobs: Knobs
    """Settings with camera rate and random seed."""
    clusters: Mapping[str, tuple[str, ...]]
    """Marker names of each body part."""
    bodies: Sequence[str]
    """Tracked rigid bodies. Bodies without markers are last."""
    timing: SampleTiming
    """Clock of the server."""
    ptp: bool
    """Whether cameras and host are synchronized by PTP. Some families report PTP time."""
    command_port: int
    """Port on the loopback interface to which clients connect; 0 selects a free port."""

    @property
    def markers_by_body(self) -> dict[str, tuple[str, ...]]:
        """Markers of each rigid body; empty for a body without its own markers."""
        owned = {part.capitalize(): names for part, names in self.clusters.items()}
        return owned | {body: () for body in self.bodies if body not in owned}


@dataclass(frozen=True, slots=True)
class MocapFamily:
    """Motion-capture servers of one driver."""

    create: Callable[[CameraPlace], tuple[MocapServer, list[str]]]
    """Function that returns a server, and the lines that follow the driver in the ``[mocap]``
    table."""
    sync_line: bool = False
    """Whether the ``[mocap]`` table names the sync line of the scene (``sync_line``), which has an
    edge at every exposure.
    """


def _natnet(place: CameraPlace) -> tuple[NatNetServer, list[str]]:
    options = NatNetServerOptions(
        bodies=tuple(
            RigidBodyAsset(body, names, number)
            for number, (body, names) in enumerate(place.markers_by_body.items(), 1)
        ),
        command_port=place.command_port,
        rate_hz=place.knobs.mocap_hz,
        device_ns=place.timing.device_ns,
        seed=place.knobs.seed,
    )
    if place.ptp:
        # PTP uses the time scale TAI. Its offset from the host clock is measured once.
        offset_ns = time.time_ns() - time.monotonic_ns() + _TAI_MINUS_UTC_S * NS_PER_S
        options = replace(
            options, bitstream=(4, 1), precision_ns=lambda host_ns: host_ns + offset_ns
        )

    server = NatNetServer(options)
    lines = [
        'server = "127.0.0.1"',
        f"command_port = {server.command_port}",
        f'up_axis = "{options.up_axis}"',
        *(['time = "ptp"'] if place.ptp else []),
    ]
    return server, lines


def _qtm(place: CameraPlace) -> tuple[QtmServer, list[str]]:
    server = QtmServer(
        QtmServerOptions(
            bodies=tuple(
                RigidBodyAsset(body, names, number)
                for number, (body, names) in enumerate(place.markers_by_body.items(), 1)
            ),
            command_port=place.command_port,
            rate_hz=place.knobs.mocap_hz,
            device_ns=place.timing.device_ns,
            seed=place.knobs.seed,
        )
    )
    return server, ['server = "127.0.0.1"', f"command_port = {server.command_port}"]


def _vicon(place: CameraPlace) -> tuple[ViconServer, list[str]]:
    server = ViconServer(
        ViconServerOptions(
            bodies=tuple(
                RigidBodyAsset(body, names, number)
                for number, (body, names) in enumerate(place.markers_by_body.items(), 1)
            ),
            command_port=place.command_port,
            rate_hz=place.knobs.mocap_hz,
            device_ns=place.timing.device_ns,
            seed=place.knobs.seed,
        )
    )
    return server, ['server = "127.0.0.1"', f"command_port = {server.command_port}"]


def _vrpn(place: CameraPlace) -> tuple[VrpnServer, list[str]]:
    markers = tuple(name for names in place.clusters.values() for name in names)
    options = VrpnServerOptions(
        bodies=tuple(place.bodies),
        markers=markers,
        port=place.command_port,
        device_ns=place.timing.device_ns,
        seed=place.knobs.seed,
    )
    server = VrpnServer(options)
    lines = [
        'server = "127.0.0.1"',
        f"port = {server.command_port}",
        f'up_axis = "{options.up_axis}"',
    ]
    return server, lines


def _lsl_markers(place: CameraPlace) -> tuple[LslServer, list[str]]:
    server = LslServer(
        LslServerOptions(
            markers=tuple(name for names in place.clusters.values() for name in names),
            bodies=tuple(place.bodies),
            rate_hz=place.knobs.mocap_hz,
            # The stamps have the default clock, because clients receive the time of liblsl, which
            # the scene cannot change.
        )
    )
    lines = [f'source_id = "{server.source_id}"', f'up_axis = "{server.options.up_axis}"']
    return server, lines


MOCAP_FAMILIES = {
    "lsl-markers": MocapFamily(_lsl_markers),
    "natnet": MocapFamily(_natnet, sync_line=True),
    "qtm": MocapFamily(_qtm),
    "vicon": MocapFamily(_vicon),
    "vrpn": MocapFamily(_vrpn),
}
"""Families, by driver name."""
