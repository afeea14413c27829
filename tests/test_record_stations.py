"""`record --scene`: stations instead of placements of the board."""

import json

import fake_rig
import numpy as np
import pytest
from fake_rig import make_rig, rig_data

from lrfcal_lib import __main__ as command_line
from lrfcal_lib.acquire import record
from lrfcal_lib.acquire.stations import Stations
from lrfcal_lib.preprocess.closing_scan import closing_of
from lrfcal_lib.session.read import open_session

SWEEP = [-20, 20, 1]


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Runs `record --scene` with a fake rig and the user's answers: exit code, what was asked, said."""

    def run(answers, *options, feedback=True, **plan):
        data = rig_data(pitch_deg=SWEEP, image_pitch_deg=[-10, 10], **plan)
        file = tmp_path / "rig.json"
        file.write_text(json.dumps(data))
        asked = []
        left = iter(answers)

        def answer(text):
            asked.append(text)
            return next(left)

        class Devices:
            @staticmethod
            def open(stated):
                rig = make_rig(data, feedback=feedback)
                rig.stated = stated
                return rig

        monkeypatch.setattr("builtins.input", answer)
        monkeypatch.setattr(record, "Rig", Devices)
        command = ["record", str(file), str(tmp_path / "s"), "--scene", *options]
        return command_line.main(command), asked, capsys.readouterr().out

    return run


def test_every_station_is_swept_photographed_and_closed(run, tmp_path):
    code, asked, said = run(["", "", ""], "--stations", "3")
    assert (
        code == 0 and len(asked) == 3 and asked[1].startswith("station 2: set the rig up")
    )
    session = open_session(tmp_path / "s")
    assert session.scene_placements == (1, 2, 3) and session.board_placements == ()
    for number in session.scene_placements:
        sweep = session.sweep(number)
        assert len(sweep.pitch) == 42 and sweep.pitch[-1] == pytest.approx(0)
        pitch_deg = np.degrees([image.pitch for image in session.images(placement=number)])
        np.testing.assert_allclose(pitch_deg, [-10, 10])
    assert said.count("stood still: back at a pitch that it had") == 3
    assert "100 % of the beams came back" in said and "lrfcal_lib reconstruct" in said


def test_a_continuous_sweep_is_closed_as_well(run, tmp_path):
    assert run([""], mode="continuous")[0] == 0
    session = open_session(tmp_path / "s")
    assert session.continuous and not closing_of(session.sweep(1)).moved


def test_a_recording_of_stations_goes_on(run, tmp_path):
    assert run(["", "q"], "--stations", "3")[0] == 0
    first = (tmp_path / "s" / "lrf" / "telegrams.bin").read_bytes()
    code, asked, _ = run(["r", "", "", ""][1:], "--stations", "3", "--resume")
    assert code == 0 and len(asked) == 2
    assert open_session(tmp_path / "s").scene_placements == (1, 2, 3)
    assert (tmp_path / "s" / "lrf" / "telegrams.bin").read_bytes().startswith(first)


def test_a_station_that_moved_is_told(run, monkeypatch):
    true = fake_rig.telegram
    scans = iter(range(1000))
    monkeypatch.setattr(
        fake_rig, "telegram", lambda pitch: true(pitch + 0.5 * (next(scans) >= 41))
    )
    code, _, said = run([""])
    assert code == 0 and "BAD   stood still" in said and "it moved, record it again" in said


def test_scenes_that_the_plan_lists_keep_their_sweeps_and_numbers():
    listed = [
        {"number": 1},
        {"number": 7, "board": False, "pitch_deg": [-8, 8, 2], "image_pitch_deg": [3]},
    ]
    stated = Stations(2).planned(make_rig(rig_data(placements=listed)).stated)
    stations = stated.plan.to_do()
    assert [station.number for station in stations] == [7, 8]
    for station in stations:
        assert station.purpose == "scene" and station.closing
        np.testing.assert_allclose(np.degrees(station.pitch[[0, -1]]), [-8, 8])
        np.testing.assert_allclose(np.degrees(station.image_pitch), [3])


@pytest.mark.parametrize("option", ["--stations=2", "--calibration=calibration.json"])
def test_options_of_a_scene_need_a_scene(option, capsys):
    assert command_line.main(["record", "rig.json", "s", option]) == 1
    assert "add --scene" in capsys.readouterr().err


def test_the_calibration_of_another_rig_is_refused_before_anything_is_recorded(quick):
    stated = make_rig(rig_data()).stated
    with pytest.raises(
        ValueError, match="images of 'left' have 32 x 24 pixels, not 640 x 480"
    ):
        Stations(1, quick.rig("joint")).planned(stated)
