"""`jointfit ik` recovers the coordinates of simulated trials, and refuses unsuitable trials."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import orjson
import pytest
from typer.testing import CliRunner

from jointfit_daemon.files.axes import from_z_up
from jointfit_daemon.files.mocap import MarkerTrajectories, read_trc, write_trc
from jointfit_daemon.files.models import read_osim, write_model
from jointfit_daemon.files.orientations import TimeTable, read_sto
from jointfit_daemon.kinematics.chains import marker_positions
from jointfit_daemon.tools.__main__ import app
from tests.files.models.osim_writer import LINEAR, ZERO, Hung, write_osim
from tests.kinematics.test_chain_coordinates import state_of

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.arrays import Array

run = CliRunner().invoke
X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
ROOT = Hung(
    "pelvis", "ground", "FreeJoint", [(n, -9.0, 9.0) for n in ("a", "b", "c", "x", "y", "z")]
)
HIP = Hung(
    "femur",
    "pelvis",
    "CustomJoint",
    [("flexion", -2.0, 2.0), ("adduction", -1.0, 1.0), ("turn", -1.0, 1.0)],
    ((-0.07, -0.06, 0.08), (0, 0, 0)),
    axes=[
        *(("flexion", Z, LINEAR), ("adduction", X, LINEAR), ("turn", Y, LINEAR)),
        *(("", axis, ZERO) for axis in (X, Y, Z)),
    ],
)  # fmt: skip
KNEE = Hung(
    "tibia", "femur", "PinJoint", [("knee", -2.2, 0.2)], ((0, -0.4, 0), (0, 0, 0)),
)  # fmt: skip
NAMES = ("a", "b", "c", "x", "y", "z", "flexion", "adduction", "turn", "knee")
MARKERS = [
    (f"{body}{k}", body, tuple(np.random.default_rng(9 + k).normal(0, 0.1, 3).tolist()), False)
    for body in ("pelvis", "femur", "tibia")
    for k in range(4)
]
FRAMES = 40


def truth() -> Array:
    """Return coordinates of a movement, rad and m, shape (T, 10)."""
    t = np.linspace(0.0, 3.0, FRAMES)[:, None]
    values = 0.5 * np.sin(t + np.linspace(0.0, 3.0, len(NAMES)))
    values[:, -1] = -1.0 + 0.8 * np.sin(2.0 * t[:, 0])
    return values


def write_trial(folder: Path, change: Any = None, name: str = "walk.trc") -> Path:
    """Write the markers of the movement, y up; `change` modifies the positions (T, M, 3)."""
    read = read_osim(folder / "leg.osim")
    y = from_z_up(marker_positions(read.model, state_of(read.model, read.coordinates, truth())))
    y = y if change is None else change(y)
    t_s, count = np.arange(len(y)) / 50.0, np.arange(1, len(y) + 1)
    write_trc(folder / name, MarkerTrajectories(read.model.marker_names, t_s, count, y, 50.0))
    return folder / name


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_osim(tmp_path / "leg.osim", [ROOT, HIP, KNEE], MARKERS)
    write_trial(tmp_path)
    return tmp_path


def asked(folder: Path, *options: str) -> list[str]:
    return ["ik", str(folder / "walk.trc"), str(folder / "leg.osim"), *options]


def table(folder: Path, *options: str) -> TimeTable:
    result = run(app, asked(folder, "--out", str(folder / "out.mot"), *options))
    assert result.exit_code == 0, result.stderr
    return read_sto(folder / "out.mot")


def answer(folder: Path, *options: str) -> dict[str, Any]:
    result = run(app, asked(folder, "--json", *options))
    assert result.exit_code == 0, result.stderr
    found: dict[str, Any] = orjson.loads(result.stdout)
    return found


def fault(words: list[str]) -> tuple[int, str]:
    result = run(app, words)
    assert result.exception is None or isinstance(result.exception, SystemExit)
    return result.exit_code, result.stderr


def units(values: Array) -> Array:
    """Return coordinates with angles in degrees and translations in metres."""
    angle = np.array([name not in "xyz" for name in NAMES])
    return np.where(angle, np.degrees(values), values)


def test_coordinates_of_a_simulated_trial_are_recovered(folder: Path) -> None:
    found = table(folder)
    assert found.columns == NAMES
    assert (found.name, found.in_degrees, found.warnings) == ("Coordinates", True, ())
    np.testing.assert_allclose(found.values, units(truth()), atol=1e-4)
    np.testing.assert_allclose(found.t_s, np.arange(FRAMES) / 50.0)


def test_a_missing_marker_is_reported_with_a_similar_label(folder: Path) -> None:
    path = folder / "walk.trc"
    name = read_osim(folder / "leg.osim").model.marker_names[-1]
    path.write_text(path.read_text().replace(f"\t{name}\t", f"\t{name}2\t"))
    notes = " ".join(answer(folder)["notes"])
    assert f"not in the trial: {name}; {name}: did you mean '{name}2'?" in notes


def test_angles_are_in_radians_on_request(folder: Path) -> None:
    found = table(folder, "--radians")
    assert not found.in_degrees
    np.testing.assert_allclose(found.values, truth(), atol=1e-6)


def test_a_model_without_coordinate_names_names_them_by_segment(folder: Path) -> None:
    model = read_osim(folder / "leg.osim").model
    write_model(folder / "leg.toml", model)
    out = folder / "out.csv"
    result = run(app, ["ik", str(folder / "walk.trc"), str(folder / "leg.toml"), "--out", str(out)])
    assert result.exit_code == 0, result.stderr
    head, *rows = out.read_text().splitlines()
    assert head.split(",")[:5] == ["time", "pelvis_rx", "pelvis_ry", "pelvis_rz", "pelvis_tx"]
    assert head.split(",")[-1] == "tibia_angle"
    knee = [float(row.split(",")[-1]) for row in rows]
    np.testing.assert_allclose(knee, np.degrees(truth()[:, -1]), atol=1e-4)


def test_opensim_reads_the_coordinates(folder: Path) -> None:
    opensim = pytest.importorskip("opensim", reason="opensim is not installed")
    opensim.Logger.setLevelString("off")
    table(folder)
    read = opensim.TimeSeriesTable(str(folder / "out.mot"))
    assert tuple(read.getColumnLabels()) == NAMES
    assert read.getNumRows() == FRAMES
    assert read.getTableMetaDataString("inDegrees") == "yes"


def test_opensim_places_the_markers_where_they_were_measured(folder: Path) -> None:
    opensim = pytest.importorskip("opensim", reason="opensim is not installed")
    opensim.Logger.setLevelString("off")
    values = table(folder, "--radians").values[7]
    model = opensim.Model(str(folder / "leg.osim"))
    state = model.initSystem()
    for name, value in zip(NAMES, values, strict=True):
        model.getCoordinateSet().get(name).setValue(state, float(value), False)
    model.realizePosition(state)
    trial = read_trc(folder / "walk.trc")
    for k, name in enumerate(trial.names):
        placed = model.getMarkerSet().get(name).getLocationInGround(state).to_numpy()
        np.testing.assert_allclose(placed, trial.positions[7, k], atol=1e-6)


def test_standard_deviations_describe_the_errors(folder: Path) -> None:
    noise = np.random.default_rng(4)
    write_trial(folder, lambda y: y + noise.normal(0.0, 0.004, y.shape))
    found = table(folder, "--sd")
    assert found.columns == (*NAMES, *(f"{name}_sd" for name in NAMES))
    ratio = (found.values[:, :10] - units(truth())) / found.values[:, 10:]
    assert 0.8 < np.sqrt(np.mean(ratio**2)) < 1.2


def test_marker_errors_are_reported_by_frame_and_marker(folder: Path) -> None:
    def moved(y: Array) -> Array:
        y[5, 1] += (0.0, 0.06, 0.0)
        return y

    write_trial(folder, moved)
    found = answer(folder, "--errors", str(folder / "errors.sto"))
    assert found["markers"][1]["maximum_at_s"] == pytest.approx(0.1)
    assert found["maximum_m"] == pytest.approx(found["markers"][1]["maximum_m"])
    assert found["accepted"]["within"] is (found["maximum_m"] < 0.04)
    errors = read_sto(folder / "errors.sto")
    assert errors.columns == ("total_squared_error", "marker_error_RMS", "marker_error_max")
    assert errors.column("marker_error_max").argmax() == 5
    assert errors.column("marker_error_max")[5] == pytest.approx(found["maximum_m"])
    square = errors.column("total_squared_error")
    np.testing.assert_allclose(errors.column("marker_error_RMS"), np.sqrt(square / 12), rtol=1e-6)


def test_errors_above_the_accepted_limits_are_marked(folder: Path) -> None:
    shifts = np.random.default_rng(2).normal(0.0, 0.02, (1, len(MARKERS), 3))
    write_trial(folder, lambda y: y + shifts)
    text = run(app, asked(folder)).stdout
    assert "ABOVE 20 mm" in text
    assert "OpenSim best practices" in text
    assert "nan" not in text


def test_weights_from_options_and_set_up_files_decide_the_fit(folder: Path) -> None:
    def moved(y: Array) -> Array:
        y[:, 11] += (0.03, 0.0, 0.02)
        return y

    write_trial(folder, moved)
    errors = [
        np.abs(table(folder, *options).values - units(truth())).max()
        for options in ((), ("--weight", "tibia3=0.01"), ("--without", "tibia3"))
    ]
    assert errors[0] > 1.0 > errors[1] > errors[2]

    tasks = "".join(
        f"<IKMarkerTask name='{name}'><apply>{'false' if name == 'tibia3' else 'true'}</apply>"
        "<weight>2</weight></IKMarkerTask>"
        for name, *_ in MARKERS
    )
    (folder / "setup.xml").write_text(
        "<OpenSimDocument Version='40000'><InverseKinematicsTool name='t'><IKTaskSet><objects>"
        f"{tasks}</objects></IKTaskSet><time_range>0.2 0.4</time_range></InverseKinematicsTool>"
        "</OpenSimDocument>"
    )
    found = table(folder, "--setup", str(folder / "setup.xml"))
    np.testing.assert_allclose(found.t_s[[0, -1]], [0.2, 0.4])
    np.testing.assert_allclose(found.values, units(truth())[10:21], atol=1e-4)


def test_only_the_frames_of_the_time_range_are_solved(folder: Path) -> None:
    found = table(folder, "--start", "0.1", "--end", "0.3")
    np.testing.assert_allclose(found.t_s, np.arange(5, 16) / 50.0)


def test_unknown_coordinates_are_left_out_of_opensim_files_and_empty_in_csv(folder: Path) -> None:
    def hidden(y: Array) -> Array:
        y[3, 8:] = np.nan  # hide the shank
        y[4] = np.nan
        return y

    write_trial(folder, hidden)
    out = folder / "out.csv"
    found = table(folder, "--out", str(out))
    assert 3 / 50.0 not in found.t_s.tolist()
    assert len(found.t_s) == FRAMES - 2
    rows = [line.split(",") for line in out.read_text().splitlines()[1:]]
    assert len(rows) == FRAMES
    assert (rows[3][-1], rows[4][1:]) == ("", [""] * 10)
    assert float(rows[3][7]) == pytest.approx(np.degrees(truth()[3, 6]), abs=0.05)
    found_json = answer(folder)
    assert (found_json["without_solution"], found_json["with_unknown_coordinates"]) == (1, 1)


def test_a_coordinate_known_in_few_frames_does_not_empty_the_table(folder: Path) -> None:
    def hidden(y: Array) -> Array:
        y[1:, 8:] = np.nan  # hide the shank, except in the first frame
        y[25:] = np.nan
        return y

    write_trial(folder, hidden)
    out = folder / "out.sto"
    notes = answer(folder, "--out", str(out))["notes"]
    found = read_sto(out)
    assert found.columns == NAMES[:-1]
    assert np.isfinite(found.values).all()
    np.testing.assert_allclose(found.t_s, np.arange(25) / 50.0)
    assert (
        "out.sto: left out, because they are known in less than half of the frames: knee" in notes
    )
    assert "out.sto: 25 of 40 frames written, the others have unknown values" in notes


def test_a_table_without_a_complete_frame_is_a_failure(folder: Path) -> None:
    def hidden(y: Array) -> Array:
        y[::2, 8:] = np.nan  # hide the shank
        y[1::2, :4] = np.nan  # hide the pelvis
        return y

    write_trial(folder, hidden)
    out = [folder / "out.mot", folder / "out.csv"]
    code, text = fault(asked(folder, *(word for path in out for word in ("--out", str(path)))))
    assert code == 1
    assert "out.mot: 0 of 40 frames written" in text
    assert f"wrote {out[1]}" in text
    assert [path.exists() for path in out] == [False, True]


def test_a_trial_with_other_markers_is_refused_with_both_lists(folder: Path) -> None:
    trial = read_trc(folder / "walk.trc")
    names = tuple(f"other{k}" for k in range(len(trial.names)))
    write_trc(
        folder / "walk.trc",
        MarkerTrajectories(names, trial.t_s, trial.frames, trial.positions, 50.0),
    )
    code, text = fault(asked(folder))
    assert code == 1
    assert "found other0" in text
    assert "expected pelvis0" in text
    assert "rename" in text


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda y: y * 1000.0, "length unit"),
        (lambda y: 1.5 * y, "scale the model"),
        (lambda y: np.where(np.arange(12)[:, None] < 2, y, np.nan), "check their names"),
        (lambda y: y[:, [8, 9, 10, 11, 4, 5, 6, 7, 0, 1, 2, 3]], "check labels"),
    ],
)
def test_a_trial_that_does_not_fit_the_model_is_refused(
    folder: Path, change: Any, words: str
) -> None:
    write_trial(folder, change)
    code, text = fault(asked(folder))
    assert code == 1
    assert "walk" in text
    assert words in text


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--start", "9"), "the trial lasts from 0 to 0.78 s"),
        (("--weight", "tibia3"), "NAME=NUMBER"),
        (("--weight", "tibia3=-1"), "at least 0"),
        (("--weight", "tibia9=1"), "did you mean 'tibia"),
        (("--without", "tibia9"), "did you mean 'tibia"),
        (("--out", "result.txt"), ".mot, .sto or .csv"),
        (("--up", "w"), "expected x, y or z"),
    ],
)
def test_bad_options_name_the_remedy(folder: Path, options: tuple[str, ...], words: str) -> None:
    code, text = fault(asked(folder, *options))
    assert code == 2
    assert words in text


def test_a_trial_without_frames_and_a_set_up_without_tasks_are_invalid_files(folder: Path) -> None:
    head = (folder / "walk.trc").read_text().splitlines()[:6]
    (folder / "empty.trc").write_text("\n".join(head) + "\n")
    code, text = fault(["ik", str(folder / "empty.trc"), str(folder / "leg.osim")])
    assert (code, "export the trial again" in text) == (2, True)
    code, text = fault(asked(folder, "--setup", str(folder / "leg.osim")))
    assert (code, "no IKMarkerTask" in text) == (2, True)
