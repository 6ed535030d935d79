"""The dashboard's web server sends files with security headers, and connects pages to brokers."""

from __future__ import annotations

import asyncio
import contextlib
import gzip
import hashlib
import json
import signal
import socket
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import aiomqtt
import pytest
from typer.testing import CliRunner
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.typing import Origin, Subprotocol

from jointfit_daemon.tools.__main__ import app
from jointfit_daemon.tools.dashboard._tunnel import BROKER_CLOSED, BROKER_UNREACHABLE
from jointfit_daemon.tools.dashboard.addresses import (
    BrokerAddress,
    ListenAddress,
    parse_broker,
    parse_listen,
)
from jointfit_daemon.tools.dashboard.server import DashboardServer
from tests.broker_fixture import HOST, free_port

if TYPE_CHECKING:
    from tests.broker_fixture import Broker

ROOT = Path(__file__).resolve().parents[3]
LISTEN = ListenAddress(HOST, 0)
NOWHERE = BrokerAddress(HOST, 1)


async def get(url: str, path: str = "", **headers: str) -> tuple[int, dict[str, str], bytes]:
    """Return status, headers and body; the path is sent unchanged."""
    host, port = url.removeprefix("http://").rstrip("/").split(":")
    reader, writer = await asyncio.open_connection(host, int(port))
    named = {"Host": f"{host}:{port}"} | {key.replace("_", "-"): v for key, v in headers.items()}
    lines = [f"GET /{path} HTTP/1.1", *(f"{key}: {value}" for key, value in named.items())]
    writer.write("\r\n".join([*lines, "", ""]).encode())
    head, _, body = (await reader.read()).partition(b"\r\n\r\n")
    writer.close()
    await writer.wait_closed()
    first, *rest = head.decode().split("\r\n")
    found = dict(line.split(": ", 1) for line in rest)
    return int(first.split()[1]), {key.lower(): value for key, value in found.items()}, body


async def test_the_page_is_served_compressed_and_revalidated_by_its_tag() -> None:
    async with DashboardServer(NOWHERE).listening(LISTEN) as url:
        status, headers, body = await get(url, Accept_Encoding="gzip")
        assert (status, headers["content-type"]) == (200, "text/html; charset=utf-8")
        assert b"<title>jointfitd</title>" in gzip.decompress(body)
        assert (await get(url))[2] == gzip.decompress(body)
        again = await get(url, If_None_Match=headers["etag"])
        assert (again[0], again[2]) == (304, b"")


@pytest.mark.parametrize("path", ["", "js/main.js", "config.json", "no-such-page", "mqtt"])
async def test_every_response_allows_scripts_of_this_origin_only(path: str) -> None:
    async with DashboardServer(NOWHERE).listening(LISTEN) as url:
        _, headers, _ = await get(url, path)
    policy = headers["content-security-policy"]
    assert "default-src 'none'; script-src 'self'; style-src 'self'" in policy
    assert "connect-src 'self';" in policy
    assert "unsafe" not in policy
    assert headers["x-content-type-options"] == "nosniff"


@pytest.mark.parametrize(
    "path",
    [
        "../_server.py",
        "js/../../_server.py",
        "%2e%2e/_server.py",
        "/etc/passwd",
        "js",
        "js/",
        "..%2f",
    ],
)
async def test_no_path_leaves_the_folder_of_the_page(path: str) -> None:
    async with DashboardServer(NOWHERE).listening(LISTEN) as url:
        assert (await get(url, path))[0] == 404


@pytest.mark.parametrize(
    ("host", "status"),
    [("attacker.example", 421), ("", 421), ("[", 421), ("192.0.2.7:8080", 200),
     ("Localhost:1", 200), ("[::1]:8080", 200), ("rig.lab", 200)],
)  # fmt: skip
async def test_the_server_answers_to_its_own_names_only(host: str, status: int) -> None:
    """A request with the host name of another site is refused, even if it reaches this machine."""
    async with DashboardServer(NOWHERE, names=("rig.lab",)).listening(LISTEN) as url:
        assert (await get(url, Host=host))[0] == status


async def test_pages_of_other_origins_cannot_use_the_tunnel() -> None:
    async with DashboardServer(NOWHERE).listening(LISTEN) as url:
        websocket = url.replace("http", "ws") + "mqtt"
        with pytest.raises(InvalidStatus, match="403"):
            await connect(websocket, origin=Origin("http://attacker.example")).__aenter__()
        async with connect(
            websocket, origin=Origin(url.rstrip("/")), subprotocols=[Subprotocol("mqtt")]
        ) as own:
            assert own.subprotocol == "mqtt"
        assert (await get(url, "mqtt"))[0] == 426


async def round_trip(url: str) -> bytes:
    """Publish a message through the tunnel; return it as received through the tunnel."""
    async with aiomqtt.Client(
        HOST, int(url.rstrip("/").rpartition(":")[2]), transport="websockets",
        websocket_path="/mqtt", protocol=aiomqtt.ProtocolVersion.V5,
    ) as client:  # fmt: skip
        await client.subscribe("a/b")
        await client.publish("a/b", b"x" * 20_000)
        async with asyncio.timeout(5):
            async for message in client.messages:
                return bytes(message.payload)
    raise AssertionError


@pytest.mark.parametrize("fixture", ["embedded_broker", "mosquitto"])
async def test_the_tunnel_carries_messages_in_both_directions(
    fixture: str, request: pytest.FixtureRequest
) -> None:
    broker: Broker = request.getfixturevalue(fixture)
    async with DashboardServer(BrokerAddress(HOST, broker.port)).listening(LISTEN) as url:
        assert await round_trip(url) == b"x" * 20_000


def open_tunnel(url: str) -> connect:
    return connect(url.replace("http", "ws") + "mqtt", subprotocols=[Subprotocol("mqtt")])


async def close_of_tunnel(url: str) -> tuple[int, str]:
    """Return the code and the reason with which the server closes the tunnel."""
    async with open_tunnel(url) as websocket:
        with pytest.raises(ConnectionClosed) as closed:
            await websocket.recv()
    assert closed.value.rcvd is not None
    return closed.value.rcvd.code, closed.value.rcvd.reason


async def test_a_missing_broker_is_named_in_the_close_frame() -> None:
    async with DashboardServer(BrokerAddress(HOST, free_port())).listening(LISTEN) as url:
        code, reason = await close_of_tunnel(url)
    assert code == BROKER_UNREACHABLE
    assert "start the broker" in reason


async def test_a_broker_that_ends_closes_the_tunnel_with_its_own_code(
    embedded_broker: Broker,
) -> None:
    address = BrokerAddress(HOST, embedded_broker.port)
    async with (
        DashboardServer(address).listening(LISTEN) as url,
        open_tunnel(url) as websocket,
    ):
        await asyncio.sleep(0.1)
        embedded_broker.stop()
        with pytest.raises(ConnectionClosed) as closed:
            await websocket.recv()
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == BROKER_CLOSED


async def test_a_page_that_does_not_read_holds_the_broker_back_instead_of_filling_memory() -> None:
    sent_bytes = 0

    async def flood(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal sent_bytes
        with contextlib.suppress(OSError):
            while True:
                writer.write(bytes(65536))
                await writer.drain()
                sent_bytes += 65536

    broker = await asyncio.start_server(flood, HOST, 0)
    port = broker.sockets[0].getsockname()[1]
    async with DashboardServer(BrokerAddress(HOST, port)).listening(LISTEN) as url:
        host, page_port = url.removeprefix("http://").rstrip("/").split(":")
        _, writer = await asyncio.open_connection(host, int(page_port), limit=1)
        writer.write(
            b"GET /mqtt HTTP/1.1\r\nHost: localhost\r\n"
            b"Upgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n"
            b"Sec-WebSocket-Protocol: mqtt\r\n\r\n"
        )
        before = -1
        async with asyncio.timeout(10):
            while sent_bytes == 0 or sent_bytes != before:
                before = sent_bytes
                await asyncio.sleep(0.2)
        writer.transport.abort()
    broker.close()
    # The kernel's buffers for two loopback connections have some megabytes each.
    assert sent_bytes < 32e6


async def test_a_packet_that_is_too_long_closes_the_tunnel(embedded_broker: Broker) -> None:
    address = BrokerAddress(HOST, embedded_broker.port)
    async with (
        DashboardServer(address).listening(LISTEN) as url,
        open_tunnel(url) as websocket,
    ):
        await websocket.send(bytes(70_000))
        with pytest.raises(ConnectionClosed) as closed:
            await websocket.recv()
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 1009


async def test_the_number_of_open_tunnels_is_limited(
    embedded_broker: Broker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(f"{DashboardServer.__module__}.MOST_VIEWERS", 1)
    address = BrokerAddress(HOST, embedded_broker.port)
    async with DashboardServer(address).listening(LISTEN) as url, open_tunnel(url):
        with pytest.raises(InvalidStatus, match="503"):
            await open_tunnel(url).__aenter__()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("mqtt://localhost", BrokerAddress("localhost", 1883)),
        ("broker.lab:1884", BrokerAddress("broker.lab", 1884)),
        ("mqtts://broker.lab", BrokerAddress("broker.lab", 8883, tls=True)),
        ("mqtt://[::1]:1884", BrokerAddress("::1", 1884)),
        ("wss://b.lab/ws", BrokerAddress("b.lab", 0, tls=True, websocket="wss://b.lab/ws")),
    ],
)
def test_a_broker_is_a_url_or_host_and_port(text: str, expected: BrokerAddress) -> None:
    assert parse_broker(text) == expected


def test_a_broker_with_websockets_of_its_own_is_allowed_by_the_policy() -> None:
    server = DashboardServer(parse_broker("wss://b.lab:9001/ws"))
    assert "connect-src 'self' wss://b.lab:9001;" in server.security_policy


@pytest.mark.parametrize("text", ["", "host:", "host:99999", "8080/x", "user@host:80", "[::1"])
def test_a_wrong_listen_address_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(ValueError, match=r"expected HOST:PORT, such as 127\.0\.0\.1:8080"):
        parse_listen(text)


run = CliRunner().invoke


def dashboard(*words: str) -> Any:
    return run(app, ["dashboard", *words])


def test_a_password_in_the_arguments_is_refused_and_not_repeated() -> None:
    password = "secret-word"
    result = dashboard("--broker", f"mqtt://user:{password}@broker.lab")
    assert result.exit_code == 2
    assert "the page asks for them" in result.stderr
    assert password not in result.stderr


@pytest.mark.parametrize("broker", ["http://broker", "mqtt://", "mqtt://host/path", "mqtt://h:0"])
def test_another_broker_url_is_refused_with_the_forms_that_work(broker: str) -> None:
    result = dashboard("--broker", broker)
    assert result.exit_code == 2
    assert "mqtts://HOST:PORT" in result.stderr


def test_a_used_port_is_named() -> None:
    with socket.create_server((HOST, 0)) as taken:
        port = taken.getsockname()[1]
        result = dashboard("--listen", f"{HOST}:{port}")
    assert result.exit_code == 2
    assert f"--listen {HOST}:{port}: Address already in use" in result.stderr


STOPPED = [
    pytest.param([], [signal.SIGTERM], id="SIGTERM"),
    pytest.param([], [signal.SIGINT], id="SIGINT"),
    pytest.param(
        ["sh", "-c", 'trap "" INT; exec "$@"', "sh"], [signal.SIGINT, signal.SIGTERM],
        id="SIGTERM, where the shell ignores SIGINT",
    ),
]  # fmt: skip
"""Commands that precede the server's command, and the signals that the server receives."""


@pytest.mark.system
@pytest.mark.parametrize(("shell", "signals"), STOPPED)
async def test_the_command_prints_its_url_and_the_missing_broker_and_stops_with_0(
    shell: list[str], signals: list[signal.Signals]
) -> None:
    process = await asyncio.create_subprocess_exec(
        *shell, sys.executable, "-m", "jointfit_daemon.tools.__main__", "dashboard",
        "--listen", f"{HOST}:0", "--broker", f"mqtt://{HOST}:{free_port()}",
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
        # Restore the default: if a shell runs the tests in the background, they ignore SIGINT.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stderr is not None
    async with asyncio.timeout(30):
        assert b"dashboard: http://127.0.0.1:" in await process.stdout.readline()
        assert b"start the broker" in await process.stderr.readline()
        for number in signals:
            assert process.returncode is None
            process.send_signal(number)
            await asyncio.sleep(0.3 if number != signals[-1] else 0.0)
        await process.communicate()
    assert process.returncode == 0


def test_vendored_scripts_are_those_of_the_manifest() -> None:
    manifest = json.loads((ROOT / "packaging/vendored_scripts.json").read_text(encoding="utf-8"))
    folder = ROOT / "jointfit_daemon/tools/dashboard/page/vendor"
    wanted = {
        name: entry["sha256"]
        for package in manifest["packages"]
        for name, entry in package["files"].items()
    }
    assert wanted == {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir()
    }


def test_the_page_contains_no_inline_script_style_or_foreign_address() -> None:
    text = (ROOT / "jointfit_daemon/tools/dashboard/page/index.html").read_text(encoding="utf-8")
    for forbidden in ("<script>", "<style", "style=", "onclick=", "http://", "https://"):
        assert forbidden not in text
