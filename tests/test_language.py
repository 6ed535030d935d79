"""The wording of docstrings and pages: words that the project avoids, and how often others occur.

The lists follow the glossary of CONVENTIONS.md. The rates are hints where to read, so the limits
are loose; a metaphor for a technical term fails at once.
"""

from __future__ import annotations

import ast
import re
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
PAGES = ("docs", "README.md", "CONVENTIONS.md")

RATES_PER_1000 = {
    r"tells?|told|says?|said": 1.0,
    r"what": 3.0,
    r"nobody|somebody|whoever|whom|who": 0.5,
    r"anew|for ever|mend(?:s|ed)?|errs|beside|worn": 0.5,
}
"""Pattern of words to largest number in 1000 words."""
BANNED = re.compile(
    r"\b(?:law|flesh|bulletin|asleep|whose turn|gives? up|look(?:s|ed)? after|put on anew)\b",
    re.IGNORECASE,
)
"""Words that a standard term replaces: invariant, soft tissue, notice, stuck, drop, re-donned."""
ALLOWED = {
    "docs/accuracy",  # the generated tables name experiments of other authors in their words
}


def docstrings(path: Path) -> str:
    """Return all docstrings of a Python file, those of attributes included."""
    return " ".join(
        node.value.value
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def prose(path: Path) -> str:
    """Return the text of a page without code."""
    text = path.read_text(encoding="utf-8")
    return re.sub(r"```.*?```|`[^`]*`", " ", text, flags=re.DOTALL)


def texts(name: str) -> dict[str, str]:
    """Return the prose of the files below a path of the project, by file name."""
    root = ROOT / name
    files = [root] if root.is_file() else sorted([*root.rglob("*.py"), *root.rglob("*.md")])
    return {
        path.relative_to(ROOT).as_posix(): (docstrings if path.suffix == ".py" else prose)(path)
        for path in files
        if not any(path.is_relative_to(ROOT / allowed) for allowed in ALLOWED)
    }


@pytest.mark.parametrize("name", [*PACKAGES, *PAGES])
def test_words_of_speech_and_filler_are_rare(name: str) -> None:
    text = " ".join(texts(name).values())
    words = len(text.split())
    rates = {
        pattern: 1000 * len(re.findall(rf"\b(?:{pattern})\b", text, re.IGNORECASE)) / words
        for pattern in RATES_PER_1000
    }
    assert {p: round(r, 1) for p, r in rates.items() if r > RATES_PER_1000[p]} == {}


@pytest.mark.parametrize("name", [*PACKAGES, *PAGES])
def test_no_metaphor_replaces_a_technical_term(name: str) -> None:
    found = {
        file: sorted({match.lower() for match in BANNED.findall(text)})
        for file, text in texts(name).items()
    }
    assert {file: words for file, words in found.items() if words} == {}
