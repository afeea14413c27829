"""What happens while a rig records, one event after the other."""

import contextlib
import logging
import math
from dataclasses import dataclass, replace
from functools import partial
from itertools import compress

import numpy as np
import urllib3

from lrfcal_lib.drivers.head import PanTilt
from lrfcal_lib.drivers.lms2xx import LMS2xx
from lrfcal_lib.drivers.port import REAL, Closed, DeviceError, LineLost, NoReply
from lrfcal_lib.drivers.rig_file import RigFileError
from lrfcal_lib.drivers.video import Camera
from lrfcal_lib.session.lms2xx_codec import METRES, MODES, encode_configuration


@dataclass(frozen=True)
class Moved:
    """The head rests at a stop, number so many of so many; what is recorded at it is later than its
    host time.

    Pitch in radians, as commanded and as it is: measured, or dead reckoning where the head does not
    tell it.
    """

    placement: int
    time_s: float
    commanded: float
    pitch: float
    measured: bool
    number: int
    of: int


@dataclass(frozen=True, eq=False)
class Scanned:
    """Readings, each with its pitch in radians; `share` is what is done of a continuous sweep, NaN
    at a stop.
    """

    placement: int
    readings: tuple
    pitch: np.ndarray
    share: float = math.nan


@dataclass(frozen=True, eq=False)
class Photographed:
    """An image of a placement, -1 for the board held close; purpose 'board', 'scene' or
    'intrinsics'.
    """

    placement: int
    camera: str
    frame: object
    pitch: float
    purpose: str


@dataclass(frozen=True)
class Tracked:
    """The pitch over a continuous sweep to a commanded one, a tuple of host time, radians, whether
    it was measured.
    """

    placement: int
    commanded: float
    track: tuple


LOG = logging.getLogger(__name__)
SCAN_S = 5.0  # wait for one fresh scan: at 9600 Bd one takes 0.9 s, an interlaced one 1.6 s
IMAGE_S = 30.0  # wait for one fresh image, a camera that comes back included
BATCH_S = 0.25  # of a continuous sweep; its scans are handed out this often
OBEYED = 204  # answer of a control; a redirection or a page moved nothing
LONGEST_REASON = 200  # characters of another answer that are told
GAP_S = 4.0  # without a scan, after which a continuous sweep is given up
SAME_STOP = 1e-3  # radians; an image and a scan this near share a stop
# of which can be told whether the view changed, even of a bare wall
FEWEST_SCANS = 8
LEAST_SWEEP = math.radians(10)
STILL = 1.9  # mean ratio of von Neumann; 2 of scans that differ by noise alone


class Rig(Closed):
    """The devices of a RigFile, all with the same host clock, s; a context manager that stops the
    head and closes them.

    :meth:`open` opens them.
    """

    def __init__(self, stated, lrf, head, cameras, *, host=REAL):
        self.stated = stated
        self.lrf = lrf
        self.head = head
        self.cameras = cameras
        self.clock = host.time
        self._closing = contextlib.ExitStack()
        self._now = host.now

    @classmethod
    def open(cls, stated, *, host=REAL, camera=None):
        """Open all devices and set the laser range finder as the rig file asks; what is set already
        is left alone.

        The host is the machine that the drivers run on; ``camera(name)`` opens cameras whose images
        come from elsewhere than the source stated. DeviceError, with the device in the message:
        those opened before are closed again.
        """
        devices = stated.devices
        skipped = {"port", "interlaced"}
        if devices.lrf.interlaced:  # it chooses its own
            skipped.add("variant")
        asked = devices.lrf.model_dump(exclude_none=True, exclude=skipped)
        openers = {
            "head": partial(PanTilt, devices.head.port, devices.head, host=host),
            "lrf": partial(LMS2xx, devices.lrf.port, host=host, **asked),
        }
        camera = camera or partial(_camera, stated)
        openers |= {f"camera '{name}'": partial(camera, name) for name in stated.cameras}
        with contextlib.ExitStack() as stack:
            opened = []
            for name, opener in openers.items():
                try:
                    opened.append(opener())
                except DeviceError as error:
                    error.args = (f"{name}: {error}", *error.args[1:])
                    raise
                except ValueError as error:
                    raise RigFileError(f"{stated.path}: {name}: {error}") from error
                stack.callback(opened[-1].close)
            head, lrf, *cameras = opened
            cameras = dict(zip(stated.cameras, cameras, strict=True))
            rig = cls(stated, lrf, head, cameras, host=host)
            rig._closing = stack.pop_all()
        return rig

    def close(self):
        """Stop the head and close all devices; a second call does nothing."""
        self._closing.close()

    @property
    def lrf_info(self):
        """The stated LrfInfo with the field of view, step, unit and largest range that the device
        has now.
        """
        stated = self.stated.lrf
        lrf = self.lrf
        view, step = (180, 0.25) if self.stated.devices.lrf.interlaced else lrf.variant
        unit = METRES[lrf.configuration.unit]
        largest = MODES[lrf.configuration.measuring_mode].largest
        seen = {
            "field_of_view": tuple(np.radians([90 - view / 2, 90 + view / 2]).tolist()),
            "bearing_step": math.radians(step),
            "range_resolution": unit,
            "max_range": largest * unit,
        }
        return replace(stated, model=stated.model or lrf.type, **seen)

    def begin_telegrams(self):
        """Telegrams with which a recording begins: the configuration, which states the measuring
        mode.
        """
        return [encode_configuration(self.lrf.configuration)]

    # --------------------------------------------------------------------------------------------
    # the board

    def move_board(self, placement):
        """Put the board of an emulated rig at a placement; False where nobody but the user can: a
        real rig.
        """
        return self._control(f"place/{placement}")

    def hold_close(self, camera, view):
        """Hold the board of an emulated rig close to a camera; as :meth:`move_board`."""
        return self._control(f"close/{camera}/{view}")

    def _control(self, command):
        if (control := self.stated.devices.control) is None:
            return False
        try:
            # what it sends is not read: an answer without end fills no memory
            answer = urllib3.request(
                "POST", f"{control}/{command}", timeout=10, retries=False, preload_content=False
            )
            answer.close()
        except urllib3.exceptions.HTTPError as error:
            wrong = error
        else:
            if answer.status == OBEYED:
                return True
            wrong = f"it answers {answer.status} {str(answer.reason)[:LONGEST_REASON]!r}"
        raise DeviceError(
            f"control {control}: {wrong}; is 'python -m lrfcal_lib emulate' still running? "
            "Remove devices.control from the rig file to move a real board by hand"
        )

    # ----------------------------------------------------------------------------------------------
    # recording

    def acquire(self, placement):
        """Record a Placement of the plan: a generator of Moved, Scanned, Photographed and Tracked,
        as they happen.

        Scans and images of a stop are later than the instant at which the head came to rest there.
        In a continuous sweep every scan has the pitch at the instant of its middle beam,
        interpolated between the head's readings (dead reckoning without them), and is handed out as
        soon as that is known. Whatever happens, also when the generator is closed, the head is
        stopped, and the scans are. DeviceError, too, after a sweep with a head that tells nothing
        if the scans are all alike: it did not move.
        """
        sweep = self._continuous if self.stated.plan.mode == "continuous" else self._stop_and_go
        seen = []
        try:
            for event in sweep(placement):
                if isinstance(event, Scanned) and not self.head.has_feedback:
                    seen += [one.ranges for one in event.readings]
                yield event
            if (
                len(seen) >= FEWEST_SCANS
                and np.ptp(placement.pitch) >= LEAST_SWEEP
                and unchanged(seen)
            ):
                head = self.stated.devices.head
                raise NoReply(
                    f"the head did not move: all {len(seen)} scans of the sweep show the same; "
                    "check its power, the "
                    f"wires A and B, address {head.address} and {head.baudrate} Bd at {head.port}"
                )
        except BaseException:
            self.halt()
            raise

    def acquire_close(self, camera):
        """Take one image of the board held close to a camera, the head at pitch 0; events as
        :meth:`acquire`.
        """
        try:
            yield from self._photograph([camera], -1, self._move(-1, 0.0, 1, 1), "intrinsics")
        except BaseException:
            self.halt()
            raise

    def halt(self):
        """Stop the head and the scans; what cannot be stopped is logged, with what to do."""
        for name, device in (("head", self.head), ("laser range finder", self.lrf)):
            try:
                device.stop()
            except DeviceError as error:
                LOG.error(
                    "the %s could not be stopped (%s): cut its power if it moves", name, error
                )

    def _stop_and_go(self, placement):
        interlaced = self.stated.devices.lrf.interlaced
        scans = placement.pitch
        images = placement.image_pitch
        alone = [image for image in images if np.abs(scans - image).min() >= SAME_STOP]
        stops = sorted([*scans.tolist(), *alone], reverse=placement.direction < 0)
        if interlaced:
            self.lrf.start(interlaced=True)
        for number, pitch in enumerate(stops, 1):
            moved = self._move(placement.number, pitch, number, len(stops))
            yield moved
            if pitch not in alone:
                readings = self._scans(moved.time_s, interlaced)
                yield Scanned(
                    placement.number, tuple(readings), np.full(len(readings), moved.pitch)
                )
            if any(abs(pitch - image) < SAME_STOP for image in images):
                yield from self._photograph(
                    self.cameras, placement.number, moved, placement.purpose
                )
        self.lrf.stop()

    def _scans(self, after, interlaced):
        """Scans of a stream, or one by one, later than an instant; a line that was lost has one
        chance to come back.
        """
        count = self.stated.plan.scans_per_stop
        if interlaced:
            return self.lrf.take(count, after=after, timeout=SCAN_S * count)
        found = []
        mended = False
        end = self._now() + SCAN_S
        while len(found) < count:
            try:
                reading = self.lrf.request()
            except (LineLost, NoReply) as error:
                if mended:
                    raise
                LOG.warning("%s; looking for the laser range finder", error)
                self.lrf.reconnect()
                mended = True
                continue
            if reading.time_s > after:
                found = [*found, reading]
                after = reading.time_s
                end = self._now() + SCAN_S
            elif self._now() > end:
                raise NoReply(
                    f"the laser range finder gives no scan later than the stop in {SCAN_S:g} s"
                )
        return found

    def _move(self, placement, pitch, number, of):
        reached = self.head.move_to(pitch)
        return Moved(placement, self.clock(), pitch, reached, self.head.has_feedback, number, of)

    def _photograph(self, cameras, placement, moved, purpose):
        for name in cameras:
            frame = self.cameras[name].newest(after=moved.time_s, timeout=IMAGE_S)
            yield Photographed(placement, name, frame, moved.pitch, purpose)

    def _continuous(self, placement):
        first, last = placement.pitch[[0, -1]].tolist()
        images = sorted(placement.image_pitch, reverse=placement.direction < 0)
        for number, pitch in enumerate([*images, first], 1):
            moved = self._move(placement.number, float(pitch), number, len(images) + 1)
            yield moved
            if number <= len(images):
                yield from self._photograph(
                    self.cameras, placement.number, moved, placement.purpose
                )
        self.lrf.start()
        held = self.lrf.take(1, timeout=SCAN_S)
        heard = self._now()
        newest = held[-1].time_s
        self.head.start_sweep(last, self.stated.plan.sweep_speed)
        while self.head.moving():
            fresh = self._since(newest)
            if fresh:
                heard = self._now()
                newest = fresh[-1].time_s
            elif self._now() - heard > GAP_S:
                raise NoReply(
                    f"no scan for {GAP_S:g} s of the sweep: check the line of the laser range "
                    "finder"
                )
            sure = [point for point in self.head.track if point[2] or not self.head.has_feedback]
            # what is not measured may change until the next reading
            known, held = _placed(held + fresh, sure)
            if known:
                share = float(np.clip((known[1][-1] - first) / (last - first), 0, 1))
                yield Scanned(placement.number, *known, share)
        track = self.head.finish_sweep()
        known, _ = _placed(held + self._since(newest), track)
        self.lrf.stop()
        if known:
            yield Scanned(placement.number, *known, 1.0)
        yield Tracked(placement.number, last, tuple(track))

    def _since(self, instant):
        """All scans after an instant that come within the time of a batch."""
        end = self._now() + BATCH_S
        found = []
        with contextlib.suppress(NoReply):
            while self._now() < end:
                found += self.lrf.take(1, after=instant, timeout=BATCH_S)
                instant = found[-1].time_s
        return found


def _placed(readings, track):
    """Scans within a track with their pitch (None without any), and those that are later."""
    if len(track) < 2:
        return None, readings
    times, pitch = np.array([point[:2] for point in track], float).T
    middle = np.array([np.mean(one.beam_times_s[[0, -1]]) for one in readings])
    inside = (middle >= times[0]) & (middle <= times[-1])
    later = list(compress(readings, middle > times[-1]))
    known = tuple(compress(readings, inside)), np.interp(middle[inside], times, pitch)
    return known if inside.any() else None, later


def unchanged(scans):
    """Whether scans differ by noise alone, as those of a head at rest do.

    By the ratio of von Neumann: squared steps from scan to scan over the squared spread, 2 for
    noise, less where something changes slowly or once. The mean over the beams counts, since beams
    along the tilt axis see the same wall at any pitch: a head that moves is never accused, one that
    does not is believed where much else moves. Beams without a range in one of the scans, (B,)
    each, do not count; False where all lack one.
    """
    ranges = np.array(scans)
    ranges = ranges[:, np.isfinite(ranges).all(axis=0)]
    steps = (np.diff(ranges, axis=0) ** 2).sum(axis=0)
    spread = ((ranges - ranges.mean(axis=0)) ** 2).sum(axis=0)
    ratio = np.divide(steps, spread, out=np.full(len(steps), 2.0), where=steps > 0)
    return ratio.size > 0 and bool(ratio.mean() > STILL)


def _camera(stated, name):
    """A camera that gives images of the size stated."""
    asked = stated.devices.cameras[name]
    info = stated.cameras[name]
    size = (info.width, info.height)
    options = asked.model_dump(exclude_none=True, exclude={"source", "size"})
    camera = Camera(asked.source, name=name, size=size, **options)
    if (got := camera.size) not in (None, size):
        camera.close()
        raise ValueError(
            f"it gives {got[0]} x {got[1]} pixels, rig.cameras.{name} states {size[0]} x "
            f"{size[1]}: state a size that it can do"
        )
    return camera
