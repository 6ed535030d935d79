"""Lists in messages contain every name, or the number of omitted names."""

from __future__ import annotations

import pytest

from jointfit_daemon.name_lists import join_words, list_names


@pytest.mark.parametrize("count", range(6))
def test_a_list_of_names_contains_or_counts_each(count: int) -> None:
    names = [f"M{k}" for k in range(count)]

    text, _, more = list_names(names, 3).partition(" and ")

    shown = text.split(", ") if text else []
    assert shown == names[:3]
    assert len(shown) + int(more.removesuffix(" more") or 0) == count


def test_words_are_joined_as_in_a_sentence() -> None:
    assert join_words(["a"]) == "a"
    assert join_words(["a", "b"]) == "a and b"
    assert join_words("abc") == "a, b and c"
