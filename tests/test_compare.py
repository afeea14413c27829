"""Two calibrations of one rig: honest ones agree, one whose camera was turned does not."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from joint_draws import draw
from scipy.spatial.transform import RigidTransform, Rotation
from shared import QUICK, stages

from lrfcal_lib import __main__ as command_line
from lrfcal_lib.calibrate.calibration_file import KIND, SCHEMA, rig_record
from lrfcal_lib.calibrate.rig import joint_rig
from lrfcal_lib.evaluate.export import calibration_record, write_calibration
from lrfcal_lib.measure.compare import compare, rig_at
from lrfcal_lib.model.kinematics import Corrections
from lrfcal_lib.session import cache
from lrfcal_lib.solvers.joint import solve_joint


@pytest.fixture(scope="module", params=["head", "platform"])
def days(request):
    """One rig, calibrated from placements that the others have not seen."""
    obs, _, rig = draw(np.random.default_rng(0), 24, mount=request.param)
    made = []
    for day, placements in enumerate(np.array_split(obs.placements, 3)):
        found = solve_joint(obs.select(placements))
        known = joint_rig(found, dict.fromkeys(rig.cameras, rig.model))
        made.append(replace(known, session=f"day {day}"))
    return made


def turned(rig, degrees, camera="left"):
    """A rig one of whose cameras was turned."""
    turn = RigidTransform.from_rotation(Rotation.from_rotvec([0, np.radians(degrees), 0]))
    moved = rig.cameras[camera]
    moved = replace(moved, T_camera=turn * moved.T_camera)
    return replace(rig, cameras=rig.cameras | {camera: moved})


def test_honest_calibrations_differ_within_what_they_claim(days):
    compared = [compare(*pair) for pair in pairwise(days)]
    assert len(compared) == 2 and all(pair.within for pair in compared)
    chi2 = sum(pair.whole.chi2 for pair in compared)
    freedom = sum(pair.whole.freedom for pair in compared)
    assert 0.4 < chi2 / freedom < 1.7
    for pair in compared:
        for part in (*pair.parts, pair.whole):
            for amount in part.amounts:
                assert amount.value <= 4 * amount.claimed
                # the scale of the pitch was held at zero: nobody claims to know it
                assert np.isfinite(amount.claimed) == (amount.what != "scale")


def test_a_calibration_agrees_with_itself(days):
    assert (
        "honest calibrations differ more in 100 % of cases"
        in compare(*days[:1] * 2).sentence()
    )


def test_a_camera_that_was_turned_is_named(days):
    first, second = days[:2]
    found = compare(first, turned(second, 0.5))
    assert not found.within and found.parts[2].p_of_others > 0.01
    assert "in left alone" in found.sentence()
    before = compare(first, second)
    assert found.parts[3].p == pytest.approx(before.parts[3].p)
    left = compare(second, turned(second, 0.5)).parts[2]
    assert left.name == "left" and left.amounts[0].value == pytest.approx(0.5)
    expected = np.radians(0.5) * first.cameras["left"].model.fx
    assert left.amounts[2].value == pytest.approx(expected, rel=0.3)


def test_a_calibration_does_not_differ_from_itself(days):
    found = compare(days[0], days[0])
    assert found.whole.p == 1.0 and found.whole.chi2 < 1e-20
    assert np.nanmax(np.abs(found.images["left"].off)) < 1e-6
    assert np.abs(found.cloud.off).max() < 1e-12


def with_lens(rig, shift=0.0):
    """A rig whose intrinsics are not exact, and the first focal length longer."""
    known = rig.uncertainty
    lens = 1e-4 * np.eye(len(known.names))
    known = replace(
        known, covariance=known.covariance + lens, trusted=known.trusted + lens, lens=lens
    )
    left = rig.cameras["left"]
    left = replace(left, model=replace(left.model, fx=left.model.fx + shift))
    return replace(rig, uncertainty=known, cameras=rig.cameras | {"left": left})


def test_errors_of_intrinsics_that_both_were_told_do_not_count(days):
    exact = compare(*days[:2])
    alike = compare(*(with_lens(rig) for rig in days[:2]))
    assert alike.whole.chi2 == pytest.approx(exact.whole.chi2, rel=1e-6)
    claimed = [[a.claimed for a in pair.parts[2].amounts] for pair in (exact, alike)]
    np.testing.assert_allclose(*claimed, rtol=1e-6)
    assert "same intrinsics" in alike.sentence()
    apart = compare(with_lens(days[0]), with_lens(days[1], 1e-6))
    assert apart.whole.chi2 < exact.whole.chi2 / 2
    assert "same intrinsics" not in apart.sentence()


def test_what_no_data_show_does_not_count(days):
    """The platform of one stated another zero of the pitch, and another place along the axis."""
    rig = days[0]
    turn = Rotation.from_rotvec([np.radians(2.0), 0, 0])
    gauge = RigidTransform.from_components([0.1, 0, 0], turn)
    cameras = rig.cameras
    if cameras["left"].mount == "platform":
        cameras = {
            name: replace(camera, T_camera=camera.T_camera * gauge.inv())
            for name, camera in cameras.items()
        }
    axis = replace(rig.axis, T_head_lrf=gauge * rig.T_head_lrf)
    found = compare(rig, replace(rig, axis=axis, cameras=cameras))
    assert found.whole.chi2 < 1e-9
    assert np.nanmax(np.abs(found.images["left"].off)) < 1e-6
    assert np.abs(found.cloud.off).max() < 1e-9


def test_what_has_no_bound_is_told_so_and_not_tested(days):
    known = days[0].uncertainty
    trusted = known.trusted.copy()
    trusted[0, 0] = np.inf
    found = compare(replace(days[0], uncertainty=replace(known, trusted=trusted)), days[1])
    axis = found.parts[0]
    assert axis.freedom == 3 and "(claimed no bound), shift" in str(axis)


def test_shifts_are_those_of_the_same_records(days):
    """A longer range offset moves points along their beams by as much."""
    rig = days[0]
    corrections = rig.corrections
    longer = Corrections(corrections.range_offset + 0.01, corrections.pitch_scale)
    found = compare(rig, replace(rig, corrections=longer))
    np.testing.assert_allclose(np.linalg.norm(found.cloud.off, axis=-1), 0.01, rtol=1e-6)
    assert found.parts[1].amounts[1].value == pytest.approx(10.0)


def test_the_command_answers_in_a_sentence_and_a_figure(tmp_path, capsys, days):
    files = []
    for rig in (days[0], days[1], turned(days[1], 1.0)):
        files.append(str(tmp_path / f"{len(files)}.json"))
        head = {
            "schema": SCHEMA,
            "kind": KIND,
            "session": rig.session,
            "date": "2026-11-23",
        }
        verdict = {"answer": "yes", "reasons": []}
        record = {**head, "method": "joint", "verdict": verdict, **rig_record(rig)}
        write_calibration(files[-1], record)
    figure = tmp_path / "c.png"
    assert command_line.main(["compare", *files[:2], "--figure", str(figure)]) == 0
    assert "differ within what both claim" in capsys.readouterr().out
    assert figure.read_bytes().startswith(b"\x89PNG")
    assert command_line.main(["compare", *files]) == 3
    assert "differ by more than both claim" in capsys.readouterr().out
    assert command_line.main(["compare", files[0]]) == 1
    assert "two or more are needed" in capsys.readouterr().err


def test_a_session_is_calibrated_and_a_folder_has_its_file(quick, tmp_path, monkeypatch):
    monkeypatch.setenv(cache.VARIABLE, str(stages()))
    of_session = rig_at(QUICK)
    write_calibration(tmp_path / "calibration.json", calibration_record(quick, "joint"))
    found = compare(of_session, rig_at(tmp_path))
    assert found.first.session == found.second.session == "sim_quick"
    assert found.whole.chi2 < 1e-20
    with pytest.raises(ValueError, match="other.*no such file"):
        rig_at(tmp_path / "other")
