"""Whole recordings that users spoil: `check` or the verdict names what was done."""

import pytest
from falsified_sessions import WAYS, copied, judged
from shared import DATA, campaign

from lrfcal_lib.calibrate.pipeline import calibrate
from lrfcal_lib.judge.alternatives import ALTERNATIVES
from lrfcal_lib.judge.recording_faults import recording_faults
from lrfcal_lib.session.faults import faults_of_files
from lrfcal_lib.session.files import SessionError
from lrfcal_lib.session.read import open_session, validate

CASES = [(name, session) for name, way in WAYS.items() for session in way.sessions]


@pytest.fixture
def folder(request, tmp_path):
    """A copy of one of two recordings, that may be spoilt."""
    lms400 = request.param == "lms400_zed"
    source = request.getfixturevalue("lms400_session") if lms400 else DATA / request.param
    return copied(source, tmp_path / request.param)


def named_by_check(folder):
    """What `check` says, and kinds of what is wrong; 'refused' where it cannot be opened."""
    try:
        session = open_session(folder)
    except SessionError as error:
        return str(error), {"refused"}
    kinds = {fault.kind for fault in faults_of_files(session)}
    return "; ".join(validate(folder)), kinds


@campaign
@pytest.mark.parametrize(("name", "folder"), CASES, indirect=["folder"])
def test_what_was_done_is_named(name, folder):
    way = WAYS[name]
    way.change(folder)
    words, kinds = named_by_check(folder)
    if "refused" in kinds:
        assert way.kinds == ("refused",) or "unit" in way.kinds
        assert way.words in words
        return
    verdict = judged(folder)
    causes = kinds | {reason.kind for reason in verdict.reasons}
    said = f"{words}; {' '.join(verdict.sentences())}"
    if way.kinds:
        assert causes & set(way.kinds) and way.words in said, said
    else:
        assert not causes & ACCUSATIONS, said


ACCUSATIONS = {
    *ALTERNATIVES,
    *(
        "repeated image",
        "repeated scan",
        "beyond range",
        "field of view",
        "dark",
        "exchanged",
    ),
    *(
        "camera moved",
        "camera zoomed",
        "sense",
        "unit",
        "far from stated",
        "lens",
        "range offset",
    ),
}


@campaign
@pytest.mark.parametrize("folder", ["sim_lms221", "lms400_zed"], indirect=True)
def test_what_nobody_spoilt_is_not_accused(folder):
    assert named_by_check(folder) == ("", set())
    calibration = calibrate(open_session(folder))
    assert recording_faults(calibration) == []
