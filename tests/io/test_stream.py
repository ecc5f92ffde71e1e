"""A camera in the network: a real stream, served by this process."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import count, islice, pairwise

import cv2
import numpy as np
import pytest

from dualslam.core.errors import InputError
from dualslam.io import open_sequence

WIDTH, HEIGHT = 64, 48
RATE_HZ = 50.0


class Camera(BaseHTTPRequestHandler):
    """Sends pictures, each brighter than the one before, as network cameras do (motion JPEG)."""

    def do_GET(self) -> None:
        """Send pictures until nobody takes them."""
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        self.end_headers()
        try:
            for i in count():
                jpeg = cv2.imencode(".jpg", np.full((HEIGHT, WIDTH, 3), 10 + i % 240, np.uint8))[1].tobytes()
                head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                self.wfile.write(head.encode() + jpeg + b"\r\n")
                time.sleep(1 / RATE_HZ)
        except OSError:
            pass

    def log_message(self, *args: object) -> None:
        """Say nothing."""


@pytest.fixture
def address(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    monkeypatch.delenv("http_proxy", raising=False)  # the decoder would ask it for this machine
    server = ThreadingHTTPServer(("127.0.0.1", 0), Camera)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://somebody:secret@127.0.0.1:{server.server_port}/video"
    server.shutdown()
    server.server_close()


def test_a_stream_is_read_as_a_webcam_is(address: str) -> None:
    sequence = open_sequence(address, fov_degrees=60, start=2, stride=2, max_frames=5)
    assert sequence.name == "stream_127.0.0.1", "and no password"
    assert (sequence.camera.width, sequence.camera.height) == (WIDTH, HEIGHT)
    began = time.time()
    frames = list(sequence)
    assert [frame.index for frame in frames] == [2, 4, 6, 8, 10]
    levels = [float(np.mean(frame.image)) for frame in frames if frame.image is not None]
    assert np.allclose(np.diff(levels), 2, atol=0.6)
    assert all(a.timestamp_s < b.timestamp_s for a, b in pairwise(frames))
    assert abs(frames[0].timestamp_s - began) < 60


def test_without_an_end_it_has_no_length_and_stops_with_its_reader(address: str) -> None:
    sequence = open_sequence(address, fov_degrees=60)
    with pytest.raises(TypeError, match="no length"):
        len(sequence)
    stream = iter(sequence)
    assert [frame.image is not None for frame in islice(stream, 3)] == [True] * 3
    stream.close()  # type: ignore[attr-defined]


def test_what_cannot_be_reached_is_one_sentence() -> None:
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))
        address = f"http://somebody:secret@127.0.0.1:{nobody.getsockname()[1]}/video"
    with pytest.raises(InputError, match=r"The stream at 127\.0\.0\.1 cannot be opened; check the address") as error:
        open_sequence(address, fov_degrees=60)
    assert "secret" not in str(error.value)
    with pytest.raises(InputError, match="no calibration"):
        open_sequence(address)
    with pytest.raises(InputError, match="address of the stream cannot be read") as error:
        open_sequence("rtsp://somebody:secret@[::1/video", fov_degrees=60)
    assert "secret" not in str(error.value)
