"""A chain model that differs from the rig is refused with its differences."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.config import ConfigError, load_rig, parse_rig
from jointfit_daemon.files.models import as_data, model_of, write_model
from jointfit_daemon.limb_model import RefinedChain, chain_fingerprint
from jointfit_daemon.pipeline import Core
from jointfit_daemon.pipeline._optical_trackers import chain_tracker
from jointfit_daemon.pipeline.events import Configured, Notice, NoticeLevel
from tests.limb_model.plain_calibration import plain_calibration

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.pipeline.events import Output

Table = dict[str, Any]


def model() -> Table:
    """Return a leg of two segments, three markers each."""
    return {
        "name": "leg",
        "segment": [
            {"name": "femur"},
            {"name": "tibia", "parent": "femur", "joint": "hinge"},
        ],
        "marker": [
            {"name": f"{letter}{k}", "segment": segment, "position": [0.1 * k, 0.0, -0.1]}
            for letter, segment in (("T", "femur"), ("C", "tibia"))
            for k in (1, 2, 3)
        ],
    }


@pytest.fixture
def rig(table: Table) -> Table:
    """Return a rig with the chain model of the fixture `model`."""
    table["mocap"]["markers"] = {"thigh": ["T1", "T2", "T3"], "shank": ["C1", "C2", "C3"]}
    table["chain"]["model"] = model()
    return table


def refusals(table: Table) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        parse_rig(table)
    return [fault.text() for fault in caught.value.faults]


RIG = """
[rig]
name = "bench-1"
[chain]
joints = ["hip", "knee", "ankle"]
segments = ["thigh", "shank"]
model = "there/leg.json"
[[imu]]
id = "S1"
segment = "thigh"
driver = "fake"
port = "/dev/nowhere-1"
[[imu]]
id = "S2"
segment = "shank"
driver = "fake"
port = "/dev/nowhere-2"
[mocap]
driver = "fakemocap"
markers.thigh = ["T1", "T2", "T3"]
markers.shank = ["C1", "C2", "C3"]
"""


def test_model_is_read_from_a_file_beside_the_rig(fakes: object, tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    write_model(tmp_path / "there" / "leg.json", model_of(model(), "test"))
    path = tmp_path / "rig.toml"
    path.write_text(RIG)
    loaded = load_rig(path)
    assert loaded.chain_model is not None
    assert loaded.chain_model.chain.marker_names == ("T1", "T2", "T3", "C1", "C2", "C3")
    names = [name for one in loaded.chain_model.coordinates for name in one.names]
    assert names[-1] == "tibia_angle"

    # the table contains the content of the model file, so a replay needs only the recording
    assert loaded.table["chain"]["model"] == as_data(loaded.chain_model.chain)
    again = parse_rig(loaded.table)
    assert again.chain_model is not None
    assert again.chain_model.chain == loaded.chain_model.chain


def test_rig_without_a_model_has_none(table: Table) -> None:
    assert parse_rig(table).chain_model is None


def test_missing_and_damaged_files_are_reported(rig: Table, tmp_path: Path) -> None:
    rig["chain"]["model"] = str(tmp_path / "no.osim")
    assert "cannot be read" in refusals(rig)[0]
    (tmp_path / "bad.toml").write_text("segment = 3")
    rig["chain"]["model"] = str(tmp_path / "bad.toml")
    assert "segment must be a list of tables" in refusals(rig)[0]
    rig["chain"]["model"] = 7
    assert refusals(rig) == [
        "chain.model = 7: expected the name of a file (chain model for inverse kinematics from the "
        "markers: an OpenSim model or a TOML or JSON file, relative to the folder of rig.toml, or "
        "a table with the same keys)"
    ]


def test_markers_that_the_rig_lacks_are_named(rig: Table) -> None:
    rig["chain"]["model"]["marker"].append(
        {"name": "T4", "segment": "femur", "position": [0, 0, 0]}
    )
    (text,) = refusals(rig)
    assert "has markers that are not in mocap.markers: T4; add them there, or remove" in text


def test_marker_on_another_segment_is_named(rig: Table) -> None:
    rig["chain"]["model"]["marker"][1]["segment"] = "tibia"
    (text,) = refusals(rig)
    assert text.startswith("mocap.markers.thigh: chain.model has T2 on 'tibia'")
    assert "on 'femur': correct the segment of T2 in the model" in text


def test_parts_of_other_names_are_reported(rig: Table) -> None:
    for marker in rig["chain"]["model"]["marker"][:3]:
        marker["name"] = f"L{marker['name']}"
    texts = refusals(rig)
    assert any("LT1, LT2, LT3; add them there" in text for text in texts)
    assert any("none of these markers is in chain.model, which has LT1" in text for text in texts)


def test_parts_on_one_segment_are_reported(rig: Table) -> None:
    for marker in rig["chain"]["model"]["marker"]:
        marker["segment"] = "femur"
    texts = refusals(rig)
    assert any("on 'femur', like those of 'thigh'" in text for text in texts)
    assert any("segments without markers on them or below them: tibia" in text for text in texts)


def test_segments_without_a_joint_between_them_are_reported(rig: Table) -> None:
    del rig["chain"]["model"]["segment"][1]["parent"], rig["chain"]["model"]["segment"][1]["joint"]
    (text,) = refusals(rig)
    assert "no joint between 'femur' (part 'thigh' of the rig) and 'tibia' (part 'shank')" in text


def test_intermediate_segments_without_markers_are_allowed(rig: Table) -> None:
    segments = rig["chain"]["model"]["segment"]
    segments.insert(1, {"name": "patella", "parent": "femur", "joint": "hinge"})
    segments[2]["parent"] = "patella"
    assert parse_rig(rig).chain_model is not None


def test_rigid_bodies_and_missing_cameras_are_refused(rig: Table) -> None:
    rig["mocap"]["markers"] = {"thigh": ["T1", "T2", "T3"]}
    rig["mocap"]["rigid_body"] = {"shank": "Shank"}
    assert any("a rigid body does not suffice" in text for text in refusals(rig))
    del rig["mocap"]
    assert refusals(rig)[0] == ("chain.model: needs cameras, which track its markers: add [mocap]")


def test_markers_that_the_model_lacks_are_a_remark(rig: Table) -> None:
    rig["mocap"]["markers"]["thigh"].append("T9")
    loaded = parse_rig(rig).chain_model
    assert loaded is not None
    assert loaded.remarks == ("not in the model, so not tracked by it: T9",)


def test_options_of_the_refinement_are_those_of_the_command(rig: Table) -> None:
    rig["calibration"] = {
        "chain_refinement": {
            "method": "block", "prior": 0.1, "weights": {"T1": 0.5}, "lock": ["C1", "C2.x"],
            "holdout": 0.2, "frames": 80, "limit_s": 30,
        }
    }  # fmt: skip
    refinement = parse_rig(rig).calibration.chain_refinement
    assert refinement is not None
    settings = refinement.settings
    assert (settings.method, settings.prior, settings.frames) == ("block", 0.1, 80)
    assert settings.holdout_share == 0.2
    assert refinement.limit_s == 30.0
    of = {m.name: m for m in refinement.model.markers}
    assert of["T1"].weight == 0.5
    assert of["C1"].locked == (True, True, True)
    assert of["C2"].locked == (True, False, False)


def test_steps_of_the_search_are_options(rig: Table) -> None:
    options = {"method": "search", "first_step_mm": 5, "threshold_mm": 1}
    rig["calibration"] = {"chain_refinement": options}
    refinement = parse_rig(rig).calibration.chain_refinement
    assert refinement is not None
    assert refinement.settings.method == "search"
    search = refinement.settings.search
    assert (search.first_step_m, search.threshold_m) == (0.005, 0.001)


def test_weights_of_a_file_replace_its_name(rig: Table, tmp_path: Path) -> None:
    path = tmp_path / "weights.toml"
    path.write_text("T1 = 0.25")
    rig["calibration"] = {"chain_refinement": {"weights": str(path)}}
    loaded = parse_rig(rig)
    assert loaded.table["calibration"]["chain_refinement"]["weights"] == {"T1": 0.25}
    assert loaded.calibration.chain_refinement is not None
    assert loaded.calibration.chain_refinement.model.markers[0].weight == 0.25


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"lock": ["T9"]}, "chain_refinement.lock = ['T9']: marker T9: unknown marker; did you"),
        ({"unlock": ["Q"]}, "unknown marker; there are: T1, T2, T3, C1, C2, C3"),
        ({"weights": {"T9": 1.0}}, "marker T9: unknown marker; did you mean"),
        ({"weights": {"T1": -1.0}}, "weight of T1: expected a number of 0 or more"),
        ({"weights": "nowhere.toml"}, "nowhere.toml: no such file: check the path"),
        (
            {"method": "search", "threshold_mm": 9.0},
            "threshold_mm = 9.0: expected first_step_mm = 8 or less",
        ),
        (
            {"method": "search", "prior": 0.05},
            "chain_refinement.prior = 0.05: method search does not use this key: remove it, or use"
            " method joint or block",
        ),
        ({"method": "search", "holdout": 0.2}, "holdout = 0.2: method search does not use this"),
        ({"first_step_mm": 8.0}, "first_step_mm = 8.0: method joint does not use this key: remove"),
        ({"method": "block", "threshold_mm": 2.0}, "threshold_mm = 2.0: method block does not use"),
        ({"method": "search", "cost": "l1"}, "method search has no loss function"),
        ({"method": "serach"}, "did you mean 'search'?"),
        ({"frames": 5}, "chain_refinement.frames = 5: should be greater than or equal to 10"),
        ({"limit_s": 999}, "chain_refinement.limit_s = 999: should be less than or equal to 200"),
        ({"first_step": 8}, "did you mean 'first_step_mm'?"),
    ],
)
def test_faulty_options_of_the_refinement_are_named(
    rig: Table, options: Table, message: str
) -> None:
    rig["calibration"] = {"chain_refinement": options}
    (text,) = refusals(rig)
    assert message in text


@pytest.mark.parametrize("other", [{"static_s": 500}, {"chain_refinement": {"frames": 5}}])
def test_another_fault_of_the_calibration_hides_none_of_its_refinement(
    rig: Table, other: Table
) -> None:
    options = {"lock": ["T9"], "weights": {"C9": 1.0}, **other.get("chain_refinement", {})}
    rig["calibration"] = other | {"chain_refinement": options}
    found = "\n".join(refusals(rig))
    assert "marker T9: unknown marker" in found
    assert "marker C9: unknown marker" in found
    assert ("static_s = 500" if "static_s" in other else "frames = 5") in found


def test_another_fault_adds_no_key_that_the_method_does_not_use(rig: Table) -> None:
    """The default values of absent keys are no contradictions to the method."""
    rig["calibration"] = {"static_s": 500, "chain_refinement": {"method": "search"}}
    (text,) = refusals(rig)
    assert "static_s = 500" in text


def test_refinement_without_a_chain_model_is_refused(rig: Table) -> None:
    del rig["chain"]["model"]
    rig["calibration"] = {"chain_refinement": {"frames": 80}}
    (text,) = refusals(rig)
    assert text.startswith("calibration.chain_refinement: needs a chain model: add [chain] model")


def test_live_model_has_the_refined_markers_of_the_same_model_only(rig: Table) -> None:
    loaded = parse_rig(rig)
    assert loaded.chain_model is not None
    model = loaded.chain_model.chain
    chain = RefinedChain("leg", chain_fingerprint(model), {"T1": (0.2, 0.0, 0.0)})
    calibration = replace(plain_calibration(loaded.chain), chain=chain)
    tracker = chain_tracker(loaded, calibration, None)
    assert tracker is not None
    assert tracker.loaded.chain.markers[0].position == (0.2, 0.0, 0.0)
    assert tracker.loaded.chain.markers[1:] == model.markers[1:]
    assert chain_tracker(loaded, calibration, tracker) is tracker  # so its marker monitor continues

    core = Core()
    assert not [one for one in core.feed(Configured(0, loaded, calibration)) if warned(one)]
    other = replace(calibration, chain=replace(chain, fingerprint="another"))
    plain = chain_tracker(loaded, other, tracker)
    assert plain is not None
    assert plain.loaded == loaded.chain_model
    (warning,) = [one for one in core.feed(Configured(1, loaded, other)) if warned(one)]
    assert isinstance(warning, Notice)
    assert "refined markers of another version of the chain model ('leg')" in warning.text


def warned(output: Output) -> bool:
    return isinstance(output, Notice) and output.level == NoticeLevel.WARNING
