"""Write the list of tests that `make test-fast` leaves out, `tests/slow_tests.txt`.

    python -m tools.slow_tests          add those that have become slow since
    python -m tools.slow_tests --anew   measure all of them, which takes longer than `make test`

The tests run as `make test-fast` runs them, again and again until none that is left takes longer than the limit: what a
test leaves behind for others of its file, as a run that they look at, is made by the next of them.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
from pathlib import Path

ROOT = Path(__file__).parent.parent
LIST = ROOT / "tests" / "slow_tests.txt"
# Seconds, with what is made for the test. Of 2,200 tests that took 928 s one after the other those below it took 44.
LIMIT = 0.2


def main() -> None:
    """Run the tests and write the list."""
    slow = set() if "--anew" in sys.argv[1:] else listed()
    while True:
        write(slow)
        with tempfile.TemporaryDirectory() as folder:
            subprocess.run(["make", "test-fast", f"REPORTS={folder}"], cwd=ROOT, check=True)
            reports = [file.read_text(encoding="utf-8") for file in Path(folder).glob("*.xml")]
        more = set().union(*(slower_than(LIMIT, report) for report in reports)) - slow
        if not more:
            return
        slow |= more


def listed() -> set[str]:
    """Tests on the list, `tests/test_file.py::test_name`."""
    return set(LIST.read_text(encoding="utf-8").split())


def write(tests: set[str]) -> None:
    """Write the list, in order."""
    LIST.write_text("".join(f"{test}\n" for test in sorted(tests)), encoding="utf-8")


def slower_than(limit: float, report: str) -> set[str]:
    """Tests of which some case took longer, by pytest's report in JUnit's XML."""
    cases = ET.fromstring(report).iter("testcase")
    return {
        f"{case.attrib['classname'].replace('.', '/')}.py::{case.attrib['name'].partition('[')[0]}"
        for case in cases
        if float(case.attrib["time"]) > limit
    }


if __name__ == "__main__":
    main()
