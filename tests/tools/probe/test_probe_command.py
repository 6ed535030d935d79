"""`jointfit probe` opens only the named devices, and prints valid lines for a rig.toml."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
import time
import tomllib
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import jsonschema
import orjson
import pytest
from pydantic import TypeAdapter
from typer.testing import CliRunner

from jointfit_daemon.config import parse_rig
from jointfit_daemon.tools.__main__ import app
from jointfit_daemon.tools.discovery import (
    CanIdentifier,
    CanTraffic,
    DecodedDevice,
    FoundServer,
    SerialPortInfo,
    SerialTraffic,
    usual_bauds,
)
from jointfit_daemon.tools.probe import _probe_report, _rig_lines
from jointfit_protocols.xbus.mtdata import MTDataLayout
from jointfit_simulators.devices import (
    NatNetServer,
    NatNetServerOptions,
    RigidBodyAsset,
    XbusDevice,
    XbusDeviceOptions,
)

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

run = CliRunner().invoke
Q = (1.0, 0.0, 0.0, 0.0)
OPENED = """
import sys
from jointfit_daemon.tools.__main__ import app
def note(event, args):
    if event == "open" and str(args[0]).startswith("/dev/tty") or event.startswith("socket.__new"):
        print(event, args, file=sys.stderr)
sys.addaudithook(note)
app(["probe"])
"""

STREAMING = XbusDeviceOptions(measures_at_once=True)


@asynccontextmanager
async def hardware(folder: Path, imu: XbusDeviceOptions = STREAMING) -> AsyncIterator[NatNetServer]:
    """Run an IMU that sends data at `folder`/imu, and yield a running motion-capture server."""
    device = XbusDevice(folder / "imu", options=imu)
    bodies = (RigidBodyAsset("Thigh", ("T1", "T2", "T3"), 1),)
    server = NatNetServer(NatNetServerOptions(bodies))

    async def push() -> None:
        while True:
            device.push(time.monotonic_ns(), Q)
            await asyncio.sleep(0.01)

    tasks = [asyncio.create_task(work) for work in (device.run(), push(), server.run())]
    try:
        yield server
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
        device.unplug()
        server.unplug()


def checked(text: str) -> dict[str, Any]:
    """Return the report in `text`; require that the report matches its JSON Schema."""
    report: dict[str, Any] = orjson.loads(text)
    schema = TypeAdapter(_probe_report.ProbeReport).json_schema(mode="serialization")
    jsonschema.validate(report, schema)
    return report


async def test_named_devices_are_recognized_and_become_lines_of_a_rig(tmp_path: Path) -> None:
    async with hardware(tmp_path) as server:
        words = ["probe", "--json", "--listen", "0.4", "--serial", str(tmp_path / "imu")]
        words += ["--mocap", f"127.0.0.1:{server.command_port}"]
        result = await asyncio.to_thread(run, app, words)
        shown = await asyncio.to_thread(run, app, [word for word in words if word != "--json"])
    assert result.exit_code == shown.exit_code == 0, result.output
    report = checked(result.stdout)
    assert report["faults"] == []
    assert report["serial"][0]["devices"][0]["driver"] == "xbus"
    assert report["mocap_servers"][0]["bodies"] == ["Thigh"]

    tables = tomllib.loads(report["rig_toml"])
    (imu,) = tables["imu"]
    assert (imu["driver"], imu["baud"]) == ("xbus", 115_200)
    assert tables["mocap"]["command_port"] == server.command_port
    assert "xbus: " in shown.stdout
    assert "rigid bodies: Thigh" in shown.stdout


async def test_the_lines_of_an_older_xsens_device_contain_its_format(tmp_path: Path) -> None:
    older = replace(STREAMING, legacy=MTDataLayout(0x0004, 0x0001))
    async with hardware(tmp_path, older):
        words = ["probe", "--json", "--listen", "0.4", "--serial", str(tmp_path / "imu")]
        result = await asyncio.to_thread(run, app, words)
    (imu,) = tomllib.loads(checked(result.stdout)["rig_toml"])["imu"]
    assert (imu["driver"], imu["format"]) == ("xbus", "mtdata")


def test_a_silent_port_and_an_absent_one_are_faults_with_exit_code_1(tmp_path: Path) -> None:
    controller, line = os.openpty()
    words = ["--serial", os.ttyname(line), "--serial", str(tmp_path / "gone"), "--can", "nocan9"]
    result = run(app, ["probe", "--listen", "0.1", "--json", *words])
    os.close(controller)
    os.close(line)
    assert result.exit_code == 1
    silent, gone, bus = checked(result.stdout)["faults"]
    assert "no byte in 0.1 s" in silent
    assert "is absent" in gone
    assert bus.startswith("nocan9: no ")


def test_bytes_of_another_device_are_a_fault() -> None:
    controller, line = os.openpty()
    text = "import os, time\nwhile 1: os.write(1, b'!AIVDM' * 9); time.sleep(.01)"
    feeding = subprocess.Popen([sys.executable, "-c", text], stdout=controller)
    result = run(app, ["probe", "--listen", "0.1", "--serial", os.ttyname(line)])
    feeding.kill()
    feeding.wait()
    os.close(controller)
    os.close(line)
    assert result.exit_code == 1
    assert "no installed driver decodes them" in result.stderr
    tried = ", ".join(map(str, usual_bauds()))
    assert f"no known format at {tried} baud" in result.stdout


@pytest.mark.parametrize(
    ("value", "expected"),
    [("10.0.0.300", "four numbers"), ("host:0", "HOST:PORT"), ("host:x", "HOST:PORT")],
)
def test_an_impossible_server_is_refused_before_anything_is_opened(
    value: str, expected: str
) -> None:
    result = run(app, ["probe", "--mocap", value])
    assert result.exit_code == 2
    assert expected in result.stderr


def test_without_options_no_port_and_no_socket_is_opened() -> None:
    done = subprocess.run(
        [sys.executable, "-c", OPENED], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "Serial ports" in done.stdout


IDS = {"sample_time": 0x205, "group_counter": 0x206, "quaternion": 0x221}


def test_the_lines_of_all_kinds_of_devices_are_a_valid_rig() -> None:
    ports = [SerialPortInfo("/dev/ttyACM0", by_id="/dev/serial/by-id/usb-x", driver="cdc_acm")]
    imu = DecodedDevice("xbus", {"baud": 921_600}, 99, 99, 98.7, 3)
    serial = [SerialTraffic("/dev/ttyACM0", None, {921_600: 9}, 921_600, (imu,))]
    sensor = DecodedDevice("xcdi", {"ids": IDS, "byte_order": "little"}, 99, 99, 100.2, 0)
    can = [CanTraffic("can0", None, (CanIdentifier(0x221, False, 8, 9, 99.0),), (sensor,))]
    server = FoundServer(
        "natnet", "192.168.1.2", 1510, "192.168.1.1", "Motive", "3", "NatNet 4.0", "unicast",
        ("Thigh",), (),
    )  # fmt: skip
    text = _rig_lines.rig_lines(ports, serial, can, [server])
    text = text.replace("SEGMENT", "thigh", 1).replace("SEGMENT", "shank", 1)
    text = text.replace("# rigid_body.SEGMENT", "rigid_body.thigh")
    whole = f"""
[rig]
name = "leg"
[chain]
joints = ["hip", "knee", "ankle"]
segments = ["thigh", "shank"]
side = "right"
{text}
[mqtt]
host = "localhost"
base = "jointfit/leg"
"""
    rig = parse_rig(tomllib.loads(whole))
    first, second, cameras = (source.settings for source in rig.sources)
    assert (first.port, first.transport, first.rate_hz) == ("/dev/serial/by-id/usb-x", "usb", 100)
    assert (second.can.channel, second.ids.quaternion, second.byte_order) == (
        "can0", 0x221, "little",
    )  # fmt: skip
    assert (cameras.server, cameras.rigid_body) == ("192.168.1.2", {"thigh": "Thigh"})


def test_the_lines_select_one_of_several_servers_at_an_address() -> None:
    one, other = (
        FoundServer(
            "lsl-markers", "qtm-pc", 16572, "192.168.1.1", f"LSL stream {name}", "1.10", "LSL",
            "unicast", settings={"stream": name},
        )
        for name in ("Markers", "Bodies")
    )  # fmt: skip
    table = tomllib.loads(_rig_lines.rig_lines([], [], [], [one, other]))["mocap"]
    assert table == {"driver": "lsl-markers", "server": "qtm-pc", "stream": "Markers"}


def test_keys_that_no_stream_shows_are_named_with_their_meaning() -> None:
    imu = DecodedDevice("lpms", {"baud": 115_200}, 99, 99, 100.0, 0)
    serial = [SerialTraffic("/dev/ttyUSB0", None, {115_200: 9}, 115_200, (imu,))]
    text = _rig_lines.rig_lines([], serial, [], [])
    assert "\n# add generation: 1: B2, CU2, URS2" in text
    (table,) = tomllib.loads(text)["imu"]
    assert (table["driver"], table["port"], table["baud"]) == ("lpms", "/dev/ttyUSB0", 115_200)
