"""Result of `jointfit doctor`, and its conversion to text."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic.dataclasses import dataclass

from jointfit_daemon.device_search import Finding, Level

if TYPE_CHECKING:
    from collections.abc import Iterator

_WORST_FIRST: tuple[Level, ...] = ("error", "warning")


@dataclass(frozen=True, slots=True)
class DoctorReport:
    """All findings, and the most severe level among them."""

    level: Level
    """``error``, ``warning``, or ``ok`` if no finding is an error or a warning."""
    findings: list[Finding]


def report_of(findings: list[Finding]) -> DoctorReport:
    """Return the report with `findings` and their most severe level."""
    levels = {finding.level for finding in findings}
    return DoctorReport(next((each for each in _WORST_FIRST if each in levels), "ok"), findings)


def finding_lines(finding: Finding) -> Iterator[str]:
    """Yield the lines of a finding; the remedy has its own line."""
    subject = f"{finding.check} {finding.id}".strip()
    yield f"{finding.level:8} {subject}: {finding.text}"
    if finding.remedy:
        yield f"{'':8} → {finding.remedy}"
