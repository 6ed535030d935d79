"""The committed pages of docs equal the text that is generated from the committed results."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.framework import pages, storage
from bench.framework.experiment import Result, find_experiments

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.mark.parametrize("name", sorted(pages.render_all()))
def test_committed_page_equals_its_generated_text(name: str) -> None:
    generated = pages.render_all()[name]
    assert (DOCS / name).read_text(encoding="utf-8") == generated, "python -m bench.framework.pages"


def test_every_experiment_is_on_a_page() -> None:
    text = "\n".join(
        path.read_text(encoding="utf-8") for path in pages.TEMPLATES.rglob("*.md")
    ).split()
    absent = [e.id for e in find_experiments() if not any(e.id in word for word in text)]
    assert absent == []


def test_unknown_fields_and_results_are_refused() -> None:
    for template in ("{{nonsense: x}}", "{{value: no-such | x}}"):
        with pytest.raises(pages.TemplateError):
            pages.render(template)
    name = find_experiments()[0].id
    with pytest.raises(pages.TemplateError, match="has no result 'nothing'"):
        pages.render(f"{{{{value: {name} | nothing}}}}")


def test_a_range_has_the_smallest_and_the_largest_result_also_inside_a_table() -> None:
    name = "recorded-legs-after-squats"
    found = [
        result.value
        for result in storage.results_of(pages.stored(name))
        if result.name.endswith("squats1: flexion")
    ]
    rendered = pages.render(f"{{{{range: {name} \\| squats1: flexion \\| 2}}}}")
    assert len(found) == 4  # two legs, two references
    assert rendered == f"{min(found):.2f} to {max(found):.2f}°"


def test_results_named_by_row_and_column_become_a_matrix() -> None:
    results = [Result(f"{row}: {column}", 1.5, 2.0) for row in "AB" for column in ("x", "y")]
    assert pages.table_of(results).splitlines()[2] == "| A | 1.500 deg (≤ 2) | 1.500 deg (≤ 2) |"
    single = pages.table_of([Result("x", 3.0, 2.0), Result("y", float("inf"), note="of two")])
    assert "| x | **3.000 deg, missed** | ≤ 2 |" in single
    assert "| y (of two) | unbounded | – |" in single
