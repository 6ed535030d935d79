"""`MonitorApp` shows the stored pictures, and limits the rate of screen updates."""

from __future__ import annotations

import asyncio
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.tools.monitor._app import MonitorApp
from jointfit_daemon.tools.monitor._monitor_state import MonitorState, SendRequest
from tests.tools.monitor.sample_rig import (
    RECORDING,
    SampleRig,
    connected_state,
    live_state,
    moment,
    take,
)
from tests.tools.monitor.snapshots import ROOT, STORED, check_picture

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

LEG = SampleRig()
AT_S = 12.3
SIX = SampleRig(
    name="both arms",
    sensors={f"segment {k}": [f"S{2 * k + 1}", f"S{2 * k + 2}"] for k in range(6)},
    joints=("pelvis", "hip", "knee", "ankle", "midfoot", "toes", "tip"),
)


def still(state: MonitorState, at_s: float = AT_S) -> MonitorApp:
    """Return the program without a broker; its clock always shows `at_s`."""
    return MonitorApp(state, None, now=lambda: moment(at_s))


def live(**options: Any) -> MonitorState:
    return live_state(LEG, **options)


def offline() -> MonitorState:
    state = live_state(replace(LEG, offline=frozenset({"S4"})))
    take(state, "bridge/event", LEG.event("no data for 3 s", id="S4", level="warning", at_s=9.0))
    return state


def broker_lost() -> MonitorState:
    state = live()
    state.set_lost("broker localhost:1883: connection refused: start the broker, or correct host")
    return state


def daemon_lost() -> MonitorState:
    state = live()
    take(state, "bridge/state", {"v": 1, "state": "offline"})
    return state


def calibrating() -> MonitorState:
    state = live()
    take(state, "calibration", LEG.calibration("functional"))
    take(state, "calibration/progress", LEG.progress())
    state.press("2")
    return state


def refused() -> MonitorState:
    state = live()
    state.press("2")
    kept = "knee: flexion error 5.1°, was 2.3°: repeat the movement, or accept the result"
    take(state, "calibration", LEG.calibration(kept=kept))
    fault = "sensor S4 sends no data: check its cable, then repeat"
    answer = {"status": "error", "error": {"faults": [{"message": fault}]}}
    state.take_answer("static", answer, moment(AT_S).monotonic_s)
    return state


def history() -> MonitorState:
    state = live()
    state.press("3")
    state.take_answer("calibrations", {"status": "ok", "data": LEG.versions()}, 0.0)
    state.listed = (("calibrated", 3), state.base)
    state.press("down")
    return state


def health() -> MonitorState:
    state = offline()
    state.press("4")
    return state


def interrupted() -> MonitorState:
    fault = {"failure": "recordings: No space left on device", "lost": 312, "free_bytes": 0}
    state = live_state(replace(LEG, recording=RECORDING | fault))
    state.press("4")
    state.scroll = 99
    return state


def stopping() -> MonitorState:
    state = live()
    state.press("R")
    return state


def log() -> MonitorState:
    state = offline()
    take(state, "bridge/event", LEG.event("mark: squats begin", id="bench-1", at_s=11.0))
    state.press("5")
    return state


def several_rigs() -> MonitorState:
    state = MonitorState("localhost:1883")
    state.set_found_rigs({"jointfit/left": "left leg", "jointfit/right": "right leg"})
    return state


ARABIC = SampleRig(
    name="ساق", sensors={"فخذ": ["حساس أول", "حساس ثان"], "ساق": ["حساس ثالث"]},
    joints=("ورك", "ركبة", "كاحل"),
)  # fmt: skip
CHINESE = SampleRig(
    name="实验台一", sensors={"大腿": ["传感器一", "传感器二"], "小腿": ["传感器三"]},
    joints=("髋关节", "膝关节", "踝关节"),
)  # fmt: skip
ONE = SampleRig(sensors={"hand": ["S1"]}, joints=("wrist", "fingertips"), cameras=False)
STATES: dict[str, tuple[Callable[[], MonitorState], tuple[int, int]]] = {
    "live-80x24": (offline, (80, 24)),
    "live-40x20": (offline, (40, 20)),
    "live-ascii": (lambda: live(unicode=False), (80, 24)),
    "waiting": (connected_state, (80, 24)),
    "broker-lost": (broker_lost, (80, 24)),
    "daemon-lost": (daemon_lost, (40, 20)),
    "calibrating": (calibrating, (80, 24)),
    "calibrating-40x20": (calibrating, (40, 20)),
    "refused": (refused, (80, 24)),
    "history": (history, (80, 24)),
    "health": (health, (80, 24)),
    "log": (log, (80, 24)),
    "recording-interrupted": (interrupted, (80, 24)),
    "recording-stop": (stopping, (40, 20)),
    "several-rigs": (several_rigs, (80, 24)),
    "arabic": (lambda: live_state(ARABIC), (80, 24)),
    "chinese": (lambda: live_state(CHINESE), (80, 24)),
    "one-segment": (lambda: live_state(ONE), (80, 24)),
    "six-segments": (lambda: live_state(SIX), (120, 40)),
}


@pytest.fixture(autouse=True)
def colours(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the pictures independent of the environment of the tests."""
    monkeypatch.delenv("NO_COLOR", raising=False)


@pytest.mark.parametrize("name", STATES)
async def test_picture(name: str) -> None:
    make, size = STATES[name]
    app = still(make(), AT_S + 3.0 if "lost" in name else AT_S)
    async with app.run_test(size=size) as pilot:
        app.draw()
        await pilot.pause()
        check_picture(app, STORED / f"{name}.svg")


async def test_picture_of_the_documentation() -> None:
    app = still(live_state(replace(LEG, offline=frozenset({"S4"}))))
    async with app.run_test(size=(100, 26)) as pilot:
        app.draw()
        await pilot.pause()
        check_picture(app, ROOT / "docs" / "monitor.svg")


async def test_no_color_leaves_words_and_marks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_COLOR", "1")
    app = still(offline())
    async with app.run_test(size=(80, 24)) as pilot:
        app.draw()
        await pilot.pause()
        check_picture(app, STORED / "no-color.svg")


async def test_keys_change_views_and_send_requests(monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[Any] = []
    app = still(live())
    monkeypatch.setattr(app, "act", sent.append)
    async with app.run_test(size=(80, 24)) as pilot:
        for key, view in (("2", "calibrate"), ("tab", "history"), ("5", "log"), ("1", "live")):
            await pilot.press(key)
            assert app.state.view == view
        await pilot.press("s", "2", "F")
        assert sent[-2:] == [
            SendRequest("static"),
            SendRequest("calibrate", {"phase": "functional", "force": True}),
        ]


async def test_a_mark_has_a_text_and_can_be_cancelled(monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[SendRequest] = []

    async def note(self: MonitorApp, request: SendRequest) -> None:
        sent.append(request)

    monkeypatch.setattr(MonitorApp, "_send", note)
    app = still(live())
    async with app.run_test(size=(80, 24)) as pilot:
        await pilot.press("m", *"no", "escape", "m", *"q 2", "enter", "2")
        assert app.state.view == "calibrate"
    assert sent == [SendRequest("mark", {"text": "q 2"})]


@pytest.mark.parametrize("key", ["q", "ctrl+c"])
async def test_the_monitor_ends_by_a_key(key: str) -> None:
    app = still(live())
    async with app.run_test() as pilot:
        await pilot.press(key)
    assert app.return_value == 0


async def test_updates_stay_below_ten_a_second_under_a_flood_of_messages_and_keys() -> None:
    state = live_state(LEG, 1.0)
    app = MonitorApp(state, None, updates_hz=1000.0, now=lambda: moment(time.monotonic() % 100))
    async with app.run_test(size=(80, 24)) as pilot:
        await pilot.pause(0.2)
        before, began = app.screen_widget.redrawn, time.monotonic()
        k = 0
        while time.monotonic() - began < 1.0:
            k += 1
            take(state, "pose/ui", LEG.pose(1.0 + 0.01 * k), 1.0 + 0.01 * k)
            app.press("right")
            await asyncio.sleep(0.001)
        updates = app.screen_widget.redrawn - before
        assert k > 30
        assert 1 <= updates <= 11  # 10 intervals have 11 ends


async def test_a_changed_number_redraws_only_its_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    state = live()
    app = still(state)
    async with app.run_test(size=(80, 24)) as pilot:
        await pilot.pause(0.15)
        regions: list[Any] = []
        refresh = app.screen_widget.refresh

        def note(*areas: Any, **options: Any) -> Any:
            regions.extend(areas)
            return refresh(*areas, **options)

        monkeypatch.setattr(app.screen_widget, "refresh", note)
        take(state, "bridge/health", LEG.health())
        assert state.rig.health is not None
        state.rig.health.devices["S1"].rate_hz = 99.9
        app.draw()
        assert [(area.height, area.width <= 5) for area in regions] == [(1, True)]


def test_pictures_belong_to_states() -> None:
    """Every stored picture shows a state of `STATES`, and every state has a picture."""
    stored = {path.stem for path in STORED.glob("*.svg")}
    assert stored == {*STATES, "no-color"}


def test_pictures_load_nothing() -> None:
    files: list[Path] = [*STORED.glob("*.svg"), ROOT / "docs" / "monitor.svg"]
    for path in files:
        assert "url(" not in path.read_text("utf-8").replace("url(#", "")
