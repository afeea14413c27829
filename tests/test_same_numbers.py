"""A session gives the same bytes, whatever the threads, the order of sets and the load, and without its truth."""

import json
import os
import shutil
import subprocess
import sys

from shared import QUICK, stages

from lrfcal_lib.session import cache

CALIBRATE = """
import sys
import cv2, numpy, scipy.linalg  # libraries that are there already have counted the threads that they are to use
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


def test_another_process_gives_the_same_bytes(tmp_path, monkeypatch):
    """With other threads, another order of sets, no truth, and nothing that this test run has worked out before."""
    folders = [tmp_path / name for name in ("here", "there")]
    for folder in folders:
        folder.mkdir()
    session = shutil.copytree(QUICK, tmp_path / "copy" / QUICK.name)
    (session / "truth.json").unlink()
    environment = os.environ | {"PYTHONHASHSEED": "2", "LRFCAL_REPORT": str(folders[1])} | dict.fromkeys(THREADS, "3")
    command = [sys.executable, "-c", CALIBRATE, str(session)]
    process = subprocess.Popen(command, cwd=folders[1], env=environment, stdout=subprocess.DEVNULL)
    for name, value in {"LRFCAL_REPORT": folders[0], cache.VARIABLE: stages()}.items():
        monkeypatch.setenv(name, str(value))
    monkeypatch.chdir(folders[0])
    monkeypatch.setattr(sys, "argv", ["", str(QUICK)])
    exec(CALIBRATE, {})
    assert process.wait() == 0
    written = [{file.name: file.read_bytes() for file in folder.rglob("*.*")} for folder in folders]
    assert {"calibration.json", "cloud.ply", "edges.csv"} <= set(written[0])
    for files in written:
        files["calibration.json"] = json.loads(files["calibration.json"])
        files["calibration.json"]["inputs_sha256"].pop("truth.json", None)
    assert [name for name in written[0] if written[0][name] != written[1][name]] == []
