"""A session of telegrams gives the sweeps that were sent, and tells about every telegram it could not use."""

import shutil

import numpy as np
import pandas as pd
import pytest
from telegrams import encode_scan

from lrfcal_lib.model.board import triangle_board
from lrfcal_lib.session.files import SessionError
from lrfcal_lib.session.lms2xx_codec import (
    Configuration,
    encode_configuration,
    encode_values,
    encode_words,
)
from lrfcal_lib.session.lms2xx_frame import (
    encode_telegram,
)
from lrfcal_lib.session.read import open_session, validate
from lrfcal_lib.session.stated import LrfInfo
from lrfcal_lib.session.telegrams import TRUNCATED, WRONG
from lrfcal_lib.session.write import SessionWriter, finish

LRF = LrfInfo(
    "made up", (np.radians(40), np.radians(140)), np.radians(0.25), 0.01, max_range=32.0
)
PITCH = np.radians([-0.5, -0.25, 0.0, 0.25])


def configuration(mode=6):
    return encode_configuration(Configuration().changed(measuring_mode=mode, unit="mm"))


def room(lines=4, beams=401, seed=0):
    """Ranges in whole millimetres with all kinds of gaps."""
    ranges = np.random.default_rng(seed).integers(1000, 30_000, (lines, beams)) / 1000
    ranges[0, 3], ranges[0, 5] = np.nan, np.inf
    return ranges


def record(path, *batches, lrf=LRF, first=None):
    with SessionWriter(path, triangle_board(), lrf) as writer:
        writer.add_telegrams(-1, [configuration() if first is None else first])
        for batch in batches:
            writer.add_telegrams(*batch)
    return path


def scans(ranges, mode=6, flags=0, **options):
    return [
        encode_words(encode_values(line, mode=mode) | np.uint16(flags << 13), **options)
        for line in ranges
    ]


@pytest.fixture
def path(tmp_path):
    first = room()
    second = room(seed=1)
    return record(
        tmp_path / "trip", (1, scans(first), PITCH, [1.0, 2, 3, 4]), (2, scans(second), 0.1)
    )


@pytest.fixture
def recorded(tmp_path):
    """Records batches and opens the session."""
    return lambda *batches, **options: open_session(
        record(tmp_path / "s", *batches, **options)
    )


def telegrams(path):
    return path / "lrf" / "telegrams.bin"


def interlaced(dense, number=None):
    """The four telegrams of a line of 721 beams; `number` is the telegram index of the first."""
    indices = [None] * 4 if number is None else [(0, number + k) for k in range(4)]
    return [
        encode_scan(dense[k::4], mode=6, partial=k, indices=indices[k]) for k in range(4)
    ]


# ---------------------------------------------------------------------------------------------- round trips


def test_sweeps_are_what_the_device_measured(path):
    session = open_session(path)
    assert session.problems == () and validate(path) == [] and session.placements == (1, 2)
    first = session.sweep(1)
    second = session.sweep(2)
    expected = room()
    expected[0, 5] = np.nan
    np.testing.assert_allclose(first.ranges, expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(first.pitch, PITCH, atol=1e-10)
    assert first.time_s.tolist() == [1, 2, 3, 4] and np.isnan(second.time_s).all()
    np.testing.assert_allclose(np.degrees(first.bearings), np.arange(40, 140.1, 0.25))
    np.testing.assert_allclose(second.pitch, 0.1)


@pytest.mark.parametrize(
    "values, first, step", [(101, 40, 1), (201, 40, 0.5), (181, 0, 1), (361, 0, 0.5)]
)
def test_the_field_of_view_is_that_of_the_telegrams(recorded, values, first, step):
    session = recorded((1, scans(room(beams=values)), PITCH))
    bearings = np.degrees(session.sweep(1).bearings)
    np.testing.assert_allclose(bearings, first + step * np.arange(values))
    last = first + step * (values - 1)
    (problem,) = validate(session.path)
    assert problem == (
        f"the bearings of the scan lines (lrf) cover {first:g} to {last:g} deg in steps of {step:g} deg, session.json "
        "states field_of_view_deg and bearing_step_deg as 40 to 140 deg in steps of 0.25 deg: the scan lines count; "
        "correct session.json, or the bearings if they are wrong"
    )


def test_a_lost_part_stays_empty_and_is_not_filled_from_another_turn(recorded):
    a, b, c = room(3, 721, seed=2)
    a[3:6] = 5.0
    sent = interlaced(a, 100)[:2] + interlaced(b, 104)[2:] + interlaced(c, 254)
    sweep = recorded((1, sent, 0.0)).sweep(1)
    found = [
        {int(k) for k in np.arange(721)[np.isfinite(line)] % 4} for line in sweep.ranges
    ]
    assert found == [{0, 1}, {2, 3}, {0, 1, 2, 3}]


def test_the_measuring_mode_follows_the_device(recorded):
    far = np.full((1, 361), 20.0)
    near = np.full((1, 361), 7.5)
    session = recorded(
        (1, scans(far), 0.0),
        (-1, [configuration(0)]),
        (2, scans(near, mode=0, flags=5), 0.0),
    )
    np.testing.assert_allclose(
        [session.sweep(1).ranges, session.sweep(2).ranges], [far, near]
    )


def test_without_configuration_the_factory_mode_is_assumed_and_told(recorded):
    near = np.full((2, 401), 7.5)
    session = recorded((1, scans(near, mode=0, flags=1), 0.0), first=scans(near, mode=0)[0])
    np.testing.assert_allclose(session.sweep(1).ranges, near)
    (problem,) = session.problems
    assert (
        "telegrams.bin: no status or configuration telegram: measuring mode 00 (factory) assumed"
        in problem
    )


def test_other_telegrams_and_scans_of_no_placement_are_ignored(recorded):
    a0, short_f4 = (encode_telegram(code, b"\0", address=0x80) for code in (0xA0, 0xF4))
    session = recorded(
        (-1, [a0, short_f4]), (-1, scans(room(1, 361))), (1, [*scans(room()), a0], 0.0)
    )
    assert session.sweep(1).ranges.shape == (4, 401)
    (problem,) = session.problems
    assert (
        "line 4, offset 51, length 9, placement -1: reply F4 has 1 bytes of data, needs 7; ignored"
        in problem
    )


# --------------------------------------------------------------------------------------------------- damage


def test_wrong_crcs_are_left_out_counted_and_named(path):
    data = bytearray(telegrams(path).read_bytes())
    data[42 + 812 + 100] ^= 4
    data[42 + 4 * 812] = 3  # no start byte
    telegrams(path).write_bytes(data + bytes(9))  # as after a crash between data and index
    session = open_session(path)
    assert session.sweep(1).ranges.shape == (3, 401) and session.sweep(2).ranges.shape == (
        3,
        401,
    )
    wrong = session.telegrams.offset[session.telegrams.outcome == WRONG]
    assert wrong.tolist() == [854, 3290]
    assert np.bincount(session.telegrams.outcome).tolist() == [6, 1, 2]
    wrong, behind = session.problems
    assert "2 of 9 telegrams have a wrong CRC, left out, at 854, 3290" in wrong
    assert "9 bytes after the last telegram in index.csv are not used" in behind


@pytest.mark.parametrize("cut", [1, 400, 811, 812])
def test_a_truncated_last_telegram_is_left_out_and_told(path, cut):
    data = telegrams(path).read_bytes()
    telegrams(path).write_bytes(data[:-cut])
    session = open_session(path)
    assert (
        len(session.sweep(2).ranges) == 3
        and (session.telegrams.outcome == TRUNCATED).sum() == 1
    )
    assert any(
        f"at {len(data) - 812}, is cut off after {812 - cut} bytes" in text
        for text in session.problems
    )


def test_a_row_cut_off_by_a_crash_is_left_out_until_finish_removes_it(path):
    file = path / "lrf" / "index.csv"
    whole = file.read_text()
    file.write_text(whole[:-3])
    session = open_session(path)
    assert len(session.sweep(2).ranges) == 3
    assert any("the last row is cut off" in text for text in session.problems)
    finish(path)
    assert file.read_text() == whole[: whole[:-1].rindex("\n") + 1]


def cell(row, column, value):
    """Another value in index.csv, the header being row 0."""

    def change(path):
        file = path / "lrf" / "index.csv"
        rows = [line.split(",") for line in file.read_text().splitlines()]
        rows[row][column] = value
        file.write_text("".join(",".join(cells) + "\n" for cells in rows))

    return change


def data(change):
    """Other bytes in telegrams.bin."""
    return lambda path: telegrams(path).write_bytes(change(telegrams(path).read_bytes()))


def again(*batches, **options):
    """Another recording in its place."""

    def change(path):
        shutil.rmtree(path)
        record(path, *batches, **options)

    return change


def no_rows(path):
    (path / "lrf" / "index.csv").write_text("t_s,offset,length,placement,pitch_deg\n")


def test_an_index_that_pandas_wrote_is_the_same(path):
    """Its placements have a point where one of them is empty."""
    before = open_session(path).scans
    file = path / "lrf" / "index.csv"
    pd.read_csv(file).to_csv(file, index=False)
    assert ",1.0," in file.read_text()
    for key, values in open_session(path).scans.items():
        np.testing.assert_array_equal(values, before[key])


HALF = np.ones((4, 361))
DAMAGE = [
    (
        cell(3, 1, "853"),
        r"index\.csv: line 4, offset 853, length 812, .*one after the other; restore",
    ),
    (
        cell(2, 2, "6"),
        r"index\.csv: line 3, offset 42, length 6, placement 1: telegrams of 7 to 65541 bytes",
    ),
    (
        cell(2, 4, ""),
        r"index\.csv: line 3, offset 42, length 812, placement 1: pitch_deg is missing",
    ),
    (cell(2, 1, "x"), r"index\.csv: line 3: offset is 'x': a whole number is needed"),
    (
        cell(3, 3, "1.5"),
        r"index\.csv: line 4: placement is '1\.5': a whole number is needed",
    ),
    (no_rows, r"index\.csv: no telegram in the index, 6538 bytes"),
    (cell(2, 4, "400"), r"a pitch is .* rad: degrees"),
    (
        data(lambda raw: raw[:2000]),
        "line 5, offset 1666, .* telegrams.bin has 2000 bytes: restore it, or remove",
    ),
    (
        data(lambda raw: b"\x06" + raw),
        "9 of 9 telegrams have a wrong CRC.*not of one recording",
    ),
    (
        again((1, scans(room()), 0.0), (2, scans(HALF), 0.0)),
        "scans of 361, 401 values are mixed",
    ),
    (
        again((1, scans(room(beams=50)), 0.0)),
        r"telegrams\.bin: a whole scan has .* values, got 50",
    ),
    (
        again((1, scans(HALF), 0.0), first=configuration(0x3F)),
        r"telegrams\.bin: measuring mode 0x3f is none of",
    ),
    (again((-1, scans(room()), 0.0)), "no telegram with a scan belongs to a placement"),
]


@pytest.mark.parametrize(("damage", "message"), DAMAGE)
def test_what_does_not_fit_is_refused(path, damage, message):
    damage(path)
    with pytest.raises(SessionError, match=message):
        open_session(path)


def test_the_writer_refuses_what_it_could_not_read_again(tmp_path):
    line = np.ones((1, 3)), [1.0, 1.5, 2.0], [0.0]
    with SessionWriter(tmp_path / "s", triangle_board(), LRF) as writer:
        with pytest.raises(SessionError, match="a pitch is 30: finite radians"):
            writer.add_telegrams(1, scans(room(1)), 30.0)
        writer.add_telegrams(1, scans(room(1)), 0.0)
        with pytest.raises(
            SessionError, match="records telegrams: add_telegrams, or begin another"
        ):
            writer.add_sweep(2, *line)
    with SessionWriter(tmp_path / "t", triangle_board(), LRF) as writer:
        writer.add_sweep(1, *line)
        with pytest.raises(
            SessionError, match="has scan lines: add_sweep, or begin another"
        ):
            writer.add_telegrams(1, scans(room(1)), 0.0)
