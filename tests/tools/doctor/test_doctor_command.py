"""`jointfit doctor` finds faults of a real broker and of a simulated motion-capture server."""

from __future__ import annotations

import asyncio
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import jsonschema
import orjson
import pytest
from pydantic import TypeAdapter
from typer.testing import CliRunner

from jointfit_daemon.config import load_rig
from jointfit_daemon.device_search import Finding
from jointfit_daemon.outputs import topics
from jointfit_daemon.outputs.mqtt._connection import MqttConnection, Outgoing
from jointfit_daemon.tools.__main__ import app
from jointfit_daemon.tools.doctor import _command
from jointfit_daemon.tools.doctor._command import examine
from jointfit_daemon.tools.doctor._doctor_report import DoctorReport
from jointfit_simulators.devices import NatNetServer, NatNetServerOptions, RigidBodyAsset
from tests.broker_fixture import free_port
from tests.tools.doctor.test_doctor_host import gateway

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from jointfit_daemon.device_search import Level
    from tests.broker_fixture import Broker

run = CliRunner().invoke
RIG = """
[rig]
name = "leg"
[chain]
joints = ["hip", "knee", "ankle"]
segments = ["thigh", "shank"]
side = "right"
[[imu]]
id = "S1"
segment = "thigh"
driver = "xbus"
port = "/dev/serial/by-id/absent"
[[imu]]
id = "S2"
segment = "shank"
driver = "xcdi"
can = "bus"
[can.bus]
interface = "slcan"
channel = "/dev/ttyACM7"
[mocap]
driver = "natnet"
server = "127.0.0.1"
command_port = {server}
rigid_body.thigh = "Thigh"
rigid_body.shank = "Shank"
[mqtt]
host = "127.0.0.1"
port = {broker}
base = "jointfit/leg"
"""
POSE = ((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0))


@contextmanager
def cameras() -> Iterator[NatNetServer]:
    """Yield a server that sends mocap frames, in a thread with its own event loop."""
    bodies = (RigidBodyAsset("Thigh", ("T1",), 1), RigidBodyAsset("Shank", ("S1",), 2))
    server = NatNetServer(NatNetServerOptions(bodies))
    stop = threading.Event()

    async def serve() -> None:
        task = asyncio.create_task(server.run())
        while not stop.is_set():
            server.push(time.monotonic_ns(), {}, {"Thigh": POSE, "Shank": POSE})
            await asyncio.sleep(0.01)
        task.cancel()
        await asyncio.wait([task])
        server.unplug()

    thread = threading.Thread(target=lambda: asyncio.run(serve()))
    thread.start()
    yield server
    stop.set()
    thread.join()


def rig_file(folder: Path, broker: int, server: int, more: str = "") -> Path:
    path = folder / "rig.toml"
    path.write_text(RIG.format(broker=broker, server=server) + more)
    return path


def examined(folder: Path, path: Path, check: str) -> list[Finding]:
    found = examine(gateway(folder), load_rig(path), 0.5)
    return [finding for finding in found if finding.check == check]


def test_broker_and_cameras_that_work_are_ok(tmp_path: Path, mosquitto: Broker) -> None:
    shares: list[float] = []
    with cameras() as server:
        path = rig_file(tmp_path, mosquitto.port, server.command_port)
        found = examine(gateway(tmp_path), load_rig(path), 0.5, shares.append)
    levels = {finding.check: finding.level for finding in found}
    assert (levels["broker"], levels["mocap"]) == ("ok", "ok")
    absent = {finding.id for finding in found if finding.check == "serial"}
    assert absent == {"/dev/serial/by-id/absent", "/dev/ttyACM7"}
    assert shares == [0.2, 0.4, 1.0]


def test_a_missing_broker_and_silent_cameras_are_errors(tmp_path: Path) -> None:
    path = rig_file(tmp_path, free_port(), free_port())
    (broker,) = examined(tmp_path, path, "broker")
    assert broker.level == "error"
    assert broker.text.startswith("connection refused")
    assert broker.remedy.startswith("sudo systemctl start mosquitto")
    (mocap,) = examined(tmp_path, path, "mocap")
    assert mocap.text.startswith("streaming off")
    (firewall,) = examined(tmp_path, path, "firewall")
    assert firewall.level == "unknown"


def test_a_wrong_user_of_the_broker_is_an_error(
    tmp_path: Path, start_mosquitto: Callable[[str], Broker]
) -> None:
    broker = start_mosquitto("allow_anonymous false\n")
    path = rig_file(tmp_path, broker.port, free_port(), 'username = "nobody"\n')
    (found,) = examined(tmp_path, path, "broker")
    assert found.level == "error"
    assert "username" in found.text
    assert "mosquitto_passwd" in found.remedy


def test_tls_to_a_port_without_it_and_a_missing_file_are_errors(
    tmp_path: Path, mosquitto: Broker
) -> None:
    more = 'password_file = "/nowhere/password"\n[mqtt.tls]\n'
    path = rig_file(tmp_path, mosquitto.port, free_port(), more)
    missing, broker = examined(tmp_path, path, "broker")
    assert "/nowhere/password" in missing.text
    assert (missing.level, broker.level) == ("error", "error")


async def test_another_daemon_with_the_same_client_id_is_a_note(
    tmp_path: Path, mosquitto: Broker
) -> None:
    path = rig_file(tmp_path, mosquitto.port, free_port())
    settings = load_rig(path).mqtt
    async with MqttConnection(settings) as other:
        topic = topics.BRIDGE_STATE.name(settings.base)
        await other.publish(Outgoing(topic, topics.ONLINE, qos=1, retain=True))
    found = await asyncio.to_thread(examined, tmp_path, path, "broker")
    assert [each.level for each in found] == ["note", "ok"]
    assert topics.client_identifier(settings.base) in found[0].text


def printed(words: list[str], folder: Path) -> tuple[int, Any]:
    command = [sys.executable, "-m", "jointfit_daemon.tools", "doctor", *words]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr, done.stderr
    return done.returncode, done.stdout


def test_the_json_of_this_host_follows_its_schema_and_decides_the_exit_code(
    tmp_path: Path,
) -> None:
    path = rig_file(tmp_path, free_port(), free_port())
    # The command uses the rig.toml in the working directory.
    code, text = printed(["--json", "--wait", "0.5"], tmp_path)
    report = orjson.loads(text)
    jsonschema.validate(report, TypeAdapter(DoctorReport).json_schema(mode="serialization"))
    assert (code, report["level"]) == (1, "error")
    checks = {finding["check"] for finding in report["findings"]}
    assert checks >= {"serial", "clock", "disk", "memory", "processor", "broker", "mocap"}
    for finding in report["findings"]:
        assert bool(finding["remedy"]) or finding["level"] in ("ok", "note")
    path.unlink()
    code, text = printed([], tmp_path)
    assert "broker and cameras were not checked" in text
    levels = {line.split()[0] for line in text.splitlines() if line[0] != " "}
    assert code == ("error" in levels)


@pytest.mark.parametrize(("level", "code"), [("note", 0), ("warning", 0), ("error", 1)])
def test_an_error_alone_ends_with_1(
    monkeypatch: pytest.MonkeyPatch, level: Level, code: int
) -> None:
    found = [Finding("disk", "", "ok", "fine"), Finding("memory", "", level, "few", "stop others")]
    monkeypatch.setattr(_command, "examine", lambda *_: found)
    assert run(app, ["doctor"]).exit_code == code


def test_a_faulty_rig_ends_with_2(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text("[rig]\n")
    result = run(app, ["doctor", "--config", str(tmp_path / "rig.toml")])
    assert result.exit_code == 2
    assert "rig.toml" in result.stderr
    assert run(app, ["doctor", "--config", str(tmp_path / "none.toml")]).exit_code == 2


@pytest.mark.parametrize("wait", ["0", "61"])
def test_an_impossible_wait_is_refused(wait: str) -> None:
    assert run(app, ["doctor", "--wait", wait]).exit_code == 2
