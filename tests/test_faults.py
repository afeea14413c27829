"""What files of a recording show to be wrong is named with the file, the value and the remedy."""

import numpy as np
import pytest
from falsified_sessions import (
    WAYS,
    Way,
    change_images,
    change_scans,
    copied,
)
from shared import DATA, QUICK

from lrfcal_lib.acquire.checks import check_image, check_placement
from lrfcal_lib.session.faults import faults_of_files
from lrfcal_lib.session.read import open_session, validate


@pytest.fixture
def folder(tmp_path):
    return copied(QUICK, tmp_path / "session")


@pytest.mark.parametrize("data", ["sim_quick", "sim_lms221"])
def test_a_sound_recording_has_no_fault(data):
    assert faults_of_files(open_session(DATA / data)) == []


def half_turned_down(folder):
    """Bearings of a scanner with half the step."""

    def change(scans):
        scans["bearings"] = np.pi / 2 + (scans["bearings"] - np.pi / 2) / 2

    change_scans(folder, change)


BY_CHECK = (
    "an image twice",
    "a placement twice",
    "one picture in both folders",
    "max_range_m exceeded",
    "images too dark",
    "field of view",
    "pitch in degrees",
    "squares in inches",
)
NAMED = {name: WAYS[name] for name in BY_CHECK} | {
    "another step": Way(half_turned_down, ("field of view",), "correct session.json"),
}


@pytest.mark.parametrize("name", NAMED)
def test_what_files_show_is_named_by_check(name, folder):
    way = NAMED[name]
    assert validate(folder) == []
    way.change(folder)
    assert way.words in " ".join(validate(folder))
    if way.kinds not in (("refused",), ("dark",)):
        kinds = {fault.kind for fault in faults_of_files(open_session(folder))}
        assert kinds >= set(way.kinds) and kinds <= {*way.kinds, "repeated image"}


def test_ranges_in_inches_are_refused_or_beyond(folder):
    WAYS["ranges in inches"].change(folder)
    assert any("inches" in words or "max_range_m" in words for words in validate(folder))


def test_a_repeated_placement_is_seen_while_recording(folder):
    session = open_session(folder)
    assert "recording" not in [light.name for light in check_placement(session, 2)]
    WAYS["a placement twice"].change(folder)
    session = open_session(folder)
    bad = [light for light in check_placement(session, 4) if light.name == "recording"]
    assert {light.state for light in bad} == {"bad"}
    assert (
        "the same to the last digit" in bad[-1].text and "are identical to" in bad[0].text
    )
    assert "recording" not in [light.name for light in check_placement(session, 1)]


def test_an_image_without_light_is_called_dark(folder):
    session = open_session(folder)
    image = session.read_image(session.images("left", 1)[0])
    assert "too dark" not in check_image(image, session.board).text
    black = check_image(image // 60, session.board)
    assert black.state in ("warn", "bad") and "too dark" in black.text


def test_a_copy_shares_nothing_that_is_changed(folder):
    before = {
        file: file.read_bytes() for file in sorted(QUICK.rglob("*")) if file.is_file()
    }
    change_images(folder, lambda pixels: pixels // 2, ("left",))
    WAYS["field of view"].change(folder)
    WAYS["pitch reversed"].change(folder)
    assert before == {file: file.read_bytes() for file in before}
