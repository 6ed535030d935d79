"""`ServerOutput` of a server without frames: one report of the loss, and no lost answer."""

from __future__ import annotations

from jointfit_daemon.model import Chunk
from jointfit_drivers.motion_capture import ServerOutput

ANSWER, FRAME = Chunk(1, b"answer"), Chunk(2, b"frame")


def test_answers_of_the_first_connection_are_emitted_at_once() -> None:
    output, emitted = ServerOutput(), list[Chunk]()
    output.begin(emitted.append)
    output.emit_answer(ANSWER)
    assert emitted == [ANSWER]


def test_after_a_connection_without_a_frame_answers_wait_for_the_first_frame() -> None:
    output, emitted = ServerOutput(), list[Chunk]()
    for _ in range(3):
        output.begin(emitted.append)
        output.emit_answer(ANSWER)
    assert emitted == [ANSWER]  # the answer of the first connection
    output.emit_frame(FRAME)
    assert emitted == [ANSWER, ANSWER, FRAME]


def test_after_a_connection_with_frames_answers_are_emitted_at_once() -> None:
    output, emitted = ServerOutput(), list[Chunk]()
    output.begin(emitted.append)
    output.emit_frame(FRAME)
    output.begin(emitted.append)
    output.emit_answer(ANSWER)
    assert emitted == [FRAME, ANSWER]
