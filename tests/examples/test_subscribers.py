"""Each example subscriber prints the knee flexion of a real broker's messages."""

from __future__ import annotations

import contextlib
import functools
import http.server
import shutil
import subprocess
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from typing_extensions import override  # typing has it from Python 3.12

from tests.broker_fixture import MosquittoBroker, free_port
from tests.examples.live_rig import BASE, SHOWN, first_line, live_rig
from tests.tools.dashboard.browser import chromium

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.broker_fixture import Broker

ROOT = Path(__file__).resolve().parents[2]
SUBSCRIBERS = ROOT / "examples" / "subscribers"
MOST_LINES = 30
"""Lines of code and comments; blank lines are not counted."""


@pytest.mark.parametrize("file", sorted(SUBSCRIBERS.glob("knee.*")), ids=lambda file: file.name)
def test_a_subscriber_is_short(file: Path) -> None:
    lines = file.read_text(encoding="utf-8").splitlines()
    assert len([line for line in lines if line.strip()]) <= MOST_LINES


@pytest.mark.system
async def test_the_python_subscriber_prints_the_flexion(broker: Broker) -> None:
    port = broker.port_of("3.1.1")  # default version of aiomqtt
    async with live_rig(port, "3.1.1"):
        shown = await first_line(sys.executable, SUBSCRIBERS / "knee.py", "127.0.0.1", str(port))
    assert shown == SHOWN


def _run(command: list[str], given: str = "") -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command, input=given, capture_output=True, text=True, check=False, timeout=80
    )


@pytest.mark.experiment
@pytest.mark.system
async def test_the_cpp_subscriber_prints_the_flexion(broker: Broker, tmp_path: Path) -> None:
    compiler = ["g++", "-std=c++17", "-Wall", "-Wextra", "-Werror", "-O0"]
    headers = "#include <mosquitto.h>\n#include <nlohmann/json.hpp>\n"
    if shutil.which("g++") is None or _run([*compiler, "-E", "-xc++", "-"], headers).returncode:
        packages = "g++ libmosquitto-dev nlohmann-json3-dev"
        pytest.skip(f"no compiler or headers (Debian: apt install {packages})")
    command = [
        *compiler,
        "-o",
        str(tmp_path / "knee"),
        str(SUBSCRIBERS / "knee.cpp"),
        "-lmosquitto",
    ]
    compiled = _run(command)
    assert compiled.returncode == 0, compiled.stderr
    port = broker.port_of("3.1.1")
    async with live_rig(port, "3.1.1"):
        shown = await first_line(tmp_path / "knee", "127.0.0.1", str(port), BASE)
    assert shown.replace("0°", "°") == SHOWN


class _Files(http.server.SimpleHTTPRequestHandler):
    @override
    def log_message(self, format: str, *args: object) -> None:
        """Log nothing."""


@contextlib.contextmanager
def served() -> Iterator[str]:
    handler = functools.partial(_Files, directory=str(ROOT))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


@pytest.mark.experiment
@pytest.mark.system
async def test_the_browser_subscriber_shows_the_flexion_and_the_loss_of_the_broker(
    tmp_path: Path,
) -> None:
    if (missing := MosquittoBroker.missing()) is not None:
        pytest.skip(missing)
    port = free_port()
    broker = MosquittoBroker(tmp_path, more=f"listener {port} 127.0.0.1\nprotocol websockets\n")
    broker.start()
    try:
        async with chromium() as browser:
            page = await browser.new_page()
            with served() as site:
                address = f"{site}/examples/subscribers/knee.html?broker=ws://127.0.0.1:{port}"
                await page.goto(address)
                shown = "expected => document.querySelector('p').textContent.includes(expected)"
                async with live_rig(broker.port):
                    await page.wait_for_function(shown, arg=SHOWN, timeout=20_000)
                broker.stop()
                await page.wait_for_function(shown, arg="No broker, retrying", timeout=20_000)
    finally:
        broker.stop()
