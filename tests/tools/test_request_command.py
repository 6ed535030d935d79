"""`jointfit request`, `mark`, and `calibrate` with stored versions send requests to a daemon."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Any

import orjson
import pytest
from typer.testing import CliRunner

from jointfit_daemon.outputs.recording import RecordedMessage, open_recording
from jointfit_daemon.tools.__main__ import app
from tests.supervisor.request_gateway import gateway_fixture  # noqa: F401 - a fixture

if TYPE_CHECKING:
    from typer.testing import Result

    from tests.broker_fixture import Broker
    from tests.supervisor.request_gateway import Running

run = CliRunner().invoke


async def test_requests_of_a_user_are_printed_as_text_and_as_json(
    gateway: Running,
    broker: Broker,
) -> None:
    gateway.table["mqtt"]["port"] = broker.port
    gateway.write(gateway.table)
    rig = str(gateway.folder / "rig.toml")

    async def jointfit(*words: str) -> Result:
        return await asyncio.to_thread(lambda: run(app, words))

    async with gateway.run():
        await gateway.until(lambda: gateway.daemon.health().link.confirmed)

        marked = await jointfit("mark", "heel strike", "--rig", rig)
        assert marked.exit_code == 0, marked.output
        assert marked.stdout.startswith("mark 1 at ")
        (mark,) = [notice for notice in gateway.notices if notice.kind == "mark"]
        assert mark.text == "heel strike"

        idle = await jointfit("record", "status", "--rig", rig)
        assert idle.stdout == "not recording\n"
        started = await jointfit("record", "start", "--rig", rig)
        assert started.stdout.startswith("recording "), started.output
        assert (await jointfit("record", "mark", "toe off", "--rig", rig)).exit_code == 0
        active = await jointfit("record", "status", "--rig", rig, "--json")
        assert orjson.loads(active.stdout)["data"]["active"] is True
        stopped = await jointfit("record", "stop", "--rig", rig)
        file = Path(stopped.stdout.removeprefix("recorded ").partition(".mcap")[0] + ".mcap")
        texts = [m.data for m in open_recording(file).messages() if isinstance(m, RecordedMessage)]
        assert any(b"toe off" in text for text in texts)

        listed = await jointfit("calibrate", rig, "--list")
        rows = [line.split()[:2] for line in listed.stdout.splitlines()]
        assert rows[1:] == [["*", "2"], ["1", listed.stdout.splitlines()[2].split()[1]]]
        used = await jointfit("calibrate", rig, "--use", "1")
        assert used.stdout == "version 1 is in force\n"
        reverted = await jointfit("calibrate", rig, "--revert", "--json")
        assert orjson.loads(reverted.stdout)["version"] == 2

        tested = await jointfit("request", "selftest", "--rig", rig)
        assert "ok      store: calibrations can be written" in tested.stdout
        answer = await jointfit("request", "rate", '{"hz":50}', "--rig", rig, "--json")
        assert orjson.loads(answer.stdout)["data"]["output_rate_hz"] == 50.0

        refused = await jointfit("request", "restart-device", '{"device":"S3"}', "--rig", rig)
        assert refused.exit_code == 1
        assert "refused: restart-device.device = 'S3': expected a device" in refused.stderr
        unknown = await jointfit("request", "marc", "--rig", rig)
        assert "did you mean 'mark'?" in unknown.stderr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("request", "rate", "{hz:5}"), "expected an object in quotes"),
        (("request", "rate", "[5]"), "expected a JSON object"),
        (("request", "a/b"), "expected one word"),
        (("record", "begin"), "expected start, stop, status or mark"),
        (("record", "mark"), "expected a text after mark"),
        (("calibrate", "--list", "--revert"), "expected one of --phase"),
    ],
)
def test_misuse_is_refused_before_a_connection(
    gateway: Running,
    monkeypatch: pytest.MonkeyPatch,
    words: tuple[str, ...],
    message: str,
) -> None:
    monkeypatch.chdir(gateway.folder)
    result: Any = run(app, words)
    assert result.exit_code == 2
    assert message in result.stderr
