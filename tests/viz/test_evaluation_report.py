import re

import pytest

from geomocap.evaluation.evaluation_settings import EvaluationSettings
from geomocap.evaluation.run_evaluation import evaluate
from geomocap.export.run_export import export_run
from tests.geomocap.made_truth import flawed_run, write_truth
from viz.evaluation_report import evaluation_report, worst_frame


@pytest.fixture(scope="module")
def run_and_truth(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    return flawed_run(folder / "run"), write_truth(folder / "truth")


def test_page_of_a_synthetic_truth(run_and_truth, tmp_path):
    run, truth = run_and_truth
    result = evaluate(run.path, truth, EvaluationSettings(every=5))
    evaluation_report(tmp_path / "e.html", result, run.path, truth)
    page = (tmp_path / "e.html").read_text()
    for name, value in result.rounded().items():
        assert f"<td>{name.replace('&', '&amp;')}</td>" in page
        assert f"{value:g}</td>" in page
    assert len(re.findall(r'src="data:image/webp;base64,', page)) == 6  # summaries, joints, bodies, three pictures
    assert "http://" not in page and "https://" not in page
    assert not re.search(r'src="(?!data:)', page)


def test_page_of_another_systems_markers(run_and_truth, tmp_path):
    run, _ = run_and_truth
    trc = export_run(run, ["trc"], folder=tmp_path).files["trc"]
    result = evaluate(run.path, trc, EvaluationSettings(find_offset=True, max_offset=0.2))
    evaluation_report(tmp_path / "e.html", result, run.path, trc)
    page = (tmp_path / "e.html").read_text()
    assert "markers.mean_error" in page
    assert "Where the errors are" not in page


def test_worst_frame_is_that_of_the_lowest_index(run_and_truth):
    run, truth = run_and_truth
    result = evaluate(run.path, truth, EvaluationSettings(every=5))
    curve = next(c for c in result.curves if c.name == "bodies: adjusted Rand index")
    assert worst_frame(result, run) == curve.frames[curve.values.argmin()]
