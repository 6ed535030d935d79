"""Compiled and interpreted modules: selection of a variant, and equal results of both variants."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import sysconfig
from pathlib import Path
from typing import NamedTuple

import pytest
from typing_extensions import override

from jointfit_protocols.corrupt import CUT_OFF, NO_START, CorruptBytes
from jointfit_protocols.resynchronizing_codec import ResynchronizingCodec
from jointfit_variant import running_variant
from tests.compiled_variant import ROOT, run_compiled

FRAMES = Path(__file__).with_name("variant_frames.py")
PACKAGE = "from jointfit_variant import select_variant\nselect_variant(__path__)\n"


def test_tests_run_on_sources_unless_the_compiled_modules_are_requested() -> None:
    assert running_variant() == os.environ.get("JOINTFIT_TEST_VARIANT", "pure")


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """Return a package with the module `wire` in both forms; the compiled form cannot be loaded."""
    inner = tmp_path / "mixed" / "inner"
    inner.mkdir(parents=True)
    (inner.parent / "__init__.py").write_text(PACKAGE)
    (inner / "__init__.py").write_text("")
    (inner / "wire.py").write_text("FORM = 'source'\n")
    (inner / f"wire{sysconfig.get_config_var('EXT_SUFFIX')}").write_bytes(b"no library")
    return tmp_path


@pytest.mark.parametrize(
    ("value", "imported"), [("1", "source"), ("0", "extension"), (None, "extension")]
)
def test_jointfit_pure_imports_sources_instead_of_extension_modules(
    package: Path, value: str | None, imported: str
) -> None:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join((str(package), str(ROOT)))}
    environment.pop("JOINTFIT_PURE", None)
    if value is not None:
        environment["JOINTFIT_PURE"] = value
    done = subprocess.run(
        [sys.executable, "-c", "import mixed.inner.wire as w; print(w.FORM)"],
        env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if imported == "source":
        assert done.stdout == "source\n", done.stderr
    else:  # Python found the file of the extension module, which cannot be loaded
        assert "ImportError" in done.stderr


@pytest.mark.experiment
@pytest.mark.timeout(600)
def test_compiled_modules_and_their_sources_give_the_same_frames_bit_for_bit() -> None:
    outputs = {}
    for pure in (False, True):
        done = run_compiled(FRAMES, pure=pure)
        assert done.returncode == 0, done.stderr
        variant, *outputs[pure] = done.stdout.splitlines()
        assert variant == ("pure" if pure else "compiled")
    assert len(outputs[True]) > 500
    assert outputs[False] == outputs[True]


class _Letter(NamedTuple):
    """Message of an invented protocol: one byte after a start byte."""

    letter: bytes
    end: int


class _LetterCodec(ResynchronizingCodec[_Letter]):
    """Codec as in a driver package outside of this project, which is not compiled."""

    def __init__(self) -> None:
        super().__init__(self._letter, re.compile(b"\x02"), longest_run=64)
        self.silences = 0

    def _letter(self, buffer: bytes, at: int, before: int) -> _Letter | CorruptBytes | None:
        if buffer[at] != 2:
            return CorruptBytes(1, NO_START)
        piece = buffer[at + 1 : at + 2]
        return _Letter(piece, before + at + 2) if piece else None

    @override
    def flush(self) -> list[_Letter | CorruptBytes]:
        self.silences += 1
        return super().flush()


def test_a_codec_of_another_package_extends_the_one_of_this_installation() -> None:
    codec = _LetterCodec()
    assert codec.feed(b"\x02a\x02") == [(b"a", 2)]
    assert codec.feed(b"b??\x02c\x02") == [(b"b", 4), CorruptBytes(2, NO_START), (b"c", 8)]
    assert codec.flush() == [CorruptBytes(1, CUT_OFF)]
    assert (codec.messages, codec.discarded, codec.silences) == (3, 3, 1)


def test_compiled_modules_are_not_current_without_a_compiler(tmp_path: Path) -> None:
    (tmp_path / ".digest").write_text("digest of an earlier build")
    done = subprocess.run(
        [sys.executable, ROOT / "packaging" / "compiled.py", "--check", "--out", tmp_path],
        env=os.environ | {"PATH": "/none"}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (1, "")
