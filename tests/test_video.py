"""Cameras: recorded images, streams that end and come back, and V4L2 devices that do not do what they are told."""

import socket
import threading
import time
from contextlib import suppress

import cv2
import numpy as np
import pytest
from shared import until

from lrfcal_lib.drivers import video
from lrfcal_lib.drivers.port import DeviceError, LineLost, NoReply, PortError
from lrfcal_lib.drivers.video import Camera, MjpegStream

WAIT_S = 120.0  # guard against a hang on a busy machine


def numbered(number, size=(64, 48)):
    """Image whose grey value tells its number."""
    return np.full((size[1], size[0], 3), (number * 16) % 256, np.uint8)


def number_of(frame):
    return round(float(frame.image.mean()) / 16) % 16


class MjpegServer:
    """MJPEG over HTTP that sends what it is told to, and the last image at first; it may end and come back."""

    def __init__(self, lengths=True):
        self.lengths, self.port, self.last, self.requests = lengths, 0, b"", []
        self.start()
        self.show(0)

    url = property(lambda self: f"http://127.0.0.1:{self.port}/video")

    def start(self):
        self.links, self.listener = [], socket.create_server(("127.0.0.1", self.port))
        self.port = self.listener.getsockname()[1]
        threading.Thread(target=self.accept, args=(self.listener,), daemon=True).start()

    def accept(self, listener):
        while True:
            try:
                link, _ = listener.accept()
            except OSError:  # closed
                return
            self.requests.append(link.recv(4096).decode())
            kind = b"Content-Type: multipart/x-mixed-replace; boundary=frame"
            link.sendall(b"HTTP/1.1 200 OK\r\n" + kind + b"\r\n\r\n" + self.last)
            self.links.append(link)

    def show(self, number):
        """Send an image, or bytes that are none."""
        data = (
            number
            if isinstance(number, bytes)
            else cv2.imencode(".jpg", numbered(number))[1].tobytes()
        )
        length = f"Content-Length: {len(data)}\r\n" if self.lengths else ""
        self.last = (
            f"--frame\r\nContent-Type: image/jpeg\r\n{length}\r\n".encode() + data + b"\r\n"
        )
        for link in self.links:
            with suppress(OSError):  # gone
                link.sendall(self.last)

    def stop(self):
        with suppress(OSError):  # stopped already
            self.listener.shutdown(socket.SHUT_RDWR)
        for one in (self.listener, *self.links):
            one.close()


def shown(server, camera, number):
    """When an image was sent, again until the camera has waited for it, and the frame."""
    while True:
        asked = time.time()
        server.show(number)
        with suppress(NoReply):
            return asked, camera.newest(after=asked, timeout=0.5)


@pytest.fixture
def server(request):
    server = MjpegServer(getattr(request, "param", True))
    yield server
    server.stop()


@pytest.fixture
def camera(server):
    with Camera(server.url, name="left") as camera:
        camera.newest(timeout=WAIT_S)
        until(lambda: server.links)
        yield camera
        server.stop()  # nothing that the camera would wait for


# ----------------------------------------------------------------------------------------------------- streams


@pytest.mark.parametrize(
    "server", [True, False], ids=["lengths", "no lengths"], indirect=True
)
def test_newest_frame_of_a_stream(server, camera):
    indices = []
    for number in range(1, 5):
        asked, frame = shown(server, camera, number)
        assert (
            number_of(frame) == number
            and frame.image.shape == (48, 64, 3)
            and frame.image.dtype == np.uint8
        )
        assert asked < frame.time_s <= time.time()
        indices.append(frame.index)
    assert indices == sorted(set(indices)) and not camera.lost
    assert camera.size == (64, 48)
    assert camera.newest() is frame
    camera.close()
    with pytest.raises(DeviceError, match="left is closed"):
        camera.newest(after=time.time())


def test_stream_lost_and_found(server, camera, caplog, capfd):
    before = camera.newest()
    server.stop()
    until(lambda: camera.lost)
    with pytest.raises(
        PortError, match="gives no video"
    ):  # what the camera tries again and again
        video.open_source(server.url, 1.0)
    assert capfd.readouterr() == ("", "")  # FFmpeg and OpenCV write there
    for after in (None, time.time() + 0.5):
        with pytest.raises(LineLost, match="camera left is lost: open http"):
            camera.newest(after=after, timeout=0.05)
    server.start()
    found = camera.newest(timeout=WAIT_S)
    assert found.time_s > before.time_s and found.index > before.index and not camera.lost
    assert [record.message for record in caplog.records if "is back" in record.message] == [
        "camera left is back"
    ]


@pytest.mark.parametrize("sent", [b"", b"abc"], ids=["silent", "damaged"])
def test_a_stream_without_a_new_image_is_not_lost(server, camera, caplog, sent):
    if sent:
        server.show(sent)
    with pytest.raises(NoReply, match="no new frame in 0.3 s"):
        camera.newest(after=time.time(), timeout=0.3)
    assert number_of(shown(server, camera, 7)[1]) == 7
    assert "lost" not in caplog.text


def test_stream_that_is_silent_for_too_long(server):
    with Camera(server.url, name="left", silence_s=0.5) as camera:
        camera.newest(timeout=WAIT_S)
        until(lambda: camera.lost)
        assert (
            camera.newest(timeout=WAIT_S).image.shape == (48, 64, 3)
            and len(server.requests) > 1
        )


def test_a_stream_has_no_exposure(server, caplog):
    with Camera(server.url, name="left", exposure=0.005) as camera:
        assert camera.size == (64, 48)
        server.stop()  # nothing that the camera would wait for
    assert "exposure cannot be set, asked 0.005" in caplog.text


def test_frames_that_piled_up_are_known(server):
    stream = MjpegStream(server.url.replace("//", "//user:pass%20word@"), 5)
    assert stream.grab()  # the one that told the size
    until(lambda: server.links)
    for number in (1, 2, 3):
        server.show(number)
    for number in (1, 2, 3):
        assert stream.grab() and not stream.waited
        assert stream.retrieve()[1].mean() == pytest.approx(16 * number, abs=2)
    while not stream.waited:  # on a busy machine the image may be there first
        threading.Timer(0.3, server.show, (4,)).start()
        assert stream.grab()
    stream.release()
    assert "Authorization: Basic dXNlcjpwYXNzIHdvcmQ=" in server.requests[0]


@pytest.mark.parametrize(
    "host", ["127.0.0.1:port", "127.0.0.1:99999", "[::1", "", "a" * 70, "x y", ":80", None]
)
def test_a_url_that_nobody_serves(server, host):
    url = f"http://{host}/left.mjpg" if host is not None else server.url
    server.stop()
    with pytest.raises(PortError, match="gives no video: open http"):
        Camera(url, name="left", silence_s=0.3)


# ---------------------------------------------------------------------------------------------------- recorded


@pytest.mark.parametrize("pattern", ["%04d.png", "video.avi"])
def test_recorded_images_in_the_order_of_their_numbers(tmp_path, pattern):
    writer = cv2.VideoWriter(
        str(tmp_path / "video.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 25.0, (64, 48)
    )
    for number in (1, 2, 3):
        cv2.imwrite(str(tmp_path / f"{4 - number:04d}.png"), numbered(4 - number))
        writer.write(numbered(number))
    writer.release()
    with Camera(tmp_path / pattern, name="right") as camera:
        assert camera.size == (64, 48)
        frames = [camera.newest(after=time.time()) for _ in range(3)]
        assert [(number_of(frame), frame.index) for frame in frames] == [
            (1, 0),
            (2, 1),
            (3, 2),
        ]
        assert frames[0].time_s <= frames[1].time_s <= frames[2].time_s and not camera.lost
        with pytest.raises(LineLost, match="at the end of its 3 "):
            camera.newest()


@pytest.mark.parametrize("name", ["none.avi", "text.avi", "none%d.png", "empty"])
def test_bad_files(tmp_path, name, capfd):
    (tmp_path / "text.avi").write_text("no video")
    (tmp_path / "empty").mkdir()
    with pytest.raises(PortError, match=f"{name} is no video .* numbered images such as"):
        Camera(tmp_path / name, name="right")
    assert capfd.readouterr() == ("", "")


# -------------------------------------------------------------------------------------------------------- V4L2


class Device:
    """A V4L2 device of 640 x 480 in place of cv2.VideoCapture; `fixed` keys keep their values."""

    there = True
    opens = True
    allowed = True
    fixed = set()
    made = 0

    def __init__(self, path, backend):
        assert backend == cv2.CAP_V4L2
        self.got = {cv2.CAP_PROP_FRAME_WIDTH: 640.0, cv2.CAP_PROP_FRAME_HEIGHT: 480.0, cv2.CAP_PROP_FPS: 30.0,
                    cv2.CAP_PROP_EXPOSURE: 157.0}  # fmt: skip
        self.isOpened, self.release = lambda: self.opens, lambda: None

    def set(self, key, value):
        self.got |= {} if key in self.fixed else {key: float(value)}
        return key not in self.fixed

    def get(self, key):
        return self.got.get(key, 0.0)

    def grab(self):
        time.sleep(0.01)
        return True

    def retrieve(self):
        self.made += 1
        return True, numbered(self.made, (640, 480))


@pytest.fixture
def device(monkeypatch):
    """The class of the devices that there are, whose habits can be changed."""
    made = type("Device", (Device,), {})
    monkeypatch.setattr(video.cv2, "VideoCapture", made)
    monkeypatch.setattr(video.os.path, "exists", lambda path: made.there)
    monkeypatch.setattr(video.os, "access", lambda path, mode: made.allowed)
    return made


def test_device_without_exposure_control_and_with_its_own_size(device, caplog):
    device.fixed = {
        cv2.CAP_PROP_EXPOSURE,
        cv2.CAP_PROP_AUTO_EXPOSURE,
        cv2.CAP_PROP_FRAME_WIDTH,
    }
    with Camera("0", name="left", size=(1024, 480), exposure=0.005) as camera:
        assert camera.size == (640, 480) and len(caplog.records) == 1
        camera.newest(timeout=WAIT_S)
    assert "exposure cannot be set, asked 0.005" in caplog.text


@pytest.mark.parametrize(("source", "habit", "what"), [
    (0, {"opens": False}, "/dev/video0 gives no video: close other programs"),
    (0, {"allowed": False}, "no permission for /dev/video0: run 'sudo usermod -aG video"),
    (0, {"there": False}, "there is no camera /dev/video0: check its plug; present are"),
])  # fmt: skip
def test_devices_that_cannot_be_opened(device, source, habit, what):
    for name, value in habit.items():
        setattr(device, name, value)
    with pytest.raises(PortError, match=what):
        Camera(0, name="left")
