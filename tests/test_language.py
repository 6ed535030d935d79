"""The wording of docstrings, messages and pages: words to avoid, and how often others occur.

The lists follow the glossary of CONVENTIONS.md. The rates are hints where to read, so the limits
are loose; a metaphor for a technical term fails at once.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = (
    "jointfit_daemon",
    "drivers/jointfit_drivers",
    "protocols/jointfit_protocols",
    "bench",
    "simulators/jointfit_simulators",
    "examples",
)
PAGES = ("docs", "README.md", "CONVENTIONS.md", "CONTRIBUTING.md", "CHANGELOG.md")

RATES_PER_1000 = {
    r"tells?|told|says?|said": 1.0,
    r"what": 3.0,
    r"nobody|somebody|whoever|whom|who": 0.5,
    r"anew|for ever|mend(?:s|ed)?|errs|beside|(?<!-)worn": 0.5,
}
"""Largest number of occurrences in 1000 words, by pattern."""
BANNED = re.compile(
    r"\b(?:law|flesh|bulletin|asleep|moods?|verdicts?|unlearn\w*|whose turn|worn since"
    r"|gives? up|look(?:s|ed)? after|put on anew)\b",
    re.IGNORECASE,
)
"""Words for which standard terms exist: invariant, soft tissue, notice, stuck, outcome, revert,
drop, re-donned."""
ALLOWED = {
    "docs/accuracy",  # tables with names by other authors
    "jointfit_daemon/tools/dashboard/page/vendor",  # libraries of other authors
}


def docstrings(text: str) -> str:
    """Return all docstrings of a Python module, those of attributes included."""
    return " ".join(_strings(text)[0])


def messages(text: str) -> str:
    """Return the strings of a Python module that hold more than one word: logs, errors, help."""
    return " ".join(string for string in _strings(text)[1] if " " in string)


@cache
def _strings(text: str) -> tuple[list[str], list[str]]:
    """Return the docstrings of a Python module, also of attributes, and all other strings."""
    nodes = list(ast.walk(ast.parse(text)))
    alone = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    found: tuple[list[str], list[str]] = ([], [])
    for node in nodes:
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            found[id(node) not in alone].append(node.value)
    return found


def prose(text: str) -> str:
    """Return the text of a Markdown page without code."""
    return re.sub(r"```.*?```|`[^`]*`", " ", text, flags=re.DOTALL)


def manual(text: str) -> str:
    """Return the text of a manual page without its comments."""
    return re.sub(r'^\.\\".*$', "", text, flags=re.MULTILINE)


def page_texts(text: str) -> str:
    """Return the strings of more than one word; from HTML also the texts between tags."""
    strings = [found for found in re.findall(r'"[^"\n]*"|`[^`]*`', text) if " " in found]
    if text.startswith("<!doctype"):
        strings.append(re.sub(r"<[^>]*>", " ", text))
    return " ".join(strings)


Reader = Callable[[str], str]
PLACES: list[tuple[Reader, str, str]] = [
    *((reader, name, ".py") for name in PACKAGES for reader in (docstrings, messages)),
    *((prose, name, ".md") for name in PAGES),
    (manual, "packaging/man", ".1"),
    *((page_texts, "jointfit_daemon/tools/dashboard/page", suffix) for suffix in (".js", ".html")),
]
"""Reader of the files, path below the project, and suffix of the files."""
everywhere = pytest.mark.parametrize(
    ("reader", "name", "suffix"),
    PLACES,
    ids=[f"{name}-{suffix[1:]}-{reader.__name__}" for reader, name, suffix in PLACES],
)


@cache
def texts(reader: Reader, name: str, suffix: str) -> dict[str, str]:
    """Return the texts of the files below a path of the project, by file name."""
    root = ROOT / name
    files = [root] if root.is_file() else sorted(root.rglob(f"*{suffix}"))
    return {
        path.relative_to(ROOT).as_posix(): reader(path.read_text(encoding="utf-8"))
        for path in files
        if not any(path.is_relative_to(ROOT / allowed) for allowed in ALLOWED)
    }


@everywhere
def test_words_of_speech_and_filler_are_rare(reader: Reader, name: str, suffix: str) -> None:
    text = " ".join(texts(reader, name, suffix).values())
    words = len(text.split())
    rates = {
        pattern: 1000 * len(re.findall(rf"\b(?:{pattern})\b", text, re.IGNORECASE)) / words
        for pattern in RATES_PER_1000
    }
    assert {p: round(r, 1) for p, r in rates.items() if r > RATES_PER_1000[p]} == {}


@everywhere
def test_no_metaphor_replaces_a_technical_term(reader: Reader, name: str, suffix: str) -> None:
    found = {
        file: sorted({match.lower() for match in BANNED.findall(text)})
        for file, text in texts(reader, name, suffix).items()
    }
    assert {file: words for file, words in found.items() if words} == {}
