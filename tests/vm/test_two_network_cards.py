"""The diagnosis of a NatNet server on another host, which two network cards reach."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from jointfit_daemon.tools.discovery import find_mocap_servers
from jointfit_drivers.natnet import NatNetMocap, NatNetSettings
from tests.vm.vcan_link import NEEDS_VCAN

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jointfit_daemon.device_search import Finding

pytestmark = NEEDS_VCAN
ROOT = Path(__file__).resolve().parents[2]
SERVER, FIRST, SECOND = "10.7.0.9", "10.7.0.1", "10.7.0.5"
PATHS = [str(ROOT / folder) for folder in ("", "drivers", "protocols", "simulators")]


def do(*words: str) -> None:
    program = shutil.which(words[0], path="/usr/sbin:/sbin:/usr/bin:/bin")
    assert program is not None
    subprocess.run([program, *words[1:]], check=True)


@pytest.fixture(scope="module")
def peer() -> Iterator[None]:
    """Run a server behind card v0 (10.7.0.1); add a second card w0 (10.7.0.5) to its network."""
    other = subprocess.Popen(["/usr/bin/unshare", "-n", "/bin/sleep", "600"])
    own = Path("/proc/self/ns/net").readlink()
    while Path(f"/proc/{other.pid}/ns/net").readlink() == own:
        time.sleep(0.01)
    inside = ("nsenter", "-t", str(other.pid), "-n")
    do("ip", "link", "add", "v0", "type", "veth", "peer", "name", "v1")
    do("ip", "link", "set", "v1", "netns", str(other.pid))
    do("ip", "link", "add", "w0", "type", "veth", "peer", "name", "w1")
    for name, address in (("v0", FIRST), ("w0", SECOND)):
        do("ip", "addr", "add", f"{address}/24", "brd", "+", "dev", name)
        do("ip", "link", "set", name, "up")
    do("ip", "link", "set", "w1", "up")
    do(*inside, "ip", "addr", "add", f"{SERVER}/24", "brd", "+", "dev", "v1")
    do(*inside, "ip", "link", "set", "v1", "up")
    program = [
        shutil.which("nsenter") or "",
        *inside[1:],
        sys.executable,
        str(ROOT / "tests/vm/natnet_peer.py"),
    ]
    serving = subprocess.Popen(
        [*program, SERVER], env=os.environ | {"PYTHONPATH": os.pathsep.join(PATHS)}
    )
    yield
    for process in (serving, other):
        process.kill()
        process.wait()
    for name in ("v0", "w0"):
        subprocess.run(["/usr/sbin/ip", "link", "del", name], check=False)


async def diagnosed(**settings: str) -> list[Finding]:
    table = {"driver": "natnet", "server": SERVER} | settings
    return await NatNetMocap.diagnose(NatNetSettings.model_validate(table), 2.0)


@pytest.mark.usefixtures("peer")
async def test_the_card_of_the_route_receives_and_the_other_is_named_as_wrong() -> None:
    until = time.monotonic() + 20
    while not await find_mocap_servers([SERVER]) and time.monotonic() < until:
        pass
    risk, stream = await diagnosed()
    assert (risk.level, stream.level) == ("note", "ok")
    assert "several interfaces reach" in risk.text
    assert [each.level for each in await diagnosed(interface="v0")] == ["ok"]

    wrong, other = await diagnosed(interface="w0")
    assert wrong.text.startswith("wrong interface")
    assert "the frames arrive at v0 (10.7.0.1)" in other.text
    assert {wrong.remedy, other.remedy} >= {f'set interface = "{FIRST}" in [mocap]'}


@pytest.mark.usefixtures("peer")
async def test_a_broadcast_finds_the_server_on_the_other_host() -> None:
    found = await find_mocap_servers(broadcast=True)
    assert [(each.server, each.port, each.interface) for each in found] == [(SERVER, 1510, FIRST)]
