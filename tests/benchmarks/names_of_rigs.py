"""Found names against the truth: `python -m tests.benchmarks.names_of_rigs KIND RUN TRUTH ...` prints a table.

The rigs' own words say what each part of the surface is; a table of patterns turns them into the templates' parts.
"""

from __future__ import annotations

import re
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from scipy.spatial import cKDTree

from geomocap.evaluation.truth import Truth
from geomocap.export.run_export import run_up
from geomocap.export.run_names import surface_of_bodies
from geomocap.files.results import read_skeleton
from geomocap.files.run import Run
from geomocap.naming.found_names import FoundNames, find_names
from geomocap.naming.mean_posture import BodySurface
from geomocap.naming.name_templates import read_template

# First pattern that is found in a rig joint's name, by kind of subject
PARTS = {
    "human": [
        ("leg_joint_._1", "thigh"), ("leg_joint_._2", "shank"), ("leg_joint", "foot"),
        ("arm_joint_(R|L__4_)$", "upper_arm"), ("arm_joint_(R__2_|L__3_)", "forearm"), ("arm_joint", "hand"),
        ("torso_joint_1", "pelvis"), ("torso_joint", "thorax"), ("neck_joint", "head"),
        ("upper_?arm|shoulder", "upper_arm"), ("lower_?arm|forearm|wrist", "forearm"),
        ("hand|palm|pinky|ring|index|thumb", "hand"), ("upper_?leg|thigh", "thigh"), ("lower_?leg|shank", "shank"),
        ("foot|toe", "foot"), ("head", "head"), ("neck|chest", "thorax"), ("hips|spine|body|torso", "pelvis"),
    ],
    "quadruped": [
        ("front_?shoulder|scapula|humerus|front_?upper_?leg|front_leg_upper", "front_upper_leg"),
        ("front_?lower_?leg|front_leg_lower", "front_lower_leg"), ("front_leg|ikfront|^ff\\.", "front_foot"),
        ("back_?shoulder|backleg|back_leg_(pelvis|upper)", "hind_upper_leg"),
        ("backupperleg|back_leg_lower", "hind_lower_leg"), ("backlowerleg|back_leg|ikback|ffb", "hind_foot"),
        ("tail", "tail"), ("neck|spine_5", "neck"), ("head|ear|mouth|jaw|eye", "head"),
        ("torso[23]|ribcage|spine_[34]", "forequarters"), ("body|back|torso|hips|root|spine", "hindquarters"),
    ],
    "bird": [
        ("wing_[12]_|wing_feather_[12]", "wing"), ("wing", "wing_tip"), ("upperleg|lowerleg", "leg"),
        ("ankle|foot|toes", "foot"), ("tail", "tail"), ("head|spine_[23]|mouth", "head"), ("", "body"),
    ],
}  # fmt: skip
SIDE = re.compile(r"(?:[._]|joint_)([lr])(?:$|_)", re.IGNORECASE)


@dataclass(frozen=True)
class Score:
    """How right names are: counts of bodies, and pairs (name, what most of it is) of the wrong ones."""

    bodies: int
    named: int
    right: int
    same_side: int
    other_side: int
    mistakes: tuple[tuple[str, str], ...]


def score(found: FoundNames, surface: BodySurface, truth: Truth, kind: str, count: int) -> Score:
    """Compare: a body is named right if half of its surface or more is on the parts that its name says."""
    parts, sides = zip(*(part_of(str(name), kind) for name in truth.joint_names), strict=True)
    joint = truth.vertex_joint[cKDTree(truth.vertices[0]).query(surface.points)[1]]
    named, right, same, other, mistakes = 0, 0, 0, 0, []
    template = found.template
    for body, name in found.bodies.items():
        assert template is not None
        mine = joint[surface.bodies == body]
        share = Counter(parts[j] for j in mine.tolist())
        meant = {template.parts[p] for p in found.parts[body]}
        named += 1
        if sum(share[p] for p in meant) < 0.5 * len(mine):
            mistakes.append((name, share.most_common(1)[0][0]))
            continue
        right += 1
        side = {template.sides[p] for p in found.parts[body]}
        if side in ({"left"}, {"right"}):
            on = Counter(sides[j] for j in mine.tolist())
            good = (on["l"] > on["r"]) == (side == {"left"})
            same, other = same + good, other + (not good)
    return Score(count, named, right, same, other, tuple(mistakes))


def part_of(name: str, kind: str) -> tuple[str, str]:
    """Part of a template and side, "l", "r" or "", of a rig joint."""
    part = next((p for pattern, p in PARTS[kind] if re.search(pattern, name, re.IGNORECASE)), "?")
    side = SIDE.search(name)
    return part, side[1].lower() if side else ""


def main(arguments: list[str]) -> None:
    """Print a row for each run: KIND RUN TRUTH, three by three; KIND! takes this template without asking."""
    print(f"{'run':14s} template   bodies named right sides  same other  mistakes")
    for kind, run_folder, truth_folder in zip(*(arguments[k::3] for k in range(3)), strict=True):
        run = Run(Path(run_folder))
        skeleton = read_skeleton(run)
        surface = surface_of_bodies(run, skeleton)
        if surface is None:
            sys.exit(f"{run_folder}: no model.npz")
        asked = [read_template(kind[:-1])] if kind.endswith("!") else None
        found = find_names(skeleton, "xyz".index(run_up(run)), surface, asked)
        s = score(found, surface, Truth.read(Path(truth_folder)), kind.rstrip("!"), skeleton.body_count)
        template = found.template.name if found.template else "none"
        told = "told" if found.sides_known else "a, b"
        wrong = ", ".join(f"{name} is {true}" for name, true in s.mistakes)
        print(
            f"{run.path.name:14s} {template:10s} {s.bodies:6d} {s.named:5d} {s.right:5d} {told:6s} "
            f"{s.same_side:4d} {s.other_side:5d}  {wrong}"
        )


if __name__ == "__main__":
    main(sys.argv[1:])
