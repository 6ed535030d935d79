"""Suggestions for misspelt names: similarity, case, and the sentence in error messages."""

from __future__ import annotations

import pytest

from jointfit_daemon.nearest_name import (
    did_you_mean,
    nearest_key,
    nearest_name,
    nearest_names,
    unknown_name,
)

SEGMENTS = ("thigh", "shank", "foot")


@pytest.mark.parametrize(
    ("name", "nearest"),
    [("tigh", "thigh"), ("SHANK", "shank"), ("shnak", "shank"), ("zzz", None), (5, None)],
)
def test_nearest_name_ignores_case_and_rejects_dissimilar_names(
    name: object, nearest: str | None
) -> None:
    assert nearest_name(name, SEGMENTS) == nearest


def test_nearest_name_does_not_suggest_the_name_itself() -> None:
    assert nearest_name("foot", SEGMENTS) is None


def test_nearest_names_are_ordered_by_similarity() -> None:
    assert nearest_names("LKNE1", ["LKNEE", "LKNE", "RANK"], count=2) == ["LKNE", "LKNEE"]


def test_a_short_name_resembles_names_with_its_first_character_only() -> None:
    assert nearest_name("T5", ["R5", "C5"]) is None
    assert nearest_name("T5", ["R5", "T4"]) == "T4"
    assert nearest_name("5T", ["T5"]) == "T5"


def test_did_you_mean_quotes_suggestions_and_is_empty_without_any() -> None:
    assert did_you_mean("tigh", SEGMENTS) == "did you mean 'thigh'?"
    assert did_you_mean("T9", ["T1", "T2"], count=2) == "did you mean 'T2' or 'T1'?"
    assert did_you_mean("zzz", SEGMENTS) == ""


def test_unknown_name_lists_all_names_and_suggests_candidates_only() -> None:
    assert unknown_name("driver", "zzz", ()) == "no driver 'zzz'; known: none"
    text = unknown_name("sensor", "s3", ["s1", "s2"], candidates=["s2"])
    assert text == "no sensor 's3'; did you mean 's2'? known: s1, s2"


SERIAL = ("id", "segment", "driver", "rate_hz", "silence_s", "port", "baud")
MOCAP = ("driver", "server", "command_port", "up_axis", "markers", "rigid_body")
BROKER = ("host", "port", "username", "password_file")


@pytest.mark.parametrize(
    ("key", "known", "meant"),
    [
        ("serial", SERIAL, "port"),
        ("device", SERIAL, "port"),
        ("baudrate", SERIAL, "baud"),
        ("baud-rate", SERIAL, "baud"),
        ("Rate", SERIAL, "rate_hz"),
        ("sampling_rate", SERIAL, "rate_hz"),
        ("name", SERIAL, "id"),
        ("rateHz", SERIAL, "rate_hz"),
        ("host", MOCAP, "server"),
        ("address", MOCAP, "server"),
        ("rigid_bodies", MOCAP, "rigid_body"),
        ("server", BROKER, "host"),
        ("address", BROKER, "host"),
        ("marker", MOCAP, "markers"),
        ("zzz", SERIAL, None),
    ],
)
def test_another_word_for_a_key_leads_to_the_key_of_the_table(
    key: str, known: tuple[str, ...], meant: str | None
) -> None:
    assert nearest_key(key, known) == meant
