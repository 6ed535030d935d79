"""The set-up page of the dashboard conducts the dialogue, and refuses messages of other origins."""

from __future__ import annotations

import contextlib
import json
from typing import TYPE_CHECKING, Any

import pytest
from typer.testing import CliRunner
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus
from websockets.typing import Origin, Subprotocol

from jointfit_daemon.config import load_rig
from jointfit_daemon.tools.__main__ import app
from jointfit_daemon.tools.dashboard.addresses import BrokerAddress, ListenAddress
from jointfit_daemon.tools.dashboard.server import DashboardServer
from jointfit_daemon.tools.dashboard.set_up import set_up_server
from jointfit_daemon.tools.init.session import SetUpSession
from tests.broker_fixture import HOST

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

pytestmark = pytest.mark.usefixtures("one_driver_of_each_kind")

SUBPROTOCOL = [Subprotocol("jointfit-set-up")]
LISTEN = ListenAddress(HOST, 0)
NOWHERE = BrokerAddress(HOST, 1)


def session_of(path: Path) -> SetUpSession:
    session = SetUpSession(path)
    session.search.network = False
    return session


@contextlib.asynccontextmanager
async def served(path: Path) -> AsyncIterator[str]:
    """Yield the address of the dialogue."""
    server = set_up_server(DashboardServer(NOWHERE), path)
    server.session = session_of(path)
    async with server.listening(LISTEN) as url:
        yield f"{url.replace('http', 'ws')}set-up"


def answer_all(session: SetUpSession, **values: str) -> dict[str, Any]:
    """Answer each question with its value in `values`; by default, with a port or the proposal."""
    state = session.handle({"do": "show"})
    while (question := state["question"]) is not None:
        key = question["name"].partition(".")[0]
        port = f"/dev/ttyUSB{len(state['answered'])}" if key == "device" else ""
        state = session.handle({"do": "answer", "value": values.get(key, port)})
        assert state["error"] is None, state
    return state


def test_a_session_continues_in_another_one_and_writes_the_rig_once(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    session_of(path).handle({"do": "answer", "value": "膝"})
    session = session_of(path)
    assert session.handle({"do": "show"})["answered"][0]["value"] == "膝"
    assert "some questions are open" in session.handle({"do": "write"})["error"]

    state = answer_all(session, username="gateway")
    assert state["password_file"] == str(tmp_path / "mqtt-password")
    assert 'name = "膝"' in state["text"]
    written = session.handle({"do": "write", "password": "geheim"})["written"]
    assert written["path"] == str(path)
    assert load_rig(path).name == "膝"
    assert (tmp_path / "mqtt-password").read_text() == "geheim\n"
    assert (tmp_path / "mqtt-password").stat().st_mode & 0o777 == 0o600
    assert sorted(each.name for each in tmp_path.iterdir()) == ["mqtt-password", "rig.toml"]


def test_a_rig_that_appears_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    session = session_of(path)
    answer_all(session)
    path.write_text("mine")
    assert "exists: remove it" in session.handle({"do": "write"})["error"]
    assert path.read_text() == "mine"


def test_a_refused_answer_and_the_way_back_keep_the_other_answers(tmp_path: Path) -> None:
    session = session_of(tmp_path / "rig.toml")
    session.handle({"do": "answer", "value": "bench"})
    refused = session.handle({"do": "answer", "value": "nose"})
    assert "expected one of knee" in refused["error"]
    assert refused["question"]["name"] == "limb"
    back = session.handle({"do": "back"})
    assert (back["question"]["name"], back["answered"]) == ("name", [])


async def test_the_dialogue_answers_on_its_path_and_survives_malformed_messages(
    tmp_path: Path,
) -> None:
    async with (
        served(tmp_path / "rig.toml") as url,
        connect(url, subprotocols=SUBPROTOCOL) as socket,
    ):
        for text in ("{", "[]", "7", "[" * 5000, b"\xff"):
            await socket.send(text)
            assert "expected a JSON object" in json.loads(await socket.recv())["error"]
        await socket.send('{"do": "unknown"}')
        assert json.loads(await socket.recv())["question"]["name"] == "name"


async def test_pages_of_other_origins_and_ordinary_dashboards_have_no_dialogue(
    tmp_path: Path,
) -> None:
    async with served(tmp_path / "rig.toml") as url:
        with pytest.raises(InvalidStatus) as refused:
            await connect(url, subprotocols=SUBPROTOCOL, origin=Origin("http://evil.example"))
        assert refused.value.response.status_code == 403
    async with DashboardServer(NOWHERE).listening(LISTEN) as url:
        with pytest.raises(InvalidStatus) as missing:
            await connect(f"{url.replace('http', 'ws')}set-up", subprotocols=SUBPROTOCOL)
        assert missing.value.response.status_code == 404


@pytest.mark.parametrize(
    ("listen", "existing", "words"),
    [("0.0.0.0:0", False, "ssh -L 8080"), ("127.0.0.1:0", True, "exists: replace it with --force")],
)
def test_the_command_refuses_other_devices_and_existing_rigs(
    tmp_path: Path, listen: str, existing: bool, words: str
) -> None:
    if existing:
        (tmp_path / "rig.toml").touch()
    done = CliRunner().invoke(app, ["dashboard", "--listen", listen, "--set-up", str(tmp_path)])
    assert done.exit_code == 2
    assert words in done.output
