"""Parsing of rig.toml, with all syntax errors.

After an error its line is removed and the rest is parsed again, so that further errors are found.
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
    faults: list[Fault] = []
    last, opened = -1, False
    while len(faults) < _MOST_ERRORS:
        try:
            return parse_toml("\n".join(lines)), faults
        except ValueError as error:  # an integer of 5000 digits is a plain ValueError
            # Line of the error; without one nothing can be removed.
            found = _AT_LINE.fullmatch(str(error))
            number = int(found[2]) if found else 0
            if faults and (found is None or (number == last + 1 and opened)):
                break  # the removed line was part of a value of several lines
            if found is None:
                faults.append(Fault("TOML", str(error)))
                break

            line, text = lines[number - 1].strip(), found[1]
            remedy = "; use a decimal point, not a comma" if _DECIMAL_COMMA.search(line) else ""
            faults.append(Fault(f"line {number}", f"{text[:1].lower()}{text[1:]}{remedy}", line))
            if not line or line.startswith("["):
                break  # otherwise its keys would belong to another table
            lines[number - 1], last = "", number
            opened = any(mark in line for mark in _OF_SEVERAL_LINES)
    return None, faults
