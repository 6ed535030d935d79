"""`jointfit schema`: every key of rig.toml, as JSON Schema."""

from __future__ import annotations

import orjson
import typer


def schema() -> None:
    """Print the JSON Schema of rig.toml: every key, its unit, its default, its meaning.

    Editors with a TOML language server complete and check rig.toml with it.
    """
    from jointfit_daemon.config import rig_schema

    typer.echo(orjson.dumps(rig_schema(), option=orjson.OPT_INDENT_2))
