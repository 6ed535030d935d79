"""The library of the Lab Streaming Layer, and a receiver of one stream."""

from __future__ import annotations

from typing import Any

import pytest


@pytest.fixture
def lsl() -> Any:
    try:
        import pylsl  # noqa: PLC0415 - skips where its library is missing
    except (ImportError, RuntimeError, OSError) as missing:
        pytest.skip(f"pylsl cannot be used: {missing}")
    return pylsl


def receive(lsl: Any, name: str) -> Any:
    """Return an open receiver of the stream with this name."""
    found = lsl.resolve_byprop("name", name, timeout=10.0)
    assert found, "the stream was not found"
    inlet = lsl.StreamInlet(found[0])
    inlet.open_stream(timeout=10.0)
    return inlet
