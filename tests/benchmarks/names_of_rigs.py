"""Found names against the truth: `python -m tests.benchmarks.names_of_rigs RUN TRUTH [RUN TRUTH ...]`.

Prints a row for each run, the sum, and a confusion table: what most of a body is, and what it was called. The rigs' own
words say what each part of the surface is; a table of patterns turns them into the templates' parts. `--template NAME`
before the folders asks for that template instead of the one that fits.
"""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
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
SIGNS = [("wing", "bird"), ("tail|front_?leg|front_?shoulder|hoof", "quadruped"), ("", "human")]  # of a rig's kind
SIDE = re.compile(r"(?:[._]|joint_)([lr])(?:$|_)", re.IGNORECASE)


@dataclass(frozen=True)
class Score:
    """How right names are: counts of bodies, and for each body what most of it is and what it was called.

    `pairs` are (true part, parts called, right), without sides; parts called are joined by +, "-" for none.
    """

    bodies: int
    named: int
    right: int
    same_side: int
    other_side: int
    mistakes: tuple[tuple[str, str], ...]
    pairs: tuple[tuple[str, str, bool], ...]


def score(found: FoundNames, surface: BodySurface, truth: Truth, kind: str, count: int) -> Score:
    """Compare: a body is named right if half of its surface or more is on the parts that its name says."""
    parts, sides = zip(*(part_of(str(name), kind) for name in truth.joint_names), strict=True)
    joint = truth.vertex_joint[cKDTree(truth.vertices[0]).query(surface.points)[1]]
    named, right, same, other = 0, 0, 0, 0
    mistakes: list[tuple[str, str]] = []
    pairs: list[tuple[str, str, bool]] = []
    template = found.template
    for body in range(count):
        mine = joint[surface.bodies == body]
        share = Counter(parts[j] for j in mine.tolist())
        most = share.most_common(1)[0][0] if share else "?"
        if body not in found.bodies:
            pairs.append((most, "-", False))
            continue
        assert template is not None
        meant = {template.parts[p] for p in found.parts[body]}
        good = sum(share[p] for p in meant) >= 0.5 * len(mine)
        called = "+".join(dict.fromkeys(template.parts[p] for p in found.parts[body]))
        pairs.append((most, called, good))
        named += 1
        if not good:
            mistakes.append((found.bodies[body], most))
            continue
        right += 1
        side = {template.sides[p] for p in found.parts[body]}
        if side in ({"left"}, {"right"}):
            on = Counter(sides[j] for j in mine.tolist())
            good = (on["l"] > on["r"]) == (side == {"left"})
            same, other = same + good, other + (not good)
    return Score(count, named, right, same, other, tuple(mistakes), tuple(pairs))


def part_of(name: str, kind: str) -> tuple[str, str]:
    """Part of a template and side, "l", "r" or "", of a rig joint."""
    part = next((p for pattern, p in PARTS[kind] if re.search(pattern, name, re.IGNORECASE)), "?")
    side = SIDE.search(name)
    return part, side[1].lower() if side else ""


def kind_of(truth: Truth) -> str:
    """Kind of subject, by the words of its rig."""
    words = " ".join(map(str, truth.joint_names))
    return next(kind for sign, kind in SIGNS if re.search(sign, words, re.IGNORECASE))


def confusion(pairs: Collection[tuple[str, str, bool]]) -> str:
    """Return a table: rows are what bodies are, columns what they were called; merged parts count as right."""
    counts = Counter(((true, true if good else called) for true, called, good in pairs))
    rows = sorted({true for true, _ in counts})
    columns = [*sorted({called for _, called in counts if called != "-"}), "-"]
    wide = max(len(row) for row in rows)
    lines = [" " * wide + "".join(f" {n + 1:3d}" for n in range(len(columns) - 1)) + "  no name"]
    for row in rows:
        cells = "".join(f" {counts[row, column] or '.':>3}" for column in columns[:-1])
        lines.append(f"{row:{wide}s}{cells}  {counts[row, '-'] or '.':>7}")
    return "\n".join([*lines, *(f"{n + 1:3d} {column}" for n, column in enumerate(columns[:-1]))])


def main(arguments: list[str]) -> None:
    """Print the tables for RUN TRUTH, two by two."""
    asked = None
    if arguments[:1] == ["--template"]:
        asked, arguments = [read_template(arguments[1])], arguments[2:]
    if not arguments or len(arguments) % 2:
        sys.exit("expected RUN TRUTH [RUN TRUTH ...]")
    print(f"{'run':14s} kind       template   bodies named right sides  same other  mistakes")
    sums, pairs = np.zeros(5, int), []
    for run_folder, truth_folder in zip(arguments[::2], arguments[1::2], strict=True):
        run, truth = Run(Path(run_folder)), Truth.read(Path(truth_folder))
        skeleton, kind = read_skeleton(run), kind_of(truth)
        surface = surface_of_bodies(run, skeleton)
        if surface is None:
            sys.exit(f"{run_folder}: no model.npz")
        found = find_names(skeleton, "xyz".index(run_up(run)), surface, asked)
        s = score(found, surface, truth, kind, skeleton.body_count)
        template = found.template.name if found.template else "none"
        told = "told" if found.sides_known else "a, b"
        wrong = ", ".join(f"{name} is {true}" for name, true in s.mistakes)
        print(
            f"{run.path.name:14s} {kind:10s} {template:10s} {s.bodies:6d} {s.named:5d} {s.right:5d} {told:6s} "
            f"{s.same_side:4d} {s.other_side:5d}  {wrong}"
        )
        # a and b are no sides: which of them is the left isn't said
        sums += [s.bodies, s.named, s.right, *((s.same_side, s.other_side) if found.sides_known else (0, 0))]
        pairs += s.pairs
    bodies, named, right, same, other = sums.tolist()
    print(f"{named} of {bodies} bodies named, {right} right; sides told {same + other}, {other} swapped\n")
    print(confusion(pairs))


if __name__ == "__main__":
    main(sys.argv[1:])
