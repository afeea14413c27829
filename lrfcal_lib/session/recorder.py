"""Sessions whose recording may be interrupted and go on later."""

import math
import os
from collections.abc import Iterable

from lrfcal_lib.session import files, read, stated
from lrfcal_lib.session.files import SessionError, naming, short
from lrfcal_lib.session.tables import read_table
from lrfcal_lib.session.write import SessionWriter, as_lines, mend_tables, write_file

# of rows of a dropped placement, by table
MARKS = {"lrf/index.csv": {"placement": ""}, "images.csv": {"purpose": read.DROPPED}}


class SessionRecorder(SessionWriter):
    """A :class:`SessionWriter` for recordings that may be interrupted and go on later (`resume`).

    While a session is recorded, session.json has the key ``unfinished``: the placement that was
    begun. The placement joins ``placements`` when it is finished, in one renaming of session.json;
    until then every reader leaves it out. Going on, or dropping a placement, marks what was
    recorded of it: its rows of index.csv lose their placement, its images get the purpose
    'dropped'. No telegram and no image is deleted. SessionError if there is a session already, or
    one that states another board or rig, where it goes on.
    """

    @property
    def finished(self) -> tuple[int, ...]:
        """Numbers of the finished placements."""
        return tuple(self.data["placements"])

    def __init__(self, *rig, resume=False, **about):
        self._resume = resume
        super().__init__(*rig, **about)

    def _create(self):
        remedy = "record with --resume to go on with it, or choose another"
        if self._resume:
            remedy = "choose another name"
        if self._resume and os.path.lexists(self.path / "session.json"):
            self._go_on()
        else:  # session.json comes first, so that a recording killed at once can go on
            super()._create(remedy, unfinished=[])
        self._begin_table("platform.csv", read.PLATFORM_COLUMNS)

    def _go_on(self):
        """Take over what an earlier recording wrote, without the placement that it did
        not finish.
        """
        data = files.read_json(self.path / "session.json", self.path)
        with naming(self.path / "session.json"):
            known = stated.parse_session(data)
            for key in ("board", "rig"):
                now = self.data[key]
                if data[key] != now:
                    raise ValueError(
                        f"{_first_difference(data[key], now, key)}, unlike the rig now: go on with "
                        "the same rig file, or begin another one"
                    )
        self.data = data | {"unfinished": known["unfinished"] or ()}
        mend_tables(self.path)
        self._drop_unfinished()
        self._state(unfinished=[])

    def begin_placement(self, placement: int) -> None:
        """State that a placement is being recorded from now on; one that was broken off is dropped.

        Parameters
        ----------
        placement

        Raises
        ------
        SessionError
            If it was recorded already.
        """
        self._drop_unfinished()
        if placement in self.finished or placement < 0:
            raise SessionError(
                f"{self.path}: placement {placement} cannot be begun; recorded: "
                f"{short(self.finished)}"
            )
        self._state(unfinished=[int(placement)])

    def finish_placement(self) -> None:
        """State that the placement begun last is complete; from now on it is part of the
        session.
        """
        self._state(
            placements=sorted([*self.finished, *self.data["unfinished"]]), unfinished=[]
        )

    def drop_placement(self, placement: int) -> None:
        """Take a placement, finished or not, out of the session; its number can be recorded again.

        Parameters
        ----------
        placement

        Raises
        ------
        SessionError
            If there is no such placement.
        """
        if placement not in {*self.finished, *self.data["unfinished"]}:
            raise SessionError(
                f"{self.path}: no placement {placement} to drop; recorded: {short(self.finished)}"
            )
        self._state(
            placements=[p for p in self.finished if p != placement], unfinished=[placement]
        )
        self._mark_dropped(placement)
        self._state(unfinished=[])

    def _drop_unfinished(self):
        for placement in self.data["unfinished"]:
            self.drop_placement(placement)

    def add_platform(self, rows: Iterable[tuple[float, float, float]]) -> None:
        """Append to the log of the platform.

        Parameters
        ----------
        rows
            Time of this computer (s), commanded and measured pitch (rad), NaN where unknown.
        """
        self._append_rows(
            "platform.csv",
            [(time_s, *map(math.degrees, angles)) for time_s, *angles in rows],
        )

    def finish(self) -> None:
        """Close the recording: nothing can be half done in it any more."""
        self._drop_unfinished()
        del self.data["unfinished"]
        self._state()
        self.close()

    def __exit__(self, kind, error, trace):
        """A recording ends by :meth:`finish`; after anything else it may go on."""
        self.close()

    def close_views(self) -> dict[str, int]:
        """Numbers of images of the board held close by camera."""
        file = self.path / "images.csv"
        rows = read_table(file, read.IMAGE_COLUMNS, self.path, needed=bool(self.cameras))
        close = [row["camera"] for row in rows if row["purpose"] == "intrinsics"]
        return {camera: close.count(camera) for camera in self.cameras}

    def _note_placement(self, placement):
        if placement not in (-1, *self.data["unfinished"]):
            raise SessionError(f"{self.path}: placement {placement} was not begun")

    def _mark_dropped(self, placement):
        """Mark the rows of a placement in the tables that there are."""
        for name, columns in read.TIMED.items():
            rows = read_table(self.path / name, columns, self.path, needed=False)
            for row in rows:
                if row["placement"].removesuffix(".0") == str(placement):
                    row.update(MARKS[name])
            if rows:
                write_file(
                    self.path, name, as_lines([columns, *(row.values() for row in rows)])
                )


def _first_difference(old, new, where):
    """Which value of session.json differs, as text."""
    if isinstance(old, dict) and isinstance(new, dict):
        key = next(k for k in [*old, *new] if old.get(k, ...) != new.get(k, ...))
        return _first_difference(old.get(key), new.get(key), f"{where}.{key}")
    return f"{where} is {old!r}, not {new!r}"
