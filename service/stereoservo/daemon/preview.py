"""Preview images of a camera for display: encoded as JPEG by a niced thread of the vision process, only while the
gateway requests them, and passed to it through a slot.
"""

from __future__ import annotations

import os
import struct
import threading
import time

import msgspec

from stereoservo.daemon.process_control import write_log
from stereoservo.daemon.seqlock import SlotReader, SlotWriter
from stereoservo.messages.decoding import cause_of
from stereoservo.messages.directories import CellDirectories
from stereoservo.numerics.arrays import ImageArray
from stereoservo.ports.devices import Frame

PICTURE_LAYOUT = "PreviewPicture.1"
PICTURE_CAPACITY = 192 << 10
"""Largest size [bytes], below the largest message of a zenoh session (`client.session.MAX_MESSAGE_BYTES`)."""
REQUEST_LAYOUT = "PreviewWanted.1"
REQUEST_BYTES = 8
REQUEST_S = 1.0
"""Validity of a request [s]; the gateway renews it while there are subscribers."""
WIDEST_PX = 640
EVERY_NS = 60_000_000
"""Least interval of images [ns]: at most 16 per second, every frame of a 15 Hz camera."""
QUALITIES = (75, 50, 25)
NICENESS = 10


class PreviewPicture(msgspec.Struct, frozen=True):
    """A JPEG of one frame. ``width``, ``height``: of the frame [px]; the JPEG may be smaller."""

    camera: str
    seq: int
    t_shutter_ns: int
    width: int
    height: int
    jpeg: bytes


picture_decoder = msgspec.msgpack.Decoder(PreviewPicture)
_encoder = msgspec.msgpack.Encoder()


def encode_jpeg(image: ImageArray) -> bytes:
    """An image (height, width) as JPEG, at most `WIDEST_PX` wide, at the best quality that fits into the slot."""
    import cv2  # not imported by the gateway and the supervisor, which use only the slots

    step = -(-image.shape[1] // WIDEST_PX)
    if step > 1:
        size = (image.shape[1] // step, image.shape[0] // step)
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    data = b""
    for quality in QUALITIES:
        data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
        if len(data) < PICTURE_CAPACITY - 1024:
            break
    return data


class PreviewEncoder:
    """Preview encoder of one camera, in its vision process: `offer` takes each newest frame; a thread encodes while
    previews are requested.

    The thread starts with the first requested image. Raises SlotError if another process writes.
    """

    def __init__(self, directories: CellDirectories, camera: str) -> None:
        self._request = SlotReader(directories.preview_request_slot(camera), REQUEST_LAYOUT)
        self._slot = SlotWriter(directories.preview_slot(camera), PICTURE_CAPACITY, PICTURE_LAYOUT)
        self._camera = camera
        self._until_ns = 0
        self._last_ns = 0
        self._ready = threading.Condition()
        self._waiting: Frame | None = None
        self._ended = False
        self._thread: threading.Thread | None = None

    def offer(self, frame: Frame, now_ns: int) -> None:
        """Pass a copy of ``frame`` to the encoder if one is requested and the last one is old enough; never waits."""
        request = self._request.poll()
        if request is not None and len(request) == REQUEST_BYTES:
            (self._until_ns,) = struct.unpack("=q", request)
        if now_ns > self._until_ns or now_ns - self._last_ns < EVERY_NS:
            return
        self._last_ns = now_ns
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name=f"preview-{self._camera}", daemon=True)
            self._thread.start()
        kept = msgspec.structs.replace(frame, image=frame.image.copy())
        with self._ready:
            self._waiting = kept
            self._ready.notify()

    def _work(self) -> None:
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)  # Linux: for this thread only
        warned = False
        while True:
            with self._ready:
                while self._waiting is None and not self._ended:
                    self._ready.wait()
                if self._ended:
                    return
                frame, self._waiting = self._waiting, None
            assert frame is not None
            try:
                height, width = frame.image.shape
                picture = PreviewPicture(
                    frame.camera, frame.seq, frame.t_shutter_ns, width, height, encode_jpeg(frame.image)
                )
                self._slot.write(_encoder.encode(picture))
            except Exception as error:  # an image that cannot be encoded must not stop the camera
                if not warned:
                    write_log(f"vision-{self._camera}", f"no preview of a picture: {cause_of(error)}")
                warned = True

    def close(self) -> None:
        """End the thread and release the slots. Idempotent."""
        with self._ready:
            self._ended = True
            self._ready.notify()
        if self._thread is not None:
            self._thread.join(1.0)
            if self._thread.is_alive():
                return  # it still writes: both slots are released when the process ends
        self._request.close()
        self._slot.close()


class PreviewRequest:
    """The gateway's side of one camera's preview: requests images, and reads the newest."""

    def __init__(self, directories: CellDirectories, camera: str) -> None:
        self._request = SlotWriter(directories.preview_request_slot(camera), REQUEST_BYTES, REQUEST_LAYOUT)
        self._slot = SlotReader(directories.preview_slot(camera), PICTURE_LAYOUT)

    def ask(self) -> None:
        """Request images for the next `REQUEST_S` seconds."""
        self._request.write(struct.pack("=q", time.monotonic_ns() + int(REQUEST_S * 1e9)))

    def poll(self) -> PreviewPicture | None:
        """The newest image, unless returned before or older than `REQUEST_S`. Raises the decoder's exceptions."""
        data = self._slot.poll()
        if data is None:
            return None
        picture = picture_decoder.decode(data)
        return picture if time.monotonic_ns() - picture.t_shutter_ns < int(REQUEST_S * 1e9) else None

    def close(self) -> None:
        """Release both slots. Idempotent."""
        self._request.close()
        self._slot.close()
