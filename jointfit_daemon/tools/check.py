"""Command `jointfit check`: validates a rig.toml and summarizes it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import orjson
import typer

from jointfit_daemon.tools.command_group import EXIT_MISUSE
from jointfit_daemon.tools.text_output import echo_wrapped

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from jointfit_daemon.config import Source


def check(
    config: Annotated[Path, typer.Argument(help="Configuration file to check.")] = Path("rig.toml"),
    *,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Check a rig.toml: print all faults, or a summary. Opens no device or connection."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from jointfit_daemon.config import ConfigError, load_rig, rig_warnings
    from jointfit_daemon.driver import driver_names

    try:
        rig = load_rig(config)
    except ConfigError as fault:
        if json:
            faults = [each.as_dict() for each in fault.faults]
            typer.echo(orjson.dumps({"ok": False, "faults": faults}, default=str))
        else:
            echo_wrapped(str(fault), err=True)
        raise typer.Exit(EXIT_MISUSE) from None

    warnings = rig_warnings(rig)
    if json:
        result = {"ok": True, "rig": rig.table, "warnings": warnings}
        typer.echo(orjson.dumps(result, default=str))
        return

    table = Table(title=f"{config}: rig {rig.name!r} is valid", title_justify="left")
    for column in ("source", "driver", "segment", "rate"):
        table.add_column(column)
    for source in rig.sources:
        table.add_row(source.id, source.driver, source.segment or "—", _rate(source))

    console = Console()
    console.print(table)
    console.print(
        f"joints {(', ' if rig.chain.parents else ' – ').join(rig.chain.joints)}, "
        f"{rig.output_rate_hz:g} Hz to mqtt://{rig.mqtt.host}:{rig.mqtt.tcp_port}/{rig.mqtt.base}, "
        f"calibration store {rig.calibration_store!r}, method {rig.calibration.method}"
    )
    if (model := rig.chain_model) is not None:
        chain = model.chain
        console.print(
            escape(
                f"chain model {chain.name!r}: {len(chain.segments)} segments, {chain.nq} degrees "
                f"of freedom, {len(chain.markers)} markers"
            )
        )
        for remark in model.remarks:
            console.print(f"[dim]note:[/] {escape(remark)}")
    known = map(escape, _calibration_lines(rig.sources))
    for line in (*known, *(f"[yellow]warning:[/] {escape(each)}" for each in warnings)):
        console.print(line)
    console.print(f"installed drivers: {', '.join(driver_names())}")


def _calibration_lines(sources: Iterable[Source]) -> Iterator[str]:
    """Yield a line for each sensor whose readings the gateway corrects."""
    from jointfit_daemon.sensor_calibration import calibration_of

    for source in sources:
        if (known := calibration_of(source.settings)) is not None:
            serial = "" if known.serial is None else f", serial {known.serial}"
            parts = ", ".join(known.parts) or "nothing"
            yield f"{source.id}: sensor calibration of {known.date}: {parts}{serial}"


def _rate(source: Source) -> str:
    """Return the configured rate as text; ``its own`` if cameras have no key ``rate_hz``."""
    if source.kind == "mocap" and not hasattr(source.settings, "rate_hz"):
        return "its own"
    return f"{source.rate_hz:g} Hz"
