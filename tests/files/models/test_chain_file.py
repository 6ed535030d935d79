"""Chain models are written to TOML and JSON and read back; all faults of a file are reported."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jointfit_daemon.files.models import read_model, write_model
from jointfit_daemon.files.text import MalformedFileError
from jointfit_daemon.kinematics.chains import ChainModel, Joint, Marker, Segment

if TYPE_CHECKING:
    from pathlib import Path

numbers = st.floats(-10.0, 10.0)
vectors = st.tuples(numbers, numbers, numbers)
words = st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=12)
unit = st.sampled_from([(1.0, 0.0, 0.0), (0.6, 0.0, -0.8), (0.0, 1.0, 0.0)])
turns = st.sampled_from([(1.0, 0.0, 0.0, 0.0), (0.5, -0.5, 0.5, 0.5)])
limits = st.none() | st.sampled_from([(-1.0, 0.5), (0.0, 2.4)])
kinds = st.sampled_from(["ball", "hinge"])


@st.composite
def paths(draw: st.DrawFn) -> tuple[tuple[float, ...], ...]:
    amounts = sorted(draw(st.lists(numbers, min_size=4, max_size=6, unique=True)))
    return tuple((q, *draw(turns), *draw(vectors)) for q in amounts)


@st.composite
def models(draw: st.DrawFn) -> ChainModel:
    names = draw(st.lists(words, min_size=1, max_size=4, unique=True))
    segments = [Segment(names[0])]
    for above, name in pairwise(names):
        joint = st.builds(Joint, kinds, vectors, vectors, unit, turns, limits)
        coupled = st.builds(
            Joint, st.just("coupled"), vectors, vectors, limits=limits, path=paths()
        )
        segments.append(Segment(name, above, draw(joint | coupled)))
    lock = st.tuples(st.booleans(), st.booleans(), st.booleans())
    marker = st.builds(Marker, words, st.sampled_from(names), vectors, st.floats(0.0, 9.0), lock)
    markers = draw(st.lists(marker, max_size=5, unique_by=lambda m: m.name))
    return ChainModel(tuple(segments), tuple(markers), draw(words))


@given(model=models(), ending=st.sampled_from([".toml", ".json"]))
@settings(max_examples=60)
def test_model_file_round_trip(
    tmp_path_factory: pytest.TempPathFactory, model: ChainModel, ending: str
) -> None:
    path = tmp_path_factory.mktemp("models") / f"model{ending}"
    write_model(path, model)
    assert read_model(path) == model


def test_a_model_is_short_by_hand(tmp_path: Path) -> None:
    path = tmp_path / "knee.toml"
    path.write_text(
        """
        [[segment]]
        name = "thigh"
        [[segment]]
        name = "shank"
        parent = "thigh"
        joint = "hinge"
        center_in_parent = [0, 0, -0.41]
        [[marker]]
        name = "KNEE"
        segment = "thigh"
        position = [0.05, 0, -0.4]
        locked = "xz"
        """
    )
    model = read_model(path)
    assert model.name == "knee"
    assert [s.joint.kind for s in model.segments] == ["free", "hinge"]
    assert model.segments[1].joint.axis == (1.0, 0.0, 0.0)
    assert model.markers[0].locked == (True, False, True)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("segment = 3", "segment must be a list"),
        ("[[segment]]\nname = 'a'\ncentre = [0, 0, 0]", "did you mean 'center'"),
        ("[[segment]]\nname = 'a'\njoint = 'pin'", "'pin', expected free, ball, hinge"),
        ("[[segment]]\nname = 'a'\naxis = [1, 0]", "axis must be 3 numbers"),
        ("[[segment]]\nname = 'a'\njoint = ['hinge']", "joint must be text"),
        ("[[segment]]\nname = 'a'\n[[marker]]\nname = 'm'", "needs a segment.*needs a position"),
        (
            "[[segment]]\nname = 'a'\n[[marker]]\nname = 'm'\nsegment = 'a'\n"
            "position = [0, 0, true]\nlocked = 'w'\nweight = 'much'",
            "position must be 3 numbers.*locked names axes.*weight must be a number",
        ),
        ("[[segment]]\nname = 'a'\nparent = 'b'", "'b' is unknown"),
        ("name = ", "m.toml: "),
        ("name = 3\n[[segment]]\nname = 'a'", "the model: name must be text"),
        (
            "[[segment]]\nname = 'a'\n[[marker]]\nname = 'm'\nsegment = 'a'\n"
            "position = [12.0, -85.0, 3.0]",
            "marker 'm' is 85 m away.*is the file in millimetres",
        ),
        (
            "[[segment]]\nname = 'a'\n[[segment]]\nname = 'b'\nparent = 'a'\n"
            "center_in_parent = [0, 0, -410]",
            "center of 'b' in its parent is 410 m away",
        ),
    ],
)
def test_all_errors_are_reported(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "m.toml").write_text(text)
    with pytest.raises(MalformedFileError, match=said):
        read_model(tmp_path / "m.toml")


def test_json_other_than_a_table_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "m.json").write_text("[1, 2]")
    with pytest.raises(MalformedFileError, match="expected a table"):
        read_model(tmp_path / "m.json")


def test_a_path_in_millimetres_is_refused(tmp_path: Path) -> None:
    path = tuple((float(q), 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, -20.0 * q) for q in range(4))
    shank = Segment("shank", "thigh", Joint("coupled", path=path))
    write_model(tmp_path / "m.toml", ChainModel((Segment("thigh"), shank), ()))
    with pytest.raises(MalformedFileError, match="path of 'shank' at 3 is 60 m away"):
        read_model(tmp_path / "m.toml")


def test_samples_of_other_lengths_are_named(tmp_path: Path) -> None:
    path = tmp_path / "m.toml"
    path.write_text('[[segment]]\nname = "a"\njoint = "coupled"\npath = [[0, 1, 0, 0, 0]]\n')
    with pytest.raises(MalformedFileError, match="path must be a list of samples, 8 numbers each"):
        read_model(path)


def test_file_of_another_kind_is_no_model(tmp_path: Path) -> None:
    with pytest.raises(MalformedFileError, match=r"squats\.trc: no chain model: expected a \.osim"):
        read_model(tmp_path / "squats.trc")
