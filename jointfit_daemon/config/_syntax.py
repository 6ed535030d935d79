"""Parsing of rig.toml that reports all syntax errors of a file, not only the first.

A file with errors is parsed statement by statement. The parser replaces an unreadable statement by
a wrong value of the same key, so that the other statements are checked as well. If the key were
removed, further faults would result, such as a missing key, or a default value that contradicts
other tables.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from jointfit_daemon.config._fault_messages import SECRET, ConfigError, Fault
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
"""Largest file, bytes. The file of a rig with four sensors has 3 kB; parsing takes 0.5 s per MB."""
_MOST_ERRORS = 50
"""Largest number of syntax errors that are reported."""
_MOST_REPEATED = 20
"""Largest number of repeated tables and keys that are reported. Finding each of them requires
parsing the whole file."""
_MOST_LINES = 200
"""Largest number of lines of one value in a file with syntax errors."""
UNREADABLE = "unreadable-line"
"""Key of the table that replaces the value on a line with a syntax error. No table of a rig has
this key, so the value is wrong everywhere. Further faults of this value are not reported."""
_POSITION = re.compile(r"(.*?)(?: \(at (?:line (\d+), column \d+|end of document)\))?", re.DOTALL)
_HEADER = re.compile(r"\[{1,2}\s*([\w-]+(?:\s*\.\s*[\w-]+)*)")
_WHOLE_HEADER = re.compile(rf"{_HEADER.pattern}\s*\]{{1,2}}\s*(?:#.*)?")
_KEY = re.compile(r"([\w-]+(?:\.[\w-]+)*)(?=\s|=)")
_ASSIGNED = re.compile(r"\s*[\w.\"'-]+\s*=")
_DECIMAL_COMMA = re.compile(r"[=\[,]\s*[+-]?\d+,\d+\s*(#.*)?$")
_BOOLEAN = re.compile(r"=\s*(True|False|TRUE|FALSE|yes|no|on|off)\b")
_REMEDIES = (
    ("Invalid value", "write a number, true or false, or a text in quotation marks"),
    ("Unterminated string", "close it with the quotation marks that open it"),
    ("Unclosed array", "separate its values by commas and close it with ]"),
    ("Unclosed inline table", "separate its keys by commas and close it with }"),
    ("Expected '='", "write key = value, or # in front of a comment"),
    ("Expected newline", "write one key = value on a line, and # in front of a comment"),
    ("Invalid statement", "write key = value, a [table], or # in front of a comment"),
    ("Expected ']]'", "close it with ]]"),
    ("Expected ']'", "close it with ]"),
    ("Invalid initial character", "write key = value; a key has letters, digits, _ and - only"),
    ("Unescaped", "write \\\\ for a backslash, or use single quotation marks"),
    ("Illegal character '\\n'", "close the text with a quotation mark on the same line"),
    ("Illegal character", "remove it, or write it as an escape sequence such as \\t"),
    ("Duplicate inline table key", "remove one of the two"),
)
"""Beginnings of error messages of tomllib, each with a remedy."""


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
        missing = "" if path.exists() else ", or write one: `jointfit init`"
        fault = Fault("file", str(error).removeprefix(f"{path}: ") + missing)
        raise ConfigError(str(path), [fault]) from error

    table, faults = _parse(text.replace("\r\n", "\n"))
    if table is None:
        raise ConfigError(str(path), faults)
    if (text_of_fault := find_structure_fault(table)) is not None:
        raise ConfigError(str(path), [*faults, Fault("TOML", text_of_fault)])
    return table, faults


def _parse(text: str) -> tuple[dict[str, Any] | None, list[Fault]]:
    """Return the table and the syntax errors; no table if the repaired text is invalid TOML."""
    try:
        return parse_toml(text), []
    except (ValueError, RecursionError):
        repair = _Repair(text.split("\n"))
    repair.replace_statements()
    return repair.parse(), repair.faults[:_MOST_ERRORS]


def _error_of(text: str) -> tuple[str, int | None] | None:
    """Return the first error of a TOML text and its line; None for a valid text."""
    try:
        parse_toml(text)
    except RecursionError:
        return f"nested more than {MAX_NESTING} levels deep", None
    except ValueError as error:  # an integer of 5000 digits is a plain ValueError
        found = _POSITION.fullmatch(str(error))
        if found is None or type(error) is ValueError:
            return f"is not a TOML value: {error}", None
        return found[1], int(found[2]) if found[2] else None
    return None


def _with_remedy(text: str, line: str) -> str:
    """Return an error message of tomllib with the remedy for `line`."""
    plain = f"{text[:1].lower()}{text[1:]}"
    if _DECIMAL_COMMA.search(line):
        return f"{plain}; use a decimal point, not a comma"
    if _BOOLEAN.search(line):
        return f"{plain}; write true or false"
    remedy = next((remedy for begin, remedy in _REMEDIES if text.startswith(begin)), None)
    return f"{plain}: {remedy}" if remedy else plain


class _Repair:
    """Lines of a rig.toml in which valid statements replace the statements with errors."""

    def __init__(self, lines: list[str]) -> None:
        self.lines, self.faults = list(lines), list[Fault]()
        self._original = lines
        self._starts: list[int] = []
        """Line indices at which the statements start."""
        self._repeated: dict[str, list[str]] = {}
        """Path of the first table of the same name, by the temporary name of each repeated
        table."""

    def replace_statements(self) -> None:
        """Replace every statement that is invalid TOML when parsed alone."""
        at = 0
        while at < len(self.lines):
            self._starts.append(at)
            length = self._length(at)
            at += length or self._replace(at)

    def parse(self) -> dict[str, Any] | None:
        """Remove repeated keys and tables; return the table, or None if the text stays invalid."""
        removed = 0
        while (error := _error_of(text := "\n".join(self.lines))) is not None:
            if removed == _MOST_REPEATED:
                return None
            self._remove_repeated(*error)
            removed += 1
        return self._merge_tables(parse_toml(text))

    def _report(self, at: int, text: str) -> None:
        line = self._original[at].strip()
        where = f"line {at + 1}"
        shown = () if SECRET.search(line.lower()) else (line,)
        self.faults.append(Fault(where, text, *shown))

    def _length(self, at: int) -> int:
        """Return the number of lines of the statement at line index `at`; 0 if it is not TOML."""
        line = self.lines[at]
        opened = any(mark in line for mark in ('"""', "'''")) or any(
            line.count(opening) > line.count(closing) for opening, closing in ("[]", "{}")
        )
        for end in range(at + 1, min(at + _MOST_LINES, len(self.lines)) + 1):
            if _error_of("\n".join(self.lines[at:end])) is None:
                return end - at
            if not opened or (end < len(self.lines) and _WHOLE_HEADER.fullmatch(self.lines[end])):
                break
        return 0

    def _replace(self, at: int) -> int:
        """Report and replace the statement at `at`; return its number of lines."""
        line = self.lines[at].strip()
        is_value = _ASSIGNED.match(line) is not None
        opened = is_value and any(mark in line for mark in ("[", "{", '"""', "'''"))
        end = at + 1
        while opened and end < len(self.lines):
            # This line looks like the start of a statement, so the value before it was not closed.
            if _ASSIGNED.match(self.lines[end]) or _WHOLE_HEADER.fullmatch(self.lines[end]):
                break
            end += 1

        text, number = _error_of("\n".join(self.lines[at:end])) or ("Invalid statement", 1)
        wrong = at + (number or 1) - 1
        self._report(wrong, _with_remedy(text, self.lines[wrong].strip()))
        self.lines[at:end] = [_replacement(line, at), *[""] * (end - at - 1)]
        return end - at

    def _remove_repeated(self, text: str, number: int | None) -> None:
        """Report and remove a statement that is valid alone but contradicts other statements."""
        last = len(self.lines) if number is None else number
        at = max(start for start in self._starts if start < last)
        line = self.lines[at].strip()
        header = _HEADER.match(line)
        if header is not None and header[1] == "imu":
            self._replace_single_imus()
            return

        end = next((start for start in self._starts if start > at), len(self.lines))
        self.lines[at:end] = [""] * (end - at)
        if header is not None:
            name = f"{UNREADABLE}-{at}"
            self._repeated[name] = [part.strip() for part in header[1].split(".")]
            self.lines[at] = f"[{name}]"
            text = f"table [{header[1]}] occurs a second time: merge the two"
        elif key := _KEY.match(line):
            text = f"{key[1]} occurs a second time in this table: remove one of the two"
        self._report(at, text)

    def _replace_single_imus(self) -> None:
        """Change every header ``[imu]`` to ``[[imu]]``."""
        for at in self._starts:
            header = _WHOLE_HEADER.fullmatch(self.lines[at].strip())
            if header and header[1] == "imu" and not self.lines[at].strip().startswith("[["):
                self.lines[at] = "[[imu]]"
                self._report(at, "[imu] is a single table: write [[imu]]")

    def _merge_tables(self, table: dict[str, Any]) -> dict[str, Any]:
        """Return the table, with keys of repeated tables moved into the first of these tables."""
        unnamed = {name: table.pop(name) for name in [*table] if name.startswith(UNREADABLE)}
        for name, path in self._repeated.items():
            keys, first = unnamed.get(name, {}), table
            for part in path:
                inner: Any = first.get(part)
                first = inner[-1] if isinstance(inner, list) and inner else inner
                if not isinstance(first, dict):
                    break
            else:
                first.update({key: value for key, value in keys.items() if key not in first})
        return table


def _replacement(line: str, at: int) -> str:
    """Return a valid replacement of a wrong line: a similar header, or an unreadable value."""
    if line.startswith("["):
        header = _HEADER.match(line)
        if header is None:
            return f"[{UNREADABLE}-{at}]"  # the keys that follow belong to no other table
        return f"[[{header[1]}]]" if header[1] == "imu" else f"[{header[1]}]"
    key = _KEY.match(line)
    if key is None:
        return ""
    assigned = "true" if _ASSIGNED.match(line) else "false"
    return f"{key[1]} = {{ {UNREADABLE} = {assigned} }}"


def without_unreadable(fault: Fault) -> Fault | None:
    """Return `fault`; None if its line is already reported as a syntax error.

    An unknown key on such a line is a separate fault, which is returned without its value.
    """
    shown = f"{fault.key} {fault.value!r}" if fault.has_value else fault.key
    if UNREADABLE not in f"{shown} {fault.expected}":
        return fault
    if fault.value == {UNREADABLE: True} and fault.expected.startswith("unknown key"):
        return Fault(fault.key, fault.expected, near=fault.near)
    return None
