"""Units and senses that a recording states wrongly are named; a sound one is not accused."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from falsified_sessions import WAYS, copied
from scipy.spatial.transform import RigidTransform, Rotation
from shared import QUICK, campaign

from lrfcal_lib.calibrate.pipeline import prepare
from lrfcal_lib.judge.recording_faults import (
    explained,
    hopeless,
    misread_recording,
    recording_faults,
)
from lrfcal_lib.session.read import open_session


def test_a_sound_recording_is_not_accused(quick):
    assert recording_faults(quick) == []
    assert misread_recording(quick.prepared) == []


def test_scans_that_images_contradict_show_the_board_in_the_right_unit(quick):
    """Images of half their stated size had 15 of 24 placements left out: "the ranges are in feet"."""
    first = min(quick.prepared.scans)
    scans = {first: quick.prepared.scans[first]}
    assert misread_recording(replace(quick.prepared, scans=scans)) == []


@pytest.mark.parametrize(
    "name",
    [
        "pitch in radians",
        "images of one camera mirrored",
        *(
            pytest.param(name, marks=campaign)
            for name in ("images mirrored", "bearings reversed", "pitch reversed")
        ),
    ],
)
def test_what_is_misread_is_named(name, tmp_path):
    folder = copied(QUICK, tmp_path / "session")
    WAYS[name].change(folder)
    (fault,) = misread_recording(prepare(open_session(folder)))
    assert fault.kind in WAYS[name].kinds and WAYS[name].words in fault.words
    assert explained([fault]) and fault.severe


def test_nothing_is_hopeless_but_what_explains_nothing(quick):
    assert not hopeless(quick.joint)
    assert hopeless(None)
    noisy = {"face_scale": 1.0, "view_scale": 30.0}
    estimate = SimpleNamespace(converged=True, unobservable=(), noise=noisy)
    assert hopeless(SimpleNamespace(solution=estimate))


def test_an_axis_that_points_backwards_is_hopeless(quick):
    turned = RigidTransform.from_rotation(Rotation.from_rotvec([0, 0, np.pi]))
    session = quick.prepared.session
    session = replace(session, T_head_lrf=session.T_head_lrf * turned)
    prepared = replace(quick.joint.prepared, session=session)
    assert hopeless(replace(quick.joint, prepared=prepared))
