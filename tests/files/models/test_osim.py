"""OpenSim models become chain models with the same motion; faults and differences are reported."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from jointfit_daemon.files.axes import from_z_up, to_z_up
from jointfit_daemon.files.models import read_osim
from jointfit_daemon.files.text import MalformedFileError
from jointfit_daemon.kinematics.chains import apply_step, marker_positions, rest_state
from jointfit_daemon.kinematics.inverse_kinematics import solve_frames, tracking_error
from tests.files.models.osim_writer import LINEAR, ZERO, Hung, spline, write_osim
from tests.kinematics.chain_coordinates import coupled_coordinates, hinge_angles

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.kinematics.chains import ChainModel

X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
SIX = [(name, -10.0, 10.0) for name in ("rx", "ry", "rz", "tx", "ty", "tz")]
ROOT = Hung("pelvis", "ground", "FreeJoint", SIX)
HIP = Hung(
    "femur",
    "pelvis",
    "CustomJoint",
    [("hf", -2.0, 2.0), ("ha", -1.0, 1.0), ("hr", -1.0, 1.0)],
    ((-0.07, -0.06, 0.08), (0, 0, 0)),
    ((0.0, 0.01, 0.0), (0, 0, 0)),
    [
        ("hf", Z, LINEAR), ("ha", X, LINEAR), ("hr", Y, LINEAR), *[("", a, ZERO) for a in (X, Y, Z)]
    ],
)  # fmt: skip
KNEE = Hung(
    "tibia",
    "femur",
    "PinJoint",
    [("knee", -2.2, 0.2)],
    ((0.0, -0.4, 0.0), (0.3, -0.2, 0.4)),
    ((0.01, 0.02, 0.0), (0.1, 0.0, 0.4)),
)
MARKERS = [
    (
        f"{body}{k}",
        body,
        tuple(np.round(np.random.default_rng(k).normal(0, 0.1, 3), 4).tolist()),
        False,
    )
    for body in ("pelvis", "femur", "tibia")
    for k in range(4)
]
NAMES = ["hf", "ha", "hr", "knee"]


@pytest.fixture(scope="module")
def opensim() -> Any:
    """Return OpenSim's library, without output and log file."""
    library = pytest.importorskip("opensim", reason="opensim is not installed")
    library.Logger.removeFileSink()
    library.Logger.setLevelString("Off")
    return library


def moved(opensim: Any, path: Path, values: np.ndarray) -> tuple[list[str], np.ndarray]:
    """Return a model's marker positions from OpenSim, y up, for values of all coordinates."""
    model = opensim.Model(str(path))
    state = model.initSystem()
    markers = [model.getMarkerSet().get(i) for i in range(model.getMarkerSet().getSize())]
    rows = []
    for row in values:
        for i, value in enumerate(row):
            model.getCoordinateSet().get(i).setValue(state, float(value), False)
        model.realizePosition(state)
        rows.append([list(m.getLocationInGround(state).to_numpy()) for m in markers])
    return [m.getName() for m in markers], np.array(rows)


def test_a_chain_moves_its_markers_as_opensim_does(tmp_path: Path, opensim: Any) -> None:
    path = write_osim(tmp_path / "small.osim", [ROOT, HIP, KNEE], MARKERS)
    values = np.random.default_rng(0).uniform(-1.0, 1.0, (12, 10))
    values[:, 9] = np.linspace(-2.0, 0.1, 12)
    names, placed = moved(opensim, path, values)
    imported = read_osim(path)
    assert imported.remarks == ()
    assert list(imported.model.marker_names) == names
    found = solve_frames(imported.model, to_z_up(placed))
    assert tracking_error(found.residuals) < 1e-9
    np.testing.assert_allclose(
        hinge_angles(imported.model, found.state)["tibia"], values[:, 9], atol=1e-9
    )


def test_our_least_squares_are_those_of_opensim(tmp_path: Path, opensim: Any) -> None:
    """On noisy markers, the marker errors equal those of OpenSim's inverse kinematics."""
    path = write_osim(tmp_path / "small.osim", [ROOT, HIP, KNEE], MARKERS)
    phase = np.linspace(0.0, 1.0, 9)
    values = np.outer(phase, np.random.default_rng(1).uniform(-0.6, 0.6, 10))
    names, placed = moved(opensim, path, values)
    placed = placed + np.random.default_rng(2).normal(0.0, 0.008, placed.shape)
    theirs = _their_residuals(opensim, path, names, placed, tmp_path)
    found = solve_frames(read_osim(path).model, to_z_up(placed))
    ours = np.linalg.norm(found.residuals, axis=-1)
    rms = np.sqrt(np.mean(theirs**2))
    assert np.sqrt(np.mean(ours**2)) == pytest.approx(rms, rel=1e-4)
    np.testing.assert_allclose(ours, theirs, atol=5e-5)


def _their_residuals(
    opensim: Any, path: Path, names: list[str], placed: np.ndarray, folder: Path
) -> np.ndarray:
    """Return the marker distances after OpenSim's inverse kinematics, m, shape (T, M)."""
    rows = [
        "PathFileType\t4\t(X/Y/Z)\tmarkers.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"100\t100\t{len(placed)}\t{len(names)}\tm\t100\t1\t{len(placed)}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        "\t\t" + "\t".join(f"{a}{i + 1}" for i in range(len(names)) for a in "XYZ"),
        "",
    ]
    for i, row in enumerate(placed):
        rows.append("\t".join([str(i + 1), f"{i / 100:.2f}", *(f"{x:.12f}" for x in row.ravel())]))
    (folder / "markers.trc").write_text("\n".join(rows) + "\n")
    tool = opensim.InverseKinematicsTool()
    model = opensim.Model(str(path))
    tool.setModel(model)
    tool.setMarkerDataFileName(str(folder / "markers.trc"))
    tool.setOutputMotionFileName(str(folder / "out.mot"))
    tool.setResultsDir(str(folder))
    tool.set_accuracy(1e-10)
    tool.set_report_marker_locations(True)
    tasks = tool.getIKTaskSet()
    for name in names:
        task = opensim.IKMarkerTask()
        task.setName(name)
        task.setWeight(1.0)
        tasks.cloneAndAppend(task)
    tool.run()
    table = opensim.TimeSeriesTable(str(next(folder.glob("*ik_model_marker_locations.sto"))))
    columns = {c: i for i, c in enumerate(table.getColumnLabels())}
    solved = table.getMatrix().to_numpy()
    at = np.stack([solved[:, [columns[f"{n}_t{a}"] for a in "xyz"]] for n in names], axis=1)
    return np.asarray(np.linalg.norm(at - placed, axis=-1))


BENDS = np.linspace(-2.0, 0.1, 9)
COSINE = f"<x>{' '.join(map(str, BENDS))}</x><y>{' '.join(map(str, 0.02 * np.cos(BENDS)))}</y>"
WAYS = {
    "rolling": spline(BENDS.tolist(), (0.02 * np.sin(2.0 * BENDS)).tolist(), 1.5),
    "polynomial": (
        "<PolynomialFunction name='function'><coefficients>0.004 0.01 -0.02 0.003</coefficients>"
        "</PolynomialFunction>"
    ),
    "natural": f"<NaturalCubicSpline name='function'>{COSINE}</NaturalCubicSpline>",
    "piecewise": (
        "<PiecewiseLinearFunction name='function'><x>-2 -1 0.1</x><y>0 0.01 0.03</y>"
        "</PiecewiseLinearFunction>"
    ),
}


def walker_knee(way: str) -> Hung:
    """Return a knee that rotates about three axes and moves along two, by one coordinate."""
    screw = spline(BENDS.tolist(), (0.1 * np.cos(BENDS)).tolist())
    axes = [("knee", Z, LINEAR), ("knee", X, screw), ("knee", Y, screw)]
    axes += [("knee", X, WAYS[way]), ("knee", Y, screw), ("", Z, ZERO)]
    return Hung(
        "tibia",
        "femur",
        "CustomJoint",
        [("knee", -2.0, 0.1)],
        ((0.0, -0.4, 0.01), (0.2, -0.1, 0.3)),
        ((0.01, 0.0, 0.02), (0.1, 0.0, -0.2)),
        axes,
    )


@pytest.mark.parametrize("way", WAYS)
def test_a_knee_of_functions_moves_as_opensim_moves_it(
    tmp_path: Path, opensim: Any, way: str
) -> None:
    path = write_osim(tmp_path / "knee.osim", [ROOT, HIP, walker_knee(way)], MARKERS)
    imported = read_osim(path)
    joint = imported.model.segments[2].joint
    assert joint.kind == "coupled"
    assert joint.limits == pytest.approx((-2.0, 0.1))
    assert len(imported.remarks) == 1
    assert imported.remarks[0].endswith("CustomJoint of knee became a coupled joint")
    values = np.random.default_rng(4).uniform(-0.5, 0.5, (23, 10))
    values[:, 9] = np.linspace(-1.99, 0.09, 23)
    _, placed = moved(opensim, path, values)
    found = solve_frames(imported.model, to_z_up(placed))
    assert tracking_error(found.residuals) < 5e-6
    knee = coupled_coordinates(imported.model, found.state)["tibia"]
    np.testing.assert_allclose(knee, values[:, 9], atol=1e-4)


def test_approximation_errors_of_samples_are_reported(tmp_path: Path) -> None:
    knee = walker_knee("rolling")
    steps = "<PiecewiseLinearFunction name='function'><x>-2 -1 -0.9 0.1</x><y>0 0 0.2 0.2</y>"
    knee.axes[3] = ("knee", X, f"{steps}</PiecewiseLinearFunction>")
    remark = read_osim(write_osim(tmp_path / "m.osim", [ROOT, HIP, knee], MARKERS)).remarks[0]
    found = re.search(r"off by ([\d.]+) mm and 0.0 degrees at most", remark)
    assert found
    assert 0.1 < float(found[1]) < 10.0


def test_least_squares_on_a_knee_of_functions_are_those_of_opensim(
    tmp_path: Path, opensim: Any
) -> None:
    path = write_osim(tmp_path / "knee.osim", [ROOT, HIP, walker_knee("rolling")], MARKERS)
    values = np.outer(np.linspace(0.0, 1.0, 9), np.random.default_rng(1).uniform(-0.6, 0.6, 10))
    values[:, 9] = np.linspace(-0.2, -1.6, 9)
    names, placed = moved(opensim, path, values)
    placed = placed + np.random.default_rng(2).normal(0.0, 0.008, placed.shape)
    theirs = _their_residuals(opensim, path, names, placed, tmp_path)
    ours = np.linalg.norm(solve_frames(read_osim(path).model, to_z_up(placed)).residuals, axis=-1)
    np.testing.assert_allclose(ours, theirs, atol=5e-5)


def test_a_custom_joint_that_is_a_hinge_becomes_one(tmp_path: Path) -> None:
    axes = [("knee", Z, LINEAR), *[("", a, ZERO) for a in (Y, X, X, Y, Z)]]
    place = ((0.0, -0.4, 0.0), (0.0, 0.0, 0.0))
    knee = Hung("tibia", "femur", "CustomJoint", [("knee", -2.0, 0.0)], place, axes=axes)
    imported = read_osim(write_osim(tmp_path / "knee.osim", [ROOT, HIP, knee], MARKERS))
    assert imported.model.segments[2].joint.kind == "hinge"
    assert imported.remarks == ()


def test_a_coupled_joint_on_a_welded_body_moves_as_opensim_moves_it(
    tmp_path: Path, opensim: Any
) -> None:
    plate = Hung("plate", "femur", "WeldJoint", [], ((0.05, -0.2, 0.0), (0.0, 0.3, 0.5)))
    knee = walker_knee("rolling")
    knee.parent = "plate"
    path = write_osim(tmp_path / "knee.osim", [ROOT, HIP, plate, knee], MARKERS)
    values = np.random.default_rng(5).uniform(-0.5, 0.0, (7, 10))
    _, placed = moved(opensim, path, values)
    found = solve_frames(read_osim(path).model, to_z_up(placed))
    assert tracking_error(found.residuals) < 2e-6


def test_welded_and_locked_bodies_become_part_of_their_parents(
    tmp_path: Path, opensim: Any
) -> None:
    plate = Hung("plate", "femur", "WeldJoint", [], ((0.05, -0.2, 0.0), (0.0, 0.3, 0.5)))
    toe = Hung(
        "toe", "tibia", "PinJoint", [("toe", -1.0, 1.0)], ((0, -0.4, 0), (0, 0, 0)), locked=True
    )
    extra = [("p1", "plate", (0.01, 0.02, 0.03), True), ("t1", "toe", (0.1, 0.0, 0.0), False)]
    path = write_osim(tmp_path / "weld.osim", [ROOT, HIP, plate, KNEE, toe], [*MARKERS, *extra])
    imported = read_osim(path)
    assert imported.model.segment_names == ("pelvis", "femur", "tibia")
    told = "\n".join(imported.remarks)
    assert "plate is fixed to femur" in told
    assert "toe is locked" in told
    assert imported.model.locked[-2].all()
    assert not imported.model.locked[-1].any()
    values = np.random.default_rng(3).uniform(-0.5, 0.5, (4, 11))
    values[:, 10] = 0.0
    _, placed = moved(opensim, path, values)
    assert tracking_error(solve_frames(imported.model, to_z_up(placed)).residuals) < 1e-9


def markers_on(*bodies: str) -> list[str]:
    return [name for name, body, *_ in MARKERS if body in bodies]


def test_bodies_that_no_marker_needs_are_left_out(tmp_path: Path) -> None:
    path = write_osim(tmp_path / "small.osim", [ROOT, HIP, KNEE], MARKERS)
    upper = read_osim(path, markers=markers_on("pelvis", "femur"))
    assert upper.model.segment_names == ("pelvis", "femur")
    assert any("tibia" in remark for remark in upper.remarks)
    lower = read_osim(path, markers=markers_on("femur", "tibia")).model
    assert [s.joint.kind for s in lower.segments] == ["free", "hinge"]
    ends = read_osim(path, markers=markers_on("pelvis", "tibia")).model
    assert ends.segment_names == ("pelvis", "femur", "tibia")
    assert len(read_osim(path, markers=["tibia1", "tibia2"]).model.markers) == 2


@pytest.mark.parametrize(
    ("kind", "coordinates", "expected"),
    [
        ("BallJoint", 3, "ball"),
        ("GimbalJoint", 3, "ball"),
        ("UniversalJoint", 2, "ball"),
        ("PinJoint", 1, "hinge"),
        ("PlanarJoint", 3, "hinge"),
    ],
)
def test_every_kind_of_joint_is_converted(
    tmp_path: Path, kind: str, coordinates: int, expected: str
) -> None:
    named = [(f"q{i}", -1.0, 1.0) for i in range(coordinates)]
    hung = Hung("femur", "pelvis", kind, named, ((0.1, 0, 0), (0.2, 0.1, 0)))
    imported = read_osim(write_osim(tmp_path / "m.osim", [ROOT, hung], MARKERS[:8]))
    assert imported.model.segments[1].joint.kind == expected
    assert bool(imported.remarks) == (kind in {"UniversalJoint", "PlanarJoint"})


def model_of(text: str) -> str:
    return f"<OpenSimDocument Version='40000'>{text}</OpenSimDocument>"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("<a", "m.osim: "),
        (
            "\n<html/>",
            "m.osim, line 2: not an OpenSim model: found <html>, expected <OpenSimDocument>",
        ),
        (model_of("<ScaleTool/>"), "found <OpenSimDocument> with <ScaleTool>.*: choose the .osim"),
        (model_of("<Model name='m'/>"), "the model has no <JointSet>, expected bodies"),
        ("<OpenSimDocument Version='30000'><Model/></OpenSimDocument>", "before 4.0"),
        (
            "<!DOCTYPE x [<!ENTITY a 'aaaa'><!ENTITY b '&a;&a;'>]>"
            + model_of("<Model>&b;</Model>"),
            "document type",
        ),
        (
            model_of(
                "<Model><BodySet><objects><Body name='b'/></objects></BodySet><JointSet><objects>"
                "<ScrewJoint name='s'><socket_parent_frame>/ground</socket_parent_frame>"
                "<socket_child_frame>/bodyset/b</socket_child_frame></ScrewJoint>"
                "</objects></JointSet></Model>"
            ),
            "ScrewJoint is not supported",
        ),
    ],
)
def test_unsupported_elements_are_rejected_by_name(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "m.osim").write_text(text)
    with pytest.raises(MalformedFileError, match=said):
        read_osim(tmp_path / "m.osim")


def test_unknown_names_are_reported_together(tmp_path: Path) -> None:
    path = write_osim(tmp_path / "small.osim", [ROOT, HIP, KNEE], MARKERS)
    with pytest.raises(
        MalformedFileError, match="no marker 'shin'; no marker 'tibia9'; there are: "
    ):
        read_osim(path, markers=["shin", "tibia9"])


def test_a_wrong_number_is_reported_with_its_line_and_remedy(tmp_path: Path) -> None:
    path = write_osim(tmp_path / "small.osim", [ROOT, HIP, KNEE], MARKERS)
    text = re.sub(r"<location>[^<]*<", "<location>1 2<", path.read_text(), count=1)
    path.write_text(text)
    line = next(k for k, row in enumerate(text.splitlines(), 1) if "<location>1 2<" in row)
    said = (
        rf"small.osim: line {line}: Marker '\w+': location is '1 2', expected 3 numbers .*: correct"
    )
    with pytest.raises(MalformedFileError, match=said):
        read_osim(path)


def test_a_word_among_any_number_of_coefficients_is_reported(tmp_path: Path) -> None:
    path = write_osim(tmp_path / "small.osim", [ROOT, HIP, KNEE], MARKERS)
    path.write_text(path.read_text().replace("<coefficients>1 0<", "<coefficients>1 none<"))
    with pytest.raises(MalformedFileError, match="coefficients is '1 none', expected numbers with"):
        read_osim(path)


def test_an_unknown_parent_frame_is_named_with_the_bodies(tmp_path: Path) -> None:
    path = write_osim(tmp_path / "small.osim", [ROOT, HIP, KNEE], MARKERS)
    socket = "<socket_parent>/bodyset/femur<"
    path.write_text(path.read_text().replace(socket, socket.replace("femur", "fumer")))
    said = (
        r"parent frame 'fumer' is neither a body .*, expected one of ground, pelvis, femur, tibia"
    )
    with pytest.raises(MalformedFileError, match=said):
        read_osim(path)


def test_joints_in_a_cycle_are_named_with_their_bodies(tmp_path: Path) -> None:
    path = write_osim(tmp_path / "small.osim", [ROOT, HIP, KNEE], MARKERS)
    text = path.read_text().replace("<socket_parent>/ground<", "<socket_parent>/bodyset/tibia<")
    path.write_text(text)
    with pytest.raises(MalformedFileError, match=r"cycle: .* \(tibia to pelvis\).*: correct"):
        read_osim(path)


def test_millimetres_are_rejected_with_or_without_a_declared_unit(tmp_path: Path) -> None:
    large = [(name, body, tuple(1000 * np.array(at)), fixed) for name, body, at, fixed in MARKERS]
    path = write_osim(tmp_path / "mm.osim", [ROOT, HIP, KNEE], large)
    with pytest.raises(MalformedFileError, match="must be metres: is the file in millimetres"):
        read_osim(path)
    path = write_osim(tmp_path / "told.osim", [ROOT, HIP, KNEE], MARKERS)
    text = path.read_text().replace("<BodySet>", "<length_units>mm</length_units><BodySet>", 1)
    path.write_text(text)
    with pytest.raises(MalformedFileError, match="length_units is 'mm', expected 'meters'"):
        read_osim(path)


def test_vectors_survive_a_round_trip() -> None:
    v = np.arange(6.0).reshape(2, 3)
    assert to_z_up(v).tolist() == [[2.0, 0.0, 1.0], [5.0, 3.0, 4.0]]
    np.testing.assert_array_equal(from_z_up(to_z_up(v)), v)


def imported(folder: Path, name: str) -> tuple[ChainModel, str]:
    found = read_osim(folder / name)
    return found.model, "\n".join(found.remarks)


def test_the_published_models_are_read(shared_data: Path) -> None:
    gait, told = imported(shared_data / "opensim_gait2354", "subject01_simbody.osim")
    assert (len(gait.segments), len(gait.markers), gait.nq) == (10, 39, 21)
    assert "knee_r: CustomJoint of knee_angle_r became a coupled joint" in told
    cap, told = imported(shared_data / "opencap_subject4" / "models", "manually_scaled.osim")
    assert (len(cap.segments), len(cap.markers), cap.nq) == (16, 49, 31)
    assert "hand_r is fixed to radius_r" in told
    assert "patellofemoral_knee_angle_r_con is ignored" in told
    assert int(cap.locked.all(axis=1).sum()) == 8
    bare, told = imported(shared_data / "opensense_xsens", "Rajagopal_2015.osim")
    assert not bare.markers
    assert "no markers" in told
    rest = marker_positions(cap, apply_step(cap, rest_state(cap), np.zeros((1, cap.nq))))
    height = rest[0, :, 2].max() - rest[0, :, 2].min()
    assert 1.3 < height < 1.9  # z is up, as in the world


def test_the_published_model_moves_its_markers_as_opensim_does(
    shared_data: Path, opensim: Any
) -> None:
    path = shared_data / "opencap_subject4" / "models" / "manually_scaled.osim"
    loaded = opensim.Model(str(path))  # the coordinates need the model object
    coordinates = loaded.getCoordinateSet()
    chosen = [coordinates.get(i) for i in range(coordinates.getSize())]
    knees = np.array(["knee" in c.getName() for c in chosen])
    left_out = np.array(["mtp" in c.getName() or "beta" in c.getName() for c in chosen])
    low = np.maximum([c.getRangeMin() for c in chosen], -0.6) * ~left_out
    high = np.minimum([c.getRangeMax() for c in chosen], np.where(knees, 1.8, 0.6)) * ~left_out
    values = low + (high - low) * np.random.default_rng(6).random((10, len(chosen)))
    names, placed = moved(opensim, path, values)
    model = read_osim(path).model
    ours = [names.index(name) for name in model.marker_names]
    found = solve_frames(model, to_z_up(placed)[:, ours])
    assert tracking_error(found.residuals) < 1e-5
