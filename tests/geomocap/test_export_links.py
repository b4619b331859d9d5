"""Links with joints: OpenSim models and URDF, replayed from their files alone."""

from itertools import product
from xml.etree import ElementTree as Xml

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from geomocap.export.export_settings import ExportSettings
from geomocap.export.linked_bodies import linked_bodies, solid_properties
from geomocap.export.osim import OSIM, xyz_angles
from geomocap.export.run_export import ON_REQUEST, export_run
from geomocap.export.skeleton_motion import motion_from_skeleton
from geomocap.export.skinned_mesh import bone_mesh
from geomocap.export.stl import write_stl
from geomocap.export.trc import read_trc
from geomocap.export.urdf import URDF, safe_name, write_urdf
from geomocap.files.run import Run
from geomocap.model.rotations import rotation_about
from geomocap.naming.name_templates import read_template
from tests.geomocap.articulated import skeleton_arrays, skeleton_of
from tests.geomocap.template_figures import figure

Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def hinged_arrays():
    """A subject whose last body turns about one axis of its parent only."""
    arrays = skeleton_arrays(6, 15)
    parent = arrays["joint_bodies"][-1, 0]
    angles = np.linspace(0, 1, 15)
    R = Rotation.from_rotvec(angles[:, None] * [0.6, 0, 0.8]).as_matrix()
    arrays["body_rotations"][:, 5] = arrays["body_rotations"][:, parent] @ R
    return arrays


@pytest.fixture
def run(tmp_path):
    run = Run(tmp_path / "run")
    run.write_npz("skeleton.npz", **hinged_arrays())
    run.write_record({"source": {"up": "z"}})
    return run


@pytest.fixture
def skeleton():
    return skeleton_of(hinged_arrays())


def columns(path, delimiter):
    lines = path.read_text().splitlines()
    if "endheader" in lines:
        lines = lines[lines.index("endheader") + 1 :]
    values = np.array([[float(v) for v in line.split(delimiter)] for line in lines[1:]])
    return dict(zip(lines[0].split(delimiter), values.T, strict=True))


def numbers(text):
    return np.array([float(v) for v in text.split()])


def test_urdf_replays_the_skeleton_by_its_joints_and_their_positions(run, skeleton):
    file = export_run(run, ["urdf"]).files["urdf"]
    robot = Xml.parse(file).getroot()
    motion = columns(file.with_name("motion_joints.csv"), ",")
    base = np.stack([motion[f"base_{a}_m"] for a in "xyz"], axis=1)
    placed = {
        "body00": (Rotation.from_quat(np.stack([motion[f"base_q{a}"] for a in "xyzw"], axis=1)).as_matrix(), base)
    }
    for joint in robot.findall("joint"):
        R, p = placed[joint.find("parent").get("link")]
        angle, axis = motion[joint.get("name")], numbers(joint.find("axis").get("xyz"))
        limit = joint.find("limit")
        assert float(limit.get("lower")) - 1e-5 <= angle.min() <= angle.max() <= float(limit.get("upper")) + 1e-5
        turned = R @ Rotation.from_rotvec(angle[:, None] * axis).as_matrix()
        placed[joint.find("child").get("link")] = turned, p + R @ numbers(joint.find("origin").get("xyz"))
    for j, (_, child) in enumerate(skeleton.joint_bodies):
        R, p = placed[f"body{child:02d}"]
        assert np.abs(p - skeleton.joint_positions[:, j]).max() < 1e-4
        assert np.abs(R - skeleton.body_rotations[:, child]).max() < 1e-4
    revolute = [joint.get("name") for joint in robot.findall("joint")]
    assert len(revolute) == 4 * 3 + 1
    assert str(skeleton.joint_names[-1]) in revolute, "the hinge is one joint"


def test_opensim_model_replays_the_skeleton_by_its_coordinates(run, skeleton):
    file = export_run(run, ["osim"]).files["osim"]
    model = Xml.parse(file).getroot().find("Model")
    motion = columns(file.with_suffix(".mot"), "\t")
    frames = len(motion["time"])
    placed = {"/ground": (np.tile(np.eye(3), (frames, 1, 1)), np.zeros((frames, 3)))}
    kinds = []
    for joint in model.find("JointSet/objects"):
        before, after = joint.findall("frames/PhysicalOffsetFrame")
        R, p = placed[before.find("socket_parent").text]
        tilt = Rotation.from_euler("XYZ", numbers(before.find("orientation").text)).as_matrix()
        assert before.find("orientation").text == after.find("orientation").text
        names = [c.get("name") for c in joint.findall("coordinates/Coordinate")]
        q = np.stack([motion[name] for name in names], axis=1)
        turn = rotation_about(2, q[:, 0]) if len(names) == 1 else Rotation.from_euler("XYZ", q[:, :3]).as_matrix()
        origin = p + R @ numbers(before.find("translation").text)
        if len(names) == 6:
            origin = origin + q[:, 3:]
        placed[after.find("socket_parent").text] = R @ tilt @ turn @ tilt.T, origin
        kinds.append(joint.tag)
    assert sorted(kinds) == [*["BallJoint"] * 4, "FreeJoint", "PinJoint"]
    for j, (_, child) in enumerate(skeleton.joint_bodies):
        R, p = placed[f"/bodyset/body{child:02d}"]
        assert np.abs(p - skeleton.joint_positions[:, j] @ Y_UP.T).max() < 1e-4
        assert np.abs(R - Y_UP @ skeleton.body_rotations[:, child] @ Y_UP.T).max() < 1e-4


def test_opensim_itself_replays_the_model(run, skeleton):
    osim = pytest.importorskip("opensim")
    file = export_run(run, ["osim"]).files["osim"]
    model = osim.Model(str(file))
    state = model.initSystem()
    motion = columns(file.with_suffix(".mot"), "\t")
    for t in (0, 7, 14):
        for name, values in motion.items():
            if name != "time":
                model.getCoordinateSet().get(name).setValue(state, float(values[t]), False)
        model.realizePosition(state)
        for j, (_, child) in enumerate(skeleton.joint_bodies):
            place = model.getBodySet().get(f"body{child:02d}").getTransformInGround(state).p()
            assert np.abs([place.get(i) for i in range(3)] - Y_UP @ skeleton.joint_positions[t, j]).max() < 1e-4


def test_yourdfpy_replays_the_robot(skeleton, tmp_path):
    yourdfpy = pytest.importorskip("yourdfpy")
    motion = motion_from_skeleton(skeleton, joints="fixed")
    names = tuple(map(str, skeleton.joint_names))
    bodies = linked_bodies(motion, bone_mesh(motion), names, URDF, density=1000, radius=0.05)
    write_urdf(tmp_path / "motion.urdf", bodies)
    robot = yourdfpy.URDF.load(str(tmp_path / "motion.urdf"), mesh_dir=str(tmp_path))
    assert len(robot.scene.geometry) == skeleton.body_count
    values = columns(tmp_path / "motion_joints.csv", ",")
    robot.update_cfg({name: values[name][9] for name in robot.actuated_joint_names})
    base = np.eye(4)
    base[:3, :3] = Rotation.from_quat([values[f"base_q{a}"][9] for a in "xyzw"]).as_matrix()
    base[:3, 3] = [values[f"base_{a}_m"][9] for a in "xyz"]
    for j, (_, child) in enumerate(skeleton.joint_bodies):
        place = (base @ robot.get_transform(f"body{child:02d}"))[:3, 3]
        assert np.abs(place - skeleton.joint_positions[9, j]).max() < 1e-4


def test_robots_and_models_are_only_written_when_asked_for(run):
    assert not set(export_run(run).files) & set(ON_REQUEST)


def test_mass_and_inertia_are_those_of_a_box():
    corners = np.array(list(product([1, 1.2], [2, 2.4], [3, 3.6])))
    mass, center, inertia = solid_properties(corners, 1000)
    assert mass == pytest.approx(48)
    assert center == pytest.approx([1.1, 2.2, 3.3])
    expected = 48 / 12 * np.diag([0.4**2 + 0.6**2, 0.2**2 + 0.6**2, 0.2**2 + 0.4**2])
    assert inertia == pytest.approx(expected, abs=1e-9)
    flat = solid_properties(corners[corners[:, 2] < 3.1], 1000)
    assert 0 < flat[0] < 5
    assert (np.linalg.eigvalsh(flat[2]) > 0).all()


def test_body_fixed_angles_and_names_that_files_bear():
    R = Rotation.from_euler("XYZ", [[0.3, -0.4, 1.2], [0.35, -0.5, 1.3]]).as_matrix()
    assert xyz_angles(R) == pytest.approx(np.array([[0.3, -0.4, 1.2], [0.35, -0.5, 1.3]]))
    assert safe_name("mixamorig:Hips") == "mixamorig_Hips"
    assert OSIM.up == "y"


def test_stl_is_read_back(tmp_path):
    box = trimesh.creation.box((1, 2, 3))
    write_stl(tmp_path / "box.stl", np.asarray(box.vertices), np.asarray(box.faces))
    again = trimesh.load_mesh(tmp_path / "box.stl")
    assert again.volume == pytest.approx(6)
    assert again.is_watertight


def person(tmp_path):
    """A run of a walking person."""
    skeleton, _ = figure(read_template("human"))
    run = Run(tmp_path / "person")
    fields = ("joint_positions", "joint_bodies", "joint_names", "body_rotations", "body_positions", "fps")
    run.write_npz("skeleton.npz", **{name: getattr(skeleton, name) for name in fields})
    run.write_record({"source": {"up": "z"}})
    return run


def test_markers_sit_where_opensims_bodies_begin(run, tmp_path):
    export_run(run, ["osim"])
    assert not (run.path / "motion_markers.xml").exists()  # a body like no person
    walker = person(tmp_path)
    files = export_run(walker, ["osim", "trc"], ExportSettings(name_set="opensim")).files
    markers = Xml.parse(files["osim"].with_name("motion_markers.xml")).iter("Marker")
    places = {m.get("name"): m.find("socket_parent_frame").text for m in markers}
    assert len(places) == 13 and places["hip_r"] == "/bodyset/femur_r" and places["elbow_l"] == "/bodyset/ulna_l"
    assert set(places) <= set(read_trc(files["trc"]).names)


def test_opensims_inverse_kinematics_follows_the_markers(tmp_path):
    """On the subject's own model, whose forearms and feet are radius and calcaneus: there the markers must be met."""
    osim = pytest.importorskip("opensim")
    walker = person(tmp_path)
    files = export_run(walker, ["osim", "trc"], ExportSettings(name_set="opensim")).files
    markers = files["osim"].with_name("motion_markers.xml")
    markers.write_text(markers.read_text().replace("/ulna_", "/radius_").replace("/talus_", "/calcn_"))
    model = osim.Model(str(files["osim"]))
    model.updateMarkerSet(osim.MarkerSet(str(markers)))
    model.initSystem()
    tool = osim.InverseKinematicsTool()
    tool.setModel(model)
    tool.setMarkerDataFileName(str(files["trc"]))
    tool.set_report_marker_locations(True)
    tool.setResultsDir(str(tmp_path))
    tool.setOutputMotionFileName(str(tmp_path / "found.mot"))
    tool.run()
    found = osim.TimeSeriesTable(str(tmp_path / "found.mot"))
    true = columns(files["osim"].with_suffix(".mot"), "\t")
    assert found.getNumRows() == len(true["time"])
    knee = np.rad2deg(true["walker_knee_r"])
    assert np.ptp(knee) > 10
    measured = found.getDependentColumn("walker_knee_r").to_numpy()
    assert np.abs(measured - knee).max() < 0.5
