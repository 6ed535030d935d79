"""The dialogue of `jointfit init` for a web page, with JSON objects as input and output.

Invariant: each output contains everything that the page shows, so a reloaded page can continue.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from jointfit_daemon.config import LATER
from jointfit_daemon.tools.init._answer_file import read_answers, write_answers
from jointfit_daemon.tools.init._dialogue import Dialogue, answer_text
from jointfit_daemon.tools.init._engine import answered_questions, complete, next_question
from jointfit_daemon.tools.init._parsing import AnswerError
from jointfit_daemon.tools.init._rig_table import rig_table
from jointfit_daemon.tools.init._rig_text import rig_text
from jointfit_daemon.tools.init._search import DeviceSearch
from jointfit_daemon.tools.init._writing import (
    state_of,
    write_password,
    write_rig,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from jointfit_daemon.tools.init._engine import Asked


@dataclass
class SetUpSession:
    """One dialogue, whose rig is written to `path`."""

    path: Path
    search: DeviceSearch = field(default_factory=lambda: DeviceSearch(lambda _: None))
    notes: list[str] = field(default_factory=list)
    on_note: Callable[[str], None] = lambda _note: None
    """Function that receives each progress note of a search at once, in the thread of `handle`."""
    _dialogue: Dialogue | None = None
    _written: dict[str, Any] | None = None

    def handle(self, message: Mapping[str, Any]) -> dict[str, Any]:
        """Process a message from the page, and return the new state.

        Parameters
        ----------
        message
            ``{"do": "show"}``, ``{"do": "answer", "value": TEXT}``, ``{"do": "back"}``,
            ``{"do": "find"}``, or ``{"do": "write", "password": TEXT}``.
        """
        self.notes.clear()
        error = None
        try:
            self._act(message)
        except (AnswerError, OSError, ValueError) as fault:
            error = str(fault)
        return self._state() | {"error": error, "notes": list(self.notes)}

    @property
    def dialogue(self) -> Dialogue:
        """The dialogue, which begins with the answers of an interrupted dialogue."""
        if self._dialogue is None:
            self.search.show = self._note
            state = state_of(self.path)
            self._dialogue = Dialogue(
                self.search,
                self._note,
                lambda _prompt: "",  # a page sends messages instead of lines
                lambda given: write_answers(state, given),
                self.search.start(),
            )
            if state.exists():
                self._dialogue.resume(read_answers(state))
                self.notes.append(f"Continued with the answers in {state}.")
        return self._dialogue

    def _note(self, text: str) -> None:
        self.notes.append(text)
        self.on_note(text)

    def _act(self, message: Mapping[str, Any]) -> None:
        dialogue, action = self.dialogue, message.get("do")
        if self._written is not None:
            return

        asked = dialogue.next()
        if action == "back":
            dialogue.go_back()
        elif action == "write":
            self._write(str(message.get("password") or ""))
        elif action == "find" and asked is not None and asked.question.finder is not None:
            dialogue.find(asked)
        elif action == "answer" and asked is not None:
            dialogue.accept_answer(asked, message.get("value") or asked.entered)

    def _write(self, password: str) -> None:
        """Write rig and password of a complete dialogue.

        Raises
        ------
        ValueError
            A question is not answered, or the file exists.
        """
        dialogue = self.dialogue
        if next_question(dialogue.answers, dialogue.found) is not None:
            raise ValueError("some questions are open: answer them first")
        if self.path.exists():
            raise ValueError(f"{self.path} exists: remove it, or choose another folder")
        secret = self._password_file()
        if secret is not None and password:
            write_password(secret, password)
        written = write_rig(self.path, dialogue.answers, dialogue.found)
        self._written = {
            "path": str(self.path), "warnings": written.warnings, "open": written.open_places,
            "next": written.next_commands,
        }  # fmt: skip

    def _password_file(self) -> Path | None:
        """Return the path of the password file to write; None if no file is needed."""
        name = self.dialogue.answers.get(("password_file", ""))
        if name is None or os.path.lexists(self.path.absolute().parent / name):
            return None
        return self.path.absolute().parent / str(name)

    def _state(self) -> dict[str, Any]:
        dialogue = self.dialogue
        asked = dialogue.current_question()
        found = dialogue.found

        secret = self._password_file() if asked is None else None
        return {
            "question": None if asked is None else _question(asked),
            "answered": [
                {"text": text, "value": answer_text(value)}
                for text, value in answered_questions(dialogue.answers, found)
            ],
            "total": len(complete(dialogue.answers, found)),
            "found": [
                {"address": each.address, "text": each.text}
                for each in (*found.ports, *found.interfaces, *found.servers)
            ],
            "text": None if asked else rig_text(rig_table(dialogue.answers, found)),
            "password_file": None if secret is None else str(secret),
            "path": str(self.path),
            "written": self._written,
        }


def _question(asked: Asked) -> dict[str, Any]:
    question = asked.question
    choices = (
        [] if question.kind == "ids" else [(each.address, each.text) for each in asked.choices]
    )
    if question.kind == "yes_no":
        choices = [("yes", ""), ("no", "")]
    if question.postponable:
        choices.append((LATER, "not known yet: enter it later"))
    return {
        "name": asked.name,
        "text": asked.text,
        "help": asked.help,
        "default": answer_text(asked.proposal),
        "optional": asked.optional,
        "finder": question.finder,
        "closed": question.kind in ("choice", "yes_no"),
        "choices": [{"value": value, "text": text} for value, text in choices],
    }
