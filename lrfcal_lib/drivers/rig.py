"""What happens while a rig records, one event after the other."""

from __future__ import annotations

import contextlib
import logging
import math
import time
from dataclasses import dataclass, replace

import numpy as np

from lrfcal_lib.drivers.host import REAL
from lrfcal_lib.drivers.port import DeviceError, LineLost, NoReply, ask
from lrfcal_lib.drivers.rig_file import RigFileError
from lrfcal_lib.session.lms2xx_codec import METRES, encode_configuration, mode_of


@dataclass(frozen=True)
class Moved:
    """The head rests at a stop.

    Attributes
    ----------
    placement : int
    time_s : float
        Host clock; what is recorded at this stop is later.
    commanded, pitch : float
        Radians.
    measured : bool
        False where the head does not tell its pitch: dead reckoning.
    number, of : int
        This stop and how many there are.
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
    """Scans, each with its pitch.

    Attributes
    ----------
    placement : int
    readings : tuple of Reading
    pitch : ndarray, shape (len(readings),)
        Radians.
    share : float
        Of a continuous sweep that is done, 0 to 1; NaN at a stop.
    """

    placement: int
    readings: tuple
    pitch: np.ndarray
    share: float = math.nan


@dataclass(frozen=True, eq=False)
class Photographed:
    """An image.

    Attributes
    ----------
    placement : int
        -1 for the board held close.
    camera : str
    frame : Frame
    pitch : float
        Radians.
    purpose : {'board', 'scene', 'intrinsics'}
    """

    placement: int
    camera: str
    frame: object
    pitch: float
    purpose: str


@dataclass(frozen=True)
class Tracked:
    """The pitch over a continuous sweep.

    Attributes
    ----------
    placement : int
    commanded : float
        Where the sweep was sent, radians.
    track : tuple of (float, float, bool)
        Host time, pitch in radians, measured.
    """

    placement: int
    commanded: float
    track: tuple


LOG = logging.getLogger(__name__)
SCAN_S = 5.0  # wait for one fresh scan: at 9600 Bd one takes 0.9 s, an interlaced one 1.6 s
IMAGE_S = 30.0  # wait for one fresh image, a camera that comes back included
BATCH_S = 0.25  # of a continuous sweep; its scans are handed out this often
GAP_S = 4.0  # without a scan, after which a continuous sweep is given up
SAME_STOP = 1e-3  # radians; an image and a scan this near share a stop
FEWEST_SCANS, LEAST_SWEEP = 8, math.radians(10)  # of which can be told whether the view changed, even of a bare wall
STILL = 1.9  # mean ratio of von Neumann; 2 of scans that differ by noise alone


def host_clock():
    """A clock, time.time() at first, that nobody sets while it runs: a step would tear scans and pitch apart."""
    zero = time.time() - time.monotonic()
    return lambda: zero + time.monotonic()


class Rig:
    """The devices of a rig file; a context manager that stops the head and closes all of them.

    Parameters
    ----------
    stated : RigFile
    lrf : LMS2xx
    head : PanTilt
    cameras : dict of str to Camera
    clock : callable
        Host clock, s, of all of them.
    host : Host
        Machine that the drivers run on.
    """

    def __init__(self, stated, lrf, head, cameras=None, *, clock=time.time, host=REAL):
        self.stated, self.lrf, self.head, self.cameras, self.clock = stated, lrf, head, cameras or {}, clock
        self._closing, self._now = contextlib.ExitStack(), host.now

    @classmethod
    def open(cls, stated, *, log=LOG, clock=None, host=REAL, camera=None):
        """Open all devices and set the laser range finder as the rig file asks; what is set already is left alone.

        Parameters
        ----------
        stated : RigFile
        log : logging.Logger
        clock : callable, optional
            :func:`host_clock` by default.
        host : Host
            Machine that the drivers run on; tests have a VirtualHost.
        camera : callable, optional
            Opens a camera by its name, for images that come from elsewhere than the source stated.

        Returns
        -------
        Rig

        Raises
        ------
        DeviceError
            With the device in the message; those opened before are closed again.
        """
        clock = clock or host_clock()
        with contextlib.ExitStack() as stack:
            options = {"log": log, "clock": clock}
            head = stack.enter_context(_named("head", _open_head, stated, host=host, **options))
            lrf = stack.enter_context(_named("lrf", _open_lrf, stated, host=host, **options))
            cameras, opener = {}, _open_camera if camera is None else lambda _, name, **options: camera(name)
            for name in stated.cameras:
                cameras[name] = _named(f"camera '{name}'", opener, stated, name, **options)
                stack.callback(cameras[name].close)
            rig = cls(stated, lrf, head, cameras, clock=clock, host=host)
            rig._closing = stack.pop_all()
        return rig

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.close()

    def close(self):
        """Stop the head and close all devices; a second call does nothing."""
        self._closing.close()

    @property
    def lrf_info(self):
        """The stated LrfInfo with the field of view, step, unit and largest range that the device has now."""
        view, step = (180, 0.25) if self.stated.lrf_device.get("interlaced") else self.lrf.variant
        unit = METRES[self.lrf.configuration.unit]
        longest = mode_of(self.lrf.configuration.measuring_mode).largest * unit
        ends = tuple(math.radians(90 + side * view / 2) for side in (-1, 1))
        model = self.stated.lrf.model or self.lrf.type
        found = {"field_of_view": ends, "bearing_step": math.radians(step), "range_resolution": unit, "model": model,
                 "max_range": longest}  # fmt: skip
        return replace(self.stated.lrf, **found)

    def begin_telegrams(self):
        """Telegrams with which a recording begins: the configuration, which states the measuring mode."""
        return [encode_configuration(self.lrf.configuration)]

    # -------------------------------------------------------------------------------------------- the board

    def move_board(self, placement):
        """Put the board of an emulated rig at a placement.

        Returns
        -------
        bool
            False where nobody but the user can: a real rig.
        """
        return self._control("place", placement)

    def hold_close(self, camera, view):
        """Hold the board of an emulated rig close to a camera; as :meth:`move_board`."""
        return self._control("close", camera, view)

    def _control(self, command, *arguments):
        if self.stated.control is None:
            return False
        try:
            ask(self.stated.control, {"command": command, "arguments": list(arguments)})
        except (OSError, ValueError) as error:
            raise DeviceError(
                f"control socket {self.stated.control}: {error}; is 'python -m lrfcal_lib emulate' still running? "
                "Remove devices.control from the rig file to move a real board by hand"
            ) from error
        return True

    # ---------------------------------------------------------------------------------------------- recording

    def acquire(self, placement):
        """Record one placement: a generator of events, in the order in which things happen.

        Parameters
        ----------
        placement : Placement
            Of the plan, which also says how (stop-and-go or continuous).

        Yields
        ------
        Moved, Scanned, Photographed or Tracked
            Scans and images of a stop are later than the instant at which the head came to rest there. In a
            continuous sweep every scan has the pitch at the instant of its middle beam, interpolated between the
            head's readings (dead reckoning without them), and is handed out as soon as that is known.

        Raises
        ------
        DeviceError
            Whatever happens, also when the generator is closed: the head is stopped, and the scans are. After a sweep
            with a head that tells nothing, if the scans are all alike: it did not move.
        """
        sweep, seen = self._continuous if self.stated.plan.mode == "continuous" else self._stop_and_go, []
        try:
            for event in sweep(placement):
                if isinstance(event, Scanned) and not self.head.has_feedback:
                    seen += [one.ranges for one in event.readings]
                yield event
            if len(seen) >= FEWEST_SCANS and np.ptp(placement.pitch) >= LEAST_SWEEP and unchanged(seen):
                head = self.stated.head_settings
                raise NoReply(
                    f"the head did not move: all {len(seen)} scans of the sweep show the same; check its power, the "
                    f"wires A and B, address {head.address} and {head.baudrate} Bd at {self.stated.head_device}"
                )
        except BaseException:
            self.halt()
            raise

    def acquire_close(self, camera):
        """Take one image of the board held close to a camera, the head at pitch 0; events as :meth:`acquire`."""
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
                LOG.error("the %s could not be stopped (%s): cut its power if it moves", name, error)

    def _stop_and_go(self, placement):
        stops, interlaced = _stops(placement), bool(self.stated.lrf_device.get("interlaced"))
        if interlaced:
            self.lrf.start(interlaced=True)
        for number, (pitch, scan, photo) in enumerate(stops, 1):
            moved = self._move(placement.number, pitch, number, len(stops))
            yield moved
            if scan:
                readings = self._take(moved.time_s) if interlaced else self._request(moved.time_s)
                _later(readings[0].time_s, moved, "scan")
                yield Scanned(placement.number, tuple(readings), np.full(len(readings), moved.pitch))
            if photo:
                yield from self._photograph(self.cameras, placement.number, moved, placement.purpose)
        self.lrf.stop()

    def _take(self, after):
        """Scans of a stream, all later than an instant."""
        count = self.stated.plan.scans_per_stop
        return self.lrf.take(count, after=after, timeout=SCAN_S * count)

    def _request(self, after):
        """Scans one by one, all later than an instant; a line that was lost is given one chance to come back."""
        found, mended, end = [], False, self._now() + SCAN_S
        while len(found) < self.stated.plan.scans_per_stop:
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
                found, after, end = [*found, reading], reading.time_s, self._now() + SCAN_S
            elif self._now() > end:
                raise NoReply(f"the laser range finder gives no scan later than the stop in {SCAN_S:g} s")
        return found

    def _move(self, placement, pitch, number, of):
        reached = self.head.move_to(pitch)
        return Moved(placement, self.clock(), pitch, reached, self.head.has_feedback, number, of)

    def _photograph(self, cameras, placement, moved, purpose):
        for name in cameras:
            frame = self.cameras[name].newest(after=moved.time_s, timeout=IMAGE_S)
            _later(frame.time_s, moved, f"image of camera '{name}'")
            yield Photographed(placement, name, frame, moved.pitch, purpose)

    def _continuous(self, placement):
        first, last = placement.pitch[[0, -1]]
        images = sorted(placement.image_pitch, reverse=placement.direction < 0)
        for number, pitch in enumerate([*images, first], 1):
            moved = self._move(placement.number, float(pitch), number, len(images) + 1)
            yield moved
            if number <= len(images):
                yield from self._photograph(self.cameras, placement.number, moved, placement.purpose)
        self.lrf.start()
        held = [self.lrf.newest(timeout=SCAN_S)]
        heard, newest = self._now(), held[-1].time_s
        self.head.start_sweep(float(last), self.stated.plan.sweep_speed)
        while self.head.moving():
            fresh = self._since(newest)
            if fresh:
                heard, newest = self._now(), fresh[-1].time_s
            elif self._now() - heard > GAP_S:
                raise NoReply(f"no scan for {GAP_S:g} s of the sweep: check the line of the laser range finder")
            known, held = self._placed(held + fresh, self._usable(self.head.track))
            if known:
                yield Scanned(placement.number, *known, _share(known[1][-1], first, last))
        track = self.head.finish_sweep()
        known, _ = self._placed(held + self._since(newest), track)
        self.lrf.stop()
        if known:
            yield Scanned(placement.number, *known, 1.0)
        yield Tracked(placement.number, float(last), tuple(track))

    def _since(self, instant):
        """All scans after an instant that come within the time of a batch."""
        end, found = self._now() + BATCH_S, []
        with contextlib.suppress(NoReply):
            while self._now() < end:
                found += self.lrf.take(1, after=instant, timeout=BATCH_S)
                instant = found[-1].time_s
        return found

    def _usable(self, track):
        """What of a growing track will not change any more."""
        return [point for point in track if point[2]] if self.head.has_feedback else track

    @staticmethod
    def _placed(readings, track):
        """Scans within a track with their pitch (None without any), and those that are later."""
        if len(track) < 2:
            return None, readings
        times, pitch = np.array([point[:2] for point in track], float).T
        instants = np.array([np.mean(one.beam_times_s[[0, -1]]) for one in readings])
        inside = [i for i, t in enumerate(instants) if times[0] <= t <= times[-1]]
        later = [one for one, t in zip(readings, instants, strict=True) if t > times[-1]]
        if not inside:
            return None, later
        return (tuple(readings[i] for i in inside), np.interp(instants[inside], times, pitch)), later


def unchanged(scans):
    """Whether scans differ by noise alone, as those of a head at rest do.

    Parameters
    ----------
    scans : sequence of array_like, shape (B,)
        Ranges in the order in which they were taken, metres; beams without a range in one of them do not count.

    Returns
    -------
    bool
        By the ratio of von Neumann: squared steps from scan to scan over the squared spread, 2 for noise, less where
        something changes slowly or once. The mean over the beams counts, since beams along the tilt axis see the same
        wall at any pitch: a head that moves is never accused, one that does not is believed where much else moves.
        False where no beam has a range in all scans.
    """
    ranges = np.array(scans)
    ranges = ranges[:, np.isfinite(ranges).all(axis=0)]
    steps, spread = (np.diff(ranges, axis=0) ** 2).sum(axis=0), ((ranges - ranges.mean(axis=0)) ** 2).sum(axis=0)
    ratio = np.divide(steps, spread, out=np.full(len(steps), 2.0), where=steps > 0)
    return ratio.size > 0 and bool(ratio.mean() > STILL)


def _stops(placement):
    """Stops of a sweep in the order of motion: pitch, whether scans are taken there, whether images."""
    scans, images = list(placement.pitch), list(placement.image_pitch)
    stops = [[p, True, any(abs(p - i) < SAME_STOP for i in images)] for p in scans]
    stops += [[i, False, True] for i in images if all(abs(p - i) >= SAME_STOP for p in scans)]
    return sorted(([float(p), *what] for p, *what in stops), reverse=placement.direction < 0)


def _later(instant, moved, what):
    """Refuse what was recorded while the head still moved, whatever a driver says."""
    if instant <= moved.time_s:
        raise DeviceError(f"the {what} is {moved.time_s - instant:.3f} s older than the stop it belongs to")


def _share(pitch, first, last):
    return float(np.clip((pitch - first) / (last - first), 0, 1))


def _named(device, opener, *arguments, **options):
    """Open a device; its name stands before the message of whatever goes wrong."""
    try:
        return opener(*arguments, **options)
    except DeviceError as error:
        error.args = (f"{device}: {error}", *error.args[1:])
        raise
    except ValueError as error:
        raise RigFileError(f"{arguments[0].path}: {device}: {error}") from error


def _open_head(stated, **options):
    from lrfcal_lib.drivers.head import PanTilt

    return PanTilt.open(stated.head_device, stated.head_settings, **options)


def _open_lrf(stated, **given):
    from lrfcal_lib.drivers.lms2xx import CONFIGURED, LMS2xx

    asked = stated.lrf_device
    options = {key: asked[key] for key in ("baudrate", "address", *CONFIGURED) if key in asked}
    if "password" in asked:
        options["password"] = asked["password"].encode()
    lrf = LMS2xx(asked["port"], **options, **given)
    try:
        if asked.get("variant") and not asked.get("interlaced"):  # such a stream chooses its own
            lrf.set_variant(*asked["variant"])
    except BaseException:
        lrf.close()
        raise
    return lrf


def _open_camera(stated, name, **given):
    from lrfcal_lib.drivers.video import Camera

    asked, info = stated.camera_devices[name], stated.cameras[name]
    options = {key: asked[key] for key in ("exposure", "fps", "silence_s") if key in asked}
    size = (info.width, info.height)
    camera = Camera.open(asked["source"], name=name, size=size, **options, **given)
    got = camera.settings["size"]["got"]
    if got is not None and tuple(got) != (info.width, info.height):
        camera.close()
        raise ValueError(
            f"it gives {got[0]} x {got[1]} pixels, rig.cameras.{name} states {info.width} x {info.height}: "
            "state a size that it can do"
        )
    return camera
