"""The fixtures: brokers accept connections, and leaks of a test are detected."""

from __future__ import annotations

import socket
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.broker_fixture import CHOICE, EmbeddedBroker, MosquittoBroker, chosen_broker

if TYPE_CHECKING:
    from tests.broker_fixture import Broker

PROJECT = Path(__file__).resolve().parents[1]

LEAKS = {
    "descriptors left open": "import os\ndef test_leak(): os.open('/dev/null', os.O_RDONLY)\n",
    "tasks left running": (
        "import asyncio\nkept = []\n"
        "async def test_leak():\n"
        "    kept.append(asyncio.create_task(asyncio.sleep(60), name='left'))\n"
    ),
}


@pytest.mark.parametrize("name", ["mosquitto", "embedded_broker"])
def test_a_broker_listens_for_both_protocol_versions(
    name: str, request: pytest.FixtureRequest
) -> None:
    broker: Broker = request.getfixturevalue(name)
    for version in ("5", "3.1.1"):
        socket.create_connection((broker.host, broker.port_of(version)), timeout=1).close()


def test_without_mosquitto_the_embedded_broker_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(CHOICE, raising=False)
    monkeypatch.setattr(MosquittoBroker, "PATH", "/nowhere")
    assert chosen_broker() is EmbeddedBroker


def test_a_broker_can_be_chosen_by_name_and_a_wrong_name_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv(CHOICE, "embedded")
    assert chosen_broker() is EmbeddedBroker
    monkeypatch.setenv(CHOICE, "mosquito")
    with pytest.raises(ValueError, match="mosquitto or embedded"):
        chosen_broker()


@pytest.mark.parametrize("complaint", LEAKS)
def test_a_test_with_a_leak_fails(complaint: str, tmp_path: Path) -> None:
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
