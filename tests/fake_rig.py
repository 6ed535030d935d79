"""Rigs of fake devices."""

from __future__ import annotations

from typing import Any

import pytest

from tests import fake_drivers


@pytest.fixture
def fakes(monkeypatch: pytest.MonkeyPatch) -> type[fake_drivers.FakeImu]:
    """Register the fake drivers, and no other drivers, in this process."""
    monkeypatch.setattr("jointfit_daemon.driver.entry_points", fake_drivers.entry_points)
    fake_drivers.FakeImu.running.clear()
    fake_drivers.FakeImu.started.clear()
    return fake_drivers.FakeImu


def _imu(name: str, segment: str) -> dict[str, Any]:
    return {"id": name, "segment": segment, "driver": "fake", "port": f"/dev/nowhere-{name}"}


@pytest.fixture
def table(fakes: type[fake_drivers.FakeImu]) -> dict[str, Any]:
    """Return a valid rig.toml: four IMUs on a leg, with mocap."""
    return {
        "rig": {"name": "bench-1"},
        "chain": {"joints": ["hip", "knee", "ankle"], "segments": ["thigh", "shank"]},
        "imu": [
            _imu("S1", "thigh"),
            _imu("S2", "thigh"),
            {"id": "S3", "segment": "shank", "driver": "fakecan", "can": "can0"},
            {
                "id": "S4",
                "segment": "shank",
                "driver": "fakecan",
                "can": "can0",
                "ids": {"quaternion": 0x121, "counter": 0x105},
            },
        ],
        "can": {"can0": {"interface": "socketcan", "channel": "can0"}},
        "mocap": {"driver": "fakemocap", "markers": {"thigh": ["T1", "T2", "T3"]}},
    }
