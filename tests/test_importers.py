"""Other people's recordings become sessions without loss."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lrfcal_lib.__main__ import main
from lrfcal_lib.model.geometry import lrf_to_platform, polar_to_points
from lrfcal_lib.session import importers
from lrfcal_lib.session.importers import import_lasersetero, read_bouguet, read_pcd, recover_polar
from lrfcal_lib.session.read import open_session
from lrfcal_lib.session.stated import SessionError, transform_from_json

BOUGUET = """
fc = [ 700.5 ; 701.5 ];
cc = [ 15.25 ; 11.75 ];
alpha_c = 0.000000000000000;
kc = [ -0.17 ; 0.02 ; -0.0003 ; 0.0004 ; 0.0 ];
fc_error = [ 3.0 ; 6.0 ];
cc_error = [ 0.3 ; 0.6 ];
kc_error = [ 0.003 ; 0.0 ; 0.0 ; 0.0 ; 0.0 ];
%-- Image size:
nx = 32;
ny = 24;
omc_1 = [ -7.4e-01 ; -3.0e-01 ; 1.4e+00 ];
Tc_1  = [ -1.428e+02 ; 9.8e+01 ; 1.3e+03 ];
"""


def authors_points(ranges, bearing_deg, p):
    """The README's formulas of the authors' platform, point by point; their bearing and pitch angle."""
    b = np.radians(bearing_deg)
    X, S = ranges * np.sin(b) - 0.038, ranges * np.cos(b) + 0.0045
    y, z = 0.157 * np.cos(p) + S * np.sin(p), 0.157 * np.sin(p) - S * np.cos(p) + 0.2
    return np.round(np.stack([X, y, z], axis=-1), 6)


def polar(rng, lines=6):
    """Ranges (whole millimetres), the authors' bearings and pitch of a few scan lines in acquisition order."""
    rows = [np.arange(*np.sort(rng.choice(np.arange(-300, 301), 2, replace=False)) + [0, 9]) / 10 for _ in range(lines)]
    ranges = [np.round(1.5 + 0.3 * rng.random(len(row)), 3) for row in rows]
    return ranges, rows, np.linspace(1.0, 1.4, lines)


def write_source(folder, rng):
    folder.mkdir()
    for n in (1, 2):
        ranges, bearings, pitch = polar(rng)
        points = np.concatenate([authors_points(r, b, p) for r, b, p in zip(ranges, bearings, pitch, strict=True)])
        header = f"# .PCD v.7\nFIELDS x y z\nPOINTS {len(points)}\nDATA ascii\n"
        rows = "\n".join(" ".join(f"{v:.6f}" for v in p) for p in points)
        (folder / f"plane_{n:02d}.pcd").write_text(header + rows)
    for name in ("left", "right"):
        (folder / f"Calib_Results_{name}.m").write_text(BOUGUET)
        for n in (1, 2):
            cv2.imwrite(str(folder / f"{name}_{n:02d}.png"), rng.integers(0, 255, (24, 32, 3)).astype(np.uint8))
    return folder


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

    return lambda folder: read_pcd(written(folder / "a.pcd", change((folder / "plane_01.pcd").read_text())))


def line(first):
    return authors_points(np.full(50, 1.5), first + np.arange(50) / 10, 1.2)


REFUSED = [
    (lambda _: recover_polar(line(0) + [0, 0, 4e-4], "c 7"), r"c 7: rebuilding the points misses by 0\.\d+ mm, more"),
    (lambda _: recover_polar(line(39.6)), r"bearings reach 45\.5 \.\. 50\.4 deg, the LMS400 sees 55 \.\. 125"),
    (lambda folder: read_bouguet(written(folder / "c.m", "fc = [ 1 ; 2 ];\n")), r"c\.m: no value of cc, kc"),
    (lambda folder: read_pcd(folder / "none.pcd"), r"none\.pcd: No such file"),
    (lambda folder: import_lasersetero(folder, folder / "dst", intrinsics="best"), "'own' or 'published', got 'best'"),
    (without("plane_*"), "plane_.*"),
    (without("Calib_Results_right.m"), "Calib_Results_right.m"),
    (cloud(lambda text: text[: len(text) // 2].rpartition("\n")[0]), "truncated"),
    (cloud(lambda text: text.replace("0.", "0,", 40)), "could not convert"),
    (cloud(lambda text: text.replace("x y z", "x y z rgb")), "ASCII PCD file with the fields x y z"),
]


@pytest.mark.parametrize(("work", "message"), REFUSED)
def test_what_cannot_be_imported_is_named(source, tmp_path, work, message):
    with pytest.raises(SessionError, match=message):
        work(source)
    assert not (tmp_path / "dst").exists()


def test_import_makes_a_sound_session(source, tmp_path, capsys):
    target = tmp_path / "dst"
    assert main(["import", "lasersetero", str(source), str(target), "--intrinsics", "published"]) == 0
    assert "rebuild to 0.00" in capsys.readouterr().out and main(["check", str(target)]) == 0
    session = open_session(target)
    assert session.problems == () and session.name == "dst" and session.placements == (1, 2)
    assert [c.mount for c in session.cameras.values()] == ["platform", "platform"]
    assert session.board.pattern.columns == 8 and session.board.corners is None
    for record in session.images():
        assert record.purpose == "board" and np.isnan(record.pitch)
        original = source / f"{record.camera}_{record.placement:02d}.png"
        assert record.file.read_bytes() == original.read_bytes()
    model = session.cameras["left"].model
    assert (model.fx, model.fy, model.cx, model.cy) == (700.5, 701.5, 15.25, 11.75)
    np.testing.assert_allclose(np.sqrt(np.diag(model.covariance))[:5], [1, 2, 0.1, 0.2, 0.001])
    pose = transform_from_json(session.reference["cameras"]["left"]["T_camera_board"]["1"])
    np.testing.assert_allclose(pose.translation, [-0.1428, 0.098, 1.3])
    np.testing.assert_allclose(pose.rotation.as_matrix(), Rotation.from_rotvec([-0.74, -0.3, 1.4]).as_matrix())


def test_commands_say_what_is_wrong(source, tmp_path, capsys):
    assert import_lasersetero(source, tmp_path / "dst") < 2e-6
    assert all(camera.model is None for camera in open_session(tmp_path / "dst").cameras.values())
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
        line, beam = np.nonzero(np.isfinite(sweep.ranges[:, ::-1]))  # acquired from left to right of the grid
        p_lrf = polar_to_points(sweep.ranges[:, ::-1][line, beam], sweep.bearings[::-1][beam])
        cloud = importers.LASERSETERO_CLOUD.apply(lrf_to_platform(p_lrf, sweep.pitch[line], session.T_head_lrf))
        raw = np.load(real_data / "lms400_zed" / "raw" / f"pose_{placement:02d}.npz")
        rays = polar_to_points(raw["range_m"], np.radians(90 - raw["bearing_deg"]))
        theirs = lrf_to_platform(rays, raw["pitch_rad"] - np.pi / 2, importers.LASERSETERO_HEAD)
        assert np.linalg.norm(cloud - importers.LASERSETERO_CLOUD.apply(theirs), axis=1).max() < 1e-6
        published = read_pcd(real_data / "lms400_zed" / f"plane_{placement:02d}.pcd")
        assert np.linalg.norm(cloud - published, axis=1).max() < 1.5e-6
