"""Random dialogues of `jointfit init`: found devices, and answers of every type to a question."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from hypothesis import strategies as st

from jointfit_daemon.tools.init._engine import accept, next_question
from jointfit_daemon.tools.init._found import (
    CanSensor,
    Found,
    FoundDevice,
    ImuDriver,
    MocapDriver,
)
from jointfit_daemon.tools.init._limbs import LIMBS
from jointfit_daemon.tools.init._parsing import AnswerError

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.tools.init._answers import Answers
    from jointfit_daemon.tools.init._engine import Asked

NOTHING = Found(
    imu_drivers=(
        ImuDriver("xbus", "serial", 115_200),
        ImuDriver("xcdi", "can", None, {"sample_time": 5, "group_counter": 6, "quaternion": 0x21}),
    ),
    mocap_drivers=(MocapDriver("natnet", 1510),),
)
"""Result of a search that found drivers, but no device."""
DEVICES = replace(
    NOTHING,
    ports=tuple(FoundDevice(f"/dev/ttyUSB{k}", "adapter") for k in range(3)),
    interfaces=(FoundDevice("can0", "up"),),
    servers=(FoundDevice("192.168.1.10", "Motive"),),
)
STREAM = replace(
    DEVICES,
    markers=tuple(f"{stem}{k}" for stem in ("P", "T", "C", "Foot_") for k in range(1, 5)),
    bodies=("Thigh", "calibration plate"),
    can_sensors={
        "can0": (
            CanSensor("xcdi", (0x105, 0x106, 0x121)),
            CanSensor("xcdi", (0x205, 0x206, 0x221)),
        )
    },
)
NAMES = st.text(st.characters(codec="utf-8"), min_size=1, max_size=6)


def answers_to(asked: Asked) -> st.SearchStrategy[Any]:
    """Return answers that may be valid, as text or as a value of TOML."""
    if asked.question.key == "limb":
        return st.sampled_from(sorted(LIMBS))
    kinds: dict[str, st.SearchStrategy[Any]] = {
        "text": NAMES,
        "names": st.lists(NAMES, min_size=1, max_size=4, unique=True),
        "number": st.sampled_from([0.3, 1, 50, 100, "250", "115200", 921_600]),
        "yes_no": st.sampled_from(["y", "no", True]),
        "choice": st.sampled_from([choice.address for choice in asked.choices] or ["x"]),
        "device": st.one_of(
            st.sampled_from(["can0", "can1", "1", "2"]),
            st.integers(0, 40).map("/dev/ttyUSB{}".format),
        ),
        "address": st.sampled_from(["10.0.0.5", "lab-pc:1883", "localhost", "[::1]:1884"]),
        "ids": st.integers(0, 7).map(
            lambda k: f"{k << 8 | 5:#x} {k << 8 | 6:#x} {k << 8 | 0x21:#x}"
        ),
    }
    return kinds[asked.question.kind]


def answer_or_default(asked: Asked, given: Any, answers: Answers, found: Found) -> Answers | None:
    """Return the extended answers; None if the answer is not accepted."""
    try:
        return accept(asked, given, answers, found)
    except AnswerError:
        return None


def completed(
    found: Found, choose: Callable[[Asked], Any], answers: Answers | None = None
) -> Answers:
    """Return the answers to all questions: the chosen answer, the default or a placeholder."""
    given = dict(answers or {})
    while (asked := next_question(given, found)) is not None:
        extended = answer_or_default(asked, choose(asked), given, found)
        if extended is None and (asked.default is not None or asked.optional):
            extended = accept(asked, None, given, found)
        if extended is None:
            extended = accept(
                asked, asked.question.stand_in(given, found, asked.subject), given, found
            )
        given = extended
    return given
