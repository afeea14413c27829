"""Write a session so that a crash loses at most what was being written, placement by placement."""

import contextlib
import errno
import json
import math
import os
import time
from pathlib import Path

import cv2
import numpy as np

from lrfcal_lib.session import read, stated
from lrfcal_lib.session.images import JPEG, check_image_size
from lrfcal_lib.session.lock import LOCK, alone
from lrfcal_lib.session.stated import SessionError, naming, short
from lrfcal_lib.session.tables import read_table
from lrfcal_lib.session.telegrams import INDEX_COLUMNS

RECORDINGS = "LRFCAL_RECORDINGS"  # environment variable: where new recordings go


def new_session_path():
    """Where a recording goes whose place nobody names: a folder by date in
    ``~/lrfcal_sessions``.
    """
    folder = os.environ.get(RECORDINGS) or Path.home() / "lrfcal_sessions"
    return Path(folder, time.strftime("%Y-%m-%d_%H%M%S")).absolute()


class SessionWriter:
    """Write a session so that a crash loses at most what was being written.

    Every sweep and every image is on the disk (fsync) before the table that names it is; at the
    end, or by ``finish(path)`` after an interruption, sweeps become the one scans.npz. A session
    holds scan lines (:meth:`add_sweep`) or the telegrams of a device (:meth:`add_telegrams`), never
    both.

    Parameters
    ----------
    path : path-like
        Must not exist or be an empty folder; its name is the session's `name` by default.
    board, lrf, cameras, T_head_lrf, platform_sigma, licence, source, simulated, reference,
    continuous
        See :class:`lrfcal_lib.session.read.Session`.

    Raises
    ------
    SessionError
        If the target exists, or something cannot stand in a session.

    Examples
    --------
    ``with SessionWriter(path, board, lrf, cameras) as writer: writer.add_sweep(1, ranges, bearings,
    pitch)``
    """

    def __init__(
        self,
        path,
        board,
        lrf,
        cameras=(),
        T_head_lrf=None,
        *,
        name=None,
        licence="",
        source="",
        simulated=False,
        platform_sigma=None,
        reference=None,
        continuous=False,
    ):
        self.path = Path(path)
        self.cameras = {camera.name: camera for camera in cameras}
        self.bearings = None  # of the sweeps so far
        self.parts = 0  # files of sweeps so far
        self.shots = dict.fromkeys(self.cameras, 0)  # images so far, by camera
        self.telegrams = self.path / "lrf" / "telegrams.bin"
        platform = {"T_head_lrf": stated.transform_to_json(T_head_lrf)}
        if platform_sigma is not None:
            platform["sigma_direction_deg"] = round(math.degrees(platform_sigma[0]), 9)
            platform["sigma_offset_m"] = platform_sigma[1]
        if continuous:
            platform["continuous"] = True
        rig = {
            "lrf": stated.lrf_to_json(lrf),
            "platform": platform,
            "cameras": {name: stated.camera_to_json(info) for name, info in self.cameras.items()},
        }
        self.data = {
            "schema": stated.SCHEMA,
            "name": name or self.path.resolve().name,
            "licence": licence,
            "source": source,
            "simulated": simulated,
            "board": stated.board_to_json(board),
            "rig": rig,
            "placements": [],
            "reference": reference or {},
        }
        with naming(self.path):
            stated.parse_session(json.loads(json.dumps(self.data)))
        if self.path.exists() and not self.path.is_dir():
            raise SessionError(
                f"{self.path}: exists already; choose another name or remove it first"
            )
        self.path.mkdir(parents=True, exist_ok=True)
        with contextlib.ExitStack() as stack:
            stack.enter_context(alone(self.path))
            self._create()
            self._held = stack.pop_all()

    def _create(self):
        if set(os.listdir(self.path)) - {LOCK}:
            raise SessionError(
                f"{self.path}: exists already; choose another name or remove it first"
            )
        self._make_folders()
        self._state()

    def _make_folders(self):
        for name in ("lrf", *(f"images/{camera}" for camera in self.cameras)):
            stated.checked(self.path / name / "any", self.path, make=True)
        if self.cameras:
            self._begin_table("images.csv", read.IMAGE_COLUMNS)

    def __enter__(self):
        return self

    def __exit__(self, kind, error, trace):
        with contextlib.closing(self):
            if kind is None:
                complete(self.path)

    def close(self):
        """Write nothing any more: others may."""
        self._held.close()

    def _write(self, name, content):
        write_file(self.path / name, content, self.path)

    def _state(self, **changes):
        """Change session.json; where that cannot be written, nothing is changed."""
        data = self.data | changes
        self._write("session.json", json.dumps(data, indent=1) + "\n")
        self.data = data

    def _begin_table(self, name, columns):
        if not os.path.lexists(self.path / name):
            self._write(name, as_lines([columns]))

    def _append_rows(self, name, rows):
        append_file(self.path / name, as_lines(rows), self.path)

    def _note_placement(self, placement):
        if placement >= 0 and placement not in self.data["placements"]:
            self._state(placements=sorted([*self.data["placements"], int(placement)]))

    def add_sweep(self, placement, ranges, bearings, pitch, time_s=None, intensities=None):
        """Append the scan lines of a placement; SessionError for wrong shapes or units, or other
        bearings than before.

        Parameters
        ----------
        ranges : array_like, shape (L, B)
            Metres, NaN where nothing came back.
        bearings : array_like, shape (B,)
            Radians, ascending; the same in all sweeps of a session.
        pitch : array_like, shape (L,)
            Radians.
        time_s, intensities : array_like, shapes (L,) and (L, B), optional
        """
        if self.telegrams.exists():
            raise SessionError(
                f"{self.telegrams}: the session records telegrams: add_telegrams, or begin "
                "another one"
            )
        ranges = np.array(ranges, float, ndmin=2)
        bearings = np.asarray(bearings, float)
        if time_s is None:
            time_s = np.full(len(ranges), np.nan)
        scans = {"ranges": ranges, "bearings": bearings}
        scans["pitch"] = np.asarray(pitch, float)
        scans["time_s"] = np.asarray(time_s, float)
        if intensities is not None:
            scans["intensities"] = np.asarray(intensities, float)
        with naming(f"{self.path}: placement {placement}"):
            scans = read.check_scans(scans | {"placement": np.full(len(ranges), placement)})
            if self.bearings is not None and not np.array_equal(self.bearings, bearings):
                raise ValueError(
                    "the bearings differ from those of the sweeps before: one grid a session"
                )
        self.bearings = bearings
        self.parts += 1
        self._write(f"lrf/part_{self.parts:06d}.npz", scans)
        self._note_placement(placement)

    def add_telegrams(self, placement, telegrams, pitch=math.nan, time_s=math.nan):
        """Append telegrams as the device sent them.

        Parameters
        ----------
        placement : int
            -1 for none: replies that are no scans, scans between the sweeps.
        telegrams : sequence of bytes
            Whole telegrams in the order they came, also damaged ones.
        pitch, time_s : float or array_like, shape (len(telegrams),)
            Radians, seconds.

        Raises
        ------
        SessionError
            For other numbers of pitches or times, pitches that are no radians, something that is no
            bytes, or a session that has scan lines already.
        """
        with naming(f"{self.path}: placement {placement}"):
            lengths = [len(raw) for raw in telegrams]
            pitch = np.broadcast_to(np.asarray(pitch, float), len(telegrams))
            time_s = np.broadcast_to(np.asarray(time_s, float), len(telegrams))
            if placement >= 0 and not np.all(np.abs(pitch) <= np.pi + 1e-6):
                raise ValueError(
                    f"a pitch is {np.abs(pitch).max():g}: finite radians, -pi to pi, are needed"
                )
            if self.parts:
                raise ValueError("the session has scan lines: add_sweep, or begin another one")
        self._begin_table("lrf/index.csv", INDEX_COLUMNS)
        self._note_placement(placement)
        offset = append_file(self.telegrams, b"".join(telegrams), self.path)
        offsets = offset + np.cumsum([0, *lengths[:-1]])
        number = number_cell(placement)
        rows = []
        pitch_deg = np.degrees(pitch)
        for begin, length, at, angle in zip(offsets, lengths, time_s, pitch_deg, strict=True):
            rows.append([cell(at), begin, length, number, cell(angle)])
        self._append_rows("lrf/index.csv", rows)

    def add_image(
        self, camera, image, placement=-1, *, pitch=math.nan, time_s=math.nan, purpose="board"
    ):
        """Append an image: a PNG or JPEG file or its bytes, kept as they are, or blue-green-red
        pixels (h, w, 3).

        The placement is -1 for none, pitch in radians, purpose one of 'board', 'intrinsics',
        'scene'. SessionError for an unknown camera or purpose, or an image of another size than the
        camera's.
        """
        if camera not in self.cameras or purpose not in read.PURPOSES:
            known = f"cameras are {short(self.cameras)}, purposes {short(read.PURPOSES)}"
            raise SessionError(f"{self.path}: camera '{camera}', purpose '{purpose}': {known}")
        what = f"camera '{camera}'"
        if isinstance(image, np.ndarray):
            content = cv2.imencode(".png", image)[1].tobytes()
        elif isinstance(image, bytes):
            content = image
        else:
            what = image
            content = stated.read_bytes(image)
        check_image_size(what, content, self.cameras[camera])
        self.shots[camera] += 1
        kind = "jpg" if content.startswith(JPEG) else "png"
        name = f"images/{camera}/{self.shots[camera]:04d}.{kind}"
        self._write(name, content)
        self._note_placement(placement)
        number = number_cell(placement)
        row = [cell(time_s), camera, name, number, cell(math.degrees(pitch)), purpose]
        self._append_rows("images.csv", [row])


def finish(path):
    """Complete a session whose recording was interrupted: one scans.npz out of its sweeps, whole
    rows in its tables.

    SessionError if there is no sweep, or one of them is damaged, or somebody records this session.
    """
    try:
        with alone(path):
            complete(Path(path))
    except FileNotFoundError as error:
        raise SessionError(
            f"{path}: {error.filename} is missing; is this the folder of a session?"
        ) from error


def complete(path):
    """As :func:`finish`, for who writes the session already; telegrams are complete as they are."""
    mend_tables(path)
    if os.path.lexists(path / "lrf" / "telegrams.bin"):
        return
    parts = read.parts_of(path)
    if not parts:
        raise SessionError(
            f"{path}: no sweep to finish in lrf/; nothing was recorded, or it is finished already"
        )
    sweeps = [read.read_npz(part, path) for part in parts]
    scans = {}
    for key in sweeps[0]:
        if key != "bearings" and all(key in sweep for sweep in sweeps):
            scans[key] = np.concatenate([sweep[key] for sweep in sweeps])
    scans["bearings"] = sweeps[0]["bearings"]
    write_file(path / "lrf" / "scans.npz", scans, path)
    for part in parts:
        part.unlink()


def mend_tables(path):
    """Remove rows that a crash cut off at the end of a session's tables."""
    for name in ("images.csv", "lrf/index.csv", "platform.csv"):
        table = path / name
        if not os.path.lexists(table):
            continue
        data = stated.read_bytes(table, path)
        if not data.endswith(b"\n"):
            write_file(table, data.rpartition(b"\n")[0] + b"\n", path)


def as_lines(rows):
    """Text of the rows of a table."""
    return "".join(",".join(map(str, row)) + "\n" for row in rows)


def cell(value):
    """A number as it stands in a table, empty for NaN."""
    return "" if math.isnan(value) else repr(round(float(value), 9))


def number_cell(placement):
    """The number of a placement as it stands in a table, empty for none."""
    return "" if placement < 0 else str(placement)


def write_file(file, content, within):
    """Write a file of a session (text or arrays, say) under another name, fsync, rename: it is
    whole or not there.
    """
    draft = stated.checked(file, within).with_name(file.name + ".draft")
    draft.unlink(missing_ok=True)
    with stated.opened(draft, within, os.O_WRONLY | os.O_CREAT | os.O_EXCL) as stream:
        if isinstance(content, dict):
            np.savez_compressed(stream, **content)
        else:
            stream.write(content.encode() if isinstance(content, str) else content)
        stream.flush()
        os.fsync(stream.fileno())
    draft.replace(file)
    handle = os.open(file.parent, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextlib.contextmanager
def whole(path):
    """Let a file that is no session's be written whole, or not at all.

    Parameters
    ----------
    path : path-like
        Its folder is made where there is none.

    Yields
    ------
    Path
        Beside it, to write to: a file there takes the place of `path` at the end. Where anything is
        raised before, it goes, and what was at `path` stays.

    Raises
    ------
    ValueError
        With the file and the remedy, where it cannot be written.
    """
    path = Path(path)
    # keeps the suffix, by which writers choose a format
    draft = path.with_name(f".{os.getpid()}-{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield draft
            draft.replace(path)
        finally:
            draft.unlink(missing_ok=True)
    except OSError as error:
        raise ValueError(f"{path}: {not_written(error)}, or name another folder") from error


def not_written(error):
    """Why an OSError kept something from being written, and what to do; half a sentence."""
    full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    remedy = "free some space" if full else "check the disk and its permissions"
    return f"cannot be written ({error.strerror or error}): {remedy}"


def append_file(file, content, within):
    """Append to a file, which is on the disk afterwards; where the new part begins. On a full disk
    all or nothing.
    """
    left = memoryview(content.encode() if isinstance(content, str) else content)
    with stated.opened(file, within, os.O_WRONLY | os.O_APPEND | os.O_CREAT) as stream:
        handle = stream.fileno()
        begin = os.fstat(stream.fileno()).st_size
        try:
            while left:
                left = left[os.write(handle, left) :]
            os.fsync(handle)
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(handle, begin)  # half a row would spoil the next one
            raise
    return begin


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
    def finished(self):
        """Numbers of the finished placements."""
        return tuple(self.data["placements"])

    def __init__(self, *rig, resume=False, **about):
        self._resume = resume
        super().__init__(*rig, **about)

    def _create(self):
        if self._resume and os.path.lexists(self.path / "session.json"):
            self._go_on()
        elif set(os.listdir(self.path)) - {"session.json.draft", LOCK}:
            hint = (
                "choose another name"
                if self._resume
                else "record with --resume to go on with it, or choose another"
            )
            raise SessionError(f"{self.path}: exists already; {hint}")
        else:  # session.json comes first, so that a recording killed at once can go on
            self._state(unfinished=[])
        self._make_folders()
        self._begin_table("platform.csv", read.PLATFORM_COLUMNS)

    def _go_on(self):
        """Take over what an earlier recording wrote, without the placement that it did
        not finish.
        """
        mine = json.loads(json.dumps(self.data))
        data = stated.read_json(self.path / "session.json", self.path)
        with naming(self.path / "session.json"):
            known = stated.parse_session(data)
            for key in ("board", "rig"):
                if data[key] != mine[key]:
                    where = _first_difference(data[key], mine[key], key)
                    remedy = "go on with the same rig file, or begin another one"
                    raise ValueError(f"{where}, unlike the rig now: {remedy}")
        self.data = dict(data)
        self.data["placements"] = list(known["placements"])
        self.data["unfinished"] = list(known["unfinished"] or ())
        self._make_folders()
        mend_tables(self.path)
        for placement in self.data["unfinished"]:
            self._mark_dropped(placement)
        self._state(unfinished=[])
        for camera in self.cameras:
            numbers = [0]
            for file in (self.path / "images" / camera).iterdir():
                if file.suffix != ".draft" and file.stem.isdecimal():
                    numbers.append(int(file.stem))
            self.shots[camera] = max(numbers)

    def begin_placement(self, placement):
        """State that a placement is being recorded from now on; one that was broken off is dropped.

        SessionError if it was recorded already.
        """
        for other in self.data["unfinished"]:
            self.drop_placement(other)
        if placement in self.finished or placement < 0:
            raise SessionError(
                f"{self.path}: placement {placement} cannot be begun; recorded: "
                f"{short(self.finished)}"
            )
        self._state(unfinished=[int(placement)])

    def finish_placement(self):
        """State that the placement begun last is complete; from now on it is part of the
        session.
        """
        self._state(placements=sorted([*self.finished, *self.data["unfinished"]]), unfinished=[])

    def drop_placement(self, placement):
        """Take a placement, finished or not, out of the session; its number can be recorded again.

        SessionError if there is no such placement.
        """
        if placement not in {*self.finished, *self.data["unfinished"]}:
            raise SessionError(
                f"{self.path}: no placement {placement} to drop; recorded: {short(self.finished)}"
            )
        self._state(placements=[p for p in self.finished if p != placement], unfinished=[placement])
        self._mark_dropped(placement)
        self._state(unfinished=[])

    def add_platform(self, rows):
        """Append to the log of the platform: host time (s), commanded and measured pitch (rad), NaN
        where unknown.
        """
        cells = []
        for time_s, commanded, measured in rows:
            angles = [cell(math.degrees(angle)) for angle in (commanded, measured)]
            cells.append([cell(time_s), *angles])
        self._append_rows("platform.csv", cells)

    def finish(self):
        """Close the recording: nothing can be half done in it any more."""
        for placement in self.data["unfinished"]:
            self.drop_placement(placement)
        del self.data["unfinished"]
        self._state()
        self.close()

    def __exit__(self, kind, error, trace):
        """A recording ends by :meth:`finish`; after anything else it may go on."""
        self.close()

    def shots_of(self, purpose):
        """Numbers of images of a purpose, a dict by camera."""
        counts = dict.fromkeys(self.cameras, 0)
        if not counts:
            return counts
        for row in read_table(self.path / "images.csv", read.IMAGE_COLUMNS, self.path)[0]:
            if row["camera"] in counts and row["purpose"] == purpose:
                counts[row["camera"]] += 1
        return counts

    def _note_placement(self, placement):
        if placement not in (-1, *self.data["unfinished"]):
            raise SessionError(f"{self.path}: placement {placement} was not begun")

    def _mark_dropped(self, placement):
        self._mark_rows("lrf/index.csv", INDEX_COLUMNS, placement, {"placement": ""})
        self._mark_rows("images.csv", read.IMAGE_COLUMNS, placement, {"purpose": read.DROPPED})

    def _mark_rows(self, name, columns, placement, mark):
        """Write other values into the rows of a placement in a table, if there is one."""
        if not os.path.lexists(self.path / name):
            return
        rows = read_table(self.path / name, columns, self.path)[0]
        for row in rows:
            if row["placement"] == str(placement):
                row.update(mark)
        self._write(name, as_lines([columns, *(row.values() for row in rows)]))


def _first_difference(old, new, where):
    """Which value of session.json differs, as text."""
    if isinstance(old, dict) and isinstance(new, dict):
        key = next(k for k in [*old, *new] if old.get(k, ...) != new.get(k, ...))
        return _first_difference(old.get(key), new.get(key), f"{where}.{key}")
    return f"{where} is {old!r}, not {new!r}"
