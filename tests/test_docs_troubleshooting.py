"""Every symptom of the troubleshooting page is a text of the program."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
PROGRAM = ("jointfit_daemon", "drivers/jointfit_drivers", "protocols/jointfit_protocols")
SCRIPTS = ROOT / "jointfit_daemon" / "tools" / "dashboard" / "page" / "js"
PLACE = "…"
"""Stands for a value in the texts of the program."""
ROW = re.compile(r"^\| (.+?) \| .+? \| .+? \|$", re.MULTILINE)


def quotes(page: str) -> list[str]:
    """Return the texts in the first column of the tables."""
    return [quote for row in ROW.findall(page) for quote in re.findall(r"`([^`]+)`", row)]


@cache
def program_texts() -> str:
    """Return all strings of the program, with `PLACE` instead of each inserted value."""
    texts = [path.read_text(encoding="utf-8") for path in sorted(SCRIPTS.glob("*.js"))]
    for package in PROGRAM:
        for path in sorted((ROOT / package).rglob("*.py")):
            texts += strings_of(path.read_text(encoding="utf-8"))
    return "\n".join(texts)


def strings_of(source: str) -> list[str]:
    """Return the strings of a Python module without its docstrings."""
    tree = ast.parse(source)
    found = []
    documentation = {
        id(node.value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            parts = (p.value if isinstance(p, ast.Constant) else PLACE for p in node.values)
            found.append("".join(map(str, parts)))
        elif (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and id(node) not in documentation
        ):
            found.append(node.value)
    return found


@pytest.mark.parametrize("quote", quotes(PAGE))
def test_a_symptom_is_a_text_of_the_program(quote: str) -> None:
    assert quote in program_texts()


def test_the_page_quotes_the_program_and_docstrings_do_not_count() -> None:
    assert len(quotes(PAGE)) > 50
    module = (
        '"""Sensor lost."""\n\ndef f(n):\n    """Bus lost."""\n    return f"{n} gone" " away"\n'
    )
    assert strings_of(module) == ["… gone away", " gone away"]
