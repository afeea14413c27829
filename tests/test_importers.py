"""Other people's recordings become sessions without loss."""

import os
import re

import numpy as np
import pytest
from tiny_import import BOUGUET, authors_points, write_source

from lrfcal_lib.__main__ import main
from lrfcal_lib.model.geometry import lrf_to_platform, polar_to_points
from lrfcal_lib.session import importers
from lrfcal_lib.session.files import SessionError, naming
from lrfcal_lib.session.importers import (
    import_lasersetero,
    read_bouguet,
    read_pcd,
    recover_polar,
)
from lrfcal_lib.session.read import open_session


@pytest.fixture
def source(tmp_path):
    return write_source(tmp_path / "src", np.random.default_rng(1))


def written(file, text):
    file.write_text(text)
    return file


def without(pattern):
    """Import a folder in which files are missing."""

    def work(folder):
        for file in folder.glob(pattern):
            file.unlink()
        import_lasersetero(folder, folder.parent / "dst")

    return work


def cloud(change):
    """Read a cloud with another text."""

    return lambda folder: read_pcd(
        written(folder / "a.pcd", change((folder / "plane_01.pcd").read_text()))
    )


def no_file(name, make):
    """Import a folder in which something else has the name of a file."""

    def work(folder):
        (folder / name).unlink()
        make(folder / name)
        import_lasersetero(folder, folder.parent / "other")

    return work


def long(file):
    file.touch()
    os.truncate(file, 3_000_000_000)


def results(old, new):
    """Read results of a calibration with another text."""
    return lambda folder: read_bouguet(written(folder / "c.m", BOUGUET.replace(old, new)))


def recovered(name, points):
    """What points of a file with this name were made of, as they are when it is imported."""
    with naming(name):
        return recover_polar(points)


def scattered(lines):
    """Points of which each begins a scan line."""
    return authors_points(
        np.full(lines, 1.5),
        np.where(np.arange(lines) % 2, 5.0, 5.1),
        np.arange(lines) % 7 / 100 + 1,
    )


def line(first):
    return authors_points(np.full(50, 1.5), first + np.arange(50) / 10, 1.2)


REFUSED = [
    (
        lambda _: recovered("c 7", line(0) + [0, 0, 4e-4]),
        r"c 7: rebuilding the points misses by 0\.\d+ mm, more",
    ),
    (
        lambda _: recovered("c 8", line(39.6)),
        r"c 8: bearings reach 45\.5 \.\. 50\.4 deg, the LMS400 sees 55",
    ),
    (
        lambda folder: read_bouguet(written(folder / "c.m", "fc = [ 1 ; 2 ];\n")),
        r"c\.m: no value of cc, kc",
    ),
    (results("-0.17 ;", ""), r"c\.m: no value of kc"),
    (results("700.5", "1e999"), r"c\.m: values of fc are not finite"),
    (results("700.5", "3-2"), r"c\.m: could not convert"),
    (
        lambda _: recovered("c 9", scattered(20_000)),
        "c 9: 14020000 values of scan lines, more than 12000000",
    ),
    (lambda folder: read_pcd(folder / "none.pcd"), r"none\.pcd: No such file"),
    (without("plane_*"), "plane_.*"),
    (without("Calib_Results_right.m"), "Calib_Results_right.m"),
    (cloud(lambda text: text[: len(text) // 2].rpartition("\n")[0]), "truncated"),
    (cloud(lambda text: text.replace("0.", "0,", 40)), "could not convert"),
    (
        cloud(lambda text: text.replace("x y z", "x y z rgb")),
        "ASCII PCD file with the fields x y z",
    ),
    (
        cloud(lambda text: re.sub("POINTS .*", "POINTS many", text)),
        "a.pcd: invalid literal .*; damaged",
    ),
    (cloud(lambda text: re.sub(r"\n[-.\d]+ ", "\nnan ", text)), "a.pcd: .*not finite"),
    (no_file("plane_02.pcd", os.mkfifo), "plane_02.pcd: is a named pipe, not a file"),
    (no_file("left_02.png", os.mkdir), "left_02.png: is a folder, not a file"),
    (
        no_file("Calib_Results_left.m", lambda file: file.symlink_to("/dev/zero")),
        "left.m: is a device, not a file",
    ),
    (
        no_file("plane_01.pcd", lambda file: file.symlink_to(file)),
        "plane_01.pcd: Too many levels of symbolic links",
    ),
    (
        no_file("plane_01.pcd", lambda file: file.symlink_to("/proc/self/pagemap")),
        "plane_01.pcd: more than 8 MB",
    ),
    (no_file("plane_01.pcd", long), "plane_01.pcd: 3000 MB, more than 8 MB"),
]


@pytest.mark.parametrize(("work", "message"), REFUSED)
def test_what_cannot_be_imported_is_named(source, tmp_path, work, message):
    with pytest.raises(SessionError, match=message):
        work(source)
    assert not (tmp_path / "dst").exists()


def test_import_makes_a_sound_session(source, tmp_path, capsys):
    target = tmp_path / "dst"
    assert main(["import", "lasersetero", str(source), str(target)]) == 0
    assert (
        "rebuild to 0.00" in capsys.readouterr().out and main(["check", str(target)]) == 0
    )
    session = open_session(target)
    assert session.problems == () and session.name == "dst" and session.placements == (1, 2)
    assert [c.mount for c in session.cameras.values()] == ["platform", "platform"]
    assert session.board.pattern.columns == 8 and session.board.corners is None
    for record in session.images():
        assert record.purpose == "board" and np.isnan(record.pitch)
        original = source / f"{record.camera}_{record.placement:02d}.png"
        assert record.file.read_bytes() == original.read_bytes()
    published = session.reference["cameras"]["left"]
    values = [*published["intrinsics"].values()]
    assert session.cameras["left"].model is None and values[:4] == [
        700.5,
        701.5,
        15.25,
        11.75,
    ]


def test_commands_say_what_is_wrong(source, tmp_path, capsys):
    assert import_lasersetero(source, tmp_path / "dst") < 2e-6
    assert all(
        camera.model is None for camera in open_session(tmp_path / "dst").cameras.values()
    )
    (tmp_path / "dst" / "images" / "left" / "0001.png").unlink()
    assert main(["check", str(tmp_path / "dst")]) == 1
    assert "0001.png" in capsys.readouterr().out
    assert main(["import", "lasersetero", str(source), str(tmp_path / "dst")]) == 1
    assert "exists already" in capsys.readouterr().err


# ---------------------------------------------------------------------------------------------- the real recording


def test_the_recording_rebuilds_the_independent_recovery(lms400_session, real_data):
    session = open_session(lms400_session)
    assert session.placements == tuple(range(1, 21)) and session.problems == ()
    for placement in session.placements:
        sweep = session.sweep(placement)
        line, beam = np.nonzero(
            np.isfinite(sweep.ranges[:, ::-1])
        )  # acquired from left to right of the grid
        p_lrf = polar_to_points(
            sweep.ranges[:, ::-1][line, beam], sweep.bearings[::-1][beam]
        )
        cloud = importers.LASERSETERO_CLOUD.apply(
            lrf_to_platform(p_lrf, sweep.pitch[line], session.T_head_lrf)
        )
        raw = np.load(real_data / "lms400_zed" / "raw" / f"pose_{placement:02d}.npz")
        rays = polar_to_points(raw["range_m"], np.radians(90 - raw["bearing_deg"]))
        theirs = lrf_to_platform(
            rays, raw["pitch_rad"] - np.pi / 2, importers.LASERSETERO_HEAD
        )
        assert (
            np.linalg.norm(cloud - importers.LASERSETERO_CLOUD.apply(theirs), axis=1).max()
            < 1e-6
        )
        published = read_pcd(real_data / "lms400_zed" / f"plane_{placement:02d}.pcd")
        assert np.linalg.norm(cloud - published, axis=1).max() < 1.5e-6
