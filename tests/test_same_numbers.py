"""A session gives the same bytes, whatever the threads, the order of sets and the load, and without its truth."""

import json
import os
import shutil
import subprocess
import sys

from shared import QUICK

CALIBRATE = """
import sys
if sys.argv[2] == "before":  # libraries that are there already have counted the threads that they are to use
    import cv2, numpy, scipy.linalg
from lrfcal_lib.calibrate import pipeline, reconstruct
from lrfcal_lib.evaluate import export, tables
from lrfcal_lib.report import notebook
found = pipeline.calibrate(export.open_session(sys.argv[1]))
method = tables.handed_over(found)
export.write_calibration("calibration.json", export.calibration_record(found, method))
reconstruct.write_ply("cloud.ply", pipeline.color_cloud(found, method))
notebook.table(tables.intrinsics_table(found.prepared.models), "intrinsics")
notebook.table(tables.platform_calibration_table(found.platform), "platform")
notebook.table(tables.camera_calibration_table(found.solutions), "cameras")
notebook.table(tables.edge_lengths(found.prepared), "edges")
"""
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")


def test_two_runs_side_by_side_give_the_same_bytes(tmp_path):
    base = {key: value for key, value in os.environ.items() if key not in THREADS}
    runs = {
        "before": base | {"PYTHONHASHSEED": "1"},
        "after": base | {"PYTHONHASHSEED": "2"} | dict.fromkeys(THREADS, "3"),
    }
    processes = []
    for name, environment in runs.items():
        folder = tmp_path / name
        folder.mkdir()
        session = shutil.copytree(QUICK, tmp_path / f"session {name}" / QUICK.name)
        if name == "after":
            (session / "truth.json").unlink()
        command = [sys.executable, "-c", CALIBRATE, str(session), name]
        environment |= {"LRFCAL_REPORT": str(folder)}
        processes.append(subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.DEVNULL))
    assert [process.wait() for process in processes] == [0, 0]
    written = [{file.name: file.read_bytes() for file in (tmp_path / name).rglob("*.*")} for name in runs]
    assert {"calibration.json", "cloud.ply", "edges.csv"} <= set(written[0])
    for files in written:
        files["calibration.json"] = json.loads(files["calibration.json"])
        files["calibration.json"]["inputs_sha256"].pop("truth.json", None)
    assert [name for name in written[0] if written[0][name] != written[1][name]] == []
