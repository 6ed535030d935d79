"""Command `jointfit record`: starts and stops the recording of a running daemon."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import orjson
import typer

from jointfit_daemon.tools.request import exit_if_refused, mark, send_request
from jointfit_daemon.tools.text_output import join_choices

if TYPE_CHECKING:
    from collections.abc import Mapping

ACTIONS = ("start", "stop", "status", "mark")


def record(
    action: Annotated[str, typer.Argument(help="start, stop, status, or mark.")],
    text: Annotated[str, typer.Argument(help="Label of a mark, 1 to 200 characters.")] = "",
    *,
    rig: Annotated[
        Path, typer.Option("--rig", "--config", help="The rig.toml of the daemon.")
    ] = Path("rig.toml"),
    json: Annotated[
        bool, typer.Option("--json", help="Print the whole answer as one JSON object.")
    ] = False,
) -> None:
    """Start or stop the recording of a running daemon, or label this instant in the recording.

    Exit codes: as for `jointfit request`.
    """
    if action not in ACTIONS:
        raise ValueError(f"{action!r} is not an action: expected {join_choices(ACTIONS)}")
    if (action == "mark") is not bool(text):
        raise ValueError("expected a text after mark, and only there: jointfit record mark TEXT")
    if action == "mark":
        mark(text, rig=rig, json=json)
        return

    answer = send_request(rig, "record", {"action": action})
    if json:
        typer.echo(orjson.dumps(answer))
    elif answer.get("status") != "error":
        typer.echo(_line(action, answer["data"]))
    exit_if_refused(answer)


def _line(action: str, state: Mapping[str, Any]) -> str:
    """Return the state of the recording as one line."""
    path, size = Path(state["directory"]) / state["file"], state["written_bytes"] / 1e6
    lost = f", {state['lost']} messages lost" if state["lost"] else ""
    if state["active"]:
        fault = f"; interrupted: {state['failure']}" if state["failure"] else ""
        return f"recording {path}: {size:.1f} MB{lost}{fault}"
    if action == "stop" and state["file"]:
        return f"recorded {path}: {size:.1f} MB{lost}"
    return "not recording"
