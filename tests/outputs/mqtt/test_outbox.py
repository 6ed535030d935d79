"""The outbox is limited, coalesces state, and counts drops."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.outputs.mqtt import Outbox

LIFE = "base/bridge/state"

actions = st.lists(
    st.tuples(
        st.sampled_from(["retain", "event", "stream", "respond", "send", "lose", "reconnect"]),
        st.sampled_from(["a", "b", LIFE]),
        st.binary(max_size=2),
    ),
    max_size=60,
)


async def drain(outbox: Outbox) -> list[tuple[str, bytes, bool]]:
    sent = []
    while outbox.queued:
        message, done = await outbox.next()
        done()
        sent.append((message.topic, message.payload, message.retain))
    return sent


async def test_state_is_sent_once_with_its_last_value() -> None:
    outbox = Outbox(LIFE)
    outbox.retain("a", b"1")
    outbox.retain("a", b"2")
    assert await drain(outbox) == [("a", b"2", True)]
    outbox.retain("a", b"2")
    assert outbox.queued == 0


async def test_a_value_that_changes_while_it_is_sent_is_sent_again() -> None:
    outbox = Outbox(LIFE)
    outbox.retain("a", b"1")
    _, done = await outbox.next()
    outbox.retain("a", b"2")
    done()
    assert await drain(outbox) == [("a", b"2", True)]


async def test_reconnect_sends_all_state_again_and_bridge_state_last() -> None:
    outbox = Outbox(LIFE)
    for topic in ("z", LIFE, "a"):
        outbox.retain(topic, b"1")
    await drain(outbox)
    outbox.requeue_state()
    assert [topic for topic, _, _ in await drain(outbox)] == ["z", "a", LIFE]


async def test_streams_drop_the_oldest_and_count() -> None:
    outbox = Outbox(LIFE)
    for number in range(1000):
        outbox.stream("pose", str(number).encode())
    sent = await drain(outbox)
    assert len(sent) + outbox.dropped == 1000
    assert sent[-1][1] == b"999"
    assert [int(payload) for _, payload, _ in sent] == list(range(1000 - len(sent), 1000))


async def test_poses_do_not_displace_events() -> None:
    outbox = Outbox(LIFE)
    outbox.event("bridge/response/calibrate", b"answer")
    for _ in range(1000):
        outbox.stream("pose", b"")
    assert (await drain(outbox))[0][1] == b"answer"


async def test_reconnect_drops_and_counts_waiting_streams() -> None:
    outbox = Outbox(LIFE)
    outbox.stream("pose", b"old")
    outbox.event("event", b"kept")
    outbox.requeue_state()
    assert [payload for _, payload, _ in await drain(outbox)] == [b"kept"]
    assert outbox.dropped == 1


async def test_unacknowledged_responses_and_events_are_sent_again_in_order() -> None:
    outbox = Outbox(LIFE)
    for number in range(4):
        outbox.event("bridge/event", b"%d" % number)
    outbox.respond("bridge/response/calibrate", b"r")
    outbox.stream("pose", b"")
    given = [await outbox.next() for _ in range(6)]
    assert not outbox.queued
    assert outbox.has_unsent
    given[2][1]()  # event 1 is acknowledged before event 0 and the response
    outbox.event("bridge/event", b"4")
    outbox.requeue_state()
    assert [payload for _, payload, _ in await drain(outbox)] == [b"r", b"0", b"2", b"3", b"4"]
    assert outbox.dropped == 1  # the pose was dropped
    assert not outbox.has_unsent


async def test_outbox_is_not_empty_before_the_last_acknowledgement() -> None:
    outbox = Outbox(LIFE)
    outbox.retain("a", b"1")
    _, done = await outbox.next()
    assert outbox.has_unsent
    done()
    assert not outbox.has_unsent


async def test_cleared_topic_is_sent_empty_once() -> None:
    outbox = Outbox(LIFE)
    outbox.retain("device/S1/info", b"x")
    await drain(outbox)
    outbox.retain("device/S1/info", b"")
    assert await drain(outbox) == [("device/S1/info", b"", True)]
    outbox.requeue_state()
    assert await drain(outbox) == []


@given(actions)
async def test_every_message_is_sent_waiting_or_counted_as_dropped(
    script: list[tuple[str, str, bytes]],
) -> None:
    outbox, given_out, sent, wanted = Outbox(LIFE), 0, 0, {}
    for action, topic, payload in script:
        if action == "retain":
            wanted[topic] = payload
            outbox.retain(topic, payload)
        elif action == "reconnect":
            outbox.requeue_state()
        elif action not in {"send", "lose"}:
            given_out += 1
            getattr(outbox, action)(topic, payload)
        elif outbox.queued:
            message, done = await outbox.next()
            if action == "send":  # otherwise the message is never acknowledged
                done()
                sent += not message.retain
    at_broker = {}
    outbox.requeue_state()
    while outbox.queued:
        message, done = await outbox.next()
        done()
        sent += not message.retain
        if message.retain:
            at_broker[message.topic] = message.payload
    assert sent + outbox.dropped == given_out
    assert {topic: value for topic, value in wanted.items() if value} == {
        topic: value for topic, value in at_broker.items() if value
    }


async def test_responses_overtake_state_events_and_streams() -> None:
    outbox = Outbox(LIFE)
    outbox.stream("pose", b"")
    outbox.event("bridge/event", b"")
    outbox.retain("bridge/health", b"1")
    outbox.respond("bridge/response/calibrate", b"")
    order = [topic for topic, _, _ in await drain(outbox)]
    assert order == ["bridge/response/calibrate", "bridge/health", "bridge/event", "pose"]


async def test_expired_messages_are_dropped_and_counted() -> None:
    now = [0.0]
    outbox = Outbox(LIFE, lambda: now[0])
    outbox.event("bridge/event", b"old")
    outbox.stream("pose", b"old")
    now[0] = 31.0
    outbox.event("bridge/event", b"new")
    outbox.stream("pose", b"new")
    sent = [(await outbox.next())[0].payload for _ in range(2)]
    assert sent == [b"new", b"new"]
    assert outbox.dropped == 2
