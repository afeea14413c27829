"""Write a session placement by placement: what is finished stays, whatever happens to the one being recorded."""

from __future__ import annotations

import json
import math
import os

from lrfcal_lib.session.common import naming, read_json, read_table, short
from lrfcal_lib.session.files import DROPPED, IMAGE_COLUMNS, PLATFORM_COLUMNS, unfinished_of
from lrfcal_lib.session.opened import LOCK, SessionError, listed
from lrfcal_lib.session.stated import parse_session
from lrfcal_lib.session.telegrams import INDEX_COLUMNS
from lrfcal_lib.session.writer import SessionWriter, append_file, cell, complete, mend_tables


class SessionRecorder(SessionWriter):
    """A :class:`SessionWriter` for recordings that may be interrupted and go on later.

    While a session is recorded, session.json has the key ``unfinished``: the placement that was begun. The placement
    joins ``placements`` when it is finished, in one renaming of session.json; until then every reader leaves it out.
    Going on, or dropping a placement, marks what was recorded of it: its rows of index.csv lose their placement, its
    images get the purpose 'dropped'. No telegram and no image is deleted.

    Parameters
    ----------
    path : path-like
        Must not exist or be an empty folder, unless the recording goes on.
    resume : bool
        Go on with the recording in `path`, if there is one.
    board, lrf, cameras, T_head_lrf, name, licence, source, simulated, reference
        As of :class:`SessionWriter`.

    Raises
    ------
    SessionError
        If there is a session already (or one that states another board or rig, where it goes on).
    """

    def __init__(self, path, board, lrf, cameras=(), T_head_lrf=None, *, resume=False, **about):
        self._resume = resume
        super().__init__(path, board, lrf, cameras, T_head_lrf, **about)

    @property
    def finished(self):
        """Numbers of the finished placements."""
        return tuple(self.data["placements"])

    def _create(self):
        stated = self.path / "session.json"
        if self._resume and os.path.lexists(stated):
            self._go_on(read_json(stated, self.path))
        else:
            self._begin(stated)
        self._make_folders()
        if not os.path.lexists(self.path / "platform.csv"):
            self._write("platform.csv", ",".join(PLATFORM_COLUMNS) + "\n")

    def _begin(self, stated):
        """session.json comes first, so that a recording killed at once can go on."""
        if set(os.listdir(self.path)) - {_draft(stated), LOCK}:
            hint = "choose another name" if self._resume else "record with --resume to go on with it, or choose another"
            raise SessionError(f"{self.path}: exists already; {hint}")
        self.data["unfinished"] = []
        self._write_index()

    def _go_on(self, data):
        """Take over what an earlier recording wrote, without the placement that it did not finish."""
        mine = json.loads(json.dumps(self.data))
        with naming(self.path / "session.json"):
            placements = list(parse_session(data)["placements"])
            left = unfinished_of(data)
            for key in ("board", "rig"):
                if data[key] != mine[key]:
                    where = _first_difference(data[key], mine[key], key)
                    raise ValueError(f"{where}, unlike the rig now: go on with the same rig file, or begin another one")
        self.data = {**data, "placements": placements, "unfinished": list(left or ())}
        self._make_folders()
        mend_tables(self.path)
        for placement in left or ():
            self._mark_dropped(placement)
        self.data["unfinished"] = []
        self._write_index()
        for camera in self.cameras:
            there = listed(self.path / "images" / camera, self.path)
            names = [name.partition(".")[0] for name in there if not name.endswith(".draft")]
            self.shots[camera] = max((int(name) for name in names if name.isdecimal()), default=0)

    def begin_placement(self, placement):
        """State that a placement is being recorded from now on.

        Raises
        ------
        SessionError
            If another one is, or the number was recorded already.
        """
        for other in self.data["unfinished"]:
            raise SessionError(f"{self.path}: placement {other} is being recorded: finish it first")
        if placement in self.finished or placement < 0:
            raise SessionError(f"{self.path}: placement {placement} cannot be begun; recorded: {short(self.finished)}")
        self.data["unfinished"] = [int(placement)]
        self._write_index()

    def finish_placement(self):
        """State that the placement begun last is complete; from now on it is part of the session."""
        if not self.data["unfinished"]:
            raise SessionError(f"{self.path}: no placement is being recorded: begin one first")
        before = dict(self.data)
        self.data |= {"placements": sorted([*self.finished, *self.data["unfinished"]]), "unfinished": []}
        try:
            self._write_index()
        except OSError:
            self.data = before
            raise

    def drop_placement(self, placement):
        """Take a placement, finished or not, out of the session; its number can be recorded again.

        Raises
        ------
        SessionError
            If there is no such placement.
        """
        if placement not in {*self.finished, *self.data["unfinished"]}:
            raise SessionError(f"{self.path}: no placement {placement} to drop; recorded: {short(self.finished)}")
        self.data["placements"] = [p for p in self.finished if p != placement]
        self.data["unfinished"] = [placement]
        self._write_index()
        self._mark_dropped(placement)
        self.data["unfinished"] = []
        self._write_index()

    def add_platform(self, rows):
        """Append to the log of the platform.

        Parameters
        ----------
        rows : sequence of (float, float, float)
            Host time (s), commanded and measured pitch (rad); NaN where a head was not told, or does not tell.
        """
        lines = [[cell(t), *(cell(math.degrees(a)) for a in angles)] for t, *angles in rows]
        append_file(self.path / "platform.csv", "".join(",".join(line) + "\n" for line in lines), self.path)

    def finish(self):
        """Close the recording: nothing can be half done in it any more."""
        for placement in self.data["unfinished"]:
            self.drop_placement(placement)
        del self.data["unfinished"]
        self._write_index()
        complete(self.path)
        self.close()

    def __exit__(self, kind, error, trace):
        """A recording ends by :meth:`finish`; after anything else it may go on."""
        self.close()

    def shots_of(self, purpose):
        """Numbers of images of a purpose, a dict by camera."""
        rows = read_table(self.path / "images.csv", IMAGE_COLUMNS, self.path)[0] if self.cameras else []
        return {c: sum(row["camera"] == c and row["purpose"] == purpose for row in rows) for c in self.cameras}

    def _note_placement(self, placement):
        if placement >= 0 and placement not in self.data["unfinished"]:
            raise SessionError(f"{self.path}: placement {placement} was not begun")

    def _mark_dropped(self, placement):
        number = str(placement)
        for file, columns, key, to in (
            ("lrf/index.csv", INDEX_COLUMNS, "placement", ""),
            ("images.csv", IMAGE_COLUMNS, "purpose", DROPPED),
        ):
            there = os.path.lexists(self.path / file)
            rows = read_table(self.path / file, columns, self.path)[0] if there else []
            mine = [row for row in rows if row["placement"] == number]
            for row in mine:
                row[key] = to
            if mine:
                lines = [",".join(columns), *(",".join(row.values()) for row in rows)]
                self._write(file, "\n".join(lines) + "\n")


def _draft(file):
    return file.name + ".draft"


def _first_difference(old, new, where):
    """Which value of session.json differs, as text."""
    if isinstance(old, dict) and isinstance(new, dict):
        key = next(k for k in [*old, *new] if old.get(k, ...) != new.get(k, ...))
        return _first_difference(old.get(key), new.get(key), f"{where}.{key}")
    return f"{where} is {old!r}, not {new!r}"
