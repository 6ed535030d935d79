"""Command `jointfit decode`: decodes a capture with the decoder that the daemon uses."""

from __future__ import annotations

import shlex
import sys
from collections import Counter
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import orjson
import typer

from jointfit_daemon.model import ClockEcho, Corrupt, DeviceEvent, ImuSample, MocapFrame, SyncPulse
from jointfit_daemon.tools.activity import show_activity
from jointfit_daemon.tools.completion import complete_driver

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from jointfit_daemon.driver import Decoder, Driver
    from jointfit_daemon.model import Chunk, Decoded

MOST_SHOWN = 8
"""Maximum number of identifiers that an error message lists."""
SHOWN = 60
"""Maximum number of characters of a setting that an error message quotes."""


@dataclass(slots=True)
class CaptureSummary:
    """Counts of decoded and rejected items of one capture."""

    corrupt: int = 0
    """Number of runs of successive bytes that belong to no message."""
    rejected: int = 0
    """Number of messages with unusable content."""
    rejected_bytes: int = 0
    reasons: Counter[str] = field(default_factory=Counter)
    """Number of rejected messages, by reason."""
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
            self.corrupt += not item.rejected
            if item.rejected:
                self.rejected += item.rejected
                self.rejected_bytes += item.discarded
                self.reasons[item.reason] += item.rejected
        elif isinstance(item, DeviceEvent):
            self.time_resets += item.kind == "restart"
            self.counter_gaps += item.kind == "gap"
            if item.kind in ("warning", "error"):
                self.warnings.append(item.text)

    def _quaternion(self, q: tuple[float, ...]) -> None:
        self.quaternions += 1
        self.first_quaternion = self.first_quaternion or q
        self.last_quaternion = q

    def table(self, decoder: Decoder) -> dict[str, object]:
        """Return the counts of the decoder and of the decoded items, by name."""
        found: dict[str, object] = {
            "messages": decoder.messages + self.rejected,
            "rejected": self.rejected,
            "corrupt": self.corrupt,
            "discarded_bytes": decoder.discarded_bytes - self.rejected_bytes,
            "quaternions": self.quaternions,
            "first_quaternion": self.first_quaternion,
            "last_quaternion": self.last_quaternion,
            "time_resets": self.time_resets,
            "counter_gaps": self.counter_gaps,
        }
        return found | ({"mocap_frames": self.frames} if self.frames else {})


_MOST_DISCARDED = 0.9
"""Share of discarded bytes above which a capture without orientations belongs to another device."""


_File = Annotated[Path, typer.Argument(help="Capture: raw bytes, pcapng, pcap, or `candump` log.")]
_JsonLines = Annotated[
    bool, typer.Option("--jsonl", help="Print one JSON object per decoded item.")
]


def decode(
    protocol: Annotated[
        str,
        typer.Argument(
            help="Driver of the recorded device, such as xbus; `jointfit check` lists all drivers.",
            autocompletion=complete_driver,
        ),
    ],
    file: _File,
    *,
    jsonl: _JsonLines = False,
    summary: Annotated[bool, typer.Option("--summary", help="Print the counts as JSON.")] = False,
    setting: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            help="Key of the driver's table in rig.toml, KEY=VALUE in TOML; repeatable. Example:"
            " --set 'ids={frame1=0x181}'.",
        ),
    ] = None,
) -> None:
    """Decode a capture with an installed driver: table of counts, JSON lines, or JSON summary."""
    from jointfit_daemon.driver import find_driver

    driver = find_driver(protocol)
    decoder_of = driver(_settings(driver, protocol, setting or [])).decoder
    decoder = decoder_of()
    counts = CaptureSummary()

    def items() -> Iterator[Decoded]:
        for chunk in _read(file, driver, decoder_of):
            yield from decoder.feed(chunk)
        yield from decoder.flush()

    with nullcontext() if jsonl else show_activity("decoding"):
        for item in items():
            counts.add(item)
            if jsonl:
                row = orjson.dumps(_row(item), default=str, option=orjson.OPT_SERIALIZE_NUMPY)
                sys.stdout.buffer.write(row + b"\n")
    if jsonl and not summary:
        return
    if not (decoder.messages or counts.rejected or summary):
        raise ValueError(f"{file}: {_why_nothing_found(file, driver, protocol)}")

    found = counts.table(decoder)
    if summary:
        typer.echo(orjson.dumps(found))
    else:
        rejected = [f"{number} rejected: {text}" for text, number in counts.reasons.most_common()]
        _print_table(found, rejected + counts.warnings)
        if not found["quaternions"]:
            # Bytes of another device may contain a few messages by chance.
            is_other = decoder.discarded_bytes > _MOST_DISCARDED * file.stat().st_size
            other = f"{file}: {_why_nothing_found(file, driver, protocol)}" if is_other else None
            typer.echo(other or _missing_orientations(driver, counts), err=True)


def _read(
    file: Path, driver: type[Driver], decoder_of: Callable[[], Decoder] | None = None
) -> Iterator[Chunk]:
    """Return the chunks of a capture.

    If the capture is of another type of connection, the error message lists the drivers for that
    type. If the capture contains several network connections, the connection in which the decoder
    from `decoder_of` finds the most messages is selected.
    """
    from jointfit_daemon.files.captures import UnreadableCaptureError, read_capture
    from jointfit_daemon.tools.discovery import installed_drivers

    split = getattr(driver, "packet_stream", None)
    rate = None if decoder_of is None else partial(_count_messages, decoder_of)
    try:
        return read_capture(file, driver.wire, split=split, rate=rate)
    except UnreadableCaptureError as error:
        fitting = [name for name, driver in installed_drivers() if driver.wire == error.recorded]
        if not fitting:
            raise
        raise ValueError(f"{error}: {', '.join(fitting)}") from None


def _count_messages(decoder_of: Callable[[], Decoder], chunks: Iterable[Chunk]) -> int:
    decoder = decoder_of()
    for chunk in chunks:
        decoder.feed(chunk)
    return decoder.messages


def _why_nothing_found(file: Path, driver: type[Driver], name: str) -> str:
    """Return why `driver` found no message in a capture, and a driver that finds messages."""
    from jointfit_daemon.files.captures import frame_sizes
    from jointfit_daemon.tools.discovery import decode_frames, decode_stream

    if not file.stat().st_size:
        return "the file is empty: record again while the device sends"
    chunks = list(_read(file, driver))
    text, others = f"no usable message of {name}", []
    if driver.wire == "can":
        sizes = frame_sizes(b"".join(chunk.data for chunk in chunks))
        shown = ", ".join(f"{number:#x}" for number, _ in sorted(sizes)[:MOST_SHOWN])
        text += f" in frames with {len(sizes)} identifiers ({shown or 'none'})"
        others = list(decode_frames(sizes, chunks))
    elif driver.wire == "stream":
        text += f" in {sum(len(chunk.data) for chunk in chunks)} bytes"
        others = [each for each in decode_stream(chunks, other_than=name) if each.samples]

    commands = []
    for other in others:
        keys = {key: value for key, value in other.settings.items() if key != "baud"}
        options = [f"--set {shlex.quote(f'{k}={_toml(k, value)}')}" for k, value in keys.items()]
        commands.append(
            " ".join(["jointfit decode", other.driver, shlex.quote(str(file)), *options])
        )
    if commands:
        return f"{text}. This command decodes it: {commands[0]}"
    remedy = " and give its identifiers and other keys with --set" if driver.wire == "can" else ""
    return f"{text}: select the driver of the recorded device{remedy}"


def _toml(key: str, value: Any) -> str:
    from jointfit_daemon.files.text import toml_value  # slow, because it imports numpy

    return toml_value(value, hexadecimal=key == "ids")


def _print_table(found: dict[str, object], warnings: list[str]) -> None:
    for key, value in found.items():
        if isinstance(value, tuple):
            cell = "  ".join(f"{part:.6f}" for part in value)
        else:
            cell = "-" if value is None else str(value)
        typer.echo(f"{key:18} {cell}")
    for text in dict.fromkeys(warnings):
        typer.echo(f"warning: {text}", err=True)


def _missing_orientations(driver: type[Driver], counts: CaptureSummary) -> str:
    from jointfit_daemon.driver import MocapSettings

    if not issubclass(driver.Settings, MocapSettings):
        return "no orientation found: configure the device to send quaternions"
    if counts.frames:
        return "no rigid body found: the frames contain markers only, or no body was visible"
    return (
        "no frame found: a capture must contain frames and the server's reply with the names of "
        "bodies and markers: start to record before jointfitd connects"
    )


def _settings(driver: type[Driver], name: str, pairs: list[str]) -> Any:
    """Return driver settings for decoding, from the options ``--set``."""
    from jointfit_daemon.files.text import MAX_NESTING, find_structure_fault, parse_toml
    from jointfit_daemon.tools.decoder_settings import decoder_settings

    given: dict[str, Any] = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals:
            raise ValueError(f"--set {pair}: expected KEY=VALUE")
        try:
            table = parse_toml(f"{key} = {value}")
        except RecursionError:
            raise ValueError(
                f"--set {key[:SHOWN]}: nested more than {MAX_NESTING} levels deep"
            ) from None
        except ValueError:  # a value without quotes is text
            table = {key: value}
        if fault := find_structure_fault(table):
            raise ValueError(f"--set {fault}")
        given |= table

    try:
        return decoder_settings(driver, name, given)
    except ValueError as error:
        if ": missing" not in str(error):
            raise
        raise ValueError(
            f"{error}. Give each key with --set KEY=VALUE, as in its [[imu]] table of rig.toml"
        ) from None


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
        kind = "rejected" if item.rejected else "corrupt"
        return {"type": kind, "discarded": item.discarded, "reason": item.reason}
    if isinstance(item, ClockEcho):
        return {"type": "echo", "sent_ns": item.sent_ns, "ticks": item.ticks}
    if isinstance(item, SyncPulse):
        return {"type": "pulse", **item._asdict()}

    return {"type": item.kind, "text": item.text, "data": dict(item.data)}
