import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomocap.export.markers import Markers, markers_from_run
from geomocap.export.skeleton_motion import motion_from_skeleton
from geomocap.export.tables import motion_table, write_csv, write_parquet
from tests.geomocap.articulated import articulated_skeleton, skeleton_arrays, skeleton_of

pandas = pytest.importorskip("pandas")


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_read_back_by_pandas(tmp_path, ending):
    arrays = skeleton_arrays()
    arrays["joint_positions"][4, 2] = np.nan
    motion = motion_from_skeleton(skeleton_of(arrays))
    table = motion_table(markers_from_run(skeleton_of(arrays)), motion)
    if ending == "csv":
        write_csv(tmp_path / "m.csv", table)
        read = pandas.read_csv(tmp_path / "m.csv")
    else:
        pytest.importorskip("pyarrow")
        write_parquet(tmp_path / "m.parquet", table)
        read = pandas.read_parquet(tmp_path / "m.parquet")
    for j, name in enumerate(arrays["joint_names"]):
        found = read[[f"{name}_{axis}_m" for axis in "xyz"]].to_numpy()
        np.testing.assert_allclose(found, arrays["joint_positions"][:, j], atol=1e-6)
    assert read["frame"].dtype.kind == "i"
    np.testing.assert_allclose(read["time_s"], np.arange(20) / 15, atol=1e-6)
    for node in range(motion.n_nodes):
        name = motion.names[node]
        angles = read[[f"{name}_{axis}_deg" for axis in "zxy"]].to_numpy()
        turns = Rotation.from_euler("ZXY", angles, degrees=True)
        np.testing.assert_allclose(turns.as_matrix(), motion.rotations[:, node], atol=1e-6)
        np.testing.assert_allclose(read[f"{name}_turn_deg"], np.rad2deg(turns.magnitude()), atol=1e-4)


def test_frames_must_agree():
    from geomocap.export.export_errors import MotionError

    with pytest.raises(MotionError, match="3 frames of markers, but 20"):
        motion_table(Markers(("a",), np.zeros((3, 1, 3)), 15.0), motion_from_skeleton(articulated_skeleton()))
