"""The drawings of the documentation: well-formed, described, in two themes, from no other site."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from tests.pictures.drift_event import DriftRun, draw, moving_rms

DOCS = Path(__file__).resolve().parents[2] / "docs"
DRAWINGS = sorted(DOCS.glob("drawings/*.svg"))
PICTURES = sorted(path for path in DOCS.glob("pictures/*") if path.suffix != ".md")
SVG = "{http://www.w3.org/2000/svg}"
MOST_BYTES = 400_000


def ids(path: Path) -> str:
    return path.name


@pytest.mark.parametrize("path", [*DRAWINGS, *PICTURES], ids=ids)
def test_a_picture_is_small_and_used_by_a_page(path: Path) -> None:
    assert path.stat().st_size <= MOST_BYTES
    pages = [DOCS.parent / "README.md", *DOCS.rglob("*.md")]
    name = path.relative_to(DOCS).as_posix()
    assert any(f"{name})" in page.read_text(encoding="utf-8") for page in pages)


@pytest.mark.parametrize("path", DRAWINGS, ids=ids)
def test_a_drawing_has_a_title_a_description_and_a_dark_theme(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    root = ET.fromstring(text)
    names = (root.get("aria-labelledby") or "").split()
    described = {element.get("id"): "".join(element.itertext()) for element in root}
    assert names
    assert all(len(described[name].split()) >= 4 for name in names)
    assert "prefers-color-scheme: dark" in text


@pytest.mark.parametrize("path", DRAWINGS + [p for p in PICTURES if p.suffix == ".svg"], ids=ids)
def test_a_drawing_loads_nothing_and_runs_no_script(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert re.findall(r"(?:https?:)?//(?!www\.w3\.org/)", text) == []
    assert "<script" not in text


def test_the_drift_drawing_names_the_event_and_the_errors_at_the_end() -> None:
    t_s = np.arange(0.0, 180.0, 0.04)
    drift = DriftRun(t_s, t_s / 12.0, np.full_like(t_s, 3.0), 77.0, "shank drifted by 5 deg (…)")
    drawing = draw(drift)
    root = ET.fromstring(drawing)
    assert "77 s: “shank drifted by 5 deg”" in drawing
    assert "grows to 15 degrees" in drawing
    assert "below 3.0 degrees" in drawing
    assert len(root.findall(f"{SVG}polyline")) == 2


def test_the_moving_rms_of_a_constant_is_its_magnitude() -> None:
    assert np.allclose(moving_rms(np.full(1000, -2.0)), 2.0)
