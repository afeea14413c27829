"""A calibration on disk: the same numbers again, and what is no calibration of this rig is refused."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest
from shared import DATA

from lrfcal_lib.calibrate.calibration_file import (
    load_calibration,
    refuse_untrusted,
    require_same_rig,
)
from lrfcal_lib.calibrate.reconstruct import reconstruct
from lrfcal_lib.evaluate.export import calibration_record, write_calibration
from lrfcal_lib.judge.uncertainty import chain_of
from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.session.files import SessionError
from lrfcal_lib.session.read import open_session


@pytest.fixture(scope="module")
def record(quick):
    return calibration_record(quick, "joint")


@pytest.fixture(scope="module")
def loaded(record, tmp_path_factory):
    path = tmp_path_factory.mktemp("alone") / "calibration.json"
    write_calibration(path, record)
    return load_calibration(path)


def flat(value):
    """What a record holds, as numbers and texts by path."""
    if hasattr(value, "as_matrix"):
        value = value.as_matrix()
    if hasattr(value, "__dataclass_fields__"):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    if isinstance(value, dict):
        return {(key, *k): v for key, part in value.items() for k, v in flat(part).items()}
    if isinstance(value, (np.ndarray, tuple)):
        return {(): np.asarray(value).tolist()}
    return {(): value}


@pytest.mark.parametrize("method", ["joint", "line"])
def test_what_is_read_is_what_was_handed_over_to_the_last_bit(quick, tmp_path, method):
    write_calibration(tmp_path / "c.json", calibration_record(quick, method))
    read = load_calibration(tmp_path / "c.json")
    given = quick.rig(method)
    assert read.answer in ("with care", "no") and read.reasons and read.date
    of_the_verdict = {"answer": read.answer, "reasons": read.reasons, "date": read.date}
    # what single sweeps were off by is of those sweeps only
    without_sweeps = replace(given.corrections, sweeps={})
    expected = flat(replace(given, corrections=without_sweeps, **of_the_verdict))
    found = flat(read)
    assert found.keys() == expected.keys()
    assert [key for key in found if found[key] != expected[key]] == []


def test_a_scene_is_the_same_with_it_and_so_is_what_is_known(quick, loaded):
    given = quick.rig("joint")
    session = quick.prepared.session
    sweep = session.sweep(session.scene_placements[0])
    clouds = [
        next(reconstruct(sweep, [], rig.T_head_lrf, rig.corrections, lrf=rig.lrf))
        for rig in (given, loaded)
    ]
    np.testing.assert_array_equal(clouds[0].points, clouds[1].points)
    for camera in (None, *given.cameras):
        one = flat(chain_of(given, camera))
        assert one == flat(chain_of(loaded, camera))
    assert loaded.known.range_noise == given.known.range_noise > 0


def test_results_come_first_hashes_last_and_lenses_are_camera_models(record, quick):
    keys = list(record)
    assert keys.index("verdict") < keys.index("cameras") < keys.index("uncertainty")
    assert keys[-1] == "inputs_sha256"
    for name, camera in record["cameras"].items():
        given = quick.rig("joint").cameras[name].model
        np.testing.assert_array_equal(
            CameraModel(**camera["lens"]).parameters, given.parameters
        )


def test_a_lens_that_nothing_determined_is_read_without_bound(record, tmp_path):
    where = ("cameras", "left", "lens", "covariance")
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(changed(record, where, [[None] * 9] * 9)))
    covariance = load_calibration(path).cameras["left"].model.covariance
    np.testing.assert_array_equal(covariance, np.full((9, 9), np.inf))


def changed(record, where, value):
    data = json.loads(json.dumps(record))
    inner = data
    for key in where[:-1]:
        inner = inner[key]
    inner[where[-1]] = value
    return data


DAMAGED = {  # what stands in the file: where, value, what is said
    "a later schema": (("schema",), 4, "schema 4, this reads 3: take a newer lrfcal"),
    "an older schema": (("schema",), 2, "schema 2, this reads 3: calibrate its session again"),
    "no schema": (("schema",), None, "schema None, this reads 3: calibrate its session again"),
    "a session": (("kind",), None, "is no calibration"),
    "a skewed rotation": (("cameras", "left", "matrix", 0, 0), 0.5, "no rotation"),
    "a mirrored rotation": (("cameras", "left", "matrix"), np.diag([1, 1, -1, 1]).tolist(), "no rotation"),
    "a hole in a covariance": (("uncertainty", "trusted", 0), [1.0], "trusted is|covariances are not"),
    "motions of another camera": (("uncertainty", "unseen_of_cameras"), {}, "other cameras"),
    "a word for a number": (("corrections", "range_offset_m"), "far", "range_offset_m is 'far'"),
    "no focal length": (("cameras", "right", "lens", "fx"), 0, "fx is 0"),
    "another mount": (("cameras", "right", "mount"), "hand", "mount is 'hand'"),
    "an unknown verdict": (("verdict", "answer"), "perhaps", "answer is 'perhaps'"),
    "no range finder": (("lrf",), None, "lrf is None"),
}  # fmt: skip


@pytest.mark.parametrize("case", DAMAGED)
def test_what_is_damaged_is_refused_with_the_reason(record, tmp_path, case):
    where, value, words = DAMAGED[case]
    path = tmp_path / "calibration.json"
    write_calibration(path, changed(record, where, value))
    with pytest.raises(SessionError, match=words) as error:
        load_calibration(path)
    assert str(error.value).startswith(str(path))


FOREIGN = {
    "half a file": ('{"schema": 2, "kind": "lrf', "not JSON"),
    "another program's": ('{"K": [1, 2, 3]}', "is no calibration"),
    "a list": ("[]", "holds a list"),
    "nothing": ("", "not JSON"),
}


@pytest.mark.parametrize("case", FOREIGN)
def test_what_is_no_calibration_is_refused(tmp_path, case):
    text, words = FOREIGN[case]
    path = tmp_path / "calibration.json"
    path.write_text(text)
    with pytest.raises(SessionError, match=words):
        load_calibration(path)
    with pytest.raises(SessionError, match="no such file"):
        load_calibration(tmp_path / "none.json")


def other_lrf(rig, **changes):
    return replace(rig, lrf=replace(rig.lrf, **changes))


RIGS = {  # what another rig has, what is said
    "other cameras": (lambda rig: replace(rig, cameras={"top": rig.cameras["left"]}), "cameras are"),
    "another mount": (
        lambda rig: replace(rig, cameras=rig.cameras | {"left": replace(rig.cameras["left"], mount="platform")}),
        "'left' is fixed to the head, not platform",
    ),
    "other beams": (lambda rig: other_lrf(rig, bearing_step=0.1), "its beams are"),
    "another view": (lambda rig: other_lrf(rig, field_of_view=(0.0, 1.0)), "range finder sees"),
}  # fmt: skip


@pytest.mark.parametrize("case", RIGS)
def test_another_rig_is_refused(quick, loaded, case):
    change, words = RIGS[case]
    session = quick.prepared.session
    for other in (session, loaded):
        require_same_rig(loaded, other)
        with pytest.raises(ValueError, match=words):
            require_same_rig(change(loaded), other)


def test_images_of_another_size_are_of_another_rig(loaded):
    with pytest.raises(ValueError, match="'left' have 1024 x 768 pixels, not 640 x 480"):
        require_same_rig(loaded, open_session(DATA / "sim_lms221"))


def test_a_rig_with_a_camera_less_is_the_same_rig(quick, loaded):
    fewer = replace(loaded, cameras={"left": loaded.cameras["left"]})
    require_same_rig(fewer, quick.prepared.session)
    require_same_rig(loaded, fewer)


def test_what_cannot_be_trusted_is_asked_for(loaded):
    refuse_untrusted(loaded)
    bad = replace(loaded, answer="no", reasons=("no placement leans",))
    with pytest.raises(ValueError, match="no placement leans.*--untrusted"):
        refuse_untrusted(bad)
    refuse_untrusted(bad, untrusted=True)


def test_a_rig_that_does_not_say_how_well_it_is_known_has_no_chain(loaded):
    with pytest.raises(ValueError, match="does not say how well"):
        chain_of(replace(loaded, uncertainty=None))
