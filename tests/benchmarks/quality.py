"""How good whole runs are: the first table of the page of results, made anew.

`python -m tests.benchmarks.quality FOLDER [NAME …]` synthesizes each capture into FOLDER, runs it with the defaults,
compares it with its truth and prints one row each. What is there already is taken, so that it may be stopped and
shared between processes; each figure keeps the commit that it was measured with. `--results FILE.toml` puts the rows
into a table of `docs/results`. `--noise` measures perfect tracks with noise, and cut short, instead. Captures of
characters that are files need the folder of data in `GEOMOCAP_DATA`.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.asset import AnimatedAsset
from data_tools.figure import figure, mechanism
from data_tools.gltf_reader import load_gltf
from data_tools.synthesize import SynthesisSettings, synthesize, write_truth
from tests.benchmarks.changes import (
    crop,
    different_cameras,
    fresh_samples,
    give_silhouettes,
    perfect_tracks,
    reverse,
    worse_tracks,
)
from tests.benchmarks.creatures import fan, runner, snake, spider
from tools.result_tables import ROOT, measured_now, read_table

DATA = Path(os.environ.get("GEOMOCAP_DATA", "."))
TABLE = ROOT / "docs" / "results" / "whole-runs.toml"
NOISES = (0, 2, 5, 10, 20)  # mm


def man() -> AnimatedAsset:
    return load_gltf(DATA / "characters" / "CesiumMan.glb", None)


def horse(clip: str) -> Callable[[], AnimatedAsset]:
    return lambda: load_gltf(DATA / "characters" / "horse-animations.glb", clip)


@dataclass(frozen=True)
class Case:
    """One row of the table.

    Attributes
    ----------
    subject : callable
        Makes the animated subject.
    synthesis : dict
        How its capture differs from eight cameras of 640×480 and 60 frames at 30 a second.
    change : callable, optional
        What is done to the folders of capture and truth afterwards.
    flags : tuple of str
        What the run is told beyond the defaults.
    scans : callable, optional
        Makes scans of the truth, which are segmented instead of the images.
    """

    subject: Callable[[], AnimatedAsset]
    synthesis: dict[str, float] = field(default_factory=dict)
    change: Callable[[Path, Path], None] | None = None
    flags: tuple[str, ...] = ()
    scans: Callable[[Path, Path], None] | None = None


SUBJECTS = {
    "man walking": man,
    "horse walking": horse("Walk"),
    "horse turning": horse("Turn_Left"),
    "horse rearing": horse("Rear"),
    "horse kicking": horse("Kick"),
}
IN_NOISE = {
    f"{name}, {how}": Case(subject, scans=scans, flags=("--paths", "points"))
    for name, subject in {"man": man, "horse": SUBJECTS["horse walking"], "mechanism": mechanism}.items()
    for how, scans in {
        **{f"{noise} mm": worse_tracks(noise / 1000) for noise in NOISES},
        "15 frames": worse_tracks(length=15),
    }.items()
}
CASES = {
    "man walking, 30 fps": Case(man),
    "the same, 15 fps": Case(man, {"fps": 15}),
    "5 cameras": Case(man, {"cameras": 5}),
    "three of 8 cameras see a part of him only": Case(man, change=crop),
    "five lens models, four sizes, noise, lossy images and videos": Case(man, change=different_cameras),
    "half the texture contrast": Case(man, {"texture_contrast": 0.14}),
    "silhouettes given, eroded by a pixel": Case(man, change=give_silhouettes(-1)),
    "dilated by a pixel": Case(man, change=give_silhouettes(1)),
    "another seed": Case(man, flags=("--tracking.seed", "1", "--nodes.seed", "1")),
    "frames reversed": Case(man, change=reverse),
    **{name: Case(subject) for name, subject in SUBJECTS.items() if name.startswith("horse")},
    "mechanism": Case(mechanism),
    "figure running, 2.5 m/s": Case(runner),
    "spider": Case(spider),
    "snake": Case(snake),
    "fan": Case(fan),
    "figure, 4 cameras 320×240, 15 fps": Case(figure, {"cameras": 4, "width": 320, "height": 240, "fps": 15}),
    "figure, 4 cameras": Case(figure, {"cameras": 4}),
    "horse walking, 4 cameras": Case(SUBJECTS["horse walking"], {"cameras": 4}),
    "man walking, 4 cameras": Case(man, {"cameras": 4}),
    "man walking, volumes only": Case(
        man, flags=("--source", "voxels", "--segmentation.paths", "nodes", "--nodes.colors", "false")
    ),
    **{f"{name}, perfect tracks": Case(subject, scans=perfect_tracks) for name, subject in SUBJECTS.items()},
    **{
        f"{name}, 4,096 points sampled anew in each of 30 frames": Case(subject, {"frames": 30}, scans=fresh_samples)
        for name, subject in SUBJECTS.items()
    },
}


def folder_name(name: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in name)


def measure(name: str, root: Path) -> dict[str, Any]:
    """Make a capture, run it and compare it with its truth, unless that was done before: the row of the results."""
    case, folder = (CASES | IN_NOISE)[name], root / folder_name(name)
    figures, origin = folder / "figures.json", folder / "origin.json"
    if not (figures.exists() and origin.exists()):
        seed = int(case.flags[case.flags.index("--tracking.seed") + 1]) if "--tracking.seed" in case.flags else 0
        began = measured_now(f'python -m tests.benchmarks.quality FOLDER "{name}"', seed)
        capture, truth, run = folder / "capture", folder / "truth", folder / "run"
        if case.change is not None or not (capture / "capture.toml").exists():
            shutil.rmtree(folder, ignore_errors=True)
            make = synthesize if case.scans is None else _without_images
            make(case.subject(), capture, truth, SynthesisSettings(**case.synthesis))
        if case.change is not None:
            case.change(capture, truth)
        if case.scans is None:
            _call("run", capture, run, "--no-pictures", *case.flags)
        else:
            case.scans(truth, folder / "scans.npz")
            fps = str(SynthesisSettings(**case.synthesis).fps)
            _call("segment", folder / "scans.npz", run, "--fps", fps, "--no-pictures", *case.flags)
        _call("evaluate", run, truth, "--json", figures)
        origin.write_text(json.dumps(began, default=str))
    came = json.loads(origin.read_text())
    return row(name, json.loads(figures.read_text())) | came | {"date": date.fromisoformat(came["date"])}


def _without_images(asset: AnimatedAsset, _: Path, truth: Path, settings: SynthesisSettings) -> None:
    times = np.arange(settings.frames) / settings.fps
    write_truth(asset, times, np.array([asset.vertices(t) for t in times]), settings, truth)


def row(name: str, figures: dict[str, float]) -> dict[str, Any]:
    """Return the figures of an evaluation as the tables of results name them."""
    connections = int(figures["truth.bodies"]) - 1
    return {
        "name": name,
        "bodies_found": int(figures["bodies.found"]),
        "bodies_true": int(figures["truth.bodies"]),
        "ari": figures["bodies.adjusted_rand_index"],
        "core_ari": figures["bodies.core_adjusted_rand_index"],
        "joint_recall": figures["joints.recall_at_5%h"],
        "joint_precision": figures["joints.precision_at_10%h"],
        "joint_error_mm": figures["joints.mean_error"],
        "edges_found": round(figures["skeleton.true_edges_found"] * connections),
        "edges_true": connections,
        "edges_false": int(figures["skeleton.false_edges"]),
        "rotation_error_deg": figures["motion.body_rotation_error_deg"],
    }


def _call(command: str, *arguments: Path | str) -> None:
    line = [sys.executable, "-m", "geomocap", command, *map(str, arguments)]
    subprocess.run(line, check=True, stdout=subprocess.DEVNULL)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--noise", action="store_true", help="tracks with noise, and short ones")
    parser.add_argument("--results", type=Path, help="table of results that takes the rows, docs/results/….toml")
    arguments = parser.parse_args()
    layout = read_table(arguments.results or TABLE)
    columns = layout.values["columns"]
    print("| " + " | ".join(column["label"] for column in columns) + " |\n" + "|---" * len(columns) + "|")
    for name in arguments.names or (IN_NOISE if arguments.noise else CASES):
        measured = measure(name, arguments.folder)
        print("| " + " | ".join(layout.cells(measured, columns)) + " |", flush=True)
        if arguments.results is not None:
            read_table(arguments.results).with_rows([measured]).write()


if __name__ == "__main__":
    main()
