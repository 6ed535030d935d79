"""Command `jointfit decode`: decodes a capture with the decoder that the daemon uses."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path  # noqa: TC003 - typer reads annotations at run time
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from jointfit_daemon.model import (
    ClockEcho,
    Corrupt,
    DeviceEvent,
    ImuSample,
    MocapFrame,
    SyncPulse,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from jointfit_daemon.driver import Decoder, Driver
    from jointfit_daemon.model import Decoded


@dataclass(slots=True)
class CaptureSummary:
    """Counts of one capture."""

    corrupt: int = 0
    quaternions: int = 0
    first_quaternion: tuple[float, ...] | None = None
    last_quaternion: tuple[float, ...] | None = None
    time_resets: int = 0
    counter_gaps: int = 0
    frames: int = 0
    warnings: list[str] = field(default_factory=list)

    def add(self, item: Decoded) -> None:
        """Count one decoded item."""
        if isinstance(item, ImuSample):
            self._quaternion(item.q_native)
        elif isinstance(item, MocapFrame):
            self.frames += 1
            for row in item.body_orientations:
                if row[0] == row[0]:
                    self._quaternion(tuple(row.tolist()))
        elif isinstance(item, Corrupt):
            self.corrupt += 1
        elif isinstance(item, DeviceEvent):
            self.time_resets += item.kind == "restart"
            self.counter_gaps += item.kind == "gap"
            if item.kind in ("warning", "error"):
                self.warnings.append(item.text)

    def _quaternion(self, q: tuple[float, ...]) -> None:
        self.quaternions += 1
        self.first_quaternion = self.first_quaternion or q
        self.last_quaternion = q


def decode(
    protocol: Annotated[str, typer.Argument(help="Driver: xbus, xcdi, natnet, or another.")],
    file: Annotated[Path, typer.Argument(help="Raw bytes, pcapng, or `candump -L` log.")],
    *,
    jsonl: Annotated[bool, typer.Option("--jsonl", help="One JSON object per item.")] = False,
    summary: Annotated[bool, typer.Option("--summary", help="Print counts as JSON.")] = False,
    setting: Annotated[
        list[str] | None, typer.Option("--set", help="Driver setting, KEY=VALUE (TOML).")
    ] = None,
) -> None:
    """Decode a capture of an installed driver: table of counts, JSON lines, or JSON summary."""
    import orjson

    from jointfit_daemon.driver import find_driver
    from jointfit_daemon.files.captures import read_capture

    driver = find_driver(protocol)
    decoder = driver(_settings(driver, protocol, setting or [])).decoder()
    chunks = read_capture(file, driver.wire)
    counts = CaptureSummary()
    for item in _items(decoder, chunks):
        counts.add(item)
        if jsonl:
            row = orjson.dumps(_row(item), default=str, option=orjson.OPT_SERIALIZE_NUMPY)
            sys.stdout.buffer.write(row + b"\n")
    if jsonl and not summary:
        return
    if not decoder.messages and not summary:
        raise ValueError(
            f"{file}: no message of protocol {protocol} found: select the driver of the recorded"
            " device, and set CAN identifiers and other settings with --set"
        )
    found = _found(decoder, counts)
    if summary:
        typer.echo(orjson.dumps(found))
    else:
        _print_table(found, counts.warnings)


def _print_table(found: Mapping[str, object], warnings: list[str]) -> None:
    for key, value in found.items():
        typer.echo(f"{key:18} {_cell(value)}")
    if explanation := _explanation(found):
        typer.echo(explanation, err=True)
    for text in dict.fromkeys(warnings):
        typer.echo(f"warning: {text}", err=True)


def _cell(value: object) -> str:
    if isinstance(value, tuple):
        return "  ".join(f"{part:.6f}" for part in value)
    return "-" if value is None else str(value)


def _explanation(found: Mapping[str, object]) -> str | None:
    """Return an explanation if the capture has no orientation."""
    if not found["quaternions"]:
        return "no orientation found: configure the device to send quaternions"
    return None


def _items(decoder: Decoder, chunks: Any) -> Iterator[Decoded]:
    for chunk in chunks:
        yield from decoder.feed(chunk)
    yield from decoder.flush()


def _found(decoder: Decoder, counts: CaptureSummary) -> dict[str, object]:
    found: dict[str, object] = {
        "messages": decoder.messages,
        "corrupt": counts.corrupt,
        "discarded_bytes": decoder.discarded_bytes,
        "quaternions": counts.quaternions,
        "first_quaternion": counts.first_quaternion,
        "last_quaternion": counts.last_quaternion,
        "time_resets": counts.time_resets,
        "counter_gaps": counts.counter_gaps,
    }
    return found | ({"mocap_frames": counts.frames} if counts.frames else {})


def _settings(driver: type[Driver], name: str, pairs: list[str]) -> Any:
    """Return driver settings for decoding; required keys of the connection get placeholders."""
    import tomllib

    from pydantic import ValidationError

    from jointfit_daemon.config import faults_of

    given: dict[str, Any] = {"driver": name}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals:
            message = f"--set {pair}: expected KEY=VALUE"
            raise ValueError(message)
        try:
            given |= tomllib.loads(f"{key} = {value}")
        except (ValueError, RecursionError):  # a bare word is text
            given[key] = value
    for key, info in driver.Settings.model_fields.items():
        if info.is_required() and key not in given:
            given[key] = _placeholder(info.annotation)
    try:
        return driver.Settings.model_validate(given)
    except ValidationError as error:
        faults = faults_of(error, driver.Settings, name)
        raise ValueError("; ".join(fault.text() for fault in faults)) from None


def _placeholder(annotation: Any) -> Any:
    from pydantic import BaseModel

    kinds = [annotation, *get_args(annotation)]
    if any(isinstance(kind, type) and issubclass(kind, BaseModel) for kind in kinds):
        return {"interface": "virtual", "channel": "file"}
    return "file" if str in kinds else 1


def _row(item: Decoded) -> dict[str, object]:
    if isinstance(item, ImuSample):
        return {"type": "imu", **item._asdict()}
    if isinstance(item, MocapFrame):
        return {
            "type": "mocap",
            "number": item.number,
            "ticks": item.ticks,
            "arrival_ns": item.arrival_ns,
            "live": item.live,
            "markers_m": dict(zip(item.layout.markers, item.markers, strict=True)),
            "bodies": {
                name: {"p_m": p, "q": q}
                for name, p, q in zip(
                    item.layout.bodies, item.body_positions, item.body_orientations, strict=True
                )
            },
        }

    if isinstance(item, Corrupt):
        return {"type": "corrupt", "discarded": item.discarded, "reason": item.reason}
    if isinstance(item, ClockEcho):
        return {"type": "echo", "sent_ns": item.sent_ns, "ticks": item.ticks}
    if isinstance(item, SyncPulse):
        return {"type": "pulse", **item._asdict()}

    return {"type": item.kind, "text": item.text, "data": dict(item.data)}
