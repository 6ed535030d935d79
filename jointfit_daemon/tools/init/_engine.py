"""The engine of the dialogue, which selects the next question and checks an answer.

Invariant: all functions are pure. Equal answers and findings yield the same question, and every
completed dialogue yields a rig that `jointfit check` accepts.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Any

from jointfit_daemon.config import LATER, ConfigError, parse_rig
from jointfit_daemon.tools.init._answers import (
    drivers_for,
    limb_of,
    sensors_of,
    wiring_of,
)
from jointfit_daemon.tools.init._parsing import NEEDED, AnswerError, parse_answer
from jointfit_daemon.tools.init._proposals import is_optional
from jointfit_daemon.tools.init._questions import QUESTIONS, Question
from jointfit_daemon.tools.init._rig_table import rig_table

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from jointfit_daemon.tools.init._answers import Answers, Key
    from jointfit_daemon.tools.init._found import Found, FoundDevice


@dataclass(frozen=True, slots=True)
class Asked:
    """A question for one subject, with the text that the user reads."""

    question: Question
    subject: str
    text: str
    default: Any
    """Answer that is used if the user types nothing; None if there is no proposal."""
    choices: tuple[FoundDevice, ...]
    optional: bool
    help: str

    @property
    def key(self) -> Key:
        """Key of the answer."""
        return self.question.key, self.subject

    @property
    def proposal(self) -> Any:
        """Answer of the Enter key: the default, ``later`` for a postponable answer, or None."""
        is_open = self.default is None and self.question.postponable and not self.optional
        return LATER if is_open else self.default

    @property
    def entered(self) -> Any:
        """Value for `accept` if the user types nothing; None selects the default."""
        return "" if self.proposal is None else (None if self.default is not None else LATER)

    @property
    def name(self) -> str:
        """Name of the answer in an answer file."""
        return f"{self.question.key}.{self.subject}" if self.subject else self.question.key


def next_question(answers: Mapping[Key, Any], found: Found) -> Asked | None:
    """Return the first question without an answer; None if the dialogue is complete."""
    for question, subject in _in_order(answers, found):
        if (question.key, subject) not in answers:
            return Asked(
                question,
                subject,
                question.text.format(subject=_subject_words(answers, subject)),
                question.default(answers, found, subject),
                question.choices(answers, found, subject),
                _is_optional(question, answers, subject),
                question.explain(answers, found, subject) or question.help,
            )
    return None


def _is_optional(question: Question, answers: Mapping[Key, Any], subject: str) -> bool:
    return question.optional or (question.key == "markers" and is_optional(answers, subject))


def _subject_words(answers: Mapping[Key, Any], subject: str) -> str:
    """Return the subject as readable words; names that a user typed remain unchanged."""
    if not subject:
        return ""
    limb = limb_of(answers)
    sensor, _, key = subject.rpartition(".")
    if sensor in sensors_of(answers) and subject not in sensors_of(answers):
        return f"{key} of the sensor {sensor}"
    is_ours = subject in (*limb.segments, *limb.optional_parts)
    return subject.replace("_", " ") if is_ours else subject


def _in_order(answers: Mapping[Key, Any], found: Found) -> Iterator[tuple[Question, str]]:
    """Yield the questions that apply; the caller stops at the first unanswered question."""
    for group, members in groupby(QUESTIONS, key=lambda question: question.group or question.key):
        questions = tuple(members)
        for subject in questions[0].subjects(answers, found):
            for question in questions:
                subjects: tuple[str, ...] = (subject,)
                if question.group == group:
                    every = question.subjects(answers, found)
                    subjects = tuple(each for each in every if _owner(question, each) == subject)
                for each in subjects:
                    yield question, each


def _owner(question: Question, subject: str) -> str:
    """Return the subject of the group: the sensor if the subject is ``SENSOR.KEY``."""
    return subject.rpartition(".")[0] if question.is_of_keys else subject


def answered_questions(answers: Mapping[Key, Any], found: Found) -> list[tuple[str, Any]]:
    """Return text and answer of the questions before the first unanswered one, in their order."""
    given = []
    for question, subject in _in_order(answers, found):
        if (question.key, subject) not in answers:
            break
        text = question.text.format(subject=_subject_words(answers, subject))
        given.append((text, answers[question.key, subject]))
    return given


def accept(asked: Asked, given: Any, answers: Mapping[Key, Any], found: Found) -> Answers:
    """Return the answers together with a new answer.

    Parameters
    ----------
    asked
        The question, from `next_question`.
    given
        A typed text, a value of an answer file, or None for the default.
    answers, found
        As in `next_question`.

    Raises
    ------
    AnswerError
        The answer has another type, or yields a rig that `jointfit check` rejects. The error then
        has the message of the check.
    """
    if given is None:
        value = asked.default
        if value is None and not asked.optional:
            raise AnswerError(NEEDED)
    elif given == LATER and asked.question.postponable:
        value = LATER
    else:
        values = [choice.address for choice in asked.choices]
        value = parse_answer(asked.question.kind, given, values, optional=asked.optional)
    if value is None and asked.question.kind == "names":
        value = ()

    extended = {**answers, asked.key: value}
    if asked.question.kind == "device" and value != LATER:
        if _PORT_WITHOUT_FOLDER.fullmatch(value):
            raise AnswerError(
                f"found {value!r}, expected the path of a serial port, such as /dev/{value}, or"
                " the name of a CAN interface, such as can0"
            )
        if not drivers_for(extended, found, asked.subject):
            wiring = wiring_of(extended, value)
            raise AnswerError(f"{value}: no installed driver reads sensors on {wiring} connections")
    if faults := rig_faults(extended, found) - rig_faults(answers, found):
        raise AnswerError("; ".join(sorted(faults)))
    return extended


_PORT_WITHOUT_FOLDER = re.compile(r"tty\w+|COM\d+", re.IGNORECASE)
"""Names of serial ports that are given without a folder."""


def complete(answers: Mapping[Key, Any], found: Found) -> Answers:
    """Return an answer to every question.

    A default replaces a missing answer. Without a default, the stand-in of the question, which is
    a valid answer for checks, replaces it.
    """
    filled = dict(answers)
    for question, subject in _in_order(filled, found):  # later questions depend on `filled`
        key = question.key, subject
        if key not in filled:
            value = question.default(filled, found, subject)
            if value is None and not _is_optional(question, filled, subject):
                value = question.stand_in(filled, found, subject)
            filled[key] = () if value is None and question.kind == "names" else value
    return filled


def without_open_places(answers: Mapping[Key, Any], found: Found) -> Answers:
    """Return complete answers; stand-ins replace the postponed answers (``later``)."""
    return complete({key: value for key, value in answers.items() if value != LATER}, found)


def rig_faults(answers: Mapping[Key, Any], found: Found) -> set[str]:
    """Return the faults of the rig that follows from the answers and the remaining defaults.

    A postponed answer (``later``) is not a fault.
    """
    try:
        parse_rig(rig_table(complete(answers, found), found))
    except ConfigError as error:
        return {fault.text() for fault in error.faults if fault.value != LATER}
    return set()
