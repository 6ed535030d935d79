"""NatNet diagnosis: a cause of "connected, but no data" is named if and only if it is present."""

from __future__ import annotations

import time
from collections.abc import Callable
from ipaddress import IPv4Network
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_drivers.natnet import NatNetMocap, NatNetSettings, _diagnosis, _session
from jointfit_drivers.natnet._network_findings import card_findings, multicast_arrivals
from jointfit_drivers.ports.network_cards import NetworkCard, network_cards
from jointfit_simulators.devices import NatNetServer, NatNetServerOptions, RigidBodyAsset
from tests.drivers.motion_capture.mocap_run import answering

if TYPE_CHECKING:
    from contextlib import AbstractAsyncContextManager

    from jointfit_daemon.device_search import Finding

THIGH = RigidBodyAsset("Thigh", ("T1", "T2", "T3"), 1)
POSE = ((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0))
SEEN: tuple[dict[str, Any], dict[str, Any]] = ({"T1": (1.0, 2.0, 3.0)}, {"Thigh": POSE})
HIDDEN: tuple[dict[str, Any], dict[str, Any]] = ({}, {"Thigh": None})
Before = Callable[[NatNetServer], None]


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jointfit_drivers.motion_capture._reception.FRAMES_S", 0.3)
    monkeypatch.setattr(_diagnosis, "_MULTICAST_S", 0.3)
    monkeypatch.setattr(_session, "CONNECT_S", 0.5)


def served(
    server: NatNetServer, scene: Any, before: Before = lambda _: None
) -> AbstractAsyncContextManager[None]:
    """Run a server that answers and, unless `scene` is None, sends a frame every 10 ms."""

    def push() -> None:
        before(server)
        server.push(time.monotonic_ns(), *scene)

    return answering(server, None if scene is None else push)


async def findings(server: NatNetServer, **settings: Any) -> list[Finding]:
    table = {"driver": "natnet", "server": "127.0.0.1", "command_port": server.command_port}
    return await NatNetMocap.diagnose(NatNetSettings.model_validate(table | settings), 0.5)


def made(**options: Any) -> NatNetServer:
    return NatNetServer(NatNetServerOptions(**({"bodies": (THIGH,)} | options)))


@pytest.mark.parametrize("transport", ["unicast", "multicast"])
async def test_a_stream_without_a_fault_is_the_only_finding(transport: str) -> None:
    server = made(transport=transport)
    async with served(server, SEEN):
        (found,) = await findings(server, rigid_body={"thigh": "Thigh"})
    assert (found.level, found.id, found.remedy) == ("ok", "127.0.0.1", "")
    assert "1 rigid bodies, 3 markers" in found.text


def edit(server: NatNetServer) -> None:
    server.edit_mode = True


def paused(server: NatNetServer) -> None:
    server.edit_mode, server.number = True, 7


def standing(server: NatNetServer) -> None:
    server.number = 7


FAULTS: dict[str, tuple[dict[str, Any], Any, Before, dict[str, Any], str, str]] = {
    # name: options, scene, change before each frame, settings, text, remedy
    "streaming off": ({}, None, edit, {}, "sends no frame", "enable streaming"),
    "firewall": (
        {"transport": "multicast"}, None, edit, {}, "a firewall", "sudo ufw allow proto udp from",
    ),
    "empty model": ({"bodies": ()}, ({}, {}), lambda _: None, {}, "no rigid body", "Assets pane"),
    "unknown name": (
        {}, SEEN, lambda _: None, {"rigid_body": {"thigh": "Tigh"}}, "did you mean 'Thigh'",
        "correct the names",
    ),
    "newer bitstream": (
        {"bitstream": (5, 0)}, None, edit, {}, "bitstream 5.0, the newest known version is 4.2",
        'bitstream = "4.1"',
    ),
    "paused": ({}, SEEN, paused, {}, "playback paused", "live mode"),
    "recording": ({}, SEEN, edit, {}, "from a recording", "live mode"),
    "cameras paused": ({}, SEEN, standing, {}, "stands still", "resume"),
    "hidden": (
        {}, HIDDEN, lambda _: None, {"rigid_body": {"thigh": "Thigh"}}, "was not tracked", "view",
    ),
    "transport": ({}, None, edit, {"transport": "multicast"}, "sends unicast", '"auto"'),
}  # fmt: skip


@pytest.mark.parametrize("name", FAULTS)
async def test_each_cause_has_one_finding_and_its_remedy(name: str) -> None:
    options, scene, before, settings, text, remedy = FAULTS[name]
    server = made(**options)
    async with served(server, scene, before):
        (found,) = await findings(server, **settings)
    assert found.level in ("warning", "error")
    assert text in found.text
    assert remedy in found.remedy


async def test_a_closed_port_is_streaming_off() -> None:
    server = made()
    server.unplug()
    (found,) = await findings(server)
    assert "streaming off: 127.0.0.1 refuses UDP port" in found.text
    assert found.remedy.startswith("start Motive")


async def test_a_server_that_does_not_answer_may_be_behind_a_firewall() -> None:
    server = made()  # its port is open, but nothing answers
    (found,) = await findings(server)
    server.unplug()
    assert "no answer" in found.text
    assert "firewall" in found.text
    assert "ping 127.0.0.1" in found.remedy


async def test_a_wrong_name_or_card_is_found_without_a_server() -> None:
    (host,) = await NatNetMocap.diagnose(
        NatNetSettings(driver="natnet", server="no-such-host.invalid"), 0.1
    )
    assert "no such host" in host.text
    (card,) = await NatNetMocap.diagnose(
        NatNetSettings(driver="natnet", server="127.0.0.1", interface="eth99"), 0.1
    )
    assert "no network card 'eth99'; this host has " in card.text
    assert "127.0.0.1" in card.text


def card(name: str, address: str) -> NetworkCard:
    return NetworkCard(name, address, IPv4Network(f"{address}/24", strict=False), None, False)


ETH, WLAN = card("eth0", "192.168.1.5"), card("wlan0", "192.168.1.9")
OTHER = card("eth1", "10.0.0.5")


@pytest.mark.parametrize(
    ("local", "routed", "cards", "text"),
    [
        ("192.168.1.5", "192.168.1.5", [ETH, OTHER], None),
        ("10.0.0.5", "192.168.1.5", [ETH, OTHER], "wrong interface"),
        ("10.0.0.5", "10.0.0.5", [OTHER], "another subnet"),
        ("192.168.1.5", "192.168.1.5", [ETH, WLAN], "several interfaces"),
    ],
)
def test_the_choice_of_the_network_card_is_checked(
    local: str, routed: str, cards: list[NetworkCard], text: str | None
) -> None:
    found = card_findings("motive", "192.168.1.20", local, routed, cards)
    assert [each.text.startswith(text or "") for each in found] == ([] if text is None else [True])


def test_two_cards_are_a_note_with_frames_and_nothing_once_one_is_chosen() -> None:
    """If frames arrive, a second card that reaches the server is a note and no fault."""
    cards = [ETH, WLAN]
    where = ("motive", "192.168.1.20", ETH.address, ETH.address, cards)
    (risk,) = card_findings(*where, arrived=True)
    assert (risk.level, risk.remedy.split(" in ")[0]) == ("note", 'set interface = "192.168.1.5"')
    assert card_findings(*where, chosen=True) == []


async def test_multicast_frames_are_counted_at_each_card() -> None:
    server = made(transport="multicast")
    (loopback,) = (card for card in network_cards() if card.loopback)
    async with served(server, SEEN):
        group = server.options.group, server.data_port
        arrivals = await multicast_arrivals(*group, "127.0.0.1", [loopback], 0.2)
        others = await multicast_arrivals(*group, "127.0.0.9", [loopback], 0.1)
    assert arrivals["127.0.0.1"] > 5
    assert others["127.0.0.1"] == 0  # frames of another server


async def test_frames_at_another_card_are_multicast_on_two_interfaces(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Multicast may arrive at another card of this host than the one that the driver uses."""

    async def at_the_other(*_: object) -> dict[str, int]:
        return {ETH.address: 0, OTHER.address: 90}

    monkeypatch.setattr(_diagnosis, "multicast_arrivals", at_the_other)
    monkeypatch.setattr(_diagnosis, "network_cards", lambda: [ETH, OTHER])
    server = made(transport="multicast")
    async with served(server, None):
        (found,) = await findings(server)
    assert "arrive at eth1 (10.0.0.5), not at" in found.text
    assert found.remedy == 'set interface = "10.0.0.5" in [mocap]'
