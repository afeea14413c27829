"""A session gives the same bytes, whatever the processors, the threads, the order of sets and the load, and without its
truth."""

import json
import os
import shutil
import subprocess
import sys

from shared import QUICK, ROOT, campaign

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
CALIBRATE = "import os, runpy, sys; {}; runpy.run_module('lrfcal_lib', run_name='__main__', alter_sys=True)"
RUNS = {  # what comes before, and the environment; libraries that are there already have counted their threads
    "one": ("os.sched_setaffinity(0, [min(os.sched_getaffinity(0))]); import cv2, numpy, scipy.linalg",
            {"PYTHONHASHSEED": "1"}),
    "all": ("0", {"PYTHONHASHSEED": "2"} | dict.fromkeys(THREADS, "3")),
}  # fmt: skip


@campaign
def test_two_runs_side_by_side_give_the_same_bytes(tmp_path):
    base = {key: value for key, value in os.environ.items() if key not in THREADS} | {
        "PYTHONPATH": str(ROOT)
    }
    processes = []
    for name, (before, environment) in RUNS.items():
        session = shutil.copytree(QUICK, tmp_path / f"session {name}" / QUICK.name)
        if name == "all":
            (session / "truth.json").unlink()
        (folder := tmp_path / name).mkdir()
        command = [
            sys.executable,
            "-c",
            CALIBRATE.format(before),
            "calibrate",
            str(session),
        ]
        run = subprocess.Popen(
            command, cwd=folder, env=base | environment, stdout=subprocess.DEVNULL
        )
        processes.append(run)
    assert [process.wait() for process in processes] == [0, 0]
    written = [
        {file.name: file.read_bytes() for file in (tmp_path / name).rglob("*.*")}
        for name in RUNS
    ]
    assert {"calibration.json", "cloud.ply"} <= set(written[0])
    for files in written:
        files["calibration.json"] = json.loads(files["calibration.json"])
        files["calibration.json"]["inputs_sha256"].pop("truth.json", None)
        files["calibration.json"].pop("date")
    assert written[0].keys() == written[1].keys()
    assert [name for name in written[0] if written[0][name] != written[1][name]] == []
