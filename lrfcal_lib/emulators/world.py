"""The one simulated world that all emulated devices look at, and its cameras as MJPEG over HTTP.

No image shows a head that moves: while it does none is sent, and one that was begun before a move
is not sent after it.
"""

import contextlib
import itertools
import secrets
import threading
import time
from collections.abc import Sequence
from functools import lru_cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np

from lrfcal_lib.drivers.port import REAL, Closed, Host
from lrfcal_lib.emulators.head import Head
from lrfcal_lib.session.files import short
from lrfcal_lib.session.images import encode_jpeg
from lrfcal_lib.simulate import beam as lrf
from lrfcal_lib.simulate.record import close_views, world_of
from lrfcal_lib.simulate.rig import Placement, Setup, placements_of

STILL = 1e-7  # radians within which a scan at rest is cast once
LOOK_S = 0.05
QUALITY = 97  # of JPEG
FPS = 8.0  # most images a second of a camera
SERVE_S = 0.2  # between looks whether the server is to end


class EmulatedWorld:
    """The world of a simulated setup at the present; the source of scans of :class:`EmulatedLms`.

    Parameters
    ----------
    setup
        What to emulate.
    host
        Whose time the world lives in.
    placements
        Where the board can be put; by default those of the setup.

    Attributes
    ----------
    places : dict of str to Placement
        Where the board can be: place/none, place/NUMBER of a placement, and close/CAMERA/VIEW,
        held close to a camera, in one of the views for its intrinsics.
    current : World
        As it is now, without the board at first.
    """

    def __init__(
        self,
        setup: Setup,
        host: Host = REAL,
        placements: Sequence[Placement] | None = None,
    ):
        self.setup = setup
        self.host = host
        self.head = Head(setup.rig.platform)
        self.placements = placements or placements_of(setup)
        self._rng = np.random.default_rng([0, 3])
        # what was looked at last, and what was seen without noise
        self._seen: dict = {}
        self.places = {"place/none": Placement(0)}
        for placement in self.placements:
            self.places[f"place/{placement.number}"] = placement
        for number, camera in enumerate(setup.rig.cameras):
            for view, close in enumerate(close_views(setup, number)):
                self.places[f"close/{camera.name}/{view}"] = close
        self.put("place/none")

    def put(self, place: str) -> None:
        """Put the board at one of the places.

        Parameters
        ----------
        place
            Its name.

        Raises
        ------
        ValueError
            For a place that there is not.
        """
        if place not in self.places:
            raise ValueError(f"no {place}; there are {short(self.places)}")
        self.current = world_of(self.setup, self.places[place])

    def scan(
        self, turn: int, quarters: np.ndarray, times: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Readings of a scan.

        Parameters
        ----------
        turn
            Of the mirror, the scan's first.
        quarters
            Bearings (B,), quarters of a degree.
        times
            Instants (B,) of the beams, seconds of the devices.

        Returns
        -------
        ranges : ndarray, shape (B,)
            Metres.
        reasons : ndarray, shape (B,)
            Index into `REASONS`, 0 for a range.
        """
        world = self.current
        rig = self.setup.rig
        pitch = self.head.pitch(times)
        # a head at rest sees the same again and again
        key = world, quarters.tobytes(), np.rint(pitch / STILL).tobytes()
        if key not in self._seen:
            bearings = np.radians(quarters / 4)
            ideal = lrf.ideal_readings(rig.beam, world, bearings, pitch, rig.T_head_lrf)
            self._seen = {key: ideal}
        return lrf.measured(rig.beam, self._seen[key], self._rng)


class CameraServer(Closed, ThreadingHTTPServer):
    """The cameras of a world, and who puts its board elsewhere, over HTTP.

    `url` has ``NAME.mjpg`` of all `cameras`; `control` obeys POST of any place of the world. A web
    page cannot know the token in that address.

    Parameters
    ----------
    world
        That the cameras show.
    rest_s
        Seconds that the head must rest before an image is drawn. Nobody tells a camera whether its
        image is wanted; most stops of a sweep need none and are shorter.
    """

    def __init__(self, world: EmulatedWorld, *, rest_s: float = 0.5):
        super().__init__(("127.0.0.1", 0), _Handler)
        self.world = world
        self.rest_s = rest_s
        self.quit = threading.Event()
        self.cameras = {camera.name: camera for camera in world.setup.rig.cameras}
        self._draw = lru_cache(len(self.cameras))(self._drawn)
        self._count = itertools.count()
        self._lock = threading.Lock()
        self.host = f"127.0.0.1:{self.server_port}"
        self.url = f"http://{self.host}"
        self.token = secrets.token_urlsafe()
        self.control = f"{self.url}/{self.token}"
        thread = threading.Thread(target=self.serve_forever, args=(SERVE_S,), daemon=True)
        thread.start()

    def close(self) -> None:
        """End the server, and wait for the end of a drawing."""
        self.quit.set()
        self.shutdown()
        self.server_close()
        with self._lock:
            pass

    def image(self, name: str, timeout: float = 1.0) -> bytes | None:
        """The image of the rig as it stands now.

        Parameters
        ----------
        name
            Of the camera.
        timeout
            Seconds to wait for a head that rests long enough to draw it.

        Returns
        -------
        bytes or None
            A JPEG file; None where the head does not rest.
        """
        end = time.monotonic() + timeout
        while not self.quit.is_set() and time.monotonic() < end:
            with self._lock:
                shown = self._shown()
                if shown is not None:
                    data = self._draw(name, *shown)
                    if self._shown() == shown:
                        return data
            self.quit.wait(LOOK_S)
        return None

    def _shown(self):
        """The world that cameras see now, and the pitch; None while the head hardly rests."""
        head = self.world.head
        now = self.world.host.now()
        if self.quit.is_set() or not head.settled(now, self.rest_s):
            return None
        return self.world.current, round(head.pitch(now), 7)

    def _drawn(self, name, scene, pitch):
        """JPEG of what a camera sees."""
        camera = self.cameras[name]
        rng = np.random.default_rng([0, next(self._count)])
        pose = self.world.setup.rig.camera_pose(camera, pitch)
        return encode_jpeg(camera.render(scene, pose, rng), QUALITY)


class _Handler(BaseHTTPRequestHandler):
    """Sends the images of a camera as a stream, or moves the board; see :mod:`http.server`."""

    def parse_request(self):
        """Refuse what was sent to another name, as by a web page whose name leads here."""
        parsed = super().parse_request()
        if parsed and self.headers["Host"] != self.server.host:
            self.send_error(403, f"this is {self.server.url} only")
            return False
        return parsed

    def do_GET(self):
        """Send the images of a camera."""
        server = self.server
        name = self.path.strip("/").removesuffix(".mjpg")
        if name not in server.cameras:
            known = short(f"{camera}.mjpg" for camera in server.cameras)
            self.send_error(404, f"there are {known}")
            return
        with contextlib.suppress(ConnectionError, TimeoutError):
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
            self.send_header("Cache-Control", "no-cache")
            self.end_headers()
            while not server.quit.is_set():
                data = server.image(name)
                if data is None:
                    # a blank line: the camera lives, its head moves
                    self.wfile.write(b"\r\n")
                else:
                    self.wfile.write(
                        b"--frame\r\nContent-Type: image/jpeg\r\n"
                        b"Content-Length: %d\r\n\r\n%b\r\n" % (len(data), data)
                    )
                    server.quit.wait(1 / FPS)

    def do_POST(self):
        """Move the board."""
        token, _, place = self.path.strip("/").partition("/")
        if token != self.server.token:
            return self.send_error(
                403, "the address of devices.control in the rig file is needed"
            )
        try:
            self.server.world.put(place)
        except ValueError as error:
            return self.send_error(400, str(error))
        self.send_response(204)
        return self.end_headers()

    def log_message(self, *_):
        pass
