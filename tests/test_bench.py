"""The bench runs and writes every figure; how large they are is for ``make bench`` on an idle machine."""

import json

import bench
from shared import campaign

KEYS = """
camera_solve_ms camera_solve_vs_scipy monte_carlo_1000_s monte_carlo_vs_scipy joint_100_s joint_vs_gtsam
colour_mpoints_per_s colour_vs_cv2 decode_mb_per_s image_12mp_s survey_12mp_png_s
study_2_workers_s study_scaling study_task_ms study_overhead_ms study_most_workers_on_paper
join_4_stations_s
calibrate_s reconstruct_s merge_s report_s peak_mb_1e8_points
""".split()


@campaign
def test_the_bench_writes_every_figure(tmp_path):
    bench.main(tmp_path, bench.TINY)
    found = json.loads((tmp_path / "bench.json").read_text())
    empty = {
        "calibrate_s",
        "reconstruct_s",
        "merge_s",
        "report_s",
        "joint_vs_gtsam",
    }  # not at this size; where there is no GTSAM
    assert all(found[key] > 0 for key in KEYS if key not in empty) and empty <= set(found)
    assert "GTSAM" in (tmp_path / "bench.csv").read_text()
