"""The drawings of the documentation: well-formed, described, in two themes, from no other site."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.pictures import moving_limb, terminal
from tests.pictures.drift_event import DriftRun, draw, moving_rms

DOCS = Path(__file__).resolve().parents[2] / "docs"
DRAWINGS = sorted(DOCS.glob("drawings/*.svg"))
PICTURES = sorted(path for path in DOCS.glob("pictures/*") if path.suffix != ".md")
SVG = "{http://www.w3.org/2000/svg}"
MOST_BYTES = 400_000
REFERENCE = re.compile(r"""(?:href=["']|src=["']|url\(|@import )(?!#)""")
"""Reference to another file."""


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
    assert REFERENCE.findall(text) == []
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


PERIOD_S = 1.3


def swinging(t_s: float, heading: float, *, hidden: bool = False) -> dict[str, Any]:
    """Return the pose of a leg that swings about the hip, turned about the vertical."""
    angle = 0.5 * math.sin(2 * math.pi * t_s / PERIOD_S)
    y, z = 0.4 * math.sin(angle), -0.4 * math.cos(angle)
    knee, ankle = ([-k * y * math.sin(heading), k * y * math.cos(heading), k * z] for k in (1, 2))
    turn, swing = (math.cos(heading / 2), math.sin(heading / 2)), (
        math.cos(angle / 2), math.sin(angle / 2),
    )  # fmt: skip
    q = [turn[0] * swing[0], turn[0] * swing[1], turn[1] * swing[1], turn[1] * swing[0]]
    flexion = None if hidden else math.degrees(angle)
    return {
        "t_us": round(1e6 * t_s),
        "segments": {"thigh": {"q": q}},
        "joints": {
            "hip": {"p_m": [0.0, 0.0, 0.0]},
            "knee": {"p_m": knee, "flexion_deg": flexion, "sd_deg": 2.0},
            "ankle": {"p_m": ankle},
        },
    }


def walk_with_heading(heading: float) -> moving_limb.Walk:
    times = np.arange(0.0, 12.0, 0.01).tolist()
    optical = [swinging(t, heading, hidden=2.0 < t < 2.1) for t in times[::4]]
    return moving_limb.walk([swinging(t, heading) for t in times], optical)


@pytest.mark.parametrize("heading", [0.0, 1.0, -2.5])
def test_the_limb_is_seen_from_its_right_side_whatever_its_heading(heading: float) -> None:
    found = walk_with_heading(heading)
    assert np.allclose(found.limb, walk_with_heading(0.0).limb, atol=1e-6)
    forward = found.limb[:, 1, 0]
    assert np.allclose(forward, 0.4 * np.sin(np.deg2rad(found.flexion_deg)), atol=2e-3)
    assert np.allclose(found.optical, found.limb, atol=2e-2)


def test_the_animation_ends_as_it_begins() -> None:
    found = walk_with_heading(0.3)
    assert 5.0 <= found.t_s[-1] <= 8.0
    assert np.abs(found.limb[-1] - found.limb[0]).max() < 0.03


def test_the_animation_stops_and_respects_reduced_motion() -> None:
    drawing = moving_limb.draw(walk_with_heading(0.3))
    root = ET.fromstring(drawing)
    animations = list(root.iter(f"{SVG}animate"))
    assert len(animations) > 10
    assert {animation.get("repeatCount") for animation in animations} == {"3"}
    still = next(group for group in root.iter(f"{SVG}g") if group.get("class") == "still")
    assert not list(still.iter(f"{SVG}animate"))
    assert "prefers-reduced-motion: reduce" in drawing


def test_a_terminal_picture_contains_the_output_and_no_other_site() -> None:
    drawn = terminal.picture([("jointfit check", "<S1> & S2\n" + "x" * 200)], "title", "A <table>")
    root = ET.fromstring(drawn)
    shown = "".join(root.itertext()).replace("\xa0", " ")
    assert "<S1> & S2" in shown
    assert shown.count("x") >= 200
    assert root.get("aria-label") == "A <table>"
    assert REFERENCE.findall(drawn) == []
