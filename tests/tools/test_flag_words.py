"""Every flag of a pose has the same sentence in the terminal and in the dashboard's page."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from jointfit_daemon.model import FrameFlag
from jointfit_daemon.tools.flag_words import flag_sentence, serious_flags

PAGE = Path(__file__).parents[2] / "jointfit_daemon/tools/dashboard/page/js/words.js"


@pytest.mark.parametrize("flag", [flag.value for flag in FrameFlag])
def test_every_flag_has_a_sentence_here_and_on_the_page(flag: str) -> None:
    sentence = flag_sentence(f"{flag}:left_thigh")
    assert sentence.endswith(".")
    assert f"{flag}:" not in sentence
    assert "_" not in sentence
    table = PAGE.read_text(encoding="utf-8").partition("const FLAGS = {")[2].partition("};")[0]
    on_page = re.search(rf'^  {flag}: "([^"]+)"', table, re.MULTILINE)
    assert on_page is not None
    assert on_page[1] == flag_sentence(f"{flag}:%")


def test_an_unknown_flag_is_shown_as_it_is_and_counts_as_serious() -> None:
    assert flag_sentence("new:thigh") == "new:thigh"
    assert serious_flags(["extrapolating", "new:thigh", "held:thigh"]) == [
        "new:thigh",
        "held:thigh",
    ]
