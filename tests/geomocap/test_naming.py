from dataclasses import replace
from itertools import product

import numpy as np
import pygltflib
import pytest

from geomocap.angles.joint_angles import joint_angles
from geomocap.export.export_settings import ExportSettings
from geomocap.export.rest_pose import at_rest
from geomocap.export.run_export import export_run
from geomocap.export.run_names import names_text
from geomocap.export.skeleton_motion import motion_from_skeleton
from geomocap.export.trc import read_trc
from geomocap.files.run import Run
from geomocap.model.skeleton import Skeleton
from geomocap.naming.best_assignment import heaviest_choices
from geomocap.naming.found_names import FoundNames, find_names, likely_parts
from geomocap.naming.given_names import with_given
from geomocap.naming.mean_posture import mean_posture
from geomocap.naming.name_sets import renamed
from geomocap.naming.name_templates import NamingError, built_in_templates, read_template
from geomocap.naming.tree_features import nesting
from geomocap.naming.tree_matching import match_tree
from tests.geomocap.articulated import skeleton_arrays, skeleton_of
from tests.geomocap.assignment_reference import heaviest_choices_python
from tests.geomocap.template_figures import figure, with_a_thigh_in_two

HUMAN, QUADRUPED, BIRD = (read_template(name) for name in ("human", "quadruped", "bird"))


def test_heaviest_choices_are_those_of_trying_all():
    rng = np.random.default_rng(1)
    for _ in range(20):
        n = 9
        weights, groups, kinds = rng.uniform(0.1, 2, n), rng.integers(0, 4, n), rng.integers(0, 4, n)
        excluded = rng.random((n, n)) < 0.2
        excluded |= excluded.T
        apart = excluded | (groups[:, None] == groups) | (kinds[:, None] == kinds)
        best = 0.0
        for bits in product([False, True], repeat=n):
            taken = np.flatnonzero(bits)
            if not (apart[np.ix_(taken, taken)] & ~np.eye(len(taken), dtype=bool)).any():
                best = max(best, float(weights[taken].sum()))
        chosen = heaviest_choices(weights, groups, kinds, excluded)
        assert chosen is not None
        assert weights[chosen].sum() == pytest.approx(best)
        assert heaviest_choices(weights, groups, kinds, excluded, above=best) is None


def test_heaviest_choices_are_those_of_the_reference_search():
    rng = np.random.default_rng(2)
    for n in (0, 1, 5, 64, 65, 130, 200):
        for part in (0.02, 0.3):
            weights, groups, kinds = rng.uniform(0.1, 2, n), rng.integers(0, 12, n), rng.integers(0, 15, n)
            weights[n // 2 :] = np.round(weights[n // 2 :], 1)  # some are equal
            excluded = rng.random((n, n)) < part
            excluded |= excluded.T
            for above in (-np.inf, 3.0, 20.0):
                chosen = heaviest_choices(weights, groups, kinds, excluded, above)
                assert chosen == heaviest_choices_python(weights, groups, kinds, excluded, above)


def test_nesting_of_sets():
    sets = np.array([[1, 1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 1, 1, 0]], bool)
    assert nesting(sets, sets)[0].tolist() == [1, 2, 0, 3]
    assert nesting(sets, sets)[1, 0] == 1


def test_joints_between_parts_in_one_body_are_told_as_missing():
    whole = find_names(figure(HUMAN)[0], 2)
    found = find_names(figure(HUMAN, without=[("shank", "right"), ("hand", "left")])[0], 2)
    assert whole.unparted == {} and FoundNames().unparted == {}
    assert found.unparted == {"knee_right": "thigh_shank_right", "wrist_left": "forearm_hand_left"}
    assert renamed(found, "mixamo").unparted.keys() == found.unparted.keys()
    assert "# no knee_right: both its parts are in thigh_shank_right\n" in names_text(found)


def test_what_a_body_holds_anyhow_is_told_where_its_joint_may_be_either():
    def parts(*names):
        return frozenset(
            k for k, (part, side) in enumerate(zip(HUMAN.parts, HUMAN.sides, strict=True)) if f"{part}_{side}" in names
        )

    hand, lower, other = parts("hand_left"), parts("forearm_left", "hand_left"), parts("forearm_right", "hand_right")
    assert likely_parts({hand: 0.8, lower: 0.2}, HUMAN) == (hand, 0.8)
    assert likely_parts({hand: 0.5, lower: 0.45, frozenset(): 0.05}, HUMAN) == (hand, pytest.approx(0.95))
    assert likely_parts({hand: 0.4, lower: 0.3, other: 0.3}, HUMAN) == (hand, pytest.approx(1.0))
    assert likely_parts({hand: 0.4, parts("foot_left"): 0.35, frozenset(): 0.25}, HUMAN) == (frozenset(), 0)


@pytest.mark.parametrize("template", [HUMAN, QUADRUPED, BIRD], ids=lambda t: t.name)
@pytest.mark.parametrize("turn", [0.0, 2.2])
def test_a_figure_of_a_template_gets_its_names(template, turn):
    skeleton, labels = figure(template, turn=turn)
    found = find_names(skeleton, 2)
    assert found.template is not None
    assert found.template.name == template.name
    assert found.sides_known
    assert [found.bodies.get(b) for b in range(len(labels))] == labels
    assert found.from_world is not None
    assert found.from_world[0] @ [np.cos(turn), np.sin(turn), 0] > 0.9


def test_left_and_right_follow_the_heading_not_the_order_of_bodies():
    skeleton, labels = figure(HUMAN, mirrored=True)
    found = find_names(skeleton, 2)
    other = {"left": "right", "right": "left"}
    expected = [f"{s[: s.rindex('_')]}_{other[s.rsplit('_')[-1]]}" if s.rsplit("_")[-1] in other else s for s in labels]
    assert [found.bodies.get(b) for b in range(len(labels))] == expected


def test_the_way_names_are_found_does_not_depend_on_the_axis_that_points_up():
    skeleton, labels = figure(HUMAN)
    turned = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])  # z up to y up
    arrays = {
        "joint_positions": skeleton.joint_positions @ turned.T,
        "body_positions": skeleton.body_positions @ turned.T,
        "body_rotations": turned @ skeleton.body_rotations @ turned.T,
        "offsets": skeleton.offsets @ turned.T,
        "body_offsets": skeleton.body_offsets @ turned.T,
    }
    plain = {
        k: getattr(skeleton, k) for k in ("joint_bodies", "joint_names", "body_names", "root", "fixed_joints", "fps")
    }
    found = find_names(Skeleton(**arrays, **plain), 1)
    assert [found.bodies.get(b) for b in range(len(labels))] == labels


def test_a_body_that_holds_two_parts_is_called_after_both():
    gone = [("hand", "left"), ("foot", "left"), ("foot", "right"), ("thorax", "")]
    skeleton, labels = figure(HUMAN, without=gone)
    found = find_names(skeleton, 2, templates=[HUMAN])
    names = dict(zip(labels, (found.bodies.get(b) for b in range(len(labels))), strict=True))
    assert names["forearm_left"] == "forearm_hand_left"
    assert names["forearm_right"] == "forearm_right"
    assert names["shank_right"] == "shank_foot_right"
    assert names["pelvis"] == "trunk"


def test_a_tree_of_nothing_known_keeps_its_numbers():
    named = [find_names(skeleton_of(skeleton_arrays(8, seed=seed)), 2).bodies for seed in range(12)]
    assert named == [{}] * 12


def test_a_users_own_template_whose_ends_look_alike_tells_no_left_from_right(tmp_path):
    leg = "pair = true\nparent = 'top'\nsurface = 1\nmobility = 0.2\n"
    (tmp_path / "table.toml").write_text(
        "[parts.top]\ncenter = [0, 0, 1]\nsurface = 6\n"
        f"[parts.leg]\n{leg}joint = [0.5, 0.3, 1]\ncenter = [0.5, 0.3, 0.5]\ntip = [0.5, 0.3, 0]\n"
        f"[parts.prop]\n{leg}joint = [-0.5, 0.3, 1]\ncenter = [-0.5, 0.3, 0.5]\ntip = [-0.5, 0.3, 0]\n"
    )
    table = read_template(tmp_path / "table.toml")
    found = find_names(figure(table, speed=0.0)[0], 2, templates=[table])
    assert found.bodies[0] == "top"
    assert not found.sides_known
    assert not any(name.endswith(("_left", "_right")) for name in found.bodies.values())


def test_both_ways_to_face_are_looked_at_alike_where_the_ends_look_alike(tmp_path):
    def leg(name, x):
        upper = f"joint = [{x}, 0.3, 1]\ncenter = [{x}, 0.3, 0.75]\n"
        lower = f"joint = [{x}, 0.3, 0.5]\ncenter = [{x}, 0.3, 0.25]\ntip = [{x}, 0.3, 0]\n"
        pair = "pair = true\nsurface = 1\nmobility = 0.2\n"
        return f"[parts.{name}]\nparent = 'top'\n{pair}{upper}[parts.{name}_foot]\nparent = '{name}'\n{pair}{lower}"

    (tmp_path / "table.toml").write_text(
        "[parts.top]\ncenter = [0, 0, 1]\nsurface = 6\n" + leg("front", 0.5) + leg("hind", -0.5)
    )
    table = read_template(tmp_path / "table.toml")
    high = table.joint_places.copy()
    high[[part.endswith("foot") for part in table.parts], 2] += 0.2  # so high that it may be none
    skeleton = figure(replace(table, joint_places=high), without=[("front_foot", "left")], speed=0.0)[0]
    ways = match_tree(mean_posture(skeleton, 2), table)
    forward, backward = (sorted(w.score + w.symmetry for w in ways if sign * w.turn[0, 0] > 0) for sign in (1, -1))
    assert len(forward) > 5
    # left and right swing in turn, so mean postures are alike only nearly
    np.testing.assert_allclose(forward[-5:], backward[-5:], atol=0.05)
    assert set(find_names(skeleton, 2, templates=[table]).bodies.values()) == {"top"}


def test_names_of_other_programs():
    found = find_names(figure(HUMAN)[0], 2)
    assert set(renamed(found, "mixamo").bodies.values()) > {"mixamorig:Hips", "mixamorig:LeftForeArm"}
    assert set(renamed(found, "opensim").bodies.values()) > {"pelvis", "femur_l", "tibia_r", "calcn_l"}
    assert set(renamed(found, "coco").joints.values()) > {"left_knee", "right_wrist"}
    assert set(renamed(found, "humanik").bodies.values()) > {"Hips", "RightUpLeg"}


def test_every_template_can_be_read_and_a_wrong_one_says_why(tmp_path):
    assert built_in_templates() == ["bird", "hand", "human", "quadruped"]
    for name in built_in_templates():
        template = read_template(name)
        assert template.surfaces.sum() == pytest.approx(1)
        assert (template.mirrored[template.mirrored] == np.arange(len(template.parts))).all()
    file = tmp_path / "worm.toml"
    for text, told in [
        ("parts = 3", "no parts"),
        ("[parts.a]\nsurface = 1", "center"),
        ("[parts.a]\ncenter = [0, 0, 0]", "surface"),
        ('[parts.a]\ncenter = [0, 0, 0]\nsurface = 1\n[parts.b]\nparent = "c"', "parent"),
        ("[parts.a]\ncolour = 1", "colour"),
        ("[parts", "TOML"),
    ]:
        file.write_text(text)
        with pytest.raises(NamingError, match=told):
            read_template(file)
    with pytest.raises(NamingError, match="no such template"):
        read_template("snail")


@pytest.fixture
def run(tmp_path):
    skeleton, _ = figure(HUMAN)
    run = Run(tmp_path / "run")
    names = ("joint_positions", "joint_bodies", "joint_names", "body_rotations", "body_positions")
    run.write_npz("skeleton.npz", **{n: getattr(skeleton, n) for n in names}, fps=np.array(30.0))
    run.write_record({"source": {"up": "z"}})
    return run


def test_motion_files_hold_the_names_and_a_list_says_how_sure_they_are(run):
    exported = export_run(run, ["trc"])
    assert exported.found.sides_known
    assert {"knee_left", "elbow_right", "neck"} <= set(read_trc(exported.files["trc"]).names)
    assert '"thigh_left" = ' in (run.path / "names_found.toml").read_text()


def test_the_users_names_go_first_and_none_means_numbers(run, tmp_path):
    (run.path / "names.toml").write_text("mine = 1\n[joints]\nknee_left = 0\n")
    names = read_trc(export_run(run, ["trc"]).files["trc"]).names
    assert names[0] == "knee_left"
    assert len(set(names)) == len(names)
    plain = export_run(run, ["trc"], ExportSettings(names="none"), folder=tmp_path / "none")
    assert plain.found.template is None
    assert "neck" not in read_trc(plain.files["trc"]).names
    assert not (tmp_path / "none" / "names_found.toml").exists()
    with pytest.raises(NamingError, match="snail"):
        export_run(run, ["trc"], ExportSettings(names="snail"))


def test_a_list_of_names_that_an_export_removes_is_not_missed_by_the_run(run):
    run.renew("export", export_run(run, ["trc"]).touched)
    (run.path / "names_found.toml").unlink()
    assert run.faults() == {"names_found.toml": "missing"}
    run.renew("export", export_run(run, ["bvh"], ExportSettings(names="none")).touched)
    assert run.faults() == {}
    (run.path / "motion.trc").unlink()
    run.renew("export", export_run(run, ["bvh"]).touched)
    assert run.faults() == {"motion.trc": "missing"}, "what others removed is"


def test_what_the_user_names_by_words_of_a_template_is_known_as_that():
    skeleton, labels = figure(HUMAN, turn=0.7)
    given = dict(enumerate(labels))
    named = with_given(FoundNames(), given, skeleton, 2, (HUMAN, QUADRUPED, BIRD))
    found = find_names(skeleton, 2)
    assert named.template is HUMAN and named.sides_known and named.trunk == labels.index("pelvis")
    assert named.bodies == found.bodies and named.joints == found.joints and named.joint_parts == found.joint_parts
    assert named.from_world == pytest.approx(found.from_world, abs=0.12)
    angles = joint_angles(skeleton, named, tuple(skeleton.joint_names))
    assert {"knee_left_flexion", "elbow_right_flexion", "back_rotation"} <= set(angles.names)
    rested, _ = at_rest(motion_from_skeleton(skeleton, root=named.trunk), None, named, "T")
    assert rested.largest_deviation_mm(skeleton.joint_positions) < 1e-6
    # one who sees that left and right are wrong
    other = {labels.index("shank_left"): "shank_right", labels.index("shank_right"): "shank_left"}
    turned = with_given(found, other, skeleton, 2, (HUMAN, QUADRUPED, BIRD))
    knee = next(j for j, name in found.joints.items() if name == "knee_left")
    assert turned.joints[knee] == "knee_right" and turned.bodies[labels.index("thigh_left")] == "thigh_left"
    # words that say nothing of the kind of subject
    assert with_given(FoundNames(), {0: "head"}, skeleton, 2, (HUMAN, QUADRUPED, BIRD)) == FoundNames()
    assert with_given(found, {0: "box"}, skeleton, 2, (HUMAN,)) is found


def test_names_the_user_gives_reach_angles_and_other_programs_words(tmp_path):
    skeleton, labels = figure(HUMAN)
    run = Run(tmp_path / "run")
    fields = ("joint_positions", "joint_bodies", "joint_names", "body_rotations", "body_positions", "fps")
    run.write_npz("skeleton.npz", **{name: getattr(skeleton, name) for name in fields})
    run.write_record({"source": {"up": "z"}})
    swapped = {"thigh_left": "thigh_right", "thigh_right": "thigh_left"}
    lines = [f'"{swapped.get(name, name)}" = {b}' for b, name in enumerate(labels) if name != "hand_left"]
    (run.path / "names.toml").write_text("\n".join([*lines, f'"paw" = {labels.index("hand_left")}']))
    exported = export_run(run, ["glb"], ExportSettings(name_set="mixamo"))
    names = [n.name for n in pygltflib.GLTF2.load(str(exported.files["glb"])).nodes]
    assert names[0] == "mixamorig:Hips" and "paw" in names and "mixamorig:LeftUpLeg" in names
    assert exported.found.bodies[labels.index("thigh_right")] == "mixamorig:LeftUpLeg"
    assert exported.angles is not None and "knee_left_flexion" in exported.angles.names


def test_the_tree_of_a_person_grows_from_the_pelvis():
    skeleton, labels = figure(HUMAN)
    arms = skeleton.joint_bodies[labels.index("upper_arm_left") - 1, 0]
    hierarchy, numbers = skeleton.hierarchy.grown_from(int(arms))
    other = replace(
        skeleton,
        root=int(arms),
        joint_bodies=hierarchy.joint_bodies,
        joint_positions=skeleton.joint_positions[:, numbers],
    )
    found = find_names(other, 2)
    assert found.bodies[found.trunk] == "pelvis"
    motion = motion_from_skeleton(other, root=found.trunk)
    assert motion.bodies[0] == found.trunk and motion.parents[0] == -1
    assert motion.largest_deviation_mm(other.joint_positions) < 1e-6
    assert not motion.moving[1:].any()
    joints = {
        found.bodies[int(b)]: found.joints[int(j)] for b, j in zip(motion.bodies[1:], motion.joints[1:], strict=True)
    }
    assert joints["thorax"] == "back" and joints["thigh_left"] == "hip_left"
    R, _ = motion.forward_kinematics()
    assert np.abs(R - other.body_rotations[:, motion.bodies]).max() < 1e-12


@pytest.mark.parametrize("what", ["one body", "one frame", "no joints", "all in one place", "no rotation", "many"])
def test_subjects_of_which_little_is_known_keep_their_numbers(what):
    arrays = skeleton_arrays({"one body": 1, "many": 30}.get(what, 6), 1 if what == "one frame" else 10)
    if what == "no joints":
        arrays["joint_positions"][:] = np.nan
    if what == "all in one place":
        arrays["joint_positions"][:] = 0
        arrays["body_positions"][:] = 0
    if what == "no rotation":
        arrays["body_rotations"][:, 3] = np.nan
    assert find_names(skeleton_of(arrays), 2).bodies == {}


def test_a_limb_in_one_piece_more_is_named_as_the_other_side_is(tmp_path):
    """Knees low for a person, and the left thigh in two: where it is parted, a knee would fit better by itself."""
    skeleton, labels = with_a_thigh_in_two(tmp_path, 0.27, knee=0.18)
    found = find_names(skeleton, 2, templates=[HUMAN])
    named = dict(zip(labels, (found.bodies.get(b) for b in range(len(labels))), strict=True))
    same = [name for name in labels if name != "thigh_low_left"]
    assert [named[name] for name in same] == same and named["thigh_low_left"] in (None, "thigh_left_2")
    ways = match_tree(mean_posture(skeleton, 2, None), HUMAN)
    assert ways[0].score < max(way.score for way in ways)  # joint by joint the other would be likelier
