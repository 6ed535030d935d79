"""The payloads of a whole calibration, compared with docs/mqtt.md in both directions."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from tests.system.station import SENSORS, Listener, Station, running
from tests.system.test_live_replay import calibrated

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.broker_fixture import Broker

pytestmark = pytest.mark.system

PAGE = Path(__file__).resolve().parents[2] / "docs" / "mqtt.md"
TOPICS = ("pose/ui", "joint/+", "calibration/progress", "bridge/log", "device/+/info")
NAMES = {
    *SENSORS, *(f"{a}{mark}{b}" for a in SENSORS for b in SENSORS for mark in "~+"),
    "mocap", "hip", "knee", "ankle", "thigh", "shank", "pelvis", "foot",
}  # fmt: skip
"""Keys that are names of this rig."""
FREE = re.compile(r"device/\w+/info|bridge/log")
"""Topics whose keys are the device's own, or that need not come."""


def keys(value: Any) -> Iterator[str]:
    """Yield all keys in a payload but names of devices, segments, joints and markers."""
    if isinstance(value, dict):
        for key, inner in value.items():
            if key not in NAMES and not re.fullmatch(r"[A-Z]+[a-z_]*\d*", key):
                yield key
            yield from keys(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from keys(inner)


def documented_words() -> set[str]:
    """Return all words in code spans and code blocks of the page."""
    text = PAGE.read_text(encoding="utf-8")
    spans = re.findall(r"```.*?```|`[^`\n]+`", text, re.DOTALL)
    return set(re.findall(r"\w+", " ".join(spans)))


def keys_of_examples() -> set[str]:
    """Return the keys in the page's examples of payloads."""
    text = PAGE.read_text(encoding="utf-8")
    examples = re.findall(r"```json\n(.*?)```", text, re.DOTALL)
    return set(re.findall(r'"(\w+)":', " ".join(examples))) - NAMES


@pytest.mark.timeout(180)
async def test_every_key_on_the_wire_is_documented_and_every_documented_key_comes(
    tmp_path: Path, broker: Broker
) -> None:
    station = Station(tmp_path, broker.port)
    found: dict[str, set[str]] = {}
    take = Listener._take

    def note(self: Listener, topic: str, payload: Any) -> None:
        found.setdefault(topic, set()).update(keys(payload))
        take(self, topic, payload)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Listener, "_take", note)
        async with running(station) as (simulator, _, listener):
            assert listener.client is not None
            await listener.client.subscribe(*TOPICS)
            answer = await listener.client.request("calibrate", {"phase": "abort"})
            found["bridge/response/calibrate"] = set(keys(answer))
            await calibrated(simulator, listener)
            await listener.until(lambda: listener.latest["calibration"]["version"], 30)
            await listener.more_poses(120)

    documented = documented_words()
    unknown = {
        topic: missing
        for topic, used in found.items()
        if not FREE.fullmatch(topic) and (missing := used - documented)
    }
    assert unknown == {}
    assert {topic for topic, used in found.items() if "v" not in used} == set()

    used = set().union(*found.values())
    assert keys_of_examples() - used == set()
