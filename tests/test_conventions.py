"""Rules of CONTRIBUTING.md that no linter checks."""

from __future__ import annotations

import ast
import re
import tokenize
import tomllib
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = (
    "jointfit_daemon",
    "drivers/jointfit_drivers",
    "protocols/jointfit_protocols",
    "simulators/jointfit_simulators",
)
SHIPPED = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
TOOLING = [path for folder in ("bench", ".ci") for path in sorted((ROOT / folder).rglob("*.py"))]
TESTS = sorted((ROOT / "tests").rglob("*.py"))
MOST_LINES = 400
MOST_LINES_OF_A_FUNCTION = 50
VAGUE = {"util", "utils", "misc", "common", "helper", "helpers", "manager", "base"}

Function = ast.FunctionDef | ast.AsyncFunctionDef


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def project() -> dict[str, dict[str, dict[str, str]]]:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    found: dict[str, dict[str, dict[str, str]]] = tomllib.loads(text)["project"]
    return found


def test_no_file_exceeds_the_limit_of_code_lines() -> None:
    long = [path for path in SHIPPED + TOOLING if path.read_bytes().count(b"\n") > MOST_LINES]
    counted = {name_of(path): len(code_lines(path)) for path in long}
    assert {name: lines for name, lines in counted.items() if lines > MOST_LINES} == {}


@cache
def code_lines(path: Path) -> frozenset[int]:
    """Return the numbers of the lines that hold code: no blank line, comment or docstring."""
    not_code = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT}
    with path.open("rb") as file:
        lines = {
            line
            for token in tokenize.tokenize(file.readline)
            if token.type not in not_code | {tokenize.ENCODING, tokenize.ENDMARKER}
            for line in range(token.start[0], token.end[0] + 1)
        }

    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    for node in ast.walk(tree_of(path)):
        if isinstance(node, documented) and ast.get_docstring(node, clean=False) is not None:
            docstring = node.body[0]
            lines -= set(range(docstring.lineno, (docstring.end_lineno or 0) + 1))
    return frozenset(lines)


def lines_of(path: Path, function: Function) -> int:
    """Return the number of code lines of a function, from its name to its end."""
    return len(code_lines(path) & set(range(function.lineno, (function.end_lineno or 0) + 1)))


def test_no_function_exceeds_the_limit_of_code_lines() -> None:
    counted = {
        f"{name_of(path)}:{node.name}": lines_of(path, node)
        for path in SHIPPED + TOOLING
        for node in ast.walk(tree_of(path))
        if isinstance(node, Function)
        if (node.end_lineno or 0) - node.lineno >= MOST_LINES_OF_A_FUNCTION
    }
    too_long = {name: lines for name, lines in counted.items() if lines > MOST_LINES_OF_A_FUNCTION}
    assert too_long == {}


def test_every_module_has_a_docstring() -> None:
    assert [
        name_of(path) for path in SHIPPED + TOOLING if not ast.get_docstring(tree_of(path))
    ] == []


def test_no_module_has_a_vague_name() -> None:
    vague = [name_of(path) for path in SHIPPED if VAGUE & set(path.stem.split("_"))]
    assert vague == []


@cache
def imported_modules(path: Path) -> set[str]:
    """Return the dotted names of modules, and of names in modules, that a file imports."""
    found: set[str] = set()
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found


def test_no_two_classes_share_a_name() -> None:
    places: dict[str, list[str]] = {}
    for path in SHIPPED:
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.ClassDef):
                places.setdefault(node.name, []).append(name_of(path))
    assert {name: found for name, found in places.items() if len(found) > 1} == {}


@pytest.mark.parametrize("family", [Path(package).name for package in PACKAGES])
def test_private_modules_are_imported_within_their_package_only(family: str) -> None:
    """For example, only `jointfit_drivers/xbus` may import `jointfit_drivers.xbus._decoder`."""
    crossing = [
        f"{name_of(path)} imports {name}"
        for path in SHIPPED + TOOLING
        for name in sorted(imported_modules(path))
        if name.startswith(f"{family}.") and "._" in name
        if f"{name.partition('._')[0].replace('.', '/')}/" not in name_of(path)
    ]
    assert crossing == []


UNIT_FACTOR = re.compile(r"^_?(NS|US|MS|MM|NS_PER_M?S|STANDARD_GRAVITY) = ", re.MULTILINE)


def test_factors_of_unit_conversions_are_defined_once() -> None:
    """Codecs have their own factors, because they import the standard library only."""
    assert [
        name_of(path)
        for path in SHIPPED
        if not name_of(path).startswith("protocols/")
        if UNIT_FACTOR.search(path.read_text(encoding="utf-8"))
    ] == []


def test_every_driver_is_in_the_readme() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    drivers = project()["entry-points"]["jointfit.drivers"]
    assert [name for name in drivers if f"| `{name}` |" not in readme] == []


NOQA = re.compile(r"# noqa(?!: [A-Z0-9, ]+ - \S)")
IGNORE = re.compile(r"# type: ignore(?!\[[a-z, -]+\] +# \w)")


@pytest.mark.parametrize(
    ("rule", "paths"),
    [(NOQA, SHIPPED + TOOLING + TESTS), (IGNORE, SHIPPED + TOOLING)],
    ids=["noqa", "type-ignore"],
)
def test_every_silenced_rule_has_its_reason(rule: re.Pattern[str], paths: list[Path]) -> None:
    found = [
        f"{name_of(path)}:{number}"
        for path in paths
        if path != Path(__file__).resolve()
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if rule.search(line)
    ]
    assert found == []


@pytest.mark.parametrize("folder", ["drivers", "protocols", "simulators", "tests", "bench"])
def test_top_level_folders_are_not_packages(folder: str) -> None:
    assert not list((ROOT / folder).glob("__init__.py"))


@pytest.mark.parametrize("package", PACKAGES)
def test_every_package_is_marked_as_typed(package: str) -> None:
    assert (ROOT / package / "py.typed").is_file()


def test_names_of_test_files_are_unique() -> None:
    names = [path.name for path in TESTS if path.name.startswith("test_")]
    assert sorted(names) == sorted(set(names))
