"""Decoding with the layout of an earlier frame returns the result of `decode`, or None."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from jointfit_protocols.natnet import FrameLayout, FrameOfData, decode, encode
from tests.protocols.natnet.test_natnet_messages import frames


@given(pair=frames(), data=st.data())
def test_frame_by_layout_equals_the_decoded_one_for_any_changed_byte(
    pair: tuple[FrameOfData, tuple[int, int]], data: st.DataObject
) -> None:
    frame, version = pair
    datagram = encode(frame._replace(skeletons=(), assets=(), force_plates=(), devices=()), version)
    decoded = decode(datagram, version)
    assert isinstance(decoded, FrameOfData)
    layout = FrameLayout.of(datagram, decoded, version)
    assert layout is not None
    assert layout.read(datagram) == decoded

    changed = bytearray(datagram)
    changed[data.draw(st.integers(0, len(datagram) - 1))] ^= data.draw(st.integers(1, 255))
    found = layout.read(bytes(changed))
    # compare texts, because NaN is not equal to NaN
    assert found is None or repr(found) == repr(decode(bytes(changed), version))


@given(pair=frames(), data=st.data())
def test_a_layout_for_selected_sets_leaves_out_the_others_and_nothing_else(
    pair: tuple[FrameOfData, tuple[int, int]], data: st.DataObject
) -> None:
    frame, version = pair
    datagram = encode(frame._replace(skeletons=(), assets=(), force_plates=(), devices=()), version)
    decoded = decode(datagram, version)
    assert isinstance(decoded, FrameOfData)
    names = sorted({each.name for each in decoded.marker_sets})
    selected = frozenset(data.draw(st.lists(st.sampled_from(names)) if names else st.just([])))
    layout = FrameLayout.of(datagram, decoded, version, selected)
    assert layout is not None
    sets = tuple(each for each in decoded.marker_sets if each.name in selected)
    assert layout.read(datagram) == decoded._replace(marker_sets=sets, other_markers=())

    changed = bytearray(datagram)
    changed[data.draw(st.integers(0, len(datagram) - 1))] ^= data.draw(st.integers(1, 255))
    found = layout.read(bytes(changed))
    # If the layout still fits, the result is that of `decode` without the other sets.
    if found is not None:
        whole = decode(bytes(changed), version)
        assert isinstance(whole, FrameOfData)
        sets = tuple(each for each in whole.marker_sets if each.name in selected)
        assert repr(found) == repr(whole._replace(marker_sets=sets, other_markers=()))


@given(pair=frames())
def test_frame_with_items_of_variable_size_has_no_layout(
    pair: tuple[FrameOfData, tuple[int, int]],
) -> None:
    frame, version = pair
    datagram = encode(frame, version)
    decoded = decode(datagram, version)
    assert isinstance(decoded, FrameOfData)
    layout = FrameLayout.of(datagram, decoded, version)
    variable = decoded.skeletons + decoded.assets + decoded.force_plates + decoded.devices
    assert (layout is None) == bool(variable)
