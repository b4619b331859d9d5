"""The list of slow tests is made from pytest's reports, and names tests that are there."""

from __future__ import annotations

import ast

from tools.slow_tests import ROOT, listed, slower_than

REPORT = """<testsuites><testsuite>
<testcase classname="tests.viz.test_film" name="test_whole" time="2.0" />
<testcase classname="tests.viz.test_film" name="test_part[a]" time="0.1" />
<testcase classname="tests.viz.test_film" name="test_part[b-c]" time="0.4" />
<testcase classname="tests.test_docs" name="test_links" time="0.3" />
</testsuite></testsuites>"""


def test_a_test_is_slow_if_one_of_its_cases_is():
    assert slower_than(0.3, REPORT) == {"tests/viz/test_film.py::test_whole", "tests/viz/test_film.py::test_part"}


def test_listed_tests_are_there():
    gone = []
    for test in sorted(listed()):
        file, _, name = test.partition("::")
        path = ROOT / file
        functions = ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if path.is_file() else ()
        if not any(isinstance(part, ast.FunctionDef) and part.name == name for part in functions):
            gone.append(test)
    assert not gone, "delete them from tests/slow_tests.txt"
