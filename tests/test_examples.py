"""The scripts in `examples/`, run as users run them, on small inputs."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from data_tools.figure import figure
from data_tools.synthesize import SynthesisSettings, synthesize
from geomocap.files.rigs import read_rig
from tests.geomocap.moving_chains import chain, same_partition

EXAMPLES = Path(__file__).parent.parent / "examples"


def run_example(name: str, monkeypatch: pytest.MonkeyPatch, *arguments: object) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
    module.main()
    return module


def test_every_example_is_tested_and_short():
    assert {p.stem for p in EXAMPLES.glob("*.py")} == {"capture_to_skeleton", "scans_to_bodies", "calibrate_by_bar"}
    for file in EXAMPLES.glob("*.py"):
        assert len(file.read_text().splitlines()) <= 60, file


def test_a_capture_to_a_skeleton(tmp_path, monkeypatch, capsys):
    settings = SynthesisSettings(cameras=4, width=160, height=120, fps=10, frames=6)
    synthesize(figure(), tmp_path / "capture", tmp_path / "truth", settings)
    settings_file = "[carving]\nresolution = 64\n[nodes]\nnodes = 240\n[tracking]\nn_patches = 400\n"
    (tmp_path / "settings.toml").write_text(settings_file)
    run_example(
        "capture_to_skeleton",
        monkeypatch,
        tmp_path / "capture",
        tmp_path / "run",
        "--config",
        tmp_path / "settings.toml",
    )
    told = capsys.readouterr().out
    skeleton = np.load(tmp_path / "run" / "skeleton.npz")
    assert f"{skeleton['body_rotations'].shape[1]} bodies" in told
    assert all(f"{name}: travelled" in told for name in skeleton["joint_names"])
    assert (tmp_path / "run" / "motion.bvh").exists()


def test_any_scans_to_bodies(tmp_path, monkeypatch, capsys):
    truth = chain(3)
    np.savez(tmp_path / "scans.npz", points=1000 * truth.positions.swapaxes(0, 1))
    run_example("scans_to_bodies", monkeypatch, tmp_path / "scans.npz", "--labels", tmp_path / "labels.npz")
    frames = truth.positions.shape[1]
    told = capsys.readouterr().out.splitlines()
    assert told[0] == f"3 bodies in {frames} scans"
    assert sum(" between bodies " in line for line in told) == 2
    assert "likely no metres" in told[-1]
    labels = np.load(tmp_path / "labels.npz")
    assert len(labels.files) == frames
    assert same_partition(labels["frame_000000"], truth.body)


def test_a_calibration_by_bar(tmp_path, monkeypatch, capsys):
    settings = SynthesisSettings(
        cameras=4, width=320, height=240, fps=10, frames=1, bar=40, withhold_calibration=True, distortion=0.0
    )
    synthesize(figure(), tmp_path / "capture", tmp_path / "truth", settings)
    run_example("calibrate_by_bar", monkeypatch, tmp_path / "capture")
    told = capsys.readouterr().out
    assert "bar ends are known to" in told and told.count("camera ") >= 4
    found, true = (read_rig(tmp_path / folder / "sparse").centers for folder in ("capture", "truth"))
    # the world's frame is free: distances between cameras are compared (they are right to 0.014 %)
    apart = [np.linalg.norm(c[:, None] - c[None], axis=2)[np.triu_indices(4, 1)] for c in (found, true)]
    np.testing.assert_allclose(apart[0], apart[1], rtol=1e-3)
