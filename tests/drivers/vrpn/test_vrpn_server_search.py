"""Search for VRPN servers, the causes of missing poses, and the query to a silent server."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.driver import DeviceLostError
from jointfit_drivers.vrpn import VrpnMocap, VrpnSettings
from jointfit_simulators.devices import TextServer, VrpnServer, VrpnServerOptions
from tests.drivers.motion_capture.mocap_run import answering

if TYPE_CHECKING:
    from contextlib import AbstractAsyncContextManager

pytestmark = pytest.mark.real_time

OPTIONS = VrpnServerOptions(bodies=("Thigh", "Shank"))
POSE = ((0.1, 0.2, 0.3), (1.0, 0.0, 0.0, 0.0))


def settings(port: int, **more: Any) -> VrpnSettings:
    table = {"driver": "vrpn", "server": "127.0.0.1", "port": port, "silence_s": 0.4}
    return VrpnSettings.model_validate(table | {"rigid_body": {"thigh": "Thigh"}} | more)


def serving(server: Any, *visible: str) -> AbstractAsyncContextManager[None]:
    """Run a server that sends the poses of the visible bodies at 100 Hz."""

    def push() -> None:
        server.push(time.monotonic_ns(), {}, dict.fromkeys(visible, POSE))

    return answering(server, push if visible else None)


async def test_a_server_is_found_with_its_version_and_bodies() -> None:
    server = VrpnServer(OPTIONS)
    async with serving(server, "Thigh", "Shank"):
        (found,) = await VrpnMocap.find_servers(
            ["127.0.0.1"], broadcast=True, port=server.command_port, wait_s=0.5
        )
    assert (found.driver, found.server, found.port) == ("vrpn", "127.0.0.1", server.command_port)
    assert found.version == "07.38"
    assert found.bodies == ("Thigh", "Shank")


@pytest.mark.parametrize("server", [TextServer(b"HTTP/1.1 400 Bad Request\r\n\r\n"), None])
async def test_a_port_without_vrpn_server_is_not_reported(server: TextServer | None) -> None:
    other = server or TextServer(b"")
    async with serving(other):
        if server is None:
            other.unplug()
        found = await VrpnMocap.find_servers(
            ["127.0.0.1"], broadcast=False, port=other.command_port, wait_s=0.3
        )
    assert found == []


async def test_an_unknown_host_is_named_with_the_remedy() -> None:
    with pytest.raises(OSError, match=r"no\.such\.host\.invalid: no such host .*set the address"):
        await VrpnMocap.find_servers(
            ["no.such.host.invalid"], broadcast=False, port=None, wait_s=0.1
        )


async def test_diagnosis_of_a_server_with_the_wanted_body_has_no_error() -> None:
    server = VrpnServer(OPTIONS)
    async with serving(server, "Thigh", "Shank"):
        findings = await VrpnMocap.diagnose(settings(server.command_port), 0.3)
    assert [finding for finding in findings if finding.level == "error"] == []


async def test_diagnosis_names_a_body_that_the_server_does_not_have() -> None:
    server = VrpnServer(OPTIONS)
    wanted = settings(server.command_port, rigid_body={"thigh": "Femur"})
    async with serving(server, "Thigh", "Shank"):
        findings = await VrpnMocap.diagnose(wanted, 0.3)
    assert any("Femur" in finding.text for finding in findings if finding.level != "ok")


async def test_diagnosis_of_a_server_without_poses_names_the_remedy() -> None:
    server = VrpnServer(OPTIONS)
    async with serving(server):
        (finding,) = await VrpnMocap.diagnose(settings(server.command_port), 0.3)
    assert finding.level == "error"
    assert "no pose" in finding.text
    assert "rigid bodies" in finding.remedy


@pytest.mark.parametrize(
    ("answers", "cause"),
    [(True, "it answers, but sends no pose"), (False, "bring the bodies into view")],
)
async def test_a_silent_server_is_asked_whether_it_still_answers(
    *, answers: bool, cause: str
) -> None:
    server = VrpnServer(VrpnServerOptions(bodies=("Thigh",), answers_ping=answers))
    async with serving(server):
        with pytest.raises(DeviceLostError, match=cause):
            await asyncio.wait_for(
                VrpnMocap(settings(server.command_port)).run(lambda _: None), 5.0
            )
