"""Summary of a batch as CSV and as HTML page, with one row for each recording."""

from __future__ import annotations

import csv
import io
from collections import Counter
from dataclasses import asdict, fields
from typing import TYPE_CHECKING
from urllib.parse import quote

from jointfit_daemon.tools.batch.recording_task import REPORT_FILE, RecordingResult
from jointfit_daemon.tools.output_files import replace_file
from jointfit_daemon.tools.report.html_document import PageLink, document, facts, section, table

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

_UNKNOWN = "–"
_HEAD = (
    "Recording", "Status", "Duration, s", "RMS difference from cameras", "Largest range of motion",
    "Gait cycles", "Samples lost, %", "Faults", "Gaps", "Replay", "Notes",
)  # fmt: skip


def write_summary(results: Sequence[RecordingResult], out: Path) -> list[Path]:
    """Write ``summary.csv`` and ``summary.html`` in the order of the recordings."""
    ordered = sorted(results, key=lambda result: result.recording)
    rows = io.StringIO()
    writer = csv.DictWriter(rows, [field.name for field in fields(RecordingResult)])
    writer.writeheader()
    writer.writerows(asdict(result) for result in ordered)  # csv writes None as an empty cell

    count = Counter(result.status for result in ordered)
    states = [(name.title(), f"{count[name]}") for name in ("done", "differs", "failed")]
    pairs = [("Recordings", f"{len(ordered)}"), *states]
    cells = [_row(result, out) for result in ordered]
    body = section(
        "recordings", "Recordings", [table("One row per recording", _HEAD, cells, text=2)]
    )
    header = f"<header><h1>Batch summary</h1>{facts(pairs, 'facts head')}</header>"
    page = document("Batch summary", f"{header}<main>{body}</main>")

    texts = {"summary.csv": rows.getvalue(), "summary.html": page}
    for name, text in texts.items():
        replace_file(out / name, text)
    return [out / name for name in texts]


def _row(result: RecordingResult, out: Path) -> tuple[str, ...]:
    page = out / result.recording / REPORT_FILE
    address = f"{quote(result.recording)}/{REPORT_FILE}"
    name = PageLink(result.recording, address) if page.is_file() else result.recording
    rms = _UNKNOWN if result.rms_deg is None else f"{result.rms_deg:.1f}° {result.angle}"
    extent = _UNKNOWN if result.range_deg is None else f"{result.range_deg:.0f}°"
    return (
        name,
        result.status if result.status == "done" else f"▲ {result.status}",
        _text(result.duration_s, 1),
        rms,
        extent,
        _text(result.gait_cycles, 0),
        _text(result.lost_percent, 2),
        _text(result.faults, 0),
        result.gaps or _UNKNOWN,
        result.verified or _UNKNOWN,
        result.error or result.notes or _UNKNOWN,
    )


def _text(value: float | None, places: int) -> str:
    return _UNKNOWN if value is None else f"{value:.{places}f}"
