"""The dashboard uses TLS for browsers and brokers, and gives the reason of each refusal."""

from __future__ import annotations

import asyncio
import json
import shutil
import ssl
import subprocess
import sys
import urllib.request
from typing import TYPE_CHECKING

import pytest
from typer.testing import CliRunner
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed
from websockets.typing import Origin, Subprotocol

from jointfit_daemon.tools.__main__ import app
from jointfit_daemon.tools.dashboard.__main__ import exposure
from jointfit_daemon.tools.dashboard._certificates import broker_context, page_context
from jointfit_daemon.tools.dashboard._tunnel import BROKER_CLOSED, BROKER_UNREACHABLE
from jointfit_daemon.tools.dashboard.addresses import BrokerAddress, ListenAddress, parse_broker
from jointfit_daemon.tools.dashboard.server import DashboardServer
from tests.broker_fixture import HOST, free_port
from tests.tools.dashboard.test_dashboard_server import close_of_tunnel, round_trip

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tests.broker_fixture import Broker

LISTEN = ListenAddress(HOST, 0)


def issue(folder: Path, name: str, *more: str) -> None:
    """Write a self-signed certificate and its key."""
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256",
         "-subj", f"/CN={name}", "-keyout", f"{name}.key", "-out", f"{name}.crt", *more],
        cwd=folder, check=True, capture_output=True,
    )  # fmt: skip


@pytest.fixture(scope="session")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with three certificates and keys.

    They are for this machine (``here``), for another host (``elsewhere``), and with a passphrase
    (``locked``).
    """
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed (Debian: apt install openssl)")
    folder = tmp_path_factory.mktemp("certificates")
    here = ("-nodes", "-days", "2", "-addext", "subjectAltName=IP:127.0.0.1")
    issue(folder, "here", *here)
    issue(folder, "elsewhere", "-nodes", "-days", "2", "-addext", "subjectAltName=DNS:other.lab")
    issue(folder, "locked", "-passout", "pass:secret", "-days", "2")
    return folder


def tls_lines(certificates: Path, name: str) -> str:
    return f"certfile {certificates / name}.crt\nkeyfile {certificates / name}.key\n"


async def test_the_tunnel_verifies_a_broker_with_tls(
    start_mosquitto: Callable[[str], Broker], certificates: Path
) -> None:
    broker = start_mosquitto(tls_lines(certificates, "here"))
    address = parse_broker(f"mqtts://{HOST}:{broker.port}")
    context = broker_context(address, certificates / "here.crt")
    async with DashboardServer(address, context).listening(LISTEN) as url:
        assert await round_trip(url) == b"x" * 20_000
    async with DashboardServer(address, broker_context(address, None)).listening(LISTEN) as url:
        assert await close_of_tunnel(url) == (
            BROKER_UNREACHABLE, "its certificate is not signed by a known authority: set --ca",
        )  # fmt: skip


async def test_a_certificate_for_another_name_is_refused(
    start_mosquitto: Callable[[str], Broker], certificates: Path
) -> None:
    broker = start_mosquitto(tls_lines(certificates, "elsewhere"))
    address = parse_broker(f"mqtts://{HOST}:{broker.port}")
    context = broker_context(address, certificates / "elsewhere.crt")
    async with DashboardServer(address, context).listening(LISTEN) as url:
        code, reason = await close_of_tunnel(url)
    assert code == BROKER_UNREACHABLE
    assert "for another name: correct --broker" in reason


async def test_a_plain_port_under_mqtts_and_a_tls_port_under_mqtt_are_named(
    start_mosquitto: Callable[[str], Broker], certificates: Path
) -> None:
    plain = start_mosquitto("")
    address = parse_broker(f"mqtts://{HOST}:{plain.port}")
    async with DashboardServer(address, broker_context(address, None)).listening(LISTEN) as url:
        code, reason = await close_of_tunnel(url)
    assert code == BROKER_UNREACHABLE
    assert "does not answer to TLS" in reason

    secure = start_mosquitto(tls_lines(certificates, "here"))
    async with DashboardServer(BrokerAddress(HOST, secure.port)).listening(LISTEN) as url:
        websocket_url = url.replace("http", "ws") + "mqtt"
        async with connect(websocket_url, subprotocols=[Subprotocol("mqtt")]) as websocket:
            await websocket.send(b"\x10\x10\x00\x04MQTT\x05\x02\x00\x05\x00\x00\x03abc")
            with pytest.raises(ConnectionClosed) as closed:
                await websocket.recv()
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == BROKER_CLOSED
    assert "a port with TLS needs mqtts://" in closed.value.rcvd.reason


async def test_the_page_and_its_tunnel_are_served_by_https(
    embedded_broker: Broker, certificates: Path
) -> None:
    pages = page_context(certificates / "here.crt", certificates / "here.key")
    trusted = ssl.create_default_context(cafile=certificates / "here.crt")
    server = DashboardServer(BrokerAddress(HOST, embedded_broker.port), page_context=pages)
    async with server.listening(LISTEN) as url:
        assert url.startswith("https://127.0.0.1:")

        def read() -> bytes:
            with urllib.request.urlopen(url, context=trusted) as answer:
                return bytes(answer.read())

        assert b"<title>jointfitd</title>" in await asyncio.to_thread(read)
        tunnel = url.replace("http", "ws") + "mqtt"
        origin = url.rstrip("/")
        async with connect(
            tunnel, ssl=trusted, origin=Origin(origin), subprotocols=[Subprotocol("mqtt")]
        ) as websocket:
            await websocket.send(b"\x10\x10\x00\x04MQTT\x05\x02\x00\x05\x00\x00\x03abc")
            assert (await websocket.recv())[:1] == b"\x20"  # CONNACK


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--key", "here.key"), "expected --certificate with the certificate of the key"),
        (("--certificate", "none.crt"), "none.crt"),
        (("--certificate", "here.crt"), "a certificate and its own private key"),
        (("--certificate", "here.crt", "--key", "elsewhere.key"), "its own private key"),
        (("--certificate", "locked.crt", "--key", "locked.key"), "without a passphrase"),
        (("--certificate", "here.key", "--key", "here.key"), "both in PEM"),
        (("--ca", "here.key", "--broker", "mqtts://localhost"), "expected a certificate in PEM"),
        (("--ca", "here.crt"), "expected a broker with TLS, such as mqtts://HOST"),
    ],
)
def test_faulty_certificates_are_named_with_what_is_expected(
    certificates: Path, words: tuple[str, ...], expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr("os.execv")  # otherwise a server could replace the process of the tests
    files = [str(certificates / word) if "." in word else word for word in words]
    result = CliRunner().invoke(app, ["dashboard", "--listen", f"{HOST}:0", *files])
    assert result.exit_code == 2
    assert expected in result.stderr


def test_a_page_for_other_devices_without_tls_has_a_warning() -> None:
    assert "--certificate and --key" in exposure(encrypted=False)
    assert "--certificate" not in exposure(encrypted=True)


@pytest.mark.system
async def test_the_command_serves_https_and_warns_where_others_can_connect(
    certificates: Path,
) -> None:
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "jointfit_daemon.tools.__main__", "dashboard",
        "--listen", "0.0.0.0:0", "--broker", f"mqtt://{HOST}:{free_port()}",
        "--certificate", str(certificates / "here.crt"), "--key", str(certificates / "here.key"),
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stderr is not None
    async with asyncio.timeout(30):
        line = (await process.stdout.readline()).decode()
        assert "protect the broker with accounts" in (await process.stderr.readline()).decode()
        url = f"https://{HOST}:{line.split()[1].rstrip('/').rpartition(':')[2]}/config.json"
        trusted = ssl.create_default_context(cafile=certificates / "here.crt")

        def read() -> bytes:
            with urllib.request.urlopen(url, context=trusted) as answer:
                return bytes(answer.read())

        assert "version" in json.loads(await asyncio.to_thread(read))
        process.terminate()
        await process.communicate()
    assert process.returncode == 0
