"""The fixtures themselves: brokers answer, and leaks are seen."""

from __future__ import annotations

import socket
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from tests.broker_fixture import IotcoreBroker, MosquittoBroker

PROJECT = Path(__file__).resolve().parents[2]

LEAKS = {
    "descriptors left open": "import os\ndef test_leak(): os.open('/dev/null', os.O_RDONLY)\n",
    "tasks left running": (
        "import asyncio\nkept = []\n"
        "async def test_leak():\n"
        "    kept.append(asyncio.create_task(asyncio.sleep(60), name='left'))\n"
    ),
}


def test_mosquitto_accepts_connections(mosquitto: MosquittoBroker) -> None:
    socket.create_connection((mosquitto.host, mosquitto.port), timeout=1).close()


def test_iotcore_listens_for_both_protocol_versions(iotcore_broker: IotcoreBroker) -> None:
    for port in (iotcore_broker.port, iotcore_broker.port5):
        socket.create_connection((iotcore_broker.host, port), timeout=1).close()


@pytest.mark.parametrize("complaint", LEAKS)
def test_a_test_that_leaks_is_failed(complaint: str, tmp_path: Path) -> None:
    (tmp_path / "test_leak.py").write_text(LEAKS[complaint], encoding="utf-8")
    options = ["-p", "tests.conftest", "-p", "no:cacheprovider", "--rootdir", str(tmp_path)]
    ran = subprocess.run(
        [sys.executable, "-m", "pytest", "-c", "pyproject.toml", *options, str(tmp_path)],
        cwd=PROJECT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 1, ran.stdout + ran.stderr
    assert complaint in ran.stdout
