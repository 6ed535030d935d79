"""Values written as TOML are read back unchanged."""

from __future__ import annotations

import tomllib

from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.files.text import toml_key, toml_value

SCALARS = st.text() | st.booleans() | st.integers() | st.floats(allow_nan=False)
VALUES = st.recursive(
    SCALARS, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner), max_leaves=8
)


@given(st.text(), VALUES)
def test_every_key_and_value_is_read_back(key: str, value: object) -> None:
    assert tomllib.loads(f"{toml_key(key)} = {toml_value(value)}") == {key: value}


def test_identifiers_are_hexadecimal_and_missing_values_are_left_out() -> None:
    ids = {"sample_time": 0x105, "quaternion": None}
    assert toml_value(ids, hexadecimal=True) == "{ sample_time = 0x105 }"
