"""Command `jointfit schema`: prints the JSON Schema of rig.toml."""

from __future__ import annotations

import orjson
import typer


def schema() -> None:
    """Print the JSON Schema of rig.toml: all keys with unit, default and description.

    Editors with a TOML language server use it to complete and check rig.toml.
    """
    from jointfit_daemon.config import rig_schema

    typer.echo(orjson.dumps(rig_schema(), option=orjson.OPT_INDENT_2))
