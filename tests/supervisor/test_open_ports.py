"""Open ports: the daemon has none, and the demo listens on this machine only."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from jointfit_daemon.tools.embedded_broker import embedded_broker
from tests import fake_drivers

if TYPE_CHECKING:
    from tests.broker_fixture import Broker

PROJECT = Path(__file__).resolve().parents[2]
LISTENS = "0A"
"""State of a listening socket, as in linux/net/tcp_states.h."""
LOOPBACK = {"0100007F", "00000000000000000000000001000000"}

pytestmark = pytest.mark.system


def inodes_of(process: int) -> set[str]:
    """Return the inodes of the sockets that a process has open."""
    found = set()
    for link in Path(f"/proc/{process}/fd").iterdir():
        try:
            target = str(link.readlink())
        except FileNotFoundError:  # closed meanwhile, like the descriptor of this listing
            continue
        if target.startswith("socket:["):
            found.add(target[8:-1])
    return found


def listening(process: int) -> list[str]:
    """Return the addresses, in the kernel's hexadecimal, that a process accepts connections on."""
    held, found = inodes_of(process), []
    for table in ("tcp", "tcp6"):
        path = Path("/proc/net") / table
        for line in path.read_text().splitlines()[1:] if path.exists() else []:
            fields = line.split()
            if fields[3] == LISTENS and fields[9] in held:
                found.append(fields[1].partition(":")[0])
    return found


def test_a_listening_socket_is_found() -> None:
    before = listening(os.getpid())  # other tests of this process may also listen
    with socket.create_server(("127.0.0.1", 0)):
        assert sorted(listening(os.getpid())) == sorted([*before, "0100007F"])


def test_the_daemon_listens_on_no_tcp_port(tmp_path: Path, broker: Broker) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text(fake_drivers.SMALLEST_RIG.format(port=broker.port))
    fake_drivers.install(tmp_path / "site")
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(tmp_path / "site"), str(PROJECT)]),
        "STATE_DIRECTORY": str(tmp_path / "state"),
    }
    with subprocess.Popen(
        [sys.executable, "-m", "jointfit_daemon", "--config", str(rig)],
        env=environment, stderr=subprocess.PIPE, text=True,
    ) as daemon:  # fmt: skip
        assert daemon.stderr is not None
        try:
            while "connected to" not in daemon.stderr.readline():
                assert daemon.poll() is None
            assert inodes_of(daemon.pid)
            assert listening(daemon.pid) == []
        finally:
            daemon.terminate()
            daemon.communicate(timeout=60)


def test_the_demos_broker_is_reached_from_this_machine_only(tmp_path: Path) -> None:
    pytest.importorskip("iotcore", reason="the extra demo is not installed")
    with embedded_broker(tmp_path):
        addresses = [
            address
            for path in Path("/proc").glob("[0-9]*")
            if parent_of(path) == os.getpid() or path.name == str(os.getpid())
            for address in listening(int(path.name))
        ]
    assert addresses
    assert set(addresses) <= LOOPBACK


def parent_of(process: Path) -> int:
    try:
        return int((process / "stat").read_text().rpartition(")")[2].split()[1])
    except (OSError, ValueError):
        return 0
