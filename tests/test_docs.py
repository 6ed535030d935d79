"""Statements of the pages are true: links have a target, rigs load, commands exist."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest
from typer.main import get_command

from jointfit_daemon.config import Rig, parse_rig
from jointfit_daemon.driver import find_driver
from jointfit_daemon.tools.__main__ import app

ROOT = Path(__file__).resolve().parents[1]
DEVICES = ROOT / "docs" / "devices.md"
PAGES = [
    *sorted(ROOT.glob("*.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "examples").rglob("*.md")),
]
EXAMPLES = sorted((ROOT / "examples").glob("*.toml"))
FENCE = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#+ +(.+?) *$", re.MULTILINE)

every_page = pytest.mark.parametrize(
    "page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix()
)


@cache
def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def prose_of(page: Path) -> str:
    """Return the page without its code blocks."""
    return FENCE.sub("", text_of(page))


def blocks(page: Path, language: str) -> list[str]:
    return [body for kind, body in FENCE.findall(text_of(page)) if kind == language]


def anchors(page: Path) -> set[str]:
    """Return the names of the headings, as GitHub and mkdocs make them."""
    plain = (re.sub(r"[^\w\- ]", "", title.lower()) for title in HEADING.findall(prose_of(page)))
    return {re.sub(r" +", "-", title.strip()) for title in plain}


def broken_links(page: Path) -> list[str]:
    broken = []
    for link in LINK.findall(prose_of(page)):
        if re.match(r"[a-z]+:", link):  # another site
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            broken.append(link)
    return broken


@every_page
def test_every_link_inside_the_project_leads_somewhere(page: Path) -> None:
    assert broken_links(page) == []


def test_a_link_into_nothing_is_noticed(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# A head, two\n[a](#a-head-two) [b](#gone) [c](gone.md) [d](http://x/)")
    assert broken_links(page) == ["#gone", "gone.md"]


PLACE = re.compile(r"`([\w./-]+(?:/|\.(?:py|md|json|toml|yml|1)))`")


def places_to_change() -> dict[str, list[Path]]:
    """Return the files and folders in the rows of "Where to change what", by first cell.

    A name without a folder is in the folder of the name before it; ``NAME`` stands for any name.
    """
    section = text_of(ROOT / "docs" / "architecture.md").split("## Where to change what")[1]
    found: dict[str, list[Path]] = {}
    for row in re.findall(r"^\| (?!change )(\S.*)", section.split("\n## ")[0], re.MULTILINE):
        change, *cells = row.split(" | ")
        folder = ROOT / "jointfit_daemon"
        for name in PLACE.findall(re.sub(r"\]\([^)]*\)", "]", " ".join(cells))):
            if "/" in name or (ROOT / name).exists():
                top = (ROOT / name.split("/")[0]).exists()
                path = ROOT / name if top else ROOT / "jointfit_daemon" / name
            else:
                path = folder / name
                path = path if path.exists() else ROOT / "jointfit_daemon" / name
            folder = path if name.endswith("/") else path.parent
            found.setdefault(change, []).append(path)
    return found


def missing(path: Path) -> bool:
    return not list(ROOT.glob(path.relative_to(ROOT).as_posix().replace("NAME", "*")))


def test_every_place_of_a_change_exists() -> None:
    places = places_to_change()
    assert sum(map(len, places.values())) > 100
    gone = {
        change: [str(p.relative_to(ROOT)) for p in paths if missing(p)]
        for change, paths in places.items()
    }
    assert {change: paths for change, paths in gone.items() if paths} == {}


CHANGES_ASKED_FOR = (
    "driver", "MQTT topic", "calibration method", "lag gate", "command", "joint type",
    "key of a payload", "configuration key", "detection of stuck sensors", "sink",
)  # fmt: skip
"""Changes whose place new contributors look for; each is in the first cell of a row."""


@pytest.mark.parametrize("change", CHANGES_ASKED_FOR)
def test_the_place_of_a_common_change_is_listed(change: str) -> None:
    assert any(change in row for row in places_to_change())


def whole_rigs(page: Path) -> list[str]:
    """Return the TOML blocks that are a rig by themselves."""
    return [body for body in blocks(page, "toml") if "[rig]" in body and "[[imu]]" in body]


def load(text: str) -> Rig:
    return parse_rig(tomllib.loads(text))


@pytest.mark.parametrize(
    ("page", "number"),
    [(page, number) for page in PAGES for number, _ in enumerate(whole_rigs(page))],
    ids=lambda value: value.name if isinstance(value, Path) else str(value),
)
def test_every_rig_in_the_pages_loads(page: Path, number: int) -> None:
    assert load(whole_rigs(page)[number]).sources


def test_the_readme_begins_with_the_purpose_a_picture_a_message_and_a_comparison() -> None:
    text = text_of(ROOT / "README.md")
    purpose = text.split("![")[0].split("\n", 1)[1]
    assert len(re.findall(r"\.(?=\s)", purpose)) == 3
    marks = ("![Animation", "```json", "## Comparison", "make demo  ", "make demo ARGS=--web")
    places = [text.index(mark) for mark in marks]
    assert places == sorted(places)


def test_the_readme_shows_a_rig() -> None:
    assert whole_rigs(ROOT / "README.md")


def test_the_parts_of_the_rig_guide_are_one_rig() -> None:
    rig = load("\n".join(blocks(ROOT / "docs" / "rig.md", "toml")))
    assert {source.id for source in rig.sources} == {"S1", "S3", "mocap"}


def test_every_driver_has_a_page_and_a_row_in_the_list_of_devices() -> None:
    rows = set(re.findall(r"^\| \[`([\w-]+)`\]\(devices/", text_of(DEVICES), re.MULTILINE))
    pages = {page.stem for page in DEVICES.with_suffix("").glob("*.md")}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    drivers = set(project["entry-points"]["jointfit.drivers"])
    assert rows == pages == drivers


@pytest.mark.parametrize(
    "page", sorted(DEVICES.with_suffix("").glob("*.md")), ids=lambda page: page.stem
)
def test_the_example_of_every_device_page_is_accepted_by_its_driver(page: Path) -> None:
    (first, *_) = blocks(page, "toml")
    tables = tomllib.loads(first)
    shown = [*tables.get("imu", ()), *([tables["mocap"]] if "mocap" in tables else [])]
    assert page.stem in {table["driver"] for table in shown}
    for table in shown:
        bus = {"can": tables["can"][table["can"]]} if "can" in table else {}
        find_driver(table["driver"]).Settings.model_validate({**table, **bus})


@every_page
def test_every_json_payload_in_the_pages_is_json(page: Path) -> None:
    for body in blocks(page, "json"):
        json.loads(body)


@every_page
def test_every_make_target_and_command_a_page_names_exists(page: Path) -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in re.findall(r"(?:^|`)make ([a-z][a-z-]*)", text_of(page), re.MULTILINE):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target
    group = get_command(app)
    known = set(getattr(group, "commands", {}))
    said = re.findall(r"(?:^|`)jointfit ([a-z]+)", text_of(page), re.MULTILINE)
    assert set(said) <= known


@pytest.mark.system
@pytest.mark.parametrize("rig", EXAMPLES, ids=lambda rig: rig.name)
def test_the_daemon_accepts_every_example(rig: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "jointfit_daemon", "--config", str(rig), "--check"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
