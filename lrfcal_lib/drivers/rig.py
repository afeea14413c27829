"""What happens while a rig records, one event after the other."""

import contextlib
import logging
import math
from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import urllib3

from lrfcal_lib.drivers.head import PanTilt
from lrfcal_lib.drivers.lms2xx import LMS2xx
from lrfcal_lib.drivers.lms2xx_scans import Reading
from lrfcal_lib.drivers.port import (
    REAL,
    Closed,
    DeviceError,
    Host,
    LineLost,
    NoReply,
    stopping,
)
from lrfcal_lib.drivers.rig_file import Placement, RigFile, RigFileError
from lrfcal_lib.drivers.video import Camera, Frame
from lrfcal_lib.session.lms2xx_codec import METRES, largest
from lrfcal_lib.session.stated import LrfInfo

LOG = logging.getLogger(__name__)
SCAN_S = 5.0  # wait for one fresh scan: at 9600 Bd one takes 0.9 s, an interlaced one 1.6 s
IMAGE_S = 30.0  # wait for one fresh image, a camera that comes back included
BATCH_S = 0.25  # of a continuous sweep; its scans are handed out this often
GAP_S = 4.0  # without a scan, after which a continuous sweep is given up
CONTROL_S = 10.0  # wait for the answer of a control
OBEYED = 204  # answer of a control; a redirection or a page moved nothing
LONGEST_REASON = 200  # characters of another answer that are told
SAME_STOP = 1e-3  # radians; an image and a scan this near share a stop
# of which can be told whether the view changed, even of a bare wall
FEWEST_SCANS = 8
LEAST_SWEEP = math.radians(10)
STILL = 1.9  # mean ratio of von Neumann; 2 of scans that differ by noise alone
LEAST_SPREAD = 1e-12  # square metres; what is always the same is taken for noise


@dataclass(frozen=True)
class Moved:
    """The head rests at a stop; what is recorded at it is later than its host time."""

    time_s: float
    commanded: float  # pitch, radians
    pitch: float  # as it is, radians
    measured: bool  # the head told it; else it is dead reckoning
    number: int  # of the stop
    of: int  # so many


@dataclass(frozen=True, eq=False)
class Scanned:
    """Readings, each with its pitch."""

    readings: tuple[Reading, ...]
    pitch: np.ndarray  # radians
    share: float  # of the sweep that is done


@dataclass(frozen=True, eq=False)
class Photographed:
    """An image of the board, also one held close, or of a scene."""

    camera: str
    frame: Frame
    pitch: float  # radians


@dataclass(frozen=True)
class Tracked:
    """The pitch over a continuous sweep."""

    commanded: float  # where it ends, radians
    track: tuple  # of host time (s), pitch (radians) and whether it was measured


Event = Moved | Scanned | Photographed | Tracked


class Rig(Closed):
    """The devices of a rig file, all with the same host clock; :meth:`open` opens them.

    A context manager that stops the head and closes them.

    Parameters
    ----------
    stated
        The rig file.
    lrf, head, cameras
        Open devices; the cameras by their names.
    host
        Machine that the drivers run on.

    Attributes
    ----------
    clock : callable
        The date of the host, s.
    """

    def __init__(
        self,
        stated: RigFile,
        lrf: LMS2xx,
        head: PanTilt,
        cameras: dict[str, Camera],
        *,
        host: Host = REAL,
    ):
        self.stated = stated
        self.lrf = lrf
        self.head = head
        self.cameras = cameras
        self.clock = host.time
        self._closing = contextlib.ExitStack()

    @classmethod
    def open(cls, stated: RigFile, *, host: Host = REAL) -> "Rig":
        """Open all devices and set the laser range finder as the rig file asks.

        What is set already is left alone.

        Parameters
        ----------
        stated
            The rig file.
        host
            Machine that the drivers run on.

        Raises
        ------
        DeviceError
            With the device in the message; those opened before are closed again.
        RigFileError
            If a device cannot be what is stated.
        """
        devices = stated.devices
        settings = devices.lrf.model_dump(exclude_none=True, exclude={"interlaced"})
        if devices.lrf.interlaced:  # it chooses its own
            settings.pop("variant", None)
        with contextlib.ExitStack() as stack:

            def opened(name, opener, *args, **options):
                """A device that is closed with the others; errors begin with its name."""
                try:
                    device = opener(*args, **options)
                except DeviceError as error:
                    error.args = (f"{name}: {error}",)
                    raise
                except ValueError as error:
                    raise RigFileError(f"{stated.path}: {name}: {error}") from error
                return stack.enter_context(device)

            rig = cls(
                stated,
                head=opened("head", PanTilt, devices.head.port, devices.head, host=host),
                lrf=opened("lrf", LMS2xx, host=host, **settings),
                cameras={
                    name: opened(f"camera '{name}'", _camera, stated, name)
                    for name in stated.cameras
                },
                host=host,
            )
            rig._closing = stack.pop_all()
        return rig

    def close(self) -> None:
        """Stop the head and close all devices; a second call does nothing."""
        self._closing.close()

    @property
    def lrf_info(self) -> LrfInfo:
        """What is stated of the laser range finder, with the field of view, step, unit and largest
        range that the device has now.
        """
        stated = self.stated.lrf
        configuration = self.lrf.configuration
        view, step = self.lrf.variant
        if self.stated.devices.lrf.interlaced:
            view = 180.0
            step = 0.25
        unit = METRES[configuration.unit]
        return replace(
            stated,
            model=stated.model or self.lrf.type,
            field_of_view=(math.radians(90 - view / 2), math.radians(90 + view / 2)),
            bearing_step=math.radians(step),
            range_resolution=unit,
            max_range=largest(configuration.measuring_mode) * unit,
        )

    # --------------------------------------------------------------------------------------------
    # the board

    def move_board(self, placement: int | str) -> bool:
        """Put the board of an emulated rig at a placement.

        Parameters
        ----------
        placement
            Its number.

        Returns
        -------
        bool
            False where nobody but the user can: a real rig.

        Raises
        ------
        DeviceError
            If the emulated rig does not obey.
        """
        return self._control(f"place/{placement}")

    def hold_close(self, camera: str, view: int) -> bool:
        """Hold the board of an emulated rig close to a camera.

        Parameters
        ----------
        camera
            Its name.
        view
            Number of the view, from 0.

        Returns
        -------
        bool
            As :meth:`move_board`.

        Raises
        ------
        DeviceError
            If the emulated rig does not obey.
        """
        return self._control(f"close/{camera}/{view}")

    def _control(self, command):
        control = self.stated.devices.control
        if control is None:
            return False
        try:
            # what it sends is not read: an answer without end fills no memory
            answer = urllib3.request(
                "POST",
                f"{control}/{command}",
                timeout=CONTROL_S,
                retries=False,
                preload_content=False,
            )
            answer.close()
            if answer.status == OBEYED:
                return True
            wrong = f"it answers {answer.status} {str(answer.reason)[:LONGEST_REASON]!r}"
        except urllib3.exceptions.HTTPError as error:
            wrong = str(error)
        raise DeviceError(
            f"control {control}: {wrong}; is 'python -m lrfcal_lib emulate' still running? "
            "Remove devices.control from the rig file to move a real board by hand"
        )

    # ----------------------------------------------------------------------------------------------
    # recording

    def acquire(self, placement: Placement) -> Generator[Event, None, None]:
        """Record a placement of the plan; its events, as they happen.

        Scans and images of a stop are later than the instant at which the head came to rest there.
        In a continuous sweep every scan has the pitch at the instant of its middle beam,
        interpolated between the head's readings (dead reckoning without them), and is handed out as
        soon as that is known. Whatever happens, also when the generator is closed, the head is
        stopped, and the scans are.

        Parameters
        ----------
        placement
            Of the plan.

        Raises
        ------
        DeviceError
            Also after a sweep with a head that tells nothing if the scans are all alike: it did not
            move.
        """
        stops = placement.pitch.tolist()
        sweep = self._at_stops(stops, placement.image_pitch, placement.descends)
        if self.stated.plan.mode == "continuous":
            sweep = self._continuous(placement)
        scans = []  # of a head that tells nothing
        try:
            if self.stated.devices.lrf.interlaced:  # in a stream, others one by one
                self.lrf.start(interlaced=True)
            for event in sweep:
                if isinstance(event, Scanned) and not self.head.has_feedback:
                    scans += [reading.ranges for reading in event.readings]
                yield event
            if placement.closing:
                # as level as it was in the first half: walls show most
                level = min(stops[: len(stops) // 2 + 1], key=abs)
                yield from self._at_stops([level])
            self.lrf.stop()
            wide = np.ptp(placement.pitch) >= LEAST_SWEEP
            if wide and len(scans) >= FEWEST_SCANS and unchanged(scans):
                head = self.stated.devices.head
                raise NoReply(
                    f"the head did not move: all {len(scans)} scans of the sweep show the same; "
                    "check its power, the wires A and B, "
                    f"address {head.address} and {head.baudrate} Bd at {head.port}"
                )
        except BaseException:
            self.halt()
            raise

    def acquire_close(self, camera: str) -> Photographed:
        """Take one image of the board held close to a camera, the head at pitch 0.

        Parameters
        ----------
        camera
            Its name.

        Raises
        ------
        DeviceError
            As :meth:`acquire`.
        """
        try:
            _, photo = self._at_stops(images=[0.0], cameras=[camera])
        except BaseException:
            self.halt()
            raise
        return photo

    def scan(
        self,
        after: float = -math.inf,
        reconnect_s: float = 10.0,
        errors: type[Exception] | tuple = (LineLost, NoReply),
    ) -> Reading:
        """Ask for one scan; a laser range finder that was lost has one chance to come back.

        Parameters
        ----------
        after
            Date of the host, s, later than which it is.
        reconnect_s
            Seconds that it may take to find it again.
        errors
            After which it is looked for.

        Raises
        ------
        DeviceError
            As :meth:`acquire`.
        """
        try:
            return self.lrf.request(after)
        except errors as error:
            LOG.warning("%s; looking for the laser range finder", error)
            self.lrf.reconnect(reconnect_s)
        return self.lrf.request(after)

    def halt(self) -> None:
        """Stop the head and the scans; what cannot be stopped is logged, with what to do."""
        for name, device in (("head", self.head), ("laser range finder", self.lrf)):
            with stopping(name):
                device.stop()

    def _at_stops(self, scans=(), images=(), descends=False, cameras=None):
        """Scan and take images (of all cameras by default) at pitches, each at rest."""
        alone = [
            image
            for image in images
            if not np.isclose(scans, image, rtol=0, atol=SAME_STOP).any()
        ]
        stops = sorted([*scans, *alone], reverse=descends)
        for number, pitch in enumerate(stops, 1):
            moved = self._move(pitch, number, len(stops))
            yield moved
            if pitch not in alone:
                readings = tuple(self._scans(moved.time_s))
                pitches = np.full(len(readings), moved.pitch)
                yield Scanned(readings, pitches, number / len(stops))
            if np.isclose(images, pitch, rtol=0, atol=SAME_STOP).any():
                for name in cameras or self.cameras:
                    frame = self.cameras[name].newest(after=moved.time_s, timeout=IMAGE_S)
                    yield Photographed(name, frame, moved.pitch)

    def _scans(self, after):
        """Scans of a stream, or one by one, later than an instant."""
        count = self.stated.plan.scans_per_stop
        if self.stated.devices.lrf.interlaced:
            return self.lrf.take(count, after=after, timeout=SCAN_S * count)
        readings = []
        for _ in range(count):
            readings.append(self.scan(after))
            after = readings[-1].time_s
        return readings

    def _move(self, pitch, number=1, of=1):
        reached = self.head.move_to(pitch)
        return Moved(self.clock(), pitch, reached, self.head.has_feedback, number, of)

    def _continuous(self, placement):
        first, last = placement.pitch[[0, -1]].tolist()
        yield from self._at_stops(images=placement.image_pitch, descends=placement.descends)
        yield self._move(first)
        self.lrf.start()
        held = self.lrf.take(1, timeout=SCAN_S)  # readings whose pitch is not known yet
        newest = held[-1].time_s
        self.head.start_sweep(last, self.stated.plan.sweep_speed)
        moving = True
        while moving:
            moving = self.head.moving()
            if not moving:
                self.head.finish_sweep()
            end = self.clock() + BATCH_S
            while self.clock() < end:
                held += self.lrf.take(1, after=newest, timeout=GAP_S)
                newest = held[-1].time_s
            track = self.head.track
            if moving and self.head.has_feedback:
                # what is not measured may change until the next reading
                track = [point for point in track if point[2]]
            if track:
                readings, pitch, held = placed(held, track)
                if readings:
                    share = np.clip((pitch[-1] - first) / (last - first), 0, 1)
                    yield Scanned(readings, pitch, share)
        self.lrf.stop()
        yield Tracked(last, tuple(track))


def placed(
    readings: list[Reading], track: Sequence[tuple[float, float, bool]]
) -> tuple[tuple[Reading, ...], np.ndarray, list[Reading]]:
    """Give scans of a sweep their pitch.

    Parameters
    ----------
    readings
        Of the sweep, in order.
    track
        Host time (s), pitch (rad) and whether it was measured; not empty.

    Returns
    -------
    known : tuple of Reading
        Those within the track, by the instants of their middle beams.
    pitch : ndarray, shape (n,)
        Of each, radians.
    later : list of Reading
        Those after the track.
    """
    times, pitch = np.array([point[:2] for point in track]).T
    middle = np.array([np.mean(reading.beam_times_s[[0, -1]]) for reading in readings])
    begin, end = np.searchsorted(middle, times[[0, -1]], side="right")
    known = np.interp(middle[begin:end], times, pitch)
    return tuple(readings[begin:end]), known, readings[end:]


def unchanged(scans: Iterable[np.ndarray]) -> bool:
    """Whether scans differ by noise alone, as those of a head at rest do.

    By the ratio of von Neumann: squared steps from scan to scan over the squared spread, 2 for
    noise, less where something changes slowly or once. The mean over the beams counts, since beams
    along the tilt axis see the same wall at any pitch: a head that moves is never accused, one that
    does not is believed where much else moves.

    Parameters
    ----------
    scans
        Ranges (B,) each, metres. Beams without a range in one of the scans do not count.

    Returns
    -------
    bool
        False where all lack one.
    """
    ranges = np.array(scans)
    ranges = ranges[:, np.isfinite(ranges).all(axis=0)]
    steps = (np.diff(ranges, axis=0) ** 2).sum(axis=0)
    spread = len(ranges) * ranges.var(axis=0)
    ratio = (steps + 2 * LEAST_SPREAD) / (spread + LEAST_SPREAD)
    return ratio.sum() > STILL * ratio.size


def _camera(stated, name):
    """A camera that gives images of the size stated."""
    info = stated.cameras[name]
    size = (info.width, info.height)
    settings = stated.devices.cameras[name].model_dump(exclude_none=True) | {"size": size}
    camera = Camera(name=name, **settings)
    if camera.size not in (None, size):
        camera.close()
        raise ValueError(
            "it gives {} x {} pixels, rig.cameras.{} states {} x {}: state a size that it can "
            "do".format(*camera.size, name, *size)
        )
    return camera
