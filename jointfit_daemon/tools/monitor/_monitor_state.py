"""State of the monitor except the rig: connection, views, pressed keys, and answers of the daemon.

Invariants: the module uses no clock, I/O or terminal. A key press changes the state, or returns an
action that the program executes.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from jointfit_daemon.outputs.log import printable
from jointfit_daemon.outputs.payload_models import CalibrationsAnswer
from jointfit_daemon.tools.monitor._decoding import UnreadablePayloadError, decode_answer
from jointfit_daemon.tools.monitor._recording_words import recording_of
from jointfit_daemon.tools.monitor._rig_view import RigView
from jointfit_daemon.tools.monitor._words import RUNNING

if TYPE_CHECKING:
    from collections.abc import Mapping
    from datetime import tzinfo

    from jointfit_daemon.outputs.payload_models import StoredVersion
    from jointfit_daemon.tools.monitor._rig_view import AngleChoice

ViewName = Literal["live", "calibrate", "history", "health", "log"]
VIEWS: tuple[ViewName, ...] = ("live", "calibrate", "history", "health", "log")
_TURN_DEG = 15
_PAGE = 10
"""Number of lines that the Page Up and Page Down keys scroll."""
_NOTICE_S = 20.0
"""Time for which the answer to a request is shown, s."""


@dataclass(frozen=True, slots=True)
class SendRequest:
    """Action: send a request to the daemon."""

    command: str
    arguments: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ChooseRig:
    """Action: show the rig with this base topic."""

    base: str


@dataclass(frozen=True, slots=True)
class AskMark:
    """Action: let the user type the text of a mark."""


@dataclass(frozen=True, slots=True)
class Quit:
    """Action: end the program."""


Action = SendRequest | ChooseRig | AskMark | Quit


@dataclass(slots=True)
class RequestOutcome:
    """Outcome of the last request to the daemon, as shown to the user."""

    text: str
    refused: bool
    until_s: float


@dataclass(slots=True)
class MonitorState:
    """Everything that the screen shows."""

    broker: str
    """Address of the broker as text."""
    timezone: tzinfo | None = None
    unicode: bool = True
    base: str | None = None
    link: Literal["connecting", "searching", "connected", "lost"] = "connecting"
    reason: str = ""
    """Reason why the connection was lost."""
    rigs: dict[str, str] = field(default_factory=dict)
    """Names of the rigs that the last search found on the broker, by base topic."""
    rig: RigView = field(default_factory=RigView)
    view: ViewName = "live"
    choice: AngleChoice | None = None
    turn_deg: int = 0
    """Direction of view, degrees about the vertical; 0 is the view from the side."""
    cursor: int = 0
    """Index of the selected entry of the history or of the list of rigs."""
    scroll: int = 0
    only_problems: bool = False
    stored: CalibrationsAnswer | None = None
    stored_fault: str = ""
    listed: tuple[object, ...] | None = None
    """Current calibration at the time when the list of stored versions was requested."""
    notice: RequestOutcome | None = None
    asked_to_stop: bool = False
    """Whether the next press of the key R stops the recording."""

    # --- connection ----------------------------------------------------------------------------

    def begin_rig(self, base: str) -> None:
        """Show the rig with this base topic; discard the data of another rig."""
        self.base, self.rig, self.stored = base, RigView(), None
        self.choice, self.cursor, self.scroll = None, 0, 0

    def set_connected(self) -> None:
        """Set the state to connected; the broker sends the retained messages next."""
        self.link, self.reason = ("connected" if self.base is not None else "searching"), ""
        self.rig.bridge, self.listed = "unknown", None

    def set_lost(self, reason: str) -> None:
        """Set the state to disconnected, and store the reason."""
        self.link, self.reason = "lost", printable(reason)

    def set_found_rigs(self, rigs: Mapping[str, str]) -> str | None:
        """Store the result of a search; return the base topic of the only rig, or None."""
        self.rigs = {base: printable(name) for base, name in sorted(rigs.items())}
        self.link, self.reason = "searching", ""
        return next(iter(self.rigs)) if len(self.rigs) == 1 else None

    # --- answers -------------------------------------------------------------------------------

    def take_answer(self, command: str, answer: Mapping[str, Any], now_s: float) -> None:
        """Process the answer to a request."""
        if command == "calibrations":
            self._take_versions(answer)
        elif answer.get("status") == "error":
            self.show_refusal(f"jointfitd refuses {command}: {_fault_text(answer)}", now_s)
        else:
            text = printable(_words_of(command, answer))
            self.notice = RequestOutcome(text, False, now_s + _NOTICE_S)
            self.listed = None

    def show_refusal(self, reason: str, now_s: float) -> None:
        """Show the reason why a request was not sent or had no answer."""
        self.notice = RequestOutcome(printable(reason), True, now_s + _NOTICE_S)

    def versions_unreadable(self, reason: str) -> None:
        """Show the reason why the stored calibrations cannot be read."""
        self.stored, self.stored_fault = None, printable(reason)

    def _take_versions(self, answer: Mapping[str, Any]) -> None:
        if answer.get("status") == "error":
            self.versions_unreadable(_fault_text(answer))
            return
        try:
            data = decode_answer("calibrations", answer.get("data"))
        except UnreadablePayloadError as fault:
            self.versions_unreadable(str(fault))
            return
        if isinstance(data, CalibrationsAnswer):
            self.stored, self.stored_fault = data, ""
            self.cursor = min(self.cursor, max(0, len(data.versions) - 1))

    # --- keys ----------------------------------------------------------------------------------

    @property
    def is_running(self) -> bool:
        """Return whether a calibration phase runs."""
        calibration = self.rig.calibration
        return calibration is not None and calibration.phase in RUNNING

    def chosen_version(self) -> StoredVersion | None:
        """Return the selected entry of the history; None if the history is empty or unknown."""
        if self.stored is None or not self.stored.versions:
            return None
        return self.stored.versions[min(self.cursor, len(self.stored.versions) - 1)]

    def press(self, key: str) -> Action | None:
        """Process a key press; return the action that the program must execute, or None."""
        if key in {"q", "ctrl+c", "ctrl+q"}:
            return Quit()
        if key != "R":
            self.asked_to_stop = False
        if self.base is None:
            bases = [*self.rigs]
            if key in {"up", "down"} and bases:
                self.cursor = (self.cursor + (1 if key == "down" else -1)) % len(bases)
            if key == "enter" and bases:
                return ChooseRig(bases[min(self.cursor, len(bases) - 1)])
            return None

        # First test the keys that select a view, then the keys of the view, then request keys.
        if key.isdecimal() and 1 <= int(key) <= len(VIEWS):
            self._show(VIEWS[int(key) - 1])
        elif key in {"tab", "shift+tab"}:
            step = 1 if key == "tab" else -1
            self._show(VIEWS[(VIEWS.index(self.view) + step) % len(VIEWS)])
        elif self.view == "history" and key in {"up", "down", "enter", "r"}:
            return self._press_in_history(key)
        elif self._move(key):
            pass
        else:
            return self._requested_by(key)
        return None

    def due_request(self) -> SendRequest | None:
        """Return a request for the stored versions if the view shows them and they are outdated."""
        calibration = self.rig.calibration
        if self.view != "history" or self.link != "connected" or self.rig.bridge != "online":
            return None
        shown = (
            None if calibration is None else (str(calibration.phase), calibration.version),
            self.base,
        )
        if shown == self.listed:
            return None
        self.listed = shown
        return SendRequest("calibrations")

    def _show(self, view: ViewName) -> None:
        self.view, self.scroll, self.cursor, self.listed = view, 0, 0, None

    def _press_in_history(self, key: str) -> Action | None:
        count = 0 if self.stored is None else len(self.stored.versions)
        if key in {"up", "down"} and count:
            self.cursor = max(0, min(count - 1, self.cursor + (1 if key == "down" else -1)))
        version = self.chosen_version()
        if key == "enter" and version is not None:
            return SendRequest("use-calibration", {"version": version.version})
        return SendRequest("use-calibration", {"revert": True}) if key == "r" else None

    def _move(self, key: str) -> bool:
        """Scroll, turn the limb, choose an angle, or filter the log, depending on the key.

        Return whether the key has one of these effects.
        """
        steps = {"down": 1, "up": -1, "pagedown": _PAGE, "pageup": -_PAGE}
        if key in steps:
            self.scroll = max(0, self.scroll + steps[key])
        elif key in {"left", "right"}:
            self.turn_deg = (self.turn_deg + (_TURN_DEG if key == "right" else -_TURN_DEG)) % 360
        elif key in {"j", "J"}:
            choices = self.rig.angle_choices()
            if choices:
                at = choices.index(self.choice) if self.choice in choices else 0
                self.choice = choices[(at + (1 if key == "j" else -1)) % len(choices)]
        elif key == "w" and self.view == "log":
            self.only_problems, self.scroll = not self.only_problems, 0
        else:
            return False
        return True

    def _record(self) -> Action | None:
        """Return the request that the key R causes, or None.

        If nothing is recorded, the key starts a recording. During a recording, the first press asks
        for confirmation, and the second press stops the recording.
        """
        recording, asked = recording_of(self.rig), self.asked_to_stop
        self.asked_to_stop = recording is not None and recording.active and not asked
        if recording is None or self.asked_to_stop:
            return None
        return SendRequest("record", {"action": "stop" if recording.active else "start"})

    def _requested_by(self, key: str) -> Action | None:
        """Return the action of a key, or None; some keys work in the calibration view only."""
        if key == "m":
            return AskMark()
        if key == "R":
            return self._record()
        if key == "s" and not self.is_running:
            return SendRequest("static")
        if key == "x" and self.is_running:
            return SendRequest("calibrate", {"phase": "abort"})

        if self.view != "calibrate" or self.is_running:
            return None
        phases: dict[str, Mapping[str, Any]] = {
            "a": {"phase": "align"},
            "f": {"phase": "functional"},
            "F": {"phase": "functional", "force": True},
        }
        return SendRequest("calibrate", phases[key]) if key in phases else None


def chosen_angle(state: MonitorState) -> AngleChoice | None:
    """Return the angle to show: the chosen angle, or else the first angle of the rig."""
    choices = state.rig.angle_choices()
    if state.choice in choices:
        return state.choice
    return choices[0] if choices else state.choice


def _fault_text(answer: Mapping[str, Any]) -> str:
    error = answer.get("error")
    error = error if isinstance(error, dict) else {}
    faults = error.get("faults")
    first = faults[0] if isinstance(faults, list) and faults else error
    return str(first.get("message") if isinstance(first, dict) else first)


def _words_of(command: str, answer: Mapping[str, Any]) -> str:
    """Return the effect of a request as text."""
    data = answer.get("data")
    data = data if isinstance(data, dict) else {}
    done = "started" if answer.get("status") == "accepted" else "done"
    if command == "mark":
        return f"mark {data.get('number')}: {done}"
    if command == "use-calibration":
        return f"version {data.get('version')} is in force: {done}"
    if command in {"calibrate", "static"}:
        return f"{data.get('phase', 'static')} phase: {done}"
    if command == "record":
        folder = f"{data.get('file')} in {data.get('directory')}"
        return f"recording started: {folder}" if data.get("active") else f"recorded {folder}"
    return f"{command}: {done}"
