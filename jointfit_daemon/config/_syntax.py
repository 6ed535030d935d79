"""Parsing of rig.toml, with all syntax errors.

After an error its line is replaced and the rest is parsed again, so that further errors are found.
The replacement is a wrong value of the same key. A removed key would cause faults of its own, such
as a missing key, or a default value that contradicts other tables.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from jointfit_daemon.config._fault_messages import ConfigError, Fault
from jointfit_daemon.files.text import (
    MAX_NESTING,
    MalformedFileError,
    find_structure_fault,
    parse_toml,
    read_text,
)

if TYPE_CHECKING:
    from pathlib import Path

_MOST_BYTES = 256 * 1024
"""Largest file, bytes: a rig of four sensors has 3 kB, and parsing takes 0.5 s per MB."""
_MOST_ERRORS = 20
"""Largest number of syntax errors that are reported."""
_OF_SEVERAL_LINES = ("[", "]", "{", "}", '"""', "'''")
_AT_LINE = re.compile(r"(.*) \(at line (\d+), column \d+\)", re.DOTALL)
_HEADER = re.compile(r"\[{1,2}\s*([\w-]+(?:\.[\w-]+)*)")
_KEY = re.compile(r"([\w-]+(?:\.[\w-]+)*)(?=\s|=)")
_ASSIGNED = re.compile(r"\s*[\w.\"'-]+\s*=")
UNREADABLE = "unreadable-line"
"""Key of the table that replaces the value on a line with a syntax error. No table of a rig has
this key, so the value is wrong everywhere; its further faults are not reported.
"""
_DECIMAL_COMMA = re.compile(r"[=\[,]\s*[+-]?\d+,\d+\s*(#.*)?$")


def read_table(path: Path) -> tuple[dict[str, Any], list[Fault]]:
    """Return the parsed part of a rig.toml, and its syntax errors.

    Raises
    ------
    ConfigError
        No part of the file can be used.
    """
    try:
        text = read_text(path, _MOST_BYTES)
    except MalformedFileError as error:
        fault = Fault("file", str(error).removeprefix(f"{path}: "))
        raise ConfigError(str(path), [fault]) from error

    try:
        table, faults = _parse(text.split("\n"))
    except RecursionError as error:
        fault = Fault("TOML", f"nested more than {MAX_NESTING} levels deep")
        raise ConfigError(str(path), [fault]) from error
    if table is None:
        raise ConfigError(str(path), faults)
    if (text_of_fault := find_structure_fault(table)) is not None:
        raise ConfigError(str(path), [*faults, Fault("TOML", text_of_fault)])
    return table, faults


def _parse(lines: list[str]) -> tuple[dict[str, Any] | None, list[Fault]]:
    """Return the table; None if the removed lines would cause further faults."""
    repair = _Repair(lines)
    while len(repair.faults) < _MOST_ERRORS:
        try:
            return parse_toml("\n".join(repair.lines)), repair.faults
        except ValueError as error:  # an integer of 5000 digits is a plain ValueError
            if not repair.replace(error):
                break
    return None, repair.faults


class _Repair:
    """Lines of a file whose errors are replaced one after the other."""

    def __init__(self, lines: list[str]) -> None:
        self.lines, self.faults = list(lines), list[Fault]()
        self._original = lines
        self._last, self._opened = -1, False

    def replace(self, error: ValueError) -> bool:
        """Report and replace the line of `error`; return False if the rest cannot be read."""
        found = _AT_LINE.fullmatch(str(error))
        number = int(found[2]) if found else 0
        if self._opened and (found is None or number == self._last + 1):
            self._opened = False
            return self._replace_value(self._last)  # the replaced line was a part of it
        if found is None:
            if not self.faults:
                self.faults.append(Fault("TOML", str(error)))
            return False
        if number == self._last and self.lines[number - 1]:
            self.lines[number - 1] = ""  # the replacement is not accepted either
            return True

        line, text = self.lines[number - 1].strip(), found[1]
        remedy = "; use a decimal point, not a comma" if _DECIMAL_COMMA.search(line) else ""
        self.faults.append(Fault(f"line {number}", f"{text[:1].lower()}{text[1:]}{remedy}", line))
        self._last = number
        if not line:
            return False
        if not _ASSIGNED.match(line) and _is_open(self.lines[: number - 1]):
            return self._replace_value(number)

        self.lines[number - 1] = _replacement(line)
        self._opened = any(mark in line for mark in _OF_SEVERAL_LINES)
        # Without a header its keys would belong to another table.
        return bool(self.lines[number - 1])

    def _replace_value(self, number: int) -> bool:
        """Make the value of several lines that contains line `number` unreadable.

        Returns False if its first line is not found.
        """
        original = self._original
        starts = [
            at for at, line in enumerate(original) if _ASSIGNED.match(line) or line[:1] == "["
        ]
        first = max((at for at in starts if at < number - 1), default=None)
        if first is None or original[first].startswith("["):
            return False

        after = min((at for at in starts if at > first), default=len(original))
        blank = [""] * (after - first - 1)
        self.lines[first:after] = [_replacement(original[first].strip()), *blank]
        # The line of the error is the next value if the bracket before it is missing.
        self.lines[after:number] = original[after:number]
        return True


def _is_open(lines: list[str]) -> bool:
    """Return whether valid `lines` end within a value of several lines."""
    try:
        parse_toml("\n".join(lines))
    except ValueError:
        return True
    return False


def _replacement(line: str) -> str:
    """Return a valid line for a wrong one: the header that it resembles, or an unreadable value."""
    if line.startswith("["):
        header = _HEADER.match(line)
        if header is None:
            return ""
        repaired = f"[[{header[1]}]]" if header[1] == "imu" else f"[{header[1]}]"
        return "" if repaired == line else repaired
    key = _KEY.match(line)
    return f"{key[1]} = {{ {UNREADABLE} = true }}" if key else f"# {line}"
