"""Reading of TOML and JSON files from untrusted sources, with limited size and depth.

Invariant: the only exception that a file causes is `MalformedFileError`. Readers read at most
`most_bytes`, never wait for the writer of a FIFO, and reject values nested so deeply that later
code would exceed the recursion limit.
"""

from __future__ import annotations

import errno
import json
import os
import re
import stat
import tomllib
from typing import TYPE_CHECKING, Any

from jointfit_daemon.files.text._tables import MalformedFileError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

MOST_BYTES = 4 * 1024 * 1024
"""Largest size of a TOML or JSON file, bytes; files written by hand are far smaller."""
MAX_NESTING = 32
"""Largest nesting depth; no format of the project needs ten levels."""
_MOST_BITS = 64
_KINDS = {
    stat.S_IFDIR: "a directory",
    stat.S_IFIFO: "a FIFO",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}
_REFUSALS = {
    errno.ENOENT: "no such file: check the path",
    errno.ENOTDIR: "a parent of the path is a file: check the path",
    errno.EACCES: "cannot be read (permission denied): allow this user to read it: `chmod a+r`",
}
"""Message texts for common operating system errors."""
_PART = r"""(?:[A-Za-z0-9_-]+|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*')"""
_DEEP_KEY = re.compile(
    rf"(?:^|[\[{{,])[ \t]*(?:{_PART}[ \t]*\.[ \t]*){{{MAX_NESTING}}}{_PART}", re.MULTILINE
)
"""Pattern of a dotted key with more than `MAX_NESTING` parts, before a value or in a table
header."""
_UTF_16 = (b"\xff\xfe", b"\xfe\xff")


def read_toml(path: Path, most_bytes: int = MOST_BYTES) -> dict[str, Any]:
    """Return the table of a TOML file.

    Raises
    ------
    MalformedFileError
        The file cannot be read, is a directory or device, is too large, or is not UTF-8 or TOML.
    """
    table: dict[str, Any] = _parse_text(path, "TOML", parse_toml, read_text(path, most_bytes))
    return table


def read_json(path: Path, most_bytes: int = MOST_BYTES) -> Any:
    """Return the value of a JSON file; NaN and infinity are rejected, as the standard requires.

    Raises
    ------
    MalformedFileError
        The file cannot be read, is a directory or device, is too large, or is not UTF-8 or JSON.
    """
    return _parse_text(path, "JSON", parse_json, read_text(path, most_bytes))


def read_text(path: Path, most_bytes: int = MOST_BYTES) -> str:
    """Return the text of a UTF-8 file, without a byte order mark.

    Raises
    ------
    MalformedFileError
        The file cannot be read, is a directory or device, is too large, or is not UTF-8.
    """
    data = read_bounded(path, most_bytes)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        found, encoding = f"byte {data[error.start]:#04x}", "WINDOWS-1252"
        if data.startswith(_UTF_16):
            found = encoding = "UTF-16"
        line = data.count(b"\n", 0, error.start) + 1
        raise MalformedFileError(
            f"{path}: is not UTF-8: found {found} (line {line}): save the file as UTF-8, or "
            f"convert it: iconv -f {encoding} -t UTF-8 {path.name} > converted-{path.name}"
        ) from error


def read_bounded(path: Path, most_bytes: int) -> bytes:
    """Return the bytes of a regular file.

    Raises
    ------
    MalformedFileError
        The file cannot be read, is a directory or device, or is larger than `most_bytes`.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY)
        try:
            kind = stat.S_IFMT(os.fstat(descriptor).st_mode)
            if kind != stat.S_IFREG:
                found = _KINDS.get(kind, "a special file")
                raise MalformedFileError(f"{path}: is {found}, expected a regular file")
            with os.fdopen(descriptor, "rb", closefd=False) as file:
                data = file.read(most_bytes + 1)
        finally:
            os.close(descriptor)
    except ValueError as error:  # a NUL in the name, or the MalformedFileError raised above
        if isinstance(error, MalformedFileError):
            raise
        raise MalformedFileError(f"{str(path)!r}: not a valid file name: {error}") from error
    except OSError as error:
        other = f"cannot be read ({error.strerror}): check the path and the disk"
        found = _REFUSALS.get(error.errno or 0, other)
        raise MalformedFileError(f"{path}: {found}") from error
    if len(data) > most_bytes:
        raise MalformedFileError(f"{path}: larger than {most_bytes} bytes: is it the right file?")
    return data


def parse_toml(text: str) -> dict[str, Any]:
    """Return the table of a TOML text.

    Raises
    ------
    ValueError
        The text is not TOML.
    RecursionError
        The text is nested too deeply.
    """
    # tomllib needs time and memory that grow with the square of the number of parts of a dotted
    # key.
    if _DEEP_KEY.search(text):
        raise RecursionError(f"a key of more than {MAX_NESTING} parts")
    return tomllib.loads(text)


def parse_json(text: str) -> Any:
    """Return the value of a JSON text.

    Raises
    ------
    ValueError
        The text is not JSON, or contains NaN or infinity.
    RecursionError
        The text is nested too deeply.
    """
    try:
        return json.loads(text, parse_constant=_refuse_constant)
    except json.JSONDecodeError as error:
        fault = error.msg.replace("Expecting", "expected")
        raise ValueError(
            f"line {error.lineno}, column {error.colno}: {fault[:1].lower()}{fault[1:]}"
        ) from error
    except RecursionError as error:
        raise RecursionError(f"nested more than {MAX_NESTING} levels deep") from error


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not a JSON number")


def _parse_text(path: Path, name: str, parse: Callable[[str], Any], text: str) -> Any:
    try:
        value = parse(text)
    except RecursionError as error:
        raise MalformedFileError(f"{path}: nested more than {MAX_NESTING} levels deep") from error
    except ValueError as error:  # an integer of 5000 digits raises ValueError, too
        raise MalformedFileError(f"{path}: not {name}: {error}") from error
    if fault := find_structure_fault(value):
        raise MalformedFileError(f"{path}: {fault}")
    return value


def find_structure_fault(value: object) -> str | None:
    """Return the reason why a parsed value would make later code fail; None if it would not.

    The function checks the nesting depth, and integers for the range of 64 bits. It is iterative,
    because a recursive check could exceed the stack.
    """
    waiting: list[tuple[object, str, int]] = [(value, "", 0)]

    while waiting:
        here, key, depth = waiting.pop()
        if depth > MAX_NESTING:
            return f"{key[:60]}…: nested more than {MAX_NESTING} levels deep"

        if isinstance(here, dict):
            waiting += [
                (inner, f"{key}.{name}" if key else str(name), depth + 1)
                for name, inner in here.items()
            ]
        elif isinstance(here, (list, tuple)):
            waiting += [(inner, f"{key}[{at}]", depth + 1) for at, inner in enumerate(here)]
        elif isinstance(here, int) and here.bit_length() >= _MOST_BITS:
            return f"{key}: an integer of more than 64 bits"
    return None
