"""Frames mapped over a Dask cluster give the same files as threads do."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.cli.conftest import QUICK, SETTINGS
from tests.cli.test_run import digests

pytest.importorskip("distributed")

CLUSTER = """
import sys
from distributed import LocalCluster
with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None, host="127.0.0.1") as cluster:
    print(cluster.scheduler_address, flush=True)
    sys.stdin.readline()
"""


@pytest.fixture
def scheduler():
    with subprocess.Popen(
        [sys.executable, "-c", CLUSTER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin and process.stdout
        yield process.stdout.readline().strip()
        process.stdin.write("\n")


def test_cluster_gives_the_same_files(small_capture, geomocap, scheduler, tmp_path):
    geomocap("voxels", small_capture, tmp_path / "threads", *SETTINGS)
    arguments = ["run", small_capture, tmp_path / "dask", *QUICK, "--no-pictures", "--scheduler", scheduler]
    result = subprocess.run([sys.executable, "-m", "geomocap", *arguments], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    made = digests(tmp_path / "dask")
    expected = digests(tmp_path / "threads")
    assert expected and {name: made[name] for name in expected} == expected
