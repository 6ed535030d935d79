"""Any content read as TOML or JSON yields a value, or one `MalformedFileError` with its cause."""

from __future__ import annotations

import os
import time
import tomllib
import tracemalloc
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jointfit_daemon.config import ConfigError, load_rig
from jointfit_daemon.files.text import (
    MalformedFileError,
    parse_toml,
    read_bounded,
    read_json,
    read_toml,
)
from jointfit_daemon.files.text._structured import MOST_BYTES

if TYPE_CHECKING:
    from collections.abc import Callable


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"a = " + b"[" * 5000, "nested more than 32 levels deep"),
        (b"a = " + b"[" * 40 + b"]" * 40, "nested more than 32 levels deep"),
        (b".".join([b"a"] * 100) + b" = 1", "nested more than 32 levels deep"),
        (b"a = " + b"1" * 5000, "not TOML"),
        (b"a = 0x" + b"f" * 5000, "an integer of more than 64 bits"),
        (b"\xff\xfea\0", "is not UTF-8: found UTF-16"),
        (b"a = 1\nb = '\xe4'", r"found byte 0xe4 \(line 2\)"),
        (b"a =", "not TOML"),
        (b"#" * (MOST_BYTES + 1), "larger than"),
    ],
)
def test_hostile_toml_is_one_fault(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "x.toml"
    path.write_bytes(content)
    with pytest.raises(MalformedFileError, match=said) as caught:
        read_toml(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("read", [read_toml, load_rig])
@pytest.mark.parametrize(
    "text", ["a." * 5000 + "b = 1", "x = {" + '"a" . ' * 5000 + "b = 1}", "[" + "a." * 5000 + "b]"]
)
def test_a_key_of_many_parts_costs_little_memory(
    tmp_path: Path, text: str, read: Callable[[Path], object]
) -> None:
    path = tmp_path / "x.toml"
    path.write_text(text)

    tracemalloc.start()
    try:
        with pytest.raises(
            (MalformedFileError, ConfigError), match="nested more than 32 levels deep"
        ):
            read(path)
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()

    assert peak_bytes < 20_000_000


@given(st.text("a\"'\\., =[{#\n", max_size=60))
def test_dotted_text_that_is_no_deep_key_is_read(text: str) -> None:
    try:
        expected: object = tomllib.loads(text)
    except ValueError:
        expected = None
    try:
        found: object = parse_toml(text)
    except ValueError:
        found = None
    assert found == expected


@pytest.mark.parametrize("content", [b"[" * 100_000, b"NaN", b"[1e999]" * 2, b"1" * 5000, b"\xff"])
def test_hostile_json_is_one_fault(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.json"
    path.write_bytes(content)
    with pytest.raises(MalformedFileError, match=r"x\.json"):
        read_json(path)


def test_a_byte_order_mark_is_accepted(tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    path.write_bytes(b"\xef\xbb\xbfa = 1")
    assert read_toml(path) == {"a": 1}


def test_special_files_are_rejected_immediately(tmp_path: Path) -> None:
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    began = time.monotonic()
    kinds = {tmp_path: "a directory", fifo: "a FIFO", Path("/dev/zero"): "a device"}
    for path, kind in kinds.items():
        with pytest.raises(MalformedFileError, match=f"is {kind}, expected a regular file"):
            read_bounded(path, 100)
    for path in (tmp_path / "none", Path("a\0b")):
        with pytest.raises(MalformedFileError):
            read_bounded(path, 100)
    assert time.monotonic() - began < 1.0


@given(st.binary(max_size=60) | st.text(max_size=60).map(str.encode))
@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_content_is_a_value_or_malformed(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x"
    path.write_bytes(content)
    for read in (read_toml, read_json):
        try:
            read(path)
        except MalformedFileError:
            continue
