"""Commands `jointfit request` and `jointfit mark`: one request to a running daemon over MQTT."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import orjson
import typer

from jointfit_daemon.tools.command_group import EXIT_FAILED
from jointfit_daemon.tools.completion import complete_request

if TYPE_CHECKING:
    from collections.abc import Mapping

_Rig = Annotated[Path, typer.Option("--rig", "--config", help="The rig.toml of the daemon.")]
_Json = Annotated[bool, typer.Option("--json", help="Print the whole answer as one JSON object.")]


def request(
    name: Annotated[
        str,
        typer.Argument(
            help="Name of the request, such as selftest; the documentation lists all requests.",
            autocompletion=complete_request,
        ),
    ],
    arguments: Annotated[
        str,
        typer.Argument(help='Arguments of the request as a JSON object, such as {"device":"S1"}.'),
    ] = "{}",
    *,
    rig: _Rig = Path("rig.toml"),
    timeout_s: Annotated[
        float, typer.Option("--timeout", help="Longest wait for the answer, s.", min=0.1, max=600.0)
    ] = 10.0,
    json: _Json = False,
) -> None:
    """Send a request to a running daemon and print the data of its answer.

    The request is signed if rig.toml names a key. Exit codes: 0 done or accepted; 1 no broker, no
    answer, or the daemon refused the request; 2 invalid JSON, options or rig.toml.
    """
    try:
        table = orjson.loads(arguments)
    except orjson.JSONDecodeError as error:
        raise ValueError(
            f"the arguments are not JSON ({error}): expected an object in quotes, such as "
            '\'{"device":"S1"}\''
        ) from error
    if not isinstance(table, dict):
        raise ValueError(  # noqa: TRY004 - the text of a user
            f'the arguments are {arguments}, expected a JSON object, such as {{"hz":50}}'
        )
    answer = send_request(rig, name, table, timeout_s)
    if json:
        typer.echo(orjson.dumps(answer))
    elif answer.get("status") != "error":
        for line in _lines(answer):
            typer.echo(line)
    exit_if_refused(answer)


def mark(
    text: Annotated[str, typer.Argument(help="Label, 1 to 200 characters.")],
    *,
    rig: _Rig = Path("rig.toml"),
    json: _Json = False,
) -> None:
    """Label this instant in the events and recordings of a running daemon.

    Exit codes: as for `jointfit request`.
    """
    answer = send_request(rig, "mark", {"text": text})
    if json:
        typer.echo(orjson.dumps(answer))
    elif answer.get("status") == "ok":
        typer.echo(f"mark {answer['data']['number']} at {answer['data']['t_us']} µs: {text}")
    exit_if_refused(answer)


def send_request(
    rig: Path, name: str, arguments: Mapping[str, Any], timeout_s: float = 10.0
) -> dict[str, Any]:
    """Send a request to the daemon of `rig`, and return its answer.

    Raises
    ------
    ConfigError
        The file `rig` is invalid.
    BrokerLostError, NoAnswerError
        The broker cannot be reached, or no daemon answers.
    """
    from jointfit_daemon.config import load_rig
    from jointfit_daemon.outputs.mqtt import MqttClient

    settings = load_rig(rig).mqtt
    if "/" in name or any(letter in name for letter in "+#\0"):
        raise ValueError(
            f"{name!r} is not the name of a request: expected one word, such as selftest"
        )

    async def exchange() -> dict[str, Any]:
        async with MqttClient(settings) as client:
            return await client.request(name, arguments, timeout_s=timeout_s)

    return asyncio.run(exchange())


def exit_if_refused(answer: Mapping[str, Any]) -> None:
    """If an answer contains faults, print one fault per line and exit."""
    if answer.get("status") != "error":
        return
    error: Mapping[str, Any] = answer.get("error") or {}
    faults = error.get("faults") or [error]
    for fault in faults:
        typer.echo(f"refused: {fault.get('message')}", err=True)
    if error.get("more"):
        typer.echo(f"and {error['more']} more faults", err=True)
    raise typer.Exit(EXIT_FAILED)


def _lines(answer: Mapping[str, Any]) -> list[str]:
    """Return the data of an answer as lines of text, one for each value or list entry."""
    data: Mapping[str, Any] = answer.get("data") or {}
    lines = []
    if "checks" in data:
        for check in data["checks"]:
            subject = f"{check['check']} {check['id']}".strip()
            remedy = f" → {check['remedy']}" if check["remedy"] else ""
            lines.append(f"{check['level']:7} {subject}: {check['text']}{remedy}")
        return lines

    for key, value in data.items():
        entries = (
            value if isinstance(value, list) and value and isinstance(value[0], dict) else None
        )
        if entries is None:
            lines.append(
                f"{key}: {value if isinstance(value, str) else orjson.dumps(value).decode()}"
            )
        else:
            lines += [orjson.dumps(entry).decode() for entry in entries]
    return lines or [str(answer.get("status"))]
