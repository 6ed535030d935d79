"""Error texts of drivers contain a remedy, but not the id with which the log line starts."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

DRIVERS = Path(__file__).resolve().parents[2] / "drivers" / "jointfit_drivers"
ERRORS = {"DeviceLostError", "DeviceAbsentError", "DeviceMisconfiguredError"}
REMEDY = re.compile(
    r"\b(add|change|check|choose|close|connect|connecting|correct|enable|enter|give|let|load|lower"
    r"|plug|remove|restart|retrying|set|start|stop|switch|update|use)\b"
)
VALUE = "…"


def errors_of(path: Path) -> list[tuple[str, str]]:
    """Return place and text of the errors that a module raises with a literal text."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.args):
            continue
        text = node.args[0]
        if node.func.id in ERRORS and isinstance(text, ast.JoinedStr | ast.Constant):
            parts = text.values if isinstance(text, ast.JoinedStr) else [text]
            words = [str(p.value) if isinstance(p, ast.Constant) else VALUE for p in parts]
            found.append((f"{path.relative_to(DRIVERS)}:{node.lineno}", "".join(words)))
    return found


ALL = [one for path in sorted(DRIVERS.rglob("*.py")) for one in errors_of(path)]


@pytest.mark.parametrize(("place", "text"), ALL, ids=[place for place, _ in ALL])
def test_an_error_states_object_finding_and_remedy(place: str, text: str) -> None:
    # A text that ends in a value has its remedy in this value, for example from `_remedy`.
    assert REMEDY.search(text) or text.endswith((VALUE, f"{VALUE})")), (place, text)
    assert text.startswith((VALUE, "NatNet server ", "mocap.")), "it names the object first"


def test_no_error_contains_the_id_of_its_source() -> None:
    named = [path.name for path in DRIVERS.rglob("*.py") if "{settings.id} (" in path.read_text()]
    assert named == []
