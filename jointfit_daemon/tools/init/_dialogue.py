"""The text dialogue, which shows questions, reads answers and starts searches.

Invariant: only `Dialogue.read_line` waits for typed input, and every accepted answer is stored at
once.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from jointfit_daemon.config import LATER
from jointfit_daemon.nearest_name import did_you_mean
from jointfit_daemon.tools.init._answers import driver_of, split_address, wiring_of
from jointfit_daemon.tools.init._engine import accept, complete, next_question
from jointfit_daemon.tools.init._parsing import AnswerError

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.tools.init._answers import Answers, Key
    from jointfit_daemon.tools.init._engine import Asked
    from jointfit_daemon.tools.init._found import Found
    from jointfit_daemon.tools.init._search import DeviceSearch

HELP, BACK, FIND = "?", "<", "find"
"""Commands that a user can type instead of an answer: explain the question, return to the previous
question, start a search."""


class UnansweredError(ValueError):
    """The input of a script ended, or an answer file has no answer to a question."""


@dataclass
class Dialogue:
    """One dialogue, which asks questions until all answers are known."""

    search: DeviceSearch
    show: Callable[[str], None]
    """Function that prints a line."""
    read_line: Callable[[str], str]
    """Function that prints a prompt and returns a line; it raises EOFError at the end of the
    input."""
    store: Callable[[Answers], None]
    """Function that stores the answers."""
    found: Found
    prepared: dict[Key, Any] = field(default_factory=dict)
    """Values of an answer file."""
    is_script: bool = False
    """Whether the input is a script. A question without a prepared answer then takes its default or
    raises an error."""
    answers: Answers = field(default_factory=dict)
    _stored: Answers = field(default_factory=dict)
    """Answers of an interrupted dialogue to questions that this dialogue has not reached."""

    @property
    def known(self) -> Answers:
        """All answers: the accepted answers, and the stored answers to later questions."""
        return {**self._stored, **self.answers}

    def run(self) -> Answers:
        """Ask until the dialogue is complete; return the answers.

        Raises
        ------
        UnansweredError
            A prepared answer is not accepted. In a script also: an answer is missing, or a prepared
            answer belongs to no question.
        """
        while (asked := self.next()) is not None:
            if asked.key in self.prepared:
                self._take_prepared(asked)
            elif self.is_script:
                try:
                    self.accept_answer(asked, None)
                except AnswerError as error:
                    raise UnansweredError(
                        f"{asked.name} is missing, and there is no proposal: "
                        f"{asked.text}: {asked.help}"
                    ) from error
            else:
                self._ask(asked)

        # A prepared answer to a question that was not asked is probably misspelled.
        for key, subject in self.prepared.keys() - self.answers.keys() if self.is_script else ():
            name = f"{key}.{subject}" if subject else key
            known = [f"{k}.{s}" if s else k for k, s in self.answers]
            raise UnansweredError(
                f"{name}: there is no such question with these answers; {did_you_mean(name, known)}"
            )
        return self.answers

    def next(self) -> Asked | None:
        """Return the next question with an updated list of devices; None if no question is open."""
        asked = self.current_question()
        if asked is None or asked.question.kind != "device":
            return asked
        self.found = self.search.refresh(self.found)
        return self.current_question()

    def current_question(self) -> Asked | None:
        """Return the next question, or None if no question is open.

        The list of devices omits ports that stored answers to later questions use.
        """
        stored = {value for (key, _), value in self._stored.items() if key == "device"}
        taken = stored - {*self.answers.get(("can_adapters", ""), ())}
        free = tuple(port for port in self.found.ports if port.address not in taken)
        return next_question(self.answers, replace(self.found, ports=free))

    def resume(self, stored: Answers) -> None:
        """Accept stored answers; ask again if an answer was postponed or became invalid."""
        self._stored = {key: value for key, value in stored.items() if value != LATER}
        self._take_stored()

    def _take_stored(self) -> None:
        """Accept stored answers up to the first question without a stored answer."""
        while (asked := next_question(self.answers, self.found)) is not None:
            if asked.key not in self._stored:
                break
            value = self._stored.pop(asked.key)
            try:
                self._accept(asked, value)
            except AnswerError as error:
                self.show(f"{asked.name} = {value!r} is asked again: {error}")
                break

    def accept_answer(self, asked: Asked, given: Any) -> None:
        """Accept and store an answer, and read the file or stream that the answer names."""
        self._accept(asked, given)
        self._take_stored()

    def _accept(self, asked: Asked, given: Any) -> None:
        if asked.question.key == "layout" and (given or asked.default):
            path = str(given or asked.default)
            driver = driver_of(self.answers, self.found, asked.subject)
            self.found = self.search.layout(self.found, path, driver.name)
        self.answers = accept(asked, given, self.answers, self.found)
        self.store(self.known)
        value = self.answers[asked.key]
        if value == LATER:
            return

        if asked.question.key == "device" and not self.search.is_present(self.found, value):
            self.show(f"  note: {value} is absent now; connect it before the daemon starts")
        if asked.question.key == "server":
            self._read_stream()

    def _read_stream(self) -> None:
        host, port = split_address(self.answers["server", ""])
        self.found, text = self.search.stream_names(self.found, host, port)
        self.show(f"  {text}")

    # --- scripts -----------------------------------------------------------------------------

    def _take_prepared(self, asked: Asked) -> None:
        value = self.prepared[asked.key]
        try:
            if value == FIND and asked.question.finder is not None:
                self.find(asked)
                again = next_question(self.answers, self.found)
                if again is not None and again.key == asked.key:
                    self.accept_answer(again, None)  # the search changed the proposal
            else:
                self.accept_answer(asked, value)
        except AnswerError as error:
            raise UnansweredError(f"{asked.name} = {value!r}: {error}") from error

    # --- terminal ----------------------------------------------------------------------------

    def _ask(self, asked: Asked) -> None:
        """Ask one question until it is answered, or until the user goes back."""
        total = len(complete(self.answers, self.found))
        self.show(f"\n({len(self.answers) + 1}/{total}) {asked.text}")
        width = max((len(choice.address) for choice in asked.choices), default=0)
        if asked.question.kind == "ids":
            names = " ".join(each.address for each in asked.choices)
            self.show(f"  {names}, such as {' '.join(each.text for each in asked.choices)}")
        else:
            for number, choice in enumerate(asked.choices, 1):
                self.show(f"  {number}  {choice.address:{width}}  {choice.text}".rstrip())

        while True:
            line = self.read_line(self._prompt(asked)).strip()
            if line == HELP:
                self.show(f"  {asked.help}")
                keys = "'<' goes back one question."
                if answer_text(asked.proposal):
                    keys = f"Enter takes the proposal in brackets, {keys}"
                self.show(f"  {keys}")
                continue
            if line == BACK:
                self.go_back()
                return
            try:
                if line == FIND and asked.question.finder is not None:
                    self.find(asked)
                else:
                    self.accept_answer(asked, line or asked.entered)
            except AnswerError as error:
                self.show(f"  {error}")
                continue
            return

    def _prompt(self, asked: Asked) -> str:
        shown = answer_text(asked.proposal)
        find = " ('find' searches)" if asked.question.finder else ""
        if not shown:
            return f"  empty: none{find} > " if asked.optional else f" {find} > "
        return f"  [{shown}]{find} > "

    def go_back(self) -> None:
        if self.answers:
            key, _ = self.answers.popitem()
            self.prepared.pop(key, None)
            self.store(self.known)

    def find(self, asked: Asked) -> None:
        """Start the search of a question.

        The search for a moved sensor accepts its result as the answer. All other searches only
        change the proposed answer.

        Raises
        ------
        AnswerError
            Nothing was found.
        """
        if asked.question.finder == "stream":
            self._read_stream()
            if not self.found.markers:
                raise AnswerError(
                    "the stream has no marker names: type the names, separated by commas"
                )
            return

        if asked.question.finder == "traffic":
            port = self.answers["device", asked.subject]
            if wiring_of(self.answers, port) == "can":
                self.found = self.search.identifiers(self.found, port)
                sensors = self.found.can_sensors[port]
                self.show(f"  {port}: {'; '.join(each.text for each in sensors)}")
                return
            self.found, text = self.search.recognized_driver(self.found, port)
            self.show(f"  {text}")
            return

        if asked.question.finder == "identifiers":
            bus = self.answers["device", asked.subject]
            self.found = self.search.identifiers(self.found, bus)
            sensors = self.found.can_sensors[bus]
            self.show(f"  {bus}: {len(sensors)} sensors were received")
            again = next_question(self.answers, self.found)
            if again is None or again.default is None:
                listed = "; ".join(each.text for each in sensors)
                raise AnswerError(
                    f"no unused sensor fits the driver and its settings; received: {listed}. "
                    f"{BACK!r} returns to these settings"
                )
            return

        self.found, address = self.search.moved_device(
            self.found, self.answers, asked.subject, asked.choices
        )
        self.show(f"  {asked.subject} is at {address}")
        self.accept_answer(asked, address)


def answer_text(value: Any) -> str:
    """Return an answer in the form that a user types."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, tuple):
        is_id = bool(value) and isinstance(value[0], int)
        return " ".join(map(hex, value)) if is_id else ", ".join(value)
    return str(value)
