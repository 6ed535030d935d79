"""The library of the Lab Streaming Layer, and a receiver of one stream."""

from __future__ import annotations

import os
from typing import Any

import pytest


@pytest.fixture
def lsl() -> Any:
    try:
        import pylsl  # noqa: PLC0415 - the library may be missing
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


@pytest.fixture(scope="session")
def lsl_network() -> Any:
    """Return pylsl; skip the test if this host cannot find LSL streams."""
    try:
        import pylsl  # noqa: PLC0415 - the library may be missing
    except (ImportError, RuntimeError, OSError) as missing:
        pytest.skip(f"pylsl cannot be used: {missing}")
    info = pylsl.StreamInfo("network", "test", 1, 0.0, "double64", f"network-{os.getpid()}")
    outlet = pylsl.StreamOutlet(info)
    found = pylsl.resolve_byprop("source_id", info.source_id(), timeout=3.0)
    del outlet
    if not found:
        pytest.skip("LSL finds no stream on this host: its network has no multicast")
    return pylsl
