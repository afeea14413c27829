"""Write a session so that a crash loses at most what was being written, placement by placement."""

import contextlib
import errno
import json
import math
import os
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.model.board import Board
from lrfcal_lib.session import files, read, stated
from lrfcal_lib.session.files import SessionError, naming, short
from lrfcal_lib.session.images import JPEG, check_image_size
from lrfcal_lib.session.lock import LOCK, alone
from lrfcal_lib.session.scans import check_scans, parts_of, read_npz
from lrfcal_lib.session.stated import CameraInfo, LrfInfo
from lrfcal_lib.session.telegrams import INDEX_COLUMNS

ABOUT = {"name": "", "licence": "", "source": "", "simulated": False}
RECORDINGS = "LRFCAL_RECORDINGS"  # environment variable: where new recordings go


def new_session_path() -> Path:
    """Where a recording goes whose place nobody names: by date in ``~/lrfcal_sessions``."""
    folder = os.environ.get(RECORDINGS) or Path.home() / "lrfcal_sessions"
    return Path(folder, time.strftime("%Y-%m-%d_%H%M%S")).absolute()


class SessionWriter(contextlib.AbstractContextManager):
    """Write a session so that a crash loses at most what was being written.

    Every sweep and every image is on the disk (fsync) before the table that names it is; at the
    end, or by ``finish(path)`` after an interruption, sweeps become the one scans.npz. A session
    holds scan lines (:meth:`add_sweep`) or the telegrams of a device (:meth:`add_telegrams`), never
    both.

    Parameters
    ----------
    path
        Must not exist or be an empty folder.
    board, lrf, cameras, T_head_lrf, platform_sigma, continuous, reference
        See :class:`lrfcal_lib.session.read.Session`.
    **about
        What else a Session says: name (by default that of its folder), licence, source, simulated.

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
        path: str | os.PathLike,
        board: Board,
        lrf: LrfInfo,
        cameras: Iterable[CameraInfo] = (),
        T_head_lrf: RigidTransform | None = None,
        *,
        platform_sigma: tuple[float, float] | None = None,
        continuous: bool = False,
        reference: dict | None = None,
        **about,
    ):
        self.path = Path(path)
        self.cameras = {camera.name: camera for camera in cameras}
        self.bearings: np.ndarray | None = None  # of the sweeps so far
        self.parts = 0  # files of sweeps so far
        if not about.keys() <= ABOUT.keys():
            raise TypeError(f"a session has {short(ABOUT)}, got {short(about)}")
        data = {
            "schema": stated.SCHEMA,
            **ABOUT,
            "name": self.path.resolve().name,
            **about,
            "board": stated.board_to_json(board),
            "rig": stated.rig_to_json(
                lrf, T_head_lrf, self.cameras, platform_sigma, continuous
            ),
            "placements": [],
            "reference": reference or {},  # last: it may be long
        }
        with naming(self.path):
            self.data = stated.plain(data)
            stated.parse_session(self.data)
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except FileExistsError:
            self._refuse()
        with contextlib.ExitStack() as stack:
            stack.enter_context(alone(self.path))
            self._create()
            self._make_folders()
            self._held = stack.pop_all()

    def _refuse(self, remedy="choose another name or remove it first"):
        raise SessionError(f"{self.path}: exists already; {remedy}")

    def _create(self, *remedy, **first):
        """Write session.json, with what it says at first, into a folder that holds nothing yet."""
        if set(os.listdir(self.path)) - {"session.json.draft", LOCK}:
            self._refuse(*remedy)
        self._state(**first)

    def _make_folders(self):
        for name in ("lrf", *(f"images/{camera}" for camera in self.cameras)):
            files.checked(self.path / name, self.path, make=True)
        if self.cameras:
            self._begin_table("images.csv", read.IMAGE_COLUMNS)

    def __exit__(self, kind, error, trace):
        with contextlib.closing(self):
            if kind is None:
                complete(self.path)

    def close(self):
        """Write nothing any more: others may."""
        self._held.close()

    def _state(self, **changes):
        """Change session.json; where that cannot be written, nothing is changed."""
        data = self.data | changes
        write_file(self.path, "session.json", (json.dumps(data, indent=1) + "\n").encode())
        self.data = data

    def _begin_table(self, name, columns):
        if not os.path.lexists(self.path / name):
            write_file(self.path, name, as_lines([columns]))

    def _append_rows(self, name, rows):
        append_file(self.path, name, as_lines(rows))

    def _note_placement(self, placement):
        if placement >= 0 and placement not in self.data["placements"]:
            self._state(placements=sorted([*self.data["placements"], int(placement)]))

    def add_sweep(
        self,
        placement: int,
        ranges: ArrayLike,
        bearings: ArrayLike,
        pitch: ArrayLike,
        time_s: ArrayLike = math.nan,
        intensities: ArrayLike | None = None,
    ) -> None:
        """Append the scan lines of a placement.

        Parameters
        ----------
        placement
        ranges
            Metres, NaN where nothing came back, shape (L, B).
        bearings
            Radians, ascending, shape (B,); the same in all sweeps of a session.
        pitch
            Radians, shape (L,).
        time_s
            Seconds, shape (L,).
        intensities
            Shape (L, B).

        Raises
        ------
        SessionError
            For wrong shapes or units, or other bearings than before.
        """
        telegrams = self.path / "lrf/telegrams.bin"
        if telegrams.exists():
            raise SessionError(
                f"{telegrams}: the session records telegrams: add_telegrams, or begin "
                "another one"
            )
        ranges = np.array(ranges, float, ndmin=2)
        if np.ndim(time_s) == 0:
            time_s = np.full(len(ranges), time_s)
        recorded = {
            "ranges": ranges,
            "bearings": bearings,
            "pitch": pitch,
            "time_s": time_s,
            "placement": np.full(len(ranges), placement),
            "intensities": intensities,
        }
        with naming(f"{self.path}: placement {placement}"):
            scans = check_scans(recorded)
            bearings = scans["bearings"]
            if self.bearings is not None and not np.array_equal(self.bearings, bearings):
                raise ValueError(
                    "the bearings differ from those of the sweeps before: one grid a session"
                )
        self.bearings = bearings
        self.parts += 1
        write_file(self.path, f"lrf/part_{self.parts:06d}.npz", scans)
        self._note_placement(placement)

    def add_telegrams(
        self,
        placement: int,
        telegrams: Sequence[bytes],
        pitch: ArrayLike = math.nan,
        time_s: ArrayLike = math.nan,
    ) -> None:
        """Append telegrams as the device sent them.

        Parameters
        ----------
        placement
            -1 for none: replies that are no scans, scans between the sweeps.
        telegrams
            Whole telegrams in the order they came, also damaged ones.
        pitch, time_s
            Radians and seconds; of all, or of each, shape (len(telegrams),).

        Raises
        ------
        SessionError
            For other numbers of pitches or times, pitches that are no radians, something that is no
            bytes, or a session that has scan lines already.
        """
        with naming(f"{self.path}: placement {placement}"):
            lengths = list(map(len, telegrams))
            pitch = np.full(len(telegrams), pitch, float)
            time_s = np.full(len(telegrams), time_s, float)
            if placement >= 0 and not np.all(np.abs(pitch) <= np.pi + 1e-6):
                raise ValueError(
                    f"a pitch is {np.abs(pitch).max():g}: finite radians, -pi to pi, are needed"
                )
            if self.parts:
                raise ValueError(
                    "the session has scan lines: add_sweep, or begin another one"
                )
        self._begin_table("lrf/index.csv", INDEX_COLUMNS)
        self._note_placement(placement)
        offset = append_file(self.path, "lrf/telegrams.bin", b"".join(telegrams))
        offsets = offset + np.cumsum(lengths) - lengths
        numbers = [number_cell(placement)] * len(telegrams)
        rows = zip(time_s, offsets, lengths, numbers, np.degrees(pitch), strict=True)
        self._append_rows("lrf/index.csv", rows)

    def add_image(
        self,
        camera: str,
        image: str | os.PathLike | bytes | np.ndarray,
        placement: int = -1,
        *,
        pitch: float = math.nan,
        time_s: float = math.nan,
        purpose: str = "board",
    ) -> str:
        """Append an image.

        Parameters
        ----------
        camera
        image
            A PNG or JPEG file or its bytes, kept as they are, or blue-green-red pixels (h, w, 3).
        placement
            -1 for none.
        pitch
            Of the platform, radians.
        time_s
            Seconds.
        purpose
            'board', 'intrinsics' or 'scene'.

        Returns
        -------
        str
            Its file in the session's folder.

        Raises
        ------
        SessionError
            For an unknown camera or purpose, or an image of another size than the camera's.
        """
        with naming(self.path):
            read.known(camera, self.cameras, "camera")
            read.known(purpose, read.PURPOSES, "purpose")
        what = f"camera '{camera}'"
        if isinstance(image, np.ndarray):
            image = bytes(cv2.imencode(".png", image)[1])
        if not isinstance(image, bytes):
            what = str(image)
            image = files.read_bytes(image)
        check_image_size(what, image, self.cameras[camera])
        names = [file.stem for file in (self.path / "images" / camera).iterdir()]
        number = 1 + max(map(int, filter(str.isdecimal, names)), default=0)
        kind = "jpg" if image.startswith(JPEG) else "png"
        name = f"images/{camera}/{number:04d}.{kind}"
        write_file(self.path, name, image)
        self._note_placement(placement)
        row = (
            time_s,
            camera,
            name,
            number_cell(placement),
            math.degrees(pitch),
            purpose,
        )
        self._append_rows("images.csv", [row])
        return name


def finish(path: str | os.PathLike) -> None:
    """Complete a session whose recording was interrupted.

    One scans.npz out of its sweeps, whole rows in its tables.

    Parameters
    ----------
    path

    Raises
    ------
    SessionError
        If there is no sweep, or one of them is damaged, or somebody records this session.
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
    if os.path.lexists(path / "lrf/telegrams.bin"):
        return
    parts = parts_of(path)
    if not parts:
        raise SessionError(
            f"{path}: no sweep to finish in lrf/; nothing was recorded, or it is finished already"
        )
    sweeps = [read_npz(part, path) for part in parts]
    scans = {
        key: np.concatenate([sweep[key] for sweep in sweeps])
        for key in sweeps[0]
        if all(key in sweep for sweep in sweeps)
    }
    scans["bearings"] = sweeps[0]["bearings"]
    write_file(path, "lrf/scans.npz", scans)
    for part in parts:
        part.unlink()


def mend_tables(path):
    """Remove rows that a crash cut off at the end of a session's tables."""
    for name in ("images.csv", "lrf/index.csv", "platform.csv"):
        table = path / name
        if not os.path.lexists(table):
            continue
        data = files.read_bytes(table, path)
        if not data.endswith(b"\n"):
            write_file(path, name, data.rpartition(b"\n")[0] + b"\n")


def as_lines(rows):
    """Bytes of the rows of a table."""
    return "".join(",".join(map(cell, row)) + "\n" for row in rows).encode()


def cell(value):
    """A text or a number as it stands in a table, empty for NaN."""
    if not isinstance(value, float):
        return str(value)
    return "" if math.isnan(value) else repr(round(float(value), 9))


def number_cell(placement):
    """The number of a placement as it stands in a table, empty for none."""
    return "" if placement < 0 else str(placement)


def write_file(folder: Path, name: str, content: bytes | dict) -> None:
    """Write a file of a session under another name, fsync, rename: it is whole or not there.

    Parameters
    ----------
    folder
        Of the session.
    name
        Of the file in it.
    content
        Bytes, or arrays by name.
    """
    file = folder / name
    files.checked(file.parent, folder)
    draft = file.with_name(file.name + ".draft")
    draft.unlink(missing_ok=True)
    with files.opened(draft, folder, os.O_WRONLY | os.O_CREAT | os.O_EXCL) as stream:
        if isinstance(content, dict):
            np.savez_compressed(stream, **content)
        else:
            stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())
    draft.replace(file)
    handle = os.open(file.parent, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextlib.contextmanager
def whole(path: str | os.PathLike) -> Iterator[Path]:
    """Let a file that is no session's be written whole, or not at all.

    Parameters
    ----------
    path
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


def not_written(error: OSError) -> str:
    """Why an OSError kept something from being written, and what to do; half a sentence."""
    full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    remedy = "free some space" if full else "check the disk and its permissions"
    return f"cannot be written ({error.strerror or error}): {remedy}"


def append_file(folder, name, content):
    """Append to a file of a session, which is on the disk afterwards; where the new part begins. On
    a full disk all or nothing.
    """
    left = memoryview(content)
    flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT
    with files.opened(folder / name, folder, flags) as stream:
        handle = stream.fileno()
        begin = os.fstat(handle).st_size
        try:
            while left:
                left = left[os.write(handle, left) :]
            os.fsync(handle)
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(handle, begin)  # half a row would spoil the next one
            raise
    return begin
