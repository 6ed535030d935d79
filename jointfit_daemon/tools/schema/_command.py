"""Command `jointfit schema`: prints the JSON Schema of rig.toml, of a payload, or of a request."""

from __future__ import annotations

from typing import Annotated, Any

import orjson
import typer

from jointfit_daemon.tools.completion import complete_topic


def schema(
    topic: Annotated[
        str,
        typer.Argument(
            help="Topic below the base, such as pose or bridge/request/mark. Default: rig.toml.",
            show_default=False,
            autocompletion=complete_topic,
        ),
    ] = "",
    *,
    asyncapi: Annotated[
        bool, typer.Option("--asyncapi", help="Print the AsyncAPI document of all topics.")
    ] = False,
) -> None:
    """Print a JSON Schema: of rig.toml, or of the payload of a topic or request.

    Editors with a TOML language server use the schema of rig.toml to complete and check the file.
    """
    from jointfit_daemon.config import rig_schema
    from jointfit_daemon.tools.schema._asyncapi import asyncapi_document

    if asyncapi and topic:
        raise ValueError("--asyncapi describes all topics: omit the topic")
    if asyncapi:
        shown = asyncapi_document()
    elif topic:
        shown = _schema_of(topic)
    else:
        shown = rig_schema()
    typer.echo(orjson.dumps(shown, option=orjson.OPT_INDENT_2))


def _schema_of(name: str) -> dict[str, Any]:
    from jointfit_daemon.nearest_name import nearest_name
    from jointfit_daemon.outputs.payload_models import (
        PAYLOADS,
        answer_schema,
        payload_schema,
        payload_topic,
    )
    from jointfit_daemon.supervisor.requests import REQUESTS
    from jointfit_daemon.tools.schema._asyncapi import request_schema

    requests = {f"bridge/request/{request}": request for request in REQUESTS}
    if name in requests:
        return request_schema(requests[name])
    answers = {f"bridge/response/{request}": request for request in REQUESTS}
    if name in answers:
        return answer_schema(answers[name])
    if (topic := payload_topic(name)) is not None:
        return payload_schema(topic)
    known = [*(topic.pattern for topic in PAYLOADS), *requests]
    near = nearest_name(name, known)
    hint = f"; did you mean {near!r}?" if near else "."
    raise ValueError(f"no topic {name!r}{hint} Known: {', '.join(known)}")
