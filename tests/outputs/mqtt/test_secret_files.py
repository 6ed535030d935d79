"""Secrets appear in no argument, environment, log, topic or recording."""

from __future__ import annotations

import asyncio
import logging
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.config import ConfigError, MqttSettings, TlsSettings, parse_rig
from jointfit_daemon.outputs.mqtt import MqttClient, MqttPublisher, Outbox
from jointfit_daemon.outputs.mqtt._connection import MqttConnection
from jointfit_daemon.outputs.mqtt._secret_files import (
    missing_password,
    password_of,
    security_warnings,
)
from tests import fake_drivers
from tests.broker_fixture import MOSQUITTO_MISSING, MosquittoBroker

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from tests.broker_fixture import Broker

PROJECT = Path(__file__).resolve().parents[3]
PASSWORD, KEY = "correct-horse-battery", "b7f3c1d92e85a640b7f3c1d92e85a640"
RIG = (
    fake_drivers.SMALLEST_RIG
    + """\
username = "jointfitd"
password_file = "password"
request_key_file = "key"
[recording]
"""
)


@pytest.fixture
def broker(tmp_path: Path, start_mosquitto: Callable[[str], Broker]) -> Broker:
    """Return a broker that accepts only clients with the password."""
    program = shutil.which("mosquitto_passwd", path=MosquittoBroker.PATH)
    if program is None:
        pytest.skip(MOSQUITTO_MISSING)
    passwords = tmp_path / "passwords"
    subprocess.run([program, "-b", "-c", str(passwords), "jointfitd", PASSWORD], check=True)
    passwords.chmod(0o600)
    return start_mosquitto(f"allow_anonymous false\npassword_file {passwords}\n")


@pytest.fixture
def folder(tmp_path: Path, broker: Broker) -> Path:
    """Return the folder of a rig with its secrets."""
    for name, secret in (("password", PASSWORD), ("key", KEY)):
        (tmp_path / name).write_text(secret + "\n")
        (tmp_path / name).chmod(0o600)
    (tmp_path / "rig.toml").write_text(RIG.format(port=broker.port))
    fake_drivers.install(tmp_path / "site")
    return tmp_path


async def everything_published(broker: Broker, folder: Path) -> bytes:
    """Return all topics and payloads up to a health message and the answer to a request."""
    settings = MqttSettings(
        host="127.0.0.1", port=broker.port, base="jointfit/bench", username="jointfitd",
        password_file=str(folder / "password"), request_key_file=str(folder / "key"),
    )  # fmt: skip
    found: list[bytes] = []

    async def listen() -> None:
        async with MqttConnection(settings) as watcher:
            await watcher.subscribe(["#"])
            async for message in watcher.messages():
                found.extend((message.topic.encode(), message.payload))

    listening = asyncio.create_task(listen())
    try:
        async with asyncio.timeout(20):
            while not any(b"bridge/health" in each for each in found):
                await asyncio.sleep(0.05)
            async with MqttClient(settings) as client:
                assert (await client.request("calibrate", {"phase": "abort"}))["status"] == "ok"
    finally:
        listening.cancel()
        await asyncio.wait([listening])
    return b"".join(found)


@pytest.fixture
def daemon(folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Start the daemon as a process."""
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(folder / "site"), str(PROJECT)]),
        "STATE_DIRECTORY": str(folder / "state"),
    }
    words = ["-m", "jointfit_daemon", "--config", str(folder / "rig.toml"), "--log-level", "debug"]
    with subprocess.Popen(
        [sys.executable, *words], env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    ) as process:
        yield process
        process.kill()


def seen_from_outside(process: subprocess.Popen[bytes]) -> bytes:
    """Return arguments and environment of the process."""
    inside = Path("/proc") / str(process.pid)
    return (inside / "cmdline").read_bytes() + (inside / "environ").read_bytes()


def stopped(process: subprocess.Popen[bytes]) -> bytes:
    """Stop the process and return its output."""
    process.terminate()
    said, _ = process.communicate(timeout=10)
    assert process.returncode == 0
    return said


def kept(folder: Path) -> bytes:
    return b"".join(path.read_bytes() for path in folder.rglob("*") if path.is_file())


@pytest.mark.system
async def test_no_secret_is_in_arguments_environment_log_topics_or_recording(
    broker: Broker, folder: Path, daemon: subprocess.Popen[bytes]
) -> None:
    published = await everything_published(broker, folder)
    seen = seen_from_outside(daemon)
    began = time.monotonic()
    said = stopped(daemon)
    assert time.monotonic() - began < 3.0  # a stop is clean within three seconds
    recorded = kept(folder / "state")
    assert b"bridge/health" in published
    for place in (published, seen, said, recorded):
        assert place
        assert PASSWORD.encode() not in place
        assert KEY.encode() not in place


def test_secret_in_the_rig_is_refused_and_not_shown(table: dict[str, Any]) -> None:
    table["mqtt"] = {"password": PASSWORD, "request_key": KEY}
    with pytest.raises(ConfigError) as told:
        parse_rig(table)
    text = str(told.value)
    assert "mqtt.password: a secret does not belong here" in text
    assert "password_file" in text
    assert PASSWORD not in text
    assert KEY not in text


def test_world_readable_secret_is_reported(tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_text(PASSWORD)
    settings = [
        MqttSettings(password_file=str(secret)),
        MqttSettings(request_key_file=str(secret)),
        MqttSettings(tls=TlsSettings(cert="x", key=str(secret))),
    ]
    for mode, open_to_others in ((0o644, True), (0o640, False), (0o600, False)):
        secret.chmod(mode)
        for each in settings:
            assert bool(security_warnings(each)) is open_to_others
    assert security_warnings(MqttSettings(password_file=str(tmp_path / "nowhere"))) == []


async def test_plain_mqtt_to_another_machine_is_logged_at_every_start(
    caplog: pytest.LogCaptureFixture,
) -> None:
    assert security_warnings(MqttSettings(insecure=True)) == []  # the broker is on this machine
    settings = MqttSettings(host="broker.invalid", insecure=True, base="b")
    with caplog.at_level(logging.WARNING):
        link = asyncio.create_task(MqttPublisher(settings, Outbox("b/s"), lambda _: None).run())
        await asyncio.sleep(0.05)
        link.cancel()
        await asyncio.wait([link])
    assert "without TLS" in caplog.text


def test_a_password_is_taken_from_the_credential(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert password_of(MqttSettings()) is None
    (tmp_path / "jointfitd.mqtt-password").write_text("s3cret\n")
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path))
    assert password_of(MqttSettings()) == "s3cret"


def test_missing_password_is_named_with_its_source(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("CREDENTIALS_DIRECTORY", raising=False)
    assert missing_password(MqttSettings()) is None
    assert missing_password(MqttSettings(username="u")) == "set password_file in [mqtt]"

    secret = tmp_path / "secret"
    settings = MqttSettings(username="u", password_file=str(secret))
    assert missing_password(settings) == f"password_file = {secret}: No such file or directory"
    secret.write_text("\n")
    assert missing_password(settings) == f"password_file = {secret}: the file contains no password"
    secret.write_text(PASSWORD)
    assert missing_password(settings) is None

    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path))
    credential = tmp_path / "jointfitd.mqtt-password"
    assert missing_password(MqttSettings(username="u")) == (
        f"systemd credential {credential}: No such file or directory"
    )
