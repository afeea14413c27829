"""Simulated recordings: platform, placements, the shipped sessions, and everything that can go wrong."""

import hashlib
from dataclasses import replace

import cv2
import numpy as np
import pytest
from shared import DATA, QUICK, at_write, disk_full
from small_rigs import scaled

from lrfcal_lib.__main__ import main
from lrfcal_lib.model.board import Chessboard, triangle_board
from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.session.lms2xx_codec import largest
from lrfcal_lib.session.read import open_session
from lrfcal_lib.simulate import record, rig
from lrfcal_lib.simulate.beam import LMS221
from lrfcal_lib.simulate.rig import (
    Platform,
    held_close,
    load_setup,
    pairs,
)
from lrfcal_lib.simulate.scene import Exposure, Imager, World

FULL = load_setup("sim_quick")


@pytest.fixture(scope="module")
def session():
    return open_session(QUICK)


@pytest.fixture(scope="module")
def tiny():
    """Two placements and a camera of few pixels, nothing else."""
    small = scaled(FULL.rig, 160)
    rig = replace(small, cameras=small.cameras[:1], beam=replace(small.beam, rings=1))
    return replace(
        FULL,
        rig=rig,
        pairs=1,
        step=np.radians(1.0),
        intrinsics_views=0,
        room_sweep=(),
        room_images=(),
    )


def test_backlash_depends_on_the_direction():
    platform = Platform(backlash=0.002, stretch=0.01, encoder_step=0.001)
    rng = np.random.default_rng(0)
    commanded = np.array([-0.1, 0.0, 0.2])
    (up, measured), (down, _) = (platform.stop(commanded, way, rng) for way in (1, -1))
    np.testing.assert_allclose(down - up, 0.002)
    np.testing.assert_allclose((up + down) / 2, 1.01 * commanded)
    np.testing.assert_allclose(measured, commanded, atol=1e-12)


def test_a_sweep_and_an_image_are_rebuilt(session):
    """To the byte on one kind of processor; on another the last bit of a sine moves roundings and photon counts."""
    placement = record.placements_of(FULL)[3]
    made = record.sweep_of(FULL, placement)
    shipped = session.sweep(4).ranges
    made = np.where(made > largest(0), np.nan, made * 0.001)
    np.testing.assert_array_equal(np.isnan(made), np.isnan(shipped))
    off = np.nan_to_num(np.abs(made - shipped))
    assert off.max() < 0.0011 and np.mean(off > 0) < 1e-3
    shots = [
        s
        for s in record.shots_of(FULL, [placement])
        if s.placement == placement and s.camera == 0
    ]
    shipped = [r.file.read_bytes() for r in session.images("left", 4)]
    for pair in zip(record.photograph(FULL, shots[0]), shipped, strict=True):
        one, two = (
            cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR).astype(float)
            for content in pair
        )
        assert (
            np.abs(one - two).mean() < 2.0
            and np.abs(cv2.blur(one - two, (15, 15))).max() < 4.0
        )


@pytest.mark.parametrize("name", ["sim_lms221", "sim_quick", "room_lms221"])
def test_the_data_card_has_the_sums_of_all_files(name):
    sums = dict(
        line.split("  ")[::-1] for line in (DATA / "SHA256SUMS").read_text().splitlines()
    )
    files = [file for file in (DATA / name).rglob("*") if file.is_file()]
    made = {
        file.relative_to(DATA).as_posix(): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in files
    }
    assert made == {
        file: value for file, value in sums.items() if file.startswith(f"{name}/")
    }
    assert (
        sum(f.stat().st_size for f in files)
        < {"sim_lms221": 40e6, "sim_quick": 3e6, "room_lms221": 8e6}[name]
    )


def test_a_room_may_be_swept_without_an_image(tmp_path, tiny):
    record.simulate(
        tmp_path / "s", replace(tiny, pairs=0, room_sweep=(0.0, np.radians(1.0), 0.01))
    )
    session = open_session(tmp_path / "s")
    assert list(session.placements) == [1] and not session.images()
    assert len(session.sweep(1).pitch) == 3


def test_an_existing_folder_is_left_alone(tmp_path, tiny, capsys):
    (tmp_path / "s").mkdir()
    with pytest.raises(ValueError, match="exists already"):
        record.simulate(tmp_path / "s", tiny)
    assert (
        main(["simulate", "sim_quick", str(tmp_path / "s")]) == 1
        and "exists already" in capsys.readouterr().err
    )
    assert list((tmp_path / "s").iterdir()) == []


@pytest.mark.parametrize("free", [1, 12])
def test_a_full_disk_leaves_nothing(tmp_path, tiny, monkeypatch, free):
    message = "No space left on device.*is there space.*Nothing was kept"
    with at_write(monkeypatch, free, disk_full), pytest.raises(ValueError, match=message):
        record.simulate(tmp_path / "s", tiny)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("given", "change", "message"), [
    (LMS221, {"resolution": 25}, "no whole scans of 180 deg in steps of 0.25 deg; it can be set to 100/0.25"),
    (LMS221, {"sigma_range": -0.01}, "Beam\nsigma_range\n.* greater than or equal to 0 .*-0.01"),
    (LMS221, {"least_share": 1.5}, "Beam\nleast_share\n.* less than or equal to 1 .*1.5"),
    (LMS221, {"rings": -1}, "Beam\nrings\n.* greater than or equal to 0 .*-1"),
    (Exposure(), {"read_noise": -1.0}, "Exposure\nread_noise\n.* greater than or equal to 0 .*-1"),
    (Exposure(), {"gain": (0.0, 10.0)}, "Exposure\ngain.*\n.* greater than 0 "),
    (Exposure(), {"samples": 0}, "Exposure\nsamples\n.* greater than 0 "),
    (Platform(), {"noise": -1e-4}, "Platform\nnoise\n.* greater than or equal to 0 .*-0.0001"),
    (Platform(), {"speed": 0.0}, "Platform\nspeed\n.* greater than 0 "),
    (Platform(), {"stretch": 2.0}, "Platform\nstretch\n.* less than 0.5 .*2"),
    (FULL, {"step": 0.0}, "Setup\nstep\n.* greater than 0 "),
    (FULL, {"quality": 0}, "Setup\nquality\n.* greater than or equal to 1 "),
    (FULL, {"intrinsics_views": -1}, "Setup\nintrinsics_views\n.* greater than or equal to 0 "),
    (FULL, {"room_sweep": (0.0, 1.0)}, "Setup\nroom_sweep"),
])  # fmt: skip
def test_impossible_settings(given, change, message):
    with pytest.raises(ValueError, match=message):
        replace(given, **change)


def lens(width, *distortion):
    model = CameraModel(width, 384, 200.0, 200.0, 255.0, 191.0, np.array(distortion))
    return Imager(model).rays


def test_what_cannot_be_simulated(tmp_path, tiny, monkeypatch):
    rng = np.random.default_rng(0)
    monkeypatch.setattr(rig, "MOST_TRIES", 50)
    camera = tiny.rig.cameras[0]
    pattern = Chessboard(4, 5, 1.0, (0.0, 0.0))
    huge = replace(tiny.rig, board=triangle_board(13.0, 14.0, pattern=pattern))
    for refused, message in (
        (
            lambda: Platform().stop(np.radians([-10, 80]), 1, rng),
            "pitch -10.00 to 80.00 deg is asked for, it turns -60.00 to 60.00",
        ),
        (lambda: pairs(tiny.rig, 0, (1.0, 2.0), rng, 0.03, 0.01), "0 pairs"),
        (lambda: held_close(huge, camera, 1, rng), "does not fit into the image of 'left'"),
        (lambda: World([]), "at least one thing"),
        (lambda: lens(512, -0.9, 0.0, 0.0, 0.0, 0.0), "folds the image"),
        (lambda: lens(513, *np.zeros(5)), "513 x 384 pixels, both must be multiples of 2"),
        (
            lambda: record.simulate(tmp_path / "s", replace(tiny, rig=huge)),
            "no place at .* m where the LRF and all cameras see board",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            refused()
    assert not list(tmp_path.iterdir())
