"""Cameras: recorded images, streams that end and come back, and V4L2 devices that do not do what they are told."""

import logging
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np
import pytest

from lrfcal_lib.drivers import video
from lrfcal_lib.drivers.port import DeviceError, LineLost, NoReply, PortError
from lrfcal_lib.drivers.video import Camera, MjpegStream

WAIT_S = 20.0  # guard against a hang on a busy machine


def numbered(number, size=(64, 48)):
    """Image whose grey value tells its number."""
    return np.full((size[1], size[0], 3), (number * 16) % 256, np.uint8)


def number_of(frame):
    return round(float(frame.image.mean()) / 16) % 16


def until(condition):
    """Wait for a state, not for a time."""
    end = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


class MjpegServer:
    """MJPEG over HTTP whose images tell when they were made; it can be ended and started again on its port."""

    def __init__(self, *, lengths=True, period_s=0.05):
        self.lengths, self.period_s, self.paused, self.port, self.made = lengths, period_s, False, 0, []
        self.passwords, self.lock = set(), threading.Lock()
        self.start()

    def start(self):
        owner = self

        class Handler(BaseHTTPRequestHandler):
            def log_message(self, *_):
                pass

            def do_GET(self):
                owner.serve(self)

        class Server(ThreadingHTTPServer):
            allow_reuse_address, daemon_threads, block_on_close = True, True, False

        self.ended = threading.Event()
        self.server = Server(("127.0.0.1", self.port), Handler)
        self.port = self.server.server_port
        threading.Thread(target=self.server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True).start()

    def serve(self, request):
        self.passwords.add(request.headers["Authorization"])
        request.send_response(200)
        request.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        request.end_headers()
        try:
            while not self.ended.wait(self.period_s):
                with self.lock:
                    if not self.paused:
                        request.wfile.write(self.part())
            request.connection.close()
        except OSError:
            pass

    def part(self):
        self.made.append(time.time())
        data = cv2.imencode(".jpg", numbered(len(self.made) - 1))[1].tobytes()
        length = f"Content-Length: {len(data)}\r\n" if self.lengths else ""
        return f"--frame\r\nContent-Type: image/jpeg\r\n{length}\r\n".encode() + data + b"\r\n"

    def pause(self, camera):
        """Send nothing more; the camera has the last image then."""
        with self.lock:
            self.paused = True
        until(lambda: number_of(camera.newest(timeout=WAIT_S)) == (len(self.made) - 1) % 16)

    def stop(self):
        self.ended.set()
        self.server.shutdown()
        self.server.server_close()

    @property
    def url(self):
        return f"http://127.0.0.1:{self.port}/video"


@pytest.fixture
def server(request):
    server = MjpegServer(**getattr(request, "param", {}))
    yield server
    server.stop()


# ----------------------------------------------------------------------------------------------------- streams


@pytest.mark.parametrize(
    "server", [{"period_s": 0.2}, {"period_s": 0.2, "lengths": False}], ids=["lengths", "no lengths"], indirect=True
)
def test_newest_frame_of_a_stream(server):
    with Camera(server.url, name="left") as camera:
        instant, indices = 0.0, []
        for _ in range(4):
            asked = time.time()
            frame = camera.newest(after=asked, timeout=WAIT_S)
            assert frame.image.shape == (48, 64, 3) and frame.image.dtype == np.uint8
            assert asked < frame.time_s <= time.time() and frame.time_s > instant
            made = [made for number, made in enumerate(server.made) if number % 16 == number_of(frame)][-1]
            assert made <= frame.time_s + 0.001
            assert made > asked - 2.0  # a busy machine may be late with a frame, but not always
            instant = frame.time_s
            indices.append(frame.index)
            time.sleep(0.01)
        assert indices == sorted(set(indices))
        assert not camera.lost
        assert camera.settings["size"] == {"asked": None, "got": (64, 48)}
        assert camera.newest().time_s >= instant


def test_stream_lost_and_found(server, caplog):
    with Camera(server.url, name="left") as camera:
        before = camera.newest(timeout=WAIT_S)
        server.stop()
        until(lambda: camera.lost)
        with pytest.raises(LineLost, match="camera left is lost: open http"):
            camera.newest(after=time.time() + 0.5, timeout=0.1)
        with pytest.raises(LineLost):
            camera.newest(timeout=0.05)
        server.start()
        ended = time.time()
        after = camera.newest(timeout=WAIT_S)
        assert after.time_s > ended and after.index > before.index
        assert not camera.lost
    assert [record.message for record in caplog.records if "left is back" in record.message] == ["camera left is back"]


def test_silent_stream(server, caplog):
    with Camera(server.url, name="left") as camera:
        server.pause(camera)
        with pytest.raises(NoReply, match="no new frame in 0.3 s"):
            camera.newest(after=time.time(), timeout=0.3)
        assert not camera.lost
        server.paused = False
        assert camera.newest(after=time.time(), timeout=WAIT_S).index > 0
    assert "lost" not in caplog.text


def test_stream_that_is_silent_for_too_long(server):
    with Camera(server.url, name="left", silence_s=0.5) as camera:
        camera.newest(timeout=WAIT_S)
        server.paused = True
        until(lambda: camera.lost)
        server.paused = False
        assert camera.newest(timeout=WAIT_S).image.shape == (48, 64, 3)


def test_a_stream_that_ended_or_fell_silent_is_at_its_end_however_often_it_is_asked(server):
    for end in (server.stop, lambda: setattr(server, "paused", True)):
        stream = MjpegStream(server.url, 0.5)
        assert stream.grab()
        end()
        while stream.grab():
            pass
        assert not stream.grab() and stream.get(cv2.CAP_PROP_FRAME_WIDTH) == 64
        stream._image = None  # as of a stream whose first image never came
        assert stream.get(cv2.CAP_PROP_FRAME_WIDTH) == stream.get(cv2.CAP_PROP_FRAME_HEIGHT) == 0
        if not server.paused:
            server.start()
        stream.release()


def test_closing_wakes_who_waits(server):
    camera = Camera(server.url, name="left")
    camera.newest(timeout=WAIT_S)
    server.paused = True
    threading.Timer(0.1, camera.close).start()
    with pytest.raises(DeviceError, match="left is closed"):
        camera.newest(after=time.time() + 0.1, timeout=WAIT_S)
    server.paused = False
    camera.close()
    with pytest.raises(DeviceError, match="left is closed"):
        camera.newest()


def test_frames_that_piled_up_are_known(server):
    server.period_s = 0.02
    stream = MjpegStream(server.url.replace("//", "//user:pass%20word@"), 5)
    assert stream.multipart and (stream.get(cv2.CAP_PROP_FRAME_WIDTH), stream.get(cv2.CAP_PROP_FPS)) == (64, 0)
    assert stream.grab() and not stream.waited  # the one that told the size
    first = stream.retrieve()[1]
    while len(server.made) < 8:
        time.sleep(0.02)
    server.paused = True
    waited = []
    while len(waited) < len(server.made) - 2:
        assert stream.grab()
        waited.append(stream.waited)
    assert not any(waited[:5])
    threading.Timer(0.1, setattr, (server, "paused", False)).start()
    while not stream.waited:
        assert stream.grab()
    assert not np.array_equal(first, stream.retrieve()[1])
    stream.release()
    assert server.passwords == {"Basic dXNlcjpwYXNzIHdvcmQ="}


def test_a_damaged_image_is_left_out(server, monkeypatch):
    with Camera(server.url, name="left") as camera:
        server.pause(camera)
        sent = []
        monkeypatch.setattr(MjpegServer, "part",
                            lambda self: sent.append(1) or b"--frame\r\nContent-Length: 3\r\n\r\nabc\r\n")  # fmt: skip
        server.paused = False
        until(lambda: sent)
        with pytest.raises(NoReply):
            camera.newest(after=time.time(), timeout=0.2)
        monkeypatch.undo()
        camera.newest(after=time.time(), timeout=WAIT_S)
        assert not camera.lost


def test_no_stream():
    server = MjpegServer()
    server.stop()
    with pytest.raises(PortError, match="gives no video: open http"):
        Camera(server.url, name="left")


@pytest.mark.parametrize("host", ["127.0.0.1:port", "127.0.0.1:99999", "[::1", "", "a" * 70, "x y", ":80"])
def test_a_url_that_names_no_host(host):
    with pytest.raises(PortError, match="gives no video: open http"):
        Camera(f"http://{host}/left.mjpg", name="left", silence_s=0.3)


def test_size_and_exposure_that_a_stream_cannot_set(server, caplog):
    asked = {"size": (640, 480), "exposure": 0.01}
    with Camera(server.url, name="left", **asked) as camera:
        assert camera.settings["size"] == {"asked": (640, 480), "got": (64, 48)}
        assert camera.settings["exposure"] == {"asked": 0.01, "got": None}
        assert camera.settings["warnings"] == [
            "camera left: size is (64, 48), asked (640, 480)",
            "camera left: exposure cannot be set, asked 0.01",
        ]
        assert all(text in caplog.text for text in camera.settings["warnings"])
        camera.newest(timeout=WAIT_S)


# ---------------------------------------------------------------------------------------------------- recorded


@pytest.fixture
def folder(tmp_path):
    for number in (3, 1, 2):
        cv2.imwrite(str(tmp_path / f"{number:04d}.png"), numbered(number))
    (tmp_path / "notes.txt").write_text("no image")
    return tmp_path


@pytest.mark.parametrize("pattern", ["", "*.png", "000[123].*"])
def test_images_in_the_order_of_their_names(folder, pattern):
    with Camera(folder / pattern if pattern else folder, name="right") as camera:
        assert camera.settings["size"]["got"] == (64, 48)
        frames = [camera.newest(after=time.time()) for _ in range(3)]
        assert [number_of(frame) for frame in frames] == [1, 2, 3]
        assert [frame.index for frame in frames] == [0, 1, 2]
        assert frames[0].time_s <= frames[1].time_s <= frames[2].time_s
        assert not camera.lost
        with pytest.raises(LineLost, match="at the end of its 3 recorded images"):
            camera.newest()
        assert camera.lost


def test_one_grey_image(tmp_path):
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((10, 20), 7, np.uint8))
    with Camera(tmp_path / "grey.png", name="right") as camera:
        assert np.array_equal(camera.newest().image, np.full((10, 20, 3), 7))
    with pytest.raises(DeviceError, match="right is closed"):
        camera.newest()


def test_video_file(tmp_path):
    path = tmp_path / "video.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25.0, (64, 48))
    assert writer.isOpened()
    for number in range(5):
        writer.write(numbered(number))
    writer.release()
    with Camera(str(path), name="right", fps=25, size=(64, 48)) as camera:
        assert camera.settings["fps"] == {"asked": 25, "got": 25.0}
        assert camera.settings["warnings"] == []
        assert [number_of(camera.newest()) for _ in range(5)] == list(range(5))
        with pytest.raises(LineLost, match="at the end of its 5"):
            camera.newest()


def test_bad_files(tmp_path):
    (tmp_path / "text.avi").write_text("no video")
    (tmp_path / "bad.png").write_text("no image")
    (tmp_path / "empty").mkdir()
    for name, what in [("none.avi", "there is no video"), ("text.avi", "is no video"), ("none.png", "no images in"),
                       ("empty", "there are no images in"), ("x*.png", "there are no images in")]:  # fmt: skip
        with pytest.raises(PortError, match=what):
            Camera(tmp_path / name, name="right")
    camera = Camera(tmp_path / "bad.png", name="right")
    with pytest.raises(PortError, match="bad.png is no image"):
        camera.newest()


# -------------------------------------------------------------------------------------------------------- V4L2


class FakeCapture:
    """A V4L2 device behind cv2.VideoCapture: `fixed` keys keep their values, `ends` makes the grabs fail."""

    values = {}
    fixed, opens, ends, made, grey = set(), True, False, 0, False

    def __init__(self, path, backend):
        assert backend == cv2.CAP_V4L2
        self.path, self.got = path, dict(type(self).values)

    def isOpened(self):  # noqa: N802
        return type(self).opens

    def set(self, key, value):
        if key in type(self).fixed:
            return False
        self.got[key] = float(value)
        return True

    def get(self, key):
        return self.got.get(key, 0.0)

    def grab(self):
        time.sleep(0.01)
        return not type(self).ends

    def retrieve(self):
        type(self).made += 1
        size = (int(self.get(cv2.CAP_PROP_FRAME_WIDTH)), int(self.get(cv2.CAP_PROP_FRAME_HEIGHT)))
        image = numbered(type(self).made, size)
        return True, image[:, :, 0] if type(self).grey else image

    def release(self):
        pass


@pytest.fixture
def device(monkeypatch):
    """A device of 640 x 480; its habits can be changed."""

    class Device(FakeCapture):
        values = {cv2.CAP_PROP_FRAME_WIDTH: 640.0, cv2.CAP_PROP_FRAME_HEIGHT: 480.0, cv2.CAP_PROP_FPS: 30.0,
                  cv2.CAP_PROP_EXPOSURE: 157.0}  # fmt: skip
        there = True

    monkeypatch.setattr(video.cv2, "VideoCapture", Device)
    monkeypatch.setattr(video.os.path, "exists", lambda path: Device.there)
    monkeypatch.setattr(video.os, "access", lambda path, mode: True)
    return Device


def test_what_a_device_does_as_told(device):
    with Camera(0, name="left", size=(320, 240), exposure=0.005, fps=15) as camera:
        assert camera.settings == {
            "size": {"asked": (320, 240), "got": (320, 240)},
            "exposure": {"asked": 0.005, "got": pytest.approx(0.005)},
            "fps": {"asked": 15, "got": 15.0},
            "warnings": [],
        }
        assert camera.newest(timeout=WAIT_S).image.shape == (240, 320, 3)


def test_device_left_as_it_is(device):
    with Camera("/dev/video3", name="left") as camera:
        assert camera.settings["exposure"] == {"asked": None, "got": pytest.approx(0.0157)}
        assert camera.settings["warnings"] == []
        device.grey = True
        assert camera.newest(after=time.time() + 0.05, timeout=WAIT_S).image.shape == (480, 640, 3)


def test_device_without_exposure_control_and_with_its_own_size(device, caplog):
    device.fixed = {cv2.CAP_PROP_EXPOSURE, cv2.CAP_PROP_AUTO_EXPOSURE, cv2.CAP_PROP_FRAME_WIDTH}
    with Camera("0", name="left", size=(1024, 480), exposure=0.005) as camera:
        assert camera.settings["exposure"]["got"] is None
        assert camera.settings["size"]["got"] == (640, 480)
        assert len(camera.settings["warnings"]) == 2
        camera.newest(timeout=WAIT_S)
    assert "exposure cannot be set, asked 0.005" in caplog.text
    assert "size is (640, 480), asked (1024, 480)" in caplog.text


def test_device_lost_and_found(device, caplog):
    caplog.set_level(logging.WARNING)
    with Camera(0, name="left", exposure=0.005) as camera:
        camera.newest(timeout=WAIT_S)
        device.ends = True
        device.there = False
        until(lambda: camera.lost)
        with pytest.raises(LineLost, match="check the plug of /dev/video0"):
            camera.newest(timeout=0.1)
        device.ends, device.there = False, True
        assert camera.newest(timeout=WAIT_S).index > 0
        assert camera.settings["exposure"]["got"] == pytest.approx(0.005)


def test_devices_that_cannot_be_opened(device, monkeypatch):
    device.opens = False
    with pytest.raises(PortError, match="/dev/video0 gives no video: close other programs"):
        Camera(0, name="left")
    monkeypatch.setattr(video.os, "access", lambda path, mode: False)
    with pytest.raises(PortError, match="no permission for /dev/video0: run 'sudo usermod -aG video"):
        Camera(0, name="left")
    device.there = False
    with pytest.raises(PortError, match="there is no camera /dev/video0: check its plug; present are"):
        Camera(0, name="left")
