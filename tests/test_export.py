"""Calibrations and clouds on disk: whole or as they were, and what cannot be written is said."""

from contextlib import nullcontext
from dataclasses import replace

import pytest
from shared import DATA, QUICK, stages
from test_session import CAMERAS, HEAD, LRF, pixels, wall

from lrfcal_lib import __main__ as command_line
from lrfcal_lib.calibrate import clouds
from lrfcal_lib.calibrate.cloud import write_ply
from lrfcal_lib.evaluate.export import write_calibration
from lrfcal_lib.measure.cloud_files import write_clouds, write_pcd
from lrfcal_lib.model.board import triangle_board
from lrfcal_lib.report import many
from lrfcal_lib.session import cache
from lrfcal_lib.session.read import open_session
from lrfcal_lib.session.write import SessionWriter

LITTLE = 100_000  # bytes; the cloud of the small session needs twice as many


@pytest.fixture(scope="module")
def cloud(quick):
    """The boards of the small session."""
    return clouds.color_cloud(quick, "joint")


@pytest.fixture(scope="module")
def ply(cloud, tmp_path_factory):
    """Its file."""
    path = tmp_path_factory.mktemp("cloud") / "cloud.ply"
    write_ply(path, [cloud])
    return path


WRITERS = {  # by the name of the file
    "calibration.json": lambda path, cloud, ply: write_calibration(
        path, {"numbers": [0.5] * LITTLE}
    ),
    "cloud.ply": lambda path, cloud, ply: write_ply(path, [cloud]),
    "scene.pcd": lambda path, cloud, ply: write_pcd(path, ply),
}


@pytest.mark.parametrize("before", [None, "of an earlier run"])
@pytest.mark.parametrize("name", WRITERS)
def test_on_a_full_disk_a_file_stays_as_it_was(
    cloud, ply, tmp_path, little_space, name, before
):
    file = tmp_path / name
    if before is not None:
        file.write_text(before)
    words = f"{name}: cannot be written .*: (free some space|check the disk).*, or name another folder"
    with little_space(LITTLE), pytest.raises(ValueError, match=words):
        WRITERS[name](file, cloud, ply)
    assert list(tmp_path.iterdir()) == [file] * (before is not None)
    assert before is None or file.read_text() == before


def test_a_cloud_that_breaks_off_leaves_no_file(cloud, tmp_path):
    def broken():
        yield cloud
        raise ValueError("no placement 7")

    with pytest.raises(ValueError, match="no placement 7"):
        write_ply(tmp_path / "cloud.ply", broken())
    assert list(tmp_path.iterdir()) == []


def test_clouds_of_another_rig_are_refused_and_leave_no_file(quick, tmp_path):
    other = replace(quick.prepared, session=open_session(DATA / "sim_lms221"))
    with pytest.raises(
        ValueError, match="camera 'left' has 640 x 480 pixels, its image 1024 x 768"
    ):
        write_clouds(tmp_path, replace(quick, prepared=other), "joint")
    assert list(tmp_path.iterdir()) == []


def test_a_session_of_scenes_is_coloured_by_the_calibration_of_another(quick, tmp_path):
    session = quick.prepared.session
    scenes = replace(
        session,
        placements=session.scene_placements,
        image_records=session.images(purpose="scene"),
    )
    found = write_clouds(
        tmp_path, replace(quick, prepared=replace(quick.prepared, session=scenes)), "joint"
    )
    assert [file.name for file in found] == ["scene.ply", "scene.pcd"] and all(
        map(type(found[0]).is_file, found)
    )


@pytest.fixture
def calibrate(tmp_path, monkeypatch, capsys):
    """Runs ``calibrate`` with an empty folder for its files: exit code, what it says, what it complains about."""
    monkeypatch.setenv(cache.VARIABLE, str(stages()))

    def calibrate(session):
        code = command_line.main(
            ["calibrate", str(session), "--out", str(tmp_path / "out")]
        )
        return code, *capsys.readouterr()

    return calibrate


def test_calibrate_on_a_full_disk_says_so(
    calibrate, quick, tmp_path, little_space, monkeypatch
):
    # processes that another test has left running would know nothing of the little space
    monkeypatch.setattr(many, "side_by_side", nullcontext)
    with little_space(LITTLE):
        code, _, complaint = calibrate(QUICK)
    assert (
        code == 1
        and complaint.startswith(f"error: {tmp_path}")
        and complaint.count("\n") == 1
    )
    assert (
        ".ply: cannot be written (File too large): free some space, or name another folder"
        in complaint
    )
    assert list((tmp_path / "out").iterdir()) == []


def test_calibrate_says_that_scenes_are_no_boards(calibrate, tmp_path):
    path = tmp_path / "session"
    with SessionWriter(path, triangle_board(), LRF, CAMERAS, HEAD) as writer:
        writer.add_sweep(1, *wall())
        writer.add_image("left", pixels(), 1, pitch=0.0, purpose="scene")
    code, said, complaint = calibrate(path)
    assert code == 3 and complaint == "" and said.count("\n") == 1
    assert said.startswith(
        f"{path}: all placements show scenes, and a calibration needs the board: record three"
    )
    assert not (tmp_path / "out").exists()
