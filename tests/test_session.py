"""A session survives the disk, and every kind of damage is named."""

import json
import math
import shutil
from functools import reduce

import cv2
import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from shared import QUICK

from lrfcal_lib.model.board import triangle_board
from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.session.files import SessionError
from lrfcal_lib.session.images import image_size
from lrfcal_lib.session.read import open_session, validate
from lrfcal_lib.session.stated import CameraInfo, LrfInfo
from lrfcal_lib.session.write import SessionWriter, finish

BEARINGS = np.radians(np.arange(60.0, 121.0))
LRF = LrfInfo(
    "made up",
    (BEARINGS[0], BEARINGS[-1]),
    np.radians(1.0),
    0.005,
    np.radians(0.01),
    0.001,
    8.0,
)
HEAD = RigidTransform.from_components(
    [0.01, 0.02, -0.03], Rotation.from_rotvec([0.1, -0.2, 0.3])
)
MODEL = CameraModel(
    32,
    24,
    30.0,
    31.0,
    15.5,
    11.5,
    np.array([0.1, -0.02, 0.001, 0.002, 0.003]),
    np.eye(9),
    0.25,
)
CAMERAS = (
    CameraInfo("left", "head", 32, 24, MODEL, HEAD),
    CameraInfo("right", "platform", 32, 24),
)

CHESSBOARD = {"kind": "chessboard", "columns": 8, "rows": 6, "square_m": 0.1}


def pixels(seed=0):
    return np.random.default_rng(seed).integers(0, 255, (24, 32, 3)).astype(np.uint8)


def wall(lines=3, distance=2.0):
    ranges = np.full((lines, 1), distance) / np.sin(BEARINGS)
    ranges[1, 7] = np.nan
    return ranges, BEARINGS, np.radians(np.linspace(-1, 1, lines))


@pytest.fixture(scope="module")
def written_once(tmp_path_factory):
    """Two sweeps and five images, all of them different."""
    path = tmp_path_factory.mktemp("sessions") / "trip"
    about = {"licence": "CC0", "source": "a test"}
    with SessionWriter(path, triangle_board(), LRF, CAMERAS, HEAD, **about) as writer:
        writer.add_sweep(1, *wall())
        second = wall(distance=2.5)
        writer.add_sweep(
            2, *second, time_s=[0.5, 1.0, 1.5], intensities=np.ones((3, len(BEARINGS)))
        )
        for seed, camera in ((1, "left"), (11, "right")):
            writer.add_image(camera, pixels(seed), 1, pitch=0.1)
            writer.add_image(camera, pixels(seed + 1), 2, time_s=3.5)
        writer.add_image("left", pixels(3), purpose="intrinsics")
    return path


@pytest.fixture
def path(written_once, tmp_path):
    return shutil.copytree(written_once, tmp_path / "trip")


def edit_scans(path, **changes):
    """Other arrays in scans.npz; a function makes them of those that are there."""
    file = path / "lrf" / "scans.npz"
    with np.load(file) as archive:
        there = dict(archive)
    np.savez(
        file,
        **there
        | {key: new(there[key]) if callable(new) else new for key, new in changes.items()},
    )


def same(a, b):
    np.testing.assert_allclose(a.as_matrix(), b.as_matrix(), atol=1e-15)


# ---------------------------------------------------------------------------------------------- round trips


def test_what_is_written_is_read(path):
    session = open_session(path)
    assert (session.name, session.licence, session.source, session.simulated) == (
        "trip",
        "CC0",
        "a test",
        False,
    )
    assert session.placements == (1, 2) and session.problems == () and session.picks == ()
    assert validate(path) == []
    written, shipped = (
        list(json.loads((folder / "session.json").read_text())) for folder in (path, QUICK)
    )
    assert written == shipped, "what comes first, as in the session that is shipped"
    assert session.lrf.field_of_view == pytest.approx(LRF.field_of_view, abs=1e-12)
    assert (
        session.lrf.bearing_step == pytest.approx(LRF.bearing_step, abs=1e-12)
        and session.lrf.max_range == 8.0
    )
    np.testing.assert_array_equal(session.board.corners, triangle_board().corners)
    same(session.T_head_lrf, HEAD)
    same(session.cameras["left"].guess, HEAD)
    np.testing.assert_array_equal(
        session.cameras["left"].model.parameters, MODEL.parameters
    )
    assert session.cameras["right"].model is None and session.cameras["right"].guess is None


def test_sweeps_keep_order_gaps_and_times(path):
    first, second = (open_session(path).sweep(p) for p in (1, 2))
    ranges, bearings, pitch = wall()
    np.testing.assert_array_equal(first.ranges, ranges)
    np.testing.assert_array_equal(first.bearings, bearings)
    np.testing.assert_array_equal(first.pitch, pitch)
    assert np.isnan(first.time_s).all() and second.time_s.tolist() == [0.5, 1.0, 1.5]


def test_a_table_that_pandas_wrote_is_the_same(path):
    before = open_session(path).image_records
    written_by_pandas(index=False)(path)
    assert ",1.0," in (path / IMAGES).read_text()
    assert repr(open_session(path).image_records) == repr(before) and validate(path) == []


def test_picks_override_by_camera_file_and_edge(path):
    pick("left,images/left/0001.png,ab,1,2,20,3.5")(path)
    session = open_session(path)
    (found,) = session.picks
    assert found.edge == "ab" and found.file == session.images("left", 1)[0].file
    assert found.ends.tolist() == [[1, 2], [20, 3.5]]


# ---------------------------------------------------------------------------------------------- crashes


def test_an_interrupted_recording_is_said_and_can_be_finished(tmp_path):
    path = tmp_path / "s"
    with (
        pytest.raises(RuntimeError, match="power"),
        SessionWriter(path, triangle_board(), LRF, CAMERAS) as writer,
    ):
        writer.add_sweep(4, *wall())
        writer.add_image("left", pixels(), 4)
        raise RuntimeError("power cut")
    with (path / "images.csv").open("a") as table:
        table.write(",left,images/left/00")
    with pytest.raises(
        SessionError, match=r"interrupted; lrfcal_lib\.session\.write\.finish"
    ):
        open_session(path)
    finish(path)
    session = open_session(path)
    assert session.placements == (4,) and len(session.images("left", 4)) == 1
    assert sorted(p.name for p in (path / "lrf").iterdir()) == ["scans.npz"]


def test_finish_needs_sweeps(path):
    with pytest.raises(SessionError, match="no sweep to finish"):
        finish(path)
    (path / "images").mkdir(exist_ok=True)
    with pytest.raises(
        SessionError, match="lrf is missing; is this the folder of a session"
    ):
        finish(path / "images")


def test_an_existing_target_is_refused(path):
    before = (path / "session.json").read_text()
    nowhere = path.with_name("link")
    nowhere.symlink_to("nowhere")
    for target in (path, path / "session.json", nowhere):
        with pytest.raises(SessionError, match="exists already"):
            SessionWriter(target, triangle_board(), LRF)
    assert (path / "session.json").read_text() == before


# ---------------------------------------------------------------------------------------------- missing parts


def test_a_placement_without_data_is_listed_and_spoils_nothing(path):
    change(path, "placements", [1, 2, 3])
    session = open_session(path)
    assert session.problems[0] == "placement 3: no scan line with a range"
    assert "placement 3: no image of camera 'left'" in session.problems
    assert session.sweep(1).ranges.shape == (3, len(BEARINGS))
    with pytest.raises(SessionError, match="placement 3 has 0 scan lines"):
        session.sweep(3)
    with pytest.raises(SessionError, match="no placement 9; the session has 1, 2, 3"):
        session.sweep(9)


def test_scan_lines_that_cannot_be_used_are_listed(path):
    edit_scans(
        path, ranges=lambda ranges: np.where(np.arange(6)[:, None] > 2, np.nan, ranges)
    )
    assert validate(path) == ["placement 2: no scan line with a range"]
    edit_scans(path, placement=np.array([1, 1, 7, 7, 7, 7]))
    assert (
        "placement 7: in the scan lines but not in session.json, ignored"
        in open_session(path).problems
    )


# ---------------------------------------------------------------------------------------------- session.json


CHANGES = [  # place in session.json, what stands there instead ("gone": nothing), message
    ("schema", "lrfcal-session/9", "schema is 'lrfcal-session/9', this version reads"),
    ("board", "gone", "json: board is missing"),
    ("name", "../up", "name is '../up': this becomes a file name"),
    ("placements", [1, 1], r"placements is \[1, 1\]: placements are different numbers"),
    ("placements", [1, "o"], "placements.1 is 'o': a valid integer"),
    (
        "rig.platform.T_head_lrf.translation_m",
        [0, 0, 157],
        "translation_m.2 is 157: less than .* 10 .*millimetres",
    ),
    ("board.corners_m", [[0, 0], [315, 0], [0, 380]], "board is 380 m large: millimetres"),
    (
        "board.corners_m",
        [[0, 0], [1, 0]],
        "corners_m must be one corner for each of 3 edges, got 2",
    ),
    (
        "board.pattern",
        CHESSBOARD | {"origin_m": [0.3, 0.05]},
        "inner corner at .* m lies [0-9]+ mm outside the outline: check columns, rows",
    ),
    ("board.edges", ["ab", "ab", "ca"], "the edges need different names"),
    ("board.edges", ["ab", "ca"], "board.edges is .*at least 3 items"),
    (
        "board.edges",
        ["$x$", "ab", "ca"],
        "board.edges.0 is .*names of edges stand in figures",
    ),
    (
        "board.features",
        ["ab", "xy"],
        "features must be two different edges of ab, bc, ca, .*; got 'ab', 'xy'",
    ),
    (
        "board.features",
        ["", ""],
        "two different edges of ab, bc, ca, at a right angle; got none",
    ),
    (
        "board.features",
        ["ab", "ab"],
        "two different edges of ab, bc, ca, at a right angle; got 'ab', 'ab'",
    ),
    ("board.pattern", CHESSBOARD | {"square_m": 77.5}, "square_m is 77.5: .*millimetres"),
    (
        "board.pattern",
        CHESSBOARD | {"columns": 1},
        "pattern.columns is 1: greater than or equal to 3",
    ),
    ("board.pattern", CHESSBOARD | {"columns": 500}, "up to 1000 inner corners in all"),
    (
        "board.pattern",
        CHESSBOARD | {"kind": "dots"},
        "pattern.kind is 'dots': 'chessboard' is needed",
    ),
    (
        "rig.cameras.left.mount",
        "wall",
        "left.mount is 'wall': 'head' or 'platform' is needed",
    ),
    ("rig.cameras.left.width", 0, "left.width is 0: greater than or equal to 1"),
    (
        "rig.cameras.left.intrinsics.fx",
        -1,
        "left.intrinsics.fx is -1: greater than 0 is needed",
    ),
    (
        "rig.cameras.left.intrinsics.covariance",
        [0.0],
        r"covariance.0 is 0\.0: a valid tuple",
    ),
    (
        "rig.lrf.field_of_view_deg",
        [120, 60],
        r"field_of_view_deg is \[120, 60\]: two ascending",
    ),
    ("rig.lrf.sigma_range_m", 5, "sigma_range_m is 5: .*millimetres"),
    ("rig.lrf.sigma_range_m", math.nan, "sigma_range_m is nan: a finite number is needed"),
]


def change(path, place, value):
    file = path / "session.json"
    data = json.loads(file.read_text())
    *way, key = place.split(".")
    holder = reduce(dict.__getitem__, way, data)
    holder.pop(key) if value == "gone" else holder.update({key: value})
    file.write_text(json.dumps(data))


@pytest.mark.parametrize(("place", "value", "message"), CHANGES)
def test_a_wrong_statement_is_named(path, place, value, message):
    change(path, place, value)
    with pytest.raises(SessionError, match=message):
        open_session(path)


# ---------------------------------------------------------------------------------------------- damaged files


def arrays(**values):
    return lambda path: edit_scans(path, **values)


def written(name, content):
    """Other bytes in a file; a function makes them of those that are there."""

    def change(path):
        file = path / name
        there = file.read_bytes() if file.exists() else b""
        file.write_bytes(content(there) if callable(content) else content)

    return change


def gone(name):
    return lambda path: (path / name).unlink()


def cell(column, value):
    """Another value in the first row of images.csv."""

    def edit(path):
        table = pd.read_csv(path / "images.csv", dtype=str)
        table.loc[0, column] = value
        table.to_csv(path / "images.csv", index=False)

    return edit


def written_by_pandas(index):
    """The table of images as pandas writes it when it is asked nothing else: whole numbers as 1.0, and row numbers."""

    def edit(path):
        pd.read_csv(path / IMAGES).to_csv(path / IMAGES, index=index)

    return edit


def pick(row):
    return written("edges.csv", f"camera,file,edge,u1,v1,u2,v2\n{row}\n".encode())


SCANS = "lrf/scans.npz"
IMAGES = "images.csv"
OUT = "must stay inside the session's folder, got "
DAMAGE = [
    (gone("session.json"), r"session\.json: No such file"),
    (written("session.json", b""), "not JSON"),
    (written("session.json", b"[1]"), "holds a list"),
    (gone(SCANS), r"scans\.npz: no such file"),
    (written(SCANS, b""), "cannot be read.*truncated"),
    (
        written(SCANS, lambda data: data[: int(0.98 * len(data))]),
        "cannot be read.*truncated",
    ),
    (
        written(SCANS, lambda data: data[:100] + bytes(60) + data[160:]),
        r"scans\.npz: cannot be read",
    ),
    (
        lambda path: np.savez(path / SCANS, ranges=np.ones((2, 61)), bearings=BEARINGS),
        "key 'placement' is missing",
    ),
    (arrays(pitch=np.array([{}] * 6)), "cannot be read.*without pickles"),
    (
        arrays(ranges=np.full((6, 61), 2000.0)),
        r"scans\.npz: the median range is .* m: millimetres",
    ),
    (arrays(ranges=np.full((6, 61), np.nan)), r"all NaN\): nothing was recorded"),
    (
        arrays(ranges=np.r_[[[-1.0] * 61], np.ones((5, 61))]),
        "negative ranges are no measurements",
    ),
    (arrays(ranges=np.ones(61)), "ranges must be scan lines x beams"),
    (arrays(bearings=np.arange(60.0, 121.0)), "a bearing is 120 rad: degrees"),
    (arrays(pitch=np.linspace(-20.0, 20.0, 6)), "a pitch is 20 rad: degrees"),
    (arrays(pitch=np.r_[np.full(3, np.nan), 0, 0, 0]), "3 values of pitch are not finite"),
    (arrays(bearings=BEARINGS[::-1]), "bearings must ascend"),
    (arrays(time_s=np.zeros(2)), r"time_s has shape \(2,\)"),
    (
        lambda path: (path / SCANS).rename(path / "lrf" / "telegrams.bin"),
        r"index\.csv: No such file.*this file is needed",
    ),
    (cell("file", "../trip/session.json"), OUT + "'../trip/session.json'"),
    (cell("file", "/etc/passwd"), OUT + "'/etc/passwd'"),
    (cell("file", "..\\x.png"), OUT + r"'\.\.\\"),
    (cell("file", "images/left/0009.png"), "0009.png: No such file"),
    (cell("file", "session.json"), "neither PNG nor JPEG"),
    (cell("camera", "up"), "camera must be one of left, right, got 'up'"),
    (cell("purpose", "fun"), "purpose must be one of intrinsics, board, scene, got 'fun'"),
    (cell("placement", "12"), "placement must be one of 1, 2, -1, got '12'"),
    (
        cell("placement", "1.5"),
        "images.csv line 2: placement is '1.5': a whole number is needed",
    ),
    (
        written_by_pandas(index=True),
        "columns must be t_s, .*; got a first column without a name: .*index=False in",
    ),
    (cell("pitch_deg", "up"), "line 2: could not convert string to float: 'up'"),
    (
        written("images/left/0002.png", cv2.imencode(".png", pixels()[:20])[1]),
        r"0002\.png: 32 x 20 pixels, but camera",
    ),
    (gone(IMAGES), r"images\.csv: No such file"),
    (written(IMAGES, b""), "got an empty file"),
    (written(IMAGES, b"\xff\xfe"), "not a CSV file in UTF-8"),
    (
        written(IMAGES, lambda data: data.replace(b"_deg", b"")),
        r"columns must be t_s, .*; got t_s, .*, pitch, purpose",
    ),
    (
        written(IMAGES, lambda data: data + b",left,images"),
        "line 7: 3 values for 6 columns; truncated",
    ),
    (
        pick("left,images/left/0009.png,ab,1,2,20,3"),
        "no 'images/left/0009.png' of camera 'left'",
    ),
    (pick("left,../0001.png,ab,1,2,20,3"), OUT),
    (
        pick("left,images/left/0001.png,top,1,2,20,3"),
        "edge must be one of ab, bc, ca, got 'top'",
    ),
    (pick("left,images/left/0001.png,ab,1,2,2,3"), "give no direction: pick two"),
    (
        pick("left,images/left/0001.png,ab,1,2,nan,3"),
        "give no direction: pick two that are 5 or more",
    ),
]


@pytest.mark.parametrize(("damage", "message"), DAMAGE)
def test_damage_is_named(path, damage, message):
    damage(path)
    with pytest.raises(SessionError, match=message):
        open_session(path)


@pytest.mark.parametrize("kind", ["png", "jpg"])
def test_truncated_images(kind):
    data = cv2.imencode(f".{kind}", pixels())[1].tobytes()
    assert image_size("a", data) == (32, 24)
    for part in (12, len(data) // 2, len(data) - 70):
        with pytest.raises(SessionError, match="a: the image is truncated after"):
            image_size("a", data[:part])


def test_an_image_that_cannot_be_decoded_is_found_by_validate(path):
    written("images/left/0001.png", lambda data: data[:60] + bytes(140) + data[200:])(path)
    (problem,) = validate(path)
    assert "0001.png: cannot be decoded" in problem


RANGES, _, PITCH = wall()
REFUSED = [
    (
        "add_sweep",
        (2, 1000 * RANGES, BEARINGS, PITCH),
        "placement 2: the median range .*millimetres",
    ),
    ("add_sweep", (2, RANGES, BEARINGS + 0.1, PITCH), "one grid a session"),
    (
        "add_image",
        ("up", pixels()),
        "camera must be one of left, right, got 'up'",
    ),
    (
        "add_image",
        ("left", pixels()[:, 1:]),
        "31 x 24 pixels, but camera 'left' has 32 x 24",
    ),
]


def test_the_writer_refuses_what_the_reader_would(tmp_path):
    writer = SessionWriter(tmp_path / "s", triangle_board(), LRF, CAMERAS)
    writer.add_sweep(1, *wall())
    for method, wrong, message in REFUSED:
        with pytest.raises(SessionError, match=message):
            getattr(writer, method)(*wrong)
    with pytest.raises(
        SessionError, match="purpose must be one of intrinsics, board, scene"
    ):
        writer.add_image("left", pixels(), purpose="fun")
