"""Diagnosis of "connected, but no data": causes of missing frames, each with its remedy.

The diagnosis connects in the same way as the driver, receives for a limited time, and disconnects.

| cause | evidence |
|---|---|
| wrong interface or subnet | the route uses another card; no card has the server's network |
| multicast on two interfaces | the frames arrive at another card than the card in use |
| firewall | the server answers, but its multicast frames arrive at no card |
| streaming off | the port is closed, or the server answers without sending frames |
| no rigid body or marker set | the stream's model is empty, or lacks names of rig.toml |
| unknown bitstream | the announced version is newer than all supported versions |
| playback paused | frames are flagged as a recording, and the frame number does not change |
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any

from jointfit_daemon.device_search import Finding
from jointfit_daemon.driver import DeviceMisconfiguredError
from jointfit_drivers.motion_capture import (
    CHECK,
    Reception,
    Route,
    host_address,
    summary,
    tracking_findings,
)
from jointfit_drivers.natnet._bitstream import FRAME_START
from jointfit_drivers.natnet._decoder import NatNetDecoder
from jointfit_drivers.natnet._network_findings import card_findings, multicast_arrivals
from jointfit_drivers.natnet._server_checks import NEWEST
from jointfit_drivers.natnet._session import CONNECT_S, MODEL_S, NatNetSession
from jointfit_drivers.ports.network_cards import network_cards
from jointfit_drivers.ports.udp_socket import local_address
from jointfit_protocols.natnet import OLDEST

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit
    from jointfit_daemon.model import Chunk
    from jointfit_drivers.natnet._settings import NatNetSettings

_MULTICAST_S = 1.0
"""Duration of the reception of multicast frames at all network cards, s."""
_STILL = 3
"""Number of repeated frame numbers from which the frames count as paused."""
_STREAMING = (
    "in Motive's Streaming pane enable streaming and select the local interface of this network "
    "(not loopback); in playback, press play"
)


class NatNetReception(Reception):
    """Receives and decodes everything that a NatNet server sends.

    Parameters
    ----------
    settings : NatNetSettings
        The ``[mocap]`` table.
    route : Route
        Addresses of the server and of the network card.
    """

    def __init__(self, settings: NatNetSettings, route: Route) -> None:
        self.datagrams = 0
        """Number of datagrams that contain a frame, whether it was decoded or not."""

        async def connect(emit: Emit) -> None:
            def take(chunk: Chunk) -> None:
                self.datagrams += chunk.data.startswith(FRAME_START)
                emit(chunk)

            await NatNetSession(settings, route, take).run()

        self.decoder = NatNetDecoder(settings)
        super().__init__(self.decoder, connect)


async def diagnose(settings: NatNetSettings, wait_s: float) -> list[Finding]:
    """Return the findings for a ``[mocap]`` table; see `Diagnosis.diagnose`."""
    name = settings.server
    try:
        host = await host_address(name)
    except OSError:
        text = f"no such host: {name!r} has no IPv4 address"
        remedy = "set server in [mocap] to the address of Motive's PC (`ipconfig` displays it)"
        return [Finding(CHECK, name, "error", text, remedy)]

    cards = network_cards()
    try:
        local = local_address(host, settings.interface)
    except OSError as error:
        listed = ", ".join(f"{card.name} ({card.address})" for card in cards)
        if settings.interface is None:
            text = f"no route to {host}: {error.strerror}; this host has {listed}"
            return [Finding(CHECK, name, "error", text, f"run `ip route get {host}`")]
        text = f"no network card {settings.interface!r}; this host has {listed}"
        remedy = "set interface in [mocap] to one of them, or remove the key"
        return [Finding(CHECK, name, "error", text, remedy)]
    routed = None
    with contextlib.suppress(OSError):
        routed = local_address(host, None)

    patient = settings.model_copy(update={"silence_s": wait_s})
    reception = NatNetReception(patient, Route(host, local))
    await reception.receive(CONNECT_S + MODEL_S + wait_s)
    findings = card_findings(
        name, host, local, routed, cards,
        chosen=settings.interface is not None, arrived=bool(reception.frames),
    )  # fmt: skip
    if reception.frames:
        return [*findings, *_stream_findings(settings, reception)]
    if "natnet" not in reception.facts:
        return [*findings, _unanswered_finding(settings, reception.failure)]
    missing = await _missing_frames(settings, Route(host, local), reception)
    return [*findings, *missing]


def _unanswered_finding(settings: NatNetSettings, failure: Exception | None) -> Finding:
    """Return the finding for a server that does not answer CONNECT."""
    name, port = settings.server, settings.command_port
    if isinstance(failure, DeviceMisconfiguredError):
        remedy = "set server and command_port in [mocap] to the values in Motive's Streaming pane"
        return Finding(CHECK, name, "error", str(failure), remedy)
    refused = failure is not None and isinstance(failure.__cause__, ConnectionRefusedError)
    if refused:
        text = f"streaming off: {name} refuses UDP port {port}, because no program listens"
        return Finding(CHECK, name, "error", text, f"start Motive; {_STREAMING}")
    text = (
        f"no answer from {name}, UDP port {port}: the address is wrong, a firewall drops the "
        "datagrams, or streaming is off"
    )
    remedy = f"ping {name}; allow Motive in the firewall of its PC; {_STREAMING}"
    return Finding(CHECK, name, "error", text, remedy)


async def _missing_frames(
    settings: NatNetSettings, route: Route, reception: NatNetReception
) -> list[Finding]:
    """Return the findings for a server that answers but sends no usable frame."""
    name, server, failure = settings.server, reception.facts, reception.failure
    natnet = ".".join(str(server["natnet"]).split(".")[:2])
    major = int(natnet.partition(".")[0])
    oldest = ".".join(map(str, OLDEST))

    newest = NEWEST.version[0]
    if major > newest or (reception.datagrams and major >= newest):
        text = f"the server streams bitstream {natnet}, the newest known version is {NEWEST.text}"
        remedy = 'switch Motive to unicast, and set bitstream = "4.1" in [mocap]'
        return [Finding(CHECK, name, "error", text, remedy)]
    if tuple(map(int, natnet.split("."))) < OLDEST:
        text = f"the server streams bitstream {natnet}, expected {oldest} or newer"
        return [Finding(CHECK, name, "error", text, "update Motive to 1.5 or later")]
    if reception.datagrams or isinstance(failure, DeviceMisconfiguredError):
        remedy = "restart streaming in Motive; `jointfit decode natnet` displays a capture"
        text = str(failure) if failure is not None else "frames arrive before the model"
        return [Finding(CHECK, name, "error", text, remedy)]

    multicast = server["transport"] == "multicast"
    if settings.transport not in ("auto", server["transport"]):
        text = f"the server sends {server['transport']}, but transport = {settings.transport!r}"
        return [Finding(CHECK, name, "error", text, 'set transport = "auto" in [mocap]')]
    if multicast:
        return [await _missing_multicast(settings, route, server)]
    text = "streaming off: the server answers, but sends no frame"
    return [Finding(CHECK, name, "error", text, _STREAMING)]


async def _missing_multicast(
    settings: NatNetSettings, route: Route, server: dict[str, Any]
) -> Finding:
    """Return the finding that frames arrive at another card, or at no card."""
    host, local = route
    name, group = settings.server, str(server["group"])
    port = settings.data_port or int(server["data_port"])

    cards = network_cards()
    arrivals = await multicast_arrivals(group, port, host, cards, _MULTICAST_S)
    other = next((c for c in cards if arrivals[c.address] and c.address != local), None)
    if other is not None:
        text = (
            f"multicast on two interfaces: the frames arrive at {other.name} ({other.address}), "
            f"not at {local}"
        )
        return Finding(CHECK, name, "error", text, f'set interface = "{other.address}" in [mocap]')

    text = (
        f"the server answers, but its multicast frames ({group}, UDP port {port}) arrive at no "
        "network card: a firewall or a switch drops them, or streaming is off"
    )
    remedy = (
        f"sudo ufw allow proto udp from {host} to any port {port} (or the same rule of your "
        f"firewall); or select unicast in Motive; {_STREAMING}"
    )
    return Finding(CHECK, name, "error", text, remedy)


def _stream_findings(settings: NatNetSettings, reception: NatNetReception) -> list[Finding]:
    """Return the findings about the content of the stream of frames."""
    name, frames = settings.server, reception.frames
    layout = frames[-1].layout
    findings = []

    if not layout.bodies and not layout.markers:
        findings.append(
            Finding(
                CHECK, name, "error", "the stream has no rigid body and no marker set",
                "in Motive create the assets, tick them in the Assets pane, and enable Rigid "
                "Bodies and Labeled Markers in the Streaming pane",
            )
        )  # fmt: skip
    for text in reception.warnings:
        remedy = "correct the names in [mocap], or the names of the assets in Motive"
        findings.append(Finding(CHECK, name, "error", text, remedy))

    still = reception.decoder.duplicates >= _STILL
    if not frames[-1].live:
        text = "playback paused: the frames repeat one instant of a recording"
        if not still:
            text = "the frames come from a recording (edit mode), not from the cameras"
        level: Any = "error" if still else "warning"
        findings.append(Finding(CHECK, name, level, text, "switch Motive to live mode"))
    elif still:
        text = "the frame number stands still: the cameras are paused"
        findings.append(Finding(CHECK, name, "error", text, "resume the cameras in Motive"))

    remedy = "check its marker positions in Motive"
    findings += tracking_findings(settings, frames, name, remedy)
    return findings or [summary(frames, name)]
