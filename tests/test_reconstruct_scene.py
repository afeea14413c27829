"""The command `reconstruct`: what it refuses, with nothing half written, and what it says in every file."""

import json
import re
import shutil

import numpy as np
import pytest
from shared import QUICK

from lrfcal_lib import __main__ as command_line
from lrfcal_lib.evaluate.export import calibration_record, write_calibration
from lrfcal_lib.session.read import open_session

SCENE = 5  # placement of sim_quick


@pytest.fixture(scope="module")
def calibration(quick, tmp_path_factory):
    """The file of the small session."""
    file = tmp_path_factory.mktemp("calibration") / "calibration.json"
    write_calibration(file, calibration_record(quick, "joint"))
    return file


@pytest.fixture(scope="module")
def scans():
    return open_session(QUICK).scans


class Case:
    """A session and a calibration that are to be spoilt."""

    def __init__(self, folder, calibration, scans):
        self.session = folder / "room"
        shutil.copytree(QUICK, self.session)
        self.calibration = folder / "calibration.json"
        shutil.copy(calibration, self.calibration)
        self.scans = {key: np.array(values) for key, values in scans.items()}
        self.rows = self.scans["placement"] == SCENE

    def write_scans(self):
        """Scan lines take the place of the telegrams."""
        shutil.rmtree(self.session / "lrf")
        (self.session / "lrf").mkdir()
        np.savez_compressed(self.session / "lrf" / "scans.npz", **self.scans)

    def append(self, line, **changes):
        """Append a scan line of the scene, changed."""
        at = np.flatnonzero(self.rows)[line]
        for key, values in self.scans.items():
            if key != "bearings":
                changed = changes.get(key, values[at])
                self.scans[key] = np.concatenate([values, [changed]])

    def edit(self, file, change):
        """Change a JSON file."""
        data = json.loads(file.read_text())
        change(data)
        file.write_text(json.dumps(data))


def no_images(case):
    table = case.session / "images.csv"
    rows = table.read_text().splitlines()
    table.write_text("\n".join(row for row in rows if not row.endswith("scene")) + "\n")


def no_returns(case):
    case.scans["ranges"][case.rows] = np.nan
    case.write_scans()


def named_twice(case):
    case.edit(case.session / "session.json", lambda data: data["placements"].append(SCENE))


def copied(case):
    for key, values in case.scans.items():
        if key != "bearings":
            copy = values[case.rows] if key != "placement" else np.full(case.rows.sum(), 9)
            case.scans[key] = np.concatenate([values, copy])
    case.write_scans()
    case.edit(case.session / "session.json", lambda data: data["placements"].append(9))


def moved(case):
    level = case.scans["ranges"][case.rows][40]
    case.append(40, ranges=level + 0.2)
    case.write_scans()


def in_motion(case):
    case.scans["time_s"][case.rows] = 0.013 * np.arange(case.rows.sum())
    case.write_scans()


def other_size(case):
    def change(data):
        data["cameras"]["left"]["lens"]["width"] += 2

    case.edit(case.calibration, change)


def verdict_no(case):
    def change(data):
        data["verdict"] |= {
            "answer": "no",
            "reasons": [{"words": "it was spoilt", "answer": "no"}],
        }

    case.edit(case.calibration, change)


def no_calibration(case):
    case.calibration.write_text("{}")


REFUSED = [
    (no_images, "no placement has an image of purpose 'scene'"),
    (no_returns, "placement 5 has 85 scan lines and no range"),
    (named_twice, "placements are different numbers"),
    (copied, "a station stands there twice: the scans of placements 5 and 9"),
    (
        moved,
        "station 5 moved while it was recorded: back at a pitch .*record it again",
    ),
    (in_motion, "station 5 was recorded while the head moved: .* within 13 ms"),
    (other_size, "images of 'left' have 640 x 480 pixels, not 642 x 480"),
    (verdict_no, "cannot be trusted: it was spoilt.*--untrusted"),
    (no_calibration, "is no calibration"),
]


@pytest.fixture
def case(tmp_path, calibration, scans):
    return Case(tmp_path, calibration, scans)


def reconstruct(case, *options):
    words = ["reconstruct", case.session, "--calibration", case.calibration, *options]
    return command_line.main([str(word) for word in words])


@pytest.mark.parametrize(
    ("spoil", "words"), REFUSED, ids=lambda case: getattr(case, "__name__", "")
)
def test_what_cannot_be_used_is_refused_with_the_cause(
    case, spoil, words, tmp_path, capsys
):
    spoil(case)
    assert reconstruct(case, "--out", tmp_path / "out") == 1
    error = capsys.readouterr().err
    assert re.fullmatch(f"error: .*{words}.*\n", error)
    assert not (tmp_path / "out").exists()


def test_an_untrusted_calibration_is_named_in_every_file(case, tmp_path, capsys):
    verdict_no(case)
    assert reconstruct(case, "--out", tmp_path / "out", "--untrusted") == 0
    files = sorted((tmp_path / "out").iterdir())
    assert len(files) == 4
    said = capsys.readouterr().out
    for file in files:
        assert str(file) in said and b"UNTRUSTED" in file.read_bytes()


def two_stations(case):
    """The scene once more, 10 mm farther away, as a second station."""

    def shifted(values, key):
        copy = values[case.rows]
        if key == "ranges":
            copy = copy + 0.01
        if key == "placement":
            copy = np.full(len(copy), 9)
        return np.concatenate([values, copy])

    for key, values in case.scans.items():
        if key != "bearings":
            case.scans[key] = shifted(values, key)
    case.write_scans()
    case.edit(case.session / "session.json", lambda data: data["placements"].append(9))
    table = case.session / "images.csv"
    rows = table.read_text().splitlines()
    copies = case.session / "images" / "left" / "copy.jpg"
    last = next(row for row in rows if row.endswith("scene") and ",left," in row)
    source = last.split(",")[2]
    shutil.copy(case.session / source, copies)
    row = last.replace(source, "images/left/copy.jpg").replace(f",{SCENE},", ",9,")
    table.write_text("\n".join([*rows, row]) + "\n")


def test_stations_stay_apart_until_they_are_joined(case, tmp_path, capsys):
    two_stations(case)
    assert reconstruct(case, "--out", tmp_path / "out") == 0
    assert (
        "2 stations, each in its own frame; 'merge' joins them" in capsys.readouterr().out
    )
    for number in (SCENE, 9):
        assert len(list((tmp_path / "out" / f"station_{number}").iterdir())) == 4
