"""Command `jointfit check`: validates a rig.toml and summarizes it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from jointfit_daemon.config import Rig

MISUSE = 2


def check(
    config: Annotated[Path, typer.Argument(help="Configuration file to check.")] = Path("rig.toml"),
    *,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Check a rig.toml: print all faults, or a summary. Opens no device or connection."""
    import orjson
    from rich.console import Console

    from jointfit_daemon.config import ConfigError, load_rig

    try:
        rig = load_rig(config)
    except ConfigError as fault:
        if json:
            typer.echo(orjson.dumps({"ok": False, "faults": list(fault.faults)}, default=str))
        else:
            typer.echo(str(fault), err=True)
        raise typer.Exit(MISUSE) from None
    if json:
        typer.echo(orjson.dumps({"ok": True, "rig": rig.table}, default=str))
    else:
        _summary(Console(), config, rig)


def _summary(console: object, config: Path, rig: Rig) -> None:
    from rich.console import Console
    from rich.table import Table

    from jointfit_daemon.config import heading_warning
    from jointfit_daemon.driver import driver_names

    table = Table(title=f"{config}: rig {rig.name!r} is valid", title_justify="left")
    for column in ("source", "driver", "segment", "rate"):
        table.add_column(column)
    for source in rig.sources:
        table.add_row(source.id, source.driver, source.segment or "—", f"{source.rate_hz:g} Hz")
    if isinstance(console, Console):
        console.print(table)
        console.print(
            f"joints {' – '.join(rig.chain.joints)}, {rig.output_rate_hz:g} Hz to "
            f"mqtt://{rig.mqtt.host}:{rig.mqtt.tcp_port}/{rig.mqtt.base}, calibration "
            f"store {rig.calibration_store!r}, method {rig.calibration.method}"
        )
        if (warning := heading_warning(rig.sources)) is not None:
            console.print(f"[yellow]warning:[/] {warning}")
        console.print(f"installed drivers: {', '.join(driver_names())}")
