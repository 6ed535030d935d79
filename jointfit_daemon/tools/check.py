"""`jointfit check`: whether a rig.toml is right, and what the daemon would do with it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from jointfit_daemon.config import Rig

MISUSE = 2


def check(
    config: Annotated[Path, typer.Argument(help="The rig.toml to check.")] = Path("rig.toml"),
    *,
    json: Annotated[bool, typer.Option("--json", help="Print JSON for programs.")] = False,
) -> None:
    """Check a rig.toml: all faults at once, or a summary of what it describes. Opens nothing."""
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

    from jointfit_daemon.config import headings
    from jointfit_daemon.driver import driver_names

    table = Table(title=f"{config}: rig {rig.name!r} is right", title_justify="left")
    for column in ("source", "driver", "on", "rate"):
        table.add_column(column)
    for source in rig.sources:
        table.add_row(source.id, source.driver, source.segment or "—", f"{source.rate_hz:g} Hz")
    if isinstance(console, Console):
        console.print(table)
        console.print(
            f"chain {' – '.join(rig.chain.joints)}, {rig.output_rate_hz:g} Hz to "
            f"mqtt://{rig.mqtt.host}:{rig.mqtt.tcp_port}/{rig.mqtt.base}, calibration "
            f"{rig.calibration_store!r} by {rig.calibration.method}"
        )
        if (doubt := headings(rig.sources)) is not None:
            console.print(f"[yellow]warning:[/] {doubt}")
        console.print(f"drivers installed: {', '.join(driver_names())}")
