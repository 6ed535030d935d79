"""The Textual program, which shows the state at a limited rate and passes keys to the state."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, ClassVar

from textual.app import App
from textual.widgets import Input
from typing_extensions import override

from jointfit_daemon.outputs.mqtt import DisconnectErrorFilter, NoAnswerError
from jointfit_daemon.tools.monitor._broker_link import BrokerLink
from jointfit_daemon.tools.monitor._monitor_state import (
    AskMark,
    ChooseRig,
    MonitorState,
    Quit,
    SendRequest,
)
from jointfit_daemon.tools.monitor._rig_view import Moment
from jointfit_daemon.tools.monitor._screen_lines import screen_lines
from jointfit_daemon.tools.monitor._screen_widget import ScreenWidget

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from textual.app import ComposeResult
    from textual.binding import BindingType
    from textual.events import Key, Resize

    from jointfit_daemon.config import MqttSettings
    from jointfit_daemon.tools.monitor._monitor_state import Action

MOST_UPDATES_HZ = 10.0
"""Maximum update rate of the terminal, Hz."""
_LONGEST_MARK = 200
"""Maximum number of characters of a mark; the JSON Schema of the request has the same limit."""


def present() -> Moment:
    """Return the current time."""
    return Moment(time.monotonic(), time.time_ns() / 1000.0)


class MonitorApp(App[int]):
    """Textual program of the monitor.

    A key changes the state at once. The screen changes at the next update, so no sequence of keys
    or messages causes more than `updates_hz` updates per second.

    Parameters
    ----------
    state
        Initial state.
    settings
        Address and account of the broker; None for a program without connection, as in tests.
    updates_hz
        Number of screen updates per second.
    now
        Function that returns the current time.
    """

    CSS = """
    Screen { layout: vertical; background: ansi_default; }
    ScreenWidget { width: 1fr; height: 1fr; background: ansi_default; }
    #mark { display: none; height: 1; border: none; padding: 0; background: ansi_default; }
    """
    ENABLE_COMMAND_PALETTE = False
    BINDINGS: ClassVar[list[BindingType]] = []
    TITLE = "jointfit monitor"

    def __init__(
        self,
        state: MonitorState,
        settings: MqttSettings | None,
        *,
        updates_hz: float = MOST_UPDATES_HZ,
        now: Callable[[], Moment] = present,
    ) -> None:
        super().__init__(ansi_color=True)
        self.state = state
        self._now, self._period_s = now, 1.0 / min(updates_hz, MOST_UPDATES_HZ)
        self._link = None if settings is None else BrokerLink(settings, state, now)
        self._tasks: set[asyncio.Task[None]] = set()
        self.screen_widget = ScreenWidget(self.press)

    @override
    def compose(self) -> ComposeResult:
        """Create the screen, and the line for the text of a mark."""
        yield self.screen_widget
        mark = Input(
            placeholder="Text of the mark; Esc cancels", id="mark", max_length=_LONGEST_MARK
        )
        yield mark

    def on_mount(self) -> None:
        """Connect to the broker, and start the periodic updates of the screen."""
        self.theme = "ansi-dark" if "ansi-dark" in self.available_themes else "textual-ansi"
        self.screen_widget.focus()
        asyncio.get_running_loop().set_exception_handler(DisconnectErrorFilter())
        if self._link is not None:
            self._start(self._link.run())
        self.set_interval(self._period_s, self.draw)

    def on_resize(self, _: Resize) -> None:
        """Draw at once in the new size."""
        self.call_after_refresh(self.draw)

    def draw(self) -> None:
        """Show the current state, and send the request that the view needs."""
        width, height = self.screen_widget.size
        if width == 0 or height == 0:
            return
        self.screen_widget.show(screen_lines(self.state, width, height, self._now()))
        if (due := self.state.due_request()) is not None:
            self.act(due)

    def press(self, key: str) -> None:
        """Pass a key to the state."""
        action = self.state.press(key)
        if action is not None:
            self.act(action)

    def on_key(self, event: Key) -> None:
        """Cancel the input of a mark at the Escape key; ignore other keys."""
        if event.key == "escape":
            self._close_mark()

    def act(self, action: Action) -> None:
        """Carry out an action that the state has returned."""
        match action:
            case Quit():
                self.exit(0)
            case ChooseRig(base) if self._link is not None:
                self._link.choose(base)
            case AskMark():
                mark = self.query_one("#mark", Input)
                mark.value, mark.display = "", True
                mark.focus()
            case SendRequest():
                self._start(self._send(action))
            case _:
                pass

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Send the mark."""
        self._close_mark()
        if text := event.value.strip():
            self.act(SendRequest("mark", {"text": text}))

    def _close_mark(self) -> None:
        mark = self.query_one("#mark", Input)
        mark.display = False
        self.screen_widget.focus()

    async def _send(self, request: SendRequest) -> None:
        if self._link is None:
            return
        try:
            answer = await self._link.request(request.command, request.arguments)
        except NoAnswerError as none:
            if request.command == "calibrations":
                self.state.versions_unreadable(str(none))
            else:
                self.state.show_refusal(str(none), self._now().monotonic_s)
            return
        self.state.take_answer(request.command, answer, self._now().monotonic_s)

    def _start(self, work: Coroutine[None, None, None]) -> None:
        """Run a task until the task or the program ends; an error in the task ends the program."""
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._on_task_end)

    def _on_task_end(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        error = None if task.cancelled() else task.exception()
        if isinstance(error, Exception):
            self._handle_exception(error)

    async def stop_tasks(self) -> None:
        """Cancel the connection and running requests."""
        for task in [*self._tasks]:
            task.cancel()
        if self._tasks:
            await asyncio.wait([*self._tasks])
