"""Cameras of the simulated rig as MJPEG over HTTP on this machine.

A process of its own draws the images, so that the serial devices keep their times. No image shows a head that moves:
while it does none is sent, and one that was begun before a move is not sent after it.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import threading
import time
from collections import OrderedDict
from concurrent.futures import CancelledError, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from functools import lru_cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait

import cv2
import numpy as np

from lrfcal_lib.simulate.record import world_of
from lrfcal_lib.simulate.scene import Imager

LOG = logging.getLogger(__name__)
BOUNDARY = "frame"
LOOK_S = 0.05
CACHED = 64  # images


def scaled(rig, width):
    """The rig with images of another width, the same field of view.

    Raises
    ------
    ValueError
        If that makes an odd number of pixels.
    """
    cameras = []
    for camera in rig.cameras:
        m, scale = camera.model, width / camera.model.width
        height = m.height * scale
        if width % 2 or abs(height - 2 * round(height / 2)) > 1e-6:
            raise ValueError(f"an image width of {width} makes {height:g} lines: both must be even whole numbers")
        centre = ((m.cx + 0.5) * scale - 0.5, (m.cy + 0.5) * scale - 0.5)
        sizes = {"width": width, "height": round(height), "fx": m.fx * scale, "fy": m.fy * scale}
        cameras.append(replace(camera, model=replace(m, **sizes, cx=centre[0], cy=centre[1])))
    return replace(rig, cameras=tuple(cameras))


class _Studio:
    """Cameras and worlds that the drawing process keeps."""

    def __init__(self, setup):
        self.setup = setup
        self.imager = lru_cache(maxsize=None)(self.imager)
        self.world = lru_cache(maxsize=2)(self.world)

    def imager(self, index):
        camera = self.setup.rig.cameras[index]
        return Imager(camera.model, camera.exposure)

    def world(self, place):
        return world_of(self.setup, place.T_platform_board, stand=place.stand)


_studio = None  # of the drawing process


def _begin(setup):
    """Furnish the drawing process."""
    global _studio
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent ends this process
    threading.Thread(target=_outlive_nobody, daemon=True).start()
    _studio = _Studio(setup)
    cv2.setNumThreads(1)


def _outlive_nobody():
    """End with a parent that was killed."""
    wait([parent_process().sentinel])
    os._exit(1)


def _draw(index, place, pitch, seed, quality):
    """JPEG of what a camera sees; runs in the drawing process."""
    rig = _studio.setup.rig
    pose = rig.camera_pose(rig.cameras[index], pitch)
    image = _studio.imager(index).render(_studio.world(place), pose, np.random.default_rng(seed))
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


class CameraServer:
    """The cameras of a world.

    Parameters
    ----------
    world : EmulatedWorld
    setup : Setup, optional
        Whose cameras to show, such as smaller ones; the world's by default.
    quality : int
        Of JPEG.
    fps : float
        Most images a second of a camera.
    seed : int
    rest_s : float
        Seconds of the devices that the head must rest before an image is drawn. Nobody tells a camera whether its
        image is wanted; most stops of a sweep need none and are shorter.

    Attributes
    ----------
    urls : dict of str to str
    error : Exception or None
        What ended the drawing process; there are no more images.
    """

    def __init__(self, world, setup=None, *, quality=97, fps=8.0, seed=0, rest_s=0.5):
        self.world, self.quality, self.fps, self.seed, self.rest_s = world, quality, fps, seed, rest_s
        setup = setup or world.setup
        self.names = [c.name for c in setup.rig.cameras]
        self._done, self._begun, self._lock = OrderedDict(), {}, threading.Lock()
        self._quit, self._serving, self.error = threading.Event(), None, None
        spawn = get_context("spawn")
        self._pool = ProcessPoolExecutor(1, mp_context=spawn, initializer=_begin, initargs=(setup,))
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), _handler(self))
        self._server.daemon_threads = True
        port = self._server.server_address[1]
        self.urls = {name: f"http://127.0.0.1:{port}/{name}.mjpg" for name in self.names}

    def start(self):
        """Serve, and draw the first images ahead."""
        self._serving = threading.Thread(target=self._server.serve_forever, args=(0.2,), daemon=True)
        self._serving.start()
        for name in self.names:
            self._ask(name, self._key(name))

    def close(self):
        """End the server and the drawing process."""
        self._quit.set()
        if self._serving is not None:
            self._server.shutdown()
        self._server.server_close()
        self._pool.shutdown(wait=True, cancel_futures=True)

    def image(self, name, timeout=1.0):
        """The image of a camera that shows the rig as it stands now.

        Parameters
        ----------
        name : str
        timeout : float
            Seconds to wait for the head to rest and the image to be drawn.

        Returns
        -------
        key, bytes
            What it shows, and a JPEG file; (None, None) where there is none in time.
        """
        end = time.monotonic() + timeout
        while not self._quit.is_set() and self.error is None:
            key = self._key(name)
            data = self._drawn(key) if key else None
            if data is not None and self._key(name) == key:
                return key, data
            if time.monotonic() > end:
                break
            self._quit.wait(LOOK_S)
        return None, None

    def _key(self, name):
        """What the camera shows now, None while the head moves or has hardly come to rest."""
        first = self.world.view()
        if first is None:
            return None
        place, pitch = first
        if self.world.head.tilt.resting(self.world.clock.now())[0] < self.rest_s + self.world.head.platform.settle:
            return None
        return name, place.key, round(pitch, 7)

    def _drawn(self, key):
        """JPEG of a key; asked for where it is not there yet."""
        with self._lock:
            future = self._begun.get(key)
            if future is not None and future.done():
                del self._begun[key]
                with contextlib.suppress(CancelledError), self._mourning():
                    self._done[key] = future.result()
            while len(self._done) > CACHED:
                self._done.popitem(last=False)
            if key in self._done:
                return self._done[key]
        self._ask(key[0], key)
        return None

    def _ask(self, name, key):
        """Have an image drawn; older ones of this camera that nobody waits for any more are dropped."""
        place = self.world.place
        with self._lock:
            if key is None or key in self._begun or self._quit.is_set() or place.key != key[1]:
                return
            for old in [k for k in self._begun if k[0] == name]:
                self._begun.pop(old).cancel()
            seed = [self.seed, self.names.index(name), len(self._done), abs(hash(key[2])) % 2**31]
            with self._mourning():
                index = self.names.index(name)
                self._begun[key] = self._pool.submit(_draw, index, place, key[2], seed, self.quality)

    @contextlib.contextmanager
    def _mourning(self):
        """Say once that the drawing process died; a pool that was shut down is no news."""
        try:
            yield
        except BrokenProcessPool as error:
            if self.error is None and not self._quit.is_set():
                LOG.error("the process that draws the images ended: a program that makes an EmulatedRig must do so "
                          "below 'if __name__ == \"__main__\":'; otherwise look at its memory")  # fmt: skip
            self.error = error
        except RuntimeError:
            if not self._quit.is_set():
                raise


def _handler(cameras):
    """Class of HTTP handlers that send the images of a CameraServer."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            name, _, kind = self.path.strip("/").rpartition(".")
            if name not in cameras.names or kind not in ("mjpg", "jpg"):
                return self.send_error(404, f"cameras are {', '.join(cameras.urls.values())}")
            with contextlib.suppress(ConnectionError, TimeoutError):
                self._stream(name) if kind == "mjpg" else self._single(name)

        def _single(self, name):
            _, data = cameras.image(name, timeout=20.0)
            if data is None:
                return self.send_error(503, "the head moves")
            self.send_response(200)
            self.send_header("Content-Type", "image/jpeg")
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)

        def _stream(self, name):
            self.send_response(200)
            self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={BOUNDARY}")
            self.send_header("Cache-Control", "no-cache")
            self.end_headers()
            while not cameras._quit.is_set() and cameras.error is None:
                _, data = cameras.image(name)
                if data is None:
                    self.wfile.write(b"\r\n")  # a blank line: the camera lives, its head moves
                else:
                    head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                    self.wfile.write(head.encode() + data + b"\r\n")
                    cameras._quit.wait(1 / cameras.fps)

        def log_message(self, *_):
            pass

    return Handler
