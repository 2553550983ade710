"""Playback of a recording on the clock, in the caller's thread: due frames with their stamps."""

from __future__ import annotations

import re
import stat
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from stereoservo.numerics.arrays import ImageArray
from stereoservo.ports import lerobot
from stereoservo.ports.devices import Clock, DriverError, Frame
from stereoservo.ports.image_files import ImageFileError, ImageReader, sidecar_of
from stereoservo_drivers.episodes import episode_of, refused
from stereoservo_drivers.video.options import Place, VideoOptions, frozen_frames
from stereoservo_drivers.video.pictures import PICTURE_FLAG, check_size, jpeg_size, one_channel
from stereoservo_drivers.video.sources import Settings
from stereoservo_drivers.video.stream_monitor import Watch

MOST_A_POLL = 8
"""Largest number of frames that a late poll skips: bounds its time."""


class Playback:
    """Frames of a recording at their times; the first one is due when delivery starts.

    With pace ``every`` each poll returns the next frame with the recording's own stamps, at any time.
    """

    def __init__(self, place: Place, options: VideoOptions, camera: str, watch: Watch, clock: Clock) -> None:
        self.settings: Settings = {}
        self._place = place
        self._options = options
        self._camera = camera
        self._watch = watch
        self._clock = clock
        self._look = frozen_frames(options, place)
        self._recording: Recording | None = None
        self._coming: Frame | None = None
        self._error: DriverError | None = None
        self._offset_ns = 0

    def open(self) -> None:
        """Open, and read the first frame. Raises DriverError."""
        first = self._open()
        self._watch.number = max(self._watch.number, first.seq - 1)
        self._coming = first

    def _open(self) -> Frame:
        self._watch.begin()
        self._recording = open_recording(self._place, self._options, self._camera)
        first = self._recording.read()
        if first is None:
            raise self._place.error("empty", "holds no frame")
        return first

    def begin(self) -> None:
        """Start delivery: the next frame is due now; for an episode in repeated playback, the one at the clock's time.
        Raises DriverError.
        """
        if self._coming is None or self._options.pace != "recorded":
            return
        now_ns = self._clock.now_ns()
        self._offset_ns = now_ns - self._coming.t_received_ns
        if isinstance(self._recording, EpisodePictures) and self._options.loop:
            into_ns = now_ns % self._recording.period_ns
            self._offset_ns = now_ns - into_ns
            if self._coming.t_received_ns < into_ns:
                coming = self._recording.read_from(into_ns)
                if coming is None:  # after its last frame
                    self._offset_ns += self._recording.period_ns
                    self._recording.close()
                    coming = self._open()
                self._coming = coming

    def take(self) -> Frame | None:
        """The newest frame that is due. Raises DriverError: the recording's, ``frozen``, or ``end_of_file``."""
        every = self._options.pace == "every"
        now_ns = self._clock.now_ns()
        found: Frame | None = None
        for _ in range(1 if every else MOST_A_POLL):
            coming = self._coming
            if coming is None or (not every and coming.t_received_ns + self._offset_ns > now_ns):
                break
            found = self._seen(coming) or found
            self._coming = self._after(coming)
        if found is None and self._error is not None:
            raise self._error
        return found

    def _seen(self, coming: Frame) -> Frame | None:
        """The frame to deliver; None if it repeats the last image."""
        image = one_channel(coming.image, self._options.channel, self._options.flip)
        watch = self._watch
        if not watch.see(image, coming.t_received_ns, coming.seq, 0, look=self._look > 0):
            if watch.row >= self._look:
                self._error = self._place.error(
                    "frozen", f"shows the same picture {watch.row} times (frozen_frames = {self._look})"
                )
            return None
        return Frame(
            self._camera,
            watch.number,
            coming.t_shutter_ns + self._offset_ns,
            coming.t_received_ns + self._offset_ns,
            image,
        )

    def _after(self, coming: Frame) -> Frame | None:
        """The frame after ``coming``; None at the end or at an error, which :meth:`take` then raises."""
        if self._error is not None or self._recording is None:
            return None
        try:
            following = self._recording.read()
            if following is None and self._options.loop:
                self._recording.close()
                following = self._open()
                period_ns = round(1e9 / self._options.rate_hz)
                self._offset_ns += coming.t_received_ns + period_ns - following.t_received_ns
        except DriverError as error:
            self._error = error
            return None
        if following is None:
            self._error = self._place.error(
                "end_of_file",
                "the recording is over. loop = true plays it again and again; a new start of the process, once more",
            )
        return following

    def close(self) -> None:
        """Close the recording."""
        if self._recording is not None:
            self._recording.close()


# -- recorded pictures ---------------------------------------------------------------------------------------
# Readers of recorded images: video files and numbered image files, one image at a time in constant memory.


LARGEST_PICTURE = 50_000_000


class Recording(Protocol):
    """Protocol of a recording that is read forwards."""

    def read(self) -> Frame | None:
        """The next frame with the recording's own stamps and numbers; None at the end. Raises DriverError."""
        ...

    def close(self) -> None:
        """Close the files."""
        ...


def open_recording(place: Place, options: VideoOptions, camera: str) -> Recording:
    """The recording from its frame ``start`` on. Raises DriverError."""
    if place.kind == "episode":
        return EpisodePictures(place, options, camera)
    if place.kind == "sequence":
        return NumberedPictures(place, options, camera)
    check_file(place, place.path)
    if sidecar_of(place.path).exists():
        return StampedVideo(place, options, camera)
    return PlainVideo(place, options, camera)


def check_file(place: Place, path: Path) -> None:
    """Check that a file can be read. Raises DriverError: ``missing``, ``permission``, ``not_a_file``, ``empty``."""
    try:
        found = path.stat()
        if stat.S_ISREG(found.st_mode):
            path.open("rb").close()
    except FileNotFoundError as error:
        raise place.error("missing", f"there is no file {path}") from error
    except OSError as error:
        code = "permission" if isinstance(error, PermissionError) else "not_a_file"
        raise place.error(code, f"{path} cannot be read ({error.strerror})") from error
    if not stat.S_ISREG(found.st_mode):
        raise place.error("not_a_file", f"{path} is a directory or a device, not a file")
    if found.st_size == 0:
        raise place.error("empty", f"{path} is empty")


class PlainVideo:
    """A video without a sidecar: frames are numbered from 0, stamps are on a grid of ``rate_hz`` from 0."""

    def __init__(self, place: Place, options: VideoOptions, camera: str) -> None:
        self._place = place
        self._options = options
        self._camera = camera
        self._next = options.start
        settings = [
            cv2.CAP_PROP_N_THREADS,
            1,
            cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
            round(options.open_timeout_s * 1e3),
            cv2.CAP_PROP_READ_TIMEOUT_MSEC,
            round(options.read_timeout_s * 1e3),
        ]
        self._capture = cv2.VideoCapture(str(place.path), cv2.CAP_FFMPEG, settings)
        try:
            if not self._capture.isOpened():
                raise place.error(
                    "not_a_video", "holds no video that can be read: cut off, of another kind, or damaged"
                )
            size = [self._capture.get(p) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
            check_size(place, options, int(size[0]), int(size[1]))
            self._said = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
            if options.start and (
                0 < self._said <= options.start or not self._capture.set(cv2.CAP_PROP_POS_FRAMES, float(options.start))
            ):
                raise place.error("start", f"start = {options.start}; it has {self._said} frames")
        except DriverError:
            self._capture.release()
            raise

    def read(self) -> Frame | None:
        """The next frame. Raises DriverError (``truncated``: it states more frames; ``silent``: reading does not
        end).
        """
        begun_s = time.monotonic()
        if not self._capture.grab():
            if time.monotonic() - begun_s >= self._options.read_timeout_s:
                raise self._place.error(
                    "silent",
                    f"no frame {self._next} was found within {self._options.read_timeout_s:g} s (read_timeout_s): "
                    "damaged data, or a disk that does not answer",
                    frame=self._next,
                )
            # Containers without a count of frames state an estimate.
            if self._next + 1 + self._said // 50 < self._said:
                raise self._place.error(
                    "truncated",
                    f"ends after {self._next} frames and says that it has {self._said}: the file is cut off. Take "
                    "another copy, or use what comes before",
                    frame=self._next,
                )
            return None
        whole, image = self._capture.retrieve()
        if not whole:
            raise self._place.error("decode", f"frame {self._next} cannot be decoded", frame=self._next)
        t_ns = round(self._next / self._options.rate_hz * 1e9)
        frame = Frame(self._camera, self._next, t_ns - round(self._options.latency_s * 1e9), t_ns, image)
        self._next += 1
        return frame

    def close(self) -> None:
        """Close the file."""
        self._capture.release()


class StampedVideo:
    """A recorded camera with its sidecar: recorded numbers and stamps, every frame checked by its CRC."""

    def __init__(self, place: Place, options: VideoOptions, camera: str) -> None:
        self._place = place
        try:
            self._reader = ImageReader(place.path, camera)
        except ImageFileError as error:
            raise _translated(place, error) from error
        try:
            header = self._reader.header
            check_size(place, options, header.width, header.height)
            for number in range(options.start):
                if self._reader.skip() is None:
                    raise place.error("start", f"start = {options.start}; it has {number} frames")
        except ImageFileError as error:
            self._reader.close()
            raise _translated(place, error) from error
        except DriverError:
            self._reader.close()
            raise

    def read(self) -> Frame | None:
        """The next frame. Raises DriverError (``crc``, ``sidecar``; ``truncated``: frames or lines are missing)."""
        try:
            frame = self._reader.read()
        except ImageFileError as error:
            raise _translated(self._place, error) from error
        if frame is None and self._reader.lost:
            raise self._place.error(
                "truncated",
                f"video and sidecar have {self._reader.frame} frames in common, {self._reader.lost} are in one of them "
                "only: a file is cut off. Take another copy, or use what comes before",
                frame=self._reader.frame,
                lost=self._reader.lost,
            )
        return frame

    def close(self) -> None:
        """Close the files."""
        self._reader.close()


class NumberedPictures:
    """Image files numbered without a gap; stamps as for :class:`PlainVideo`."""

    def __init__(self, place: Place, options: VideoOptions, camera: str) -> None:
        self._place = place
        self._options = options
        self._camera = camera
        numbers = sorted(_numbers(place))
        if not numbers:
            raise place.error("missing", f"there is no picture of this name in {place.path.parent}")
        if options.start and options.start not in numbers:
            raise place.error("start", f"start = {options.start}; there are the numbers {numbers[0]} to {numbers[-1]}")
        self._next = options.start or numbers[0]
        self._last = numbers[-1]
        gap = next((a + 1 for a, b in pairwise(numbers) if b != a + 1 and a >= self._next), None)
        if gap is not None:
            raise place.error(
                "sequence_gap",
                f"picture {place.path.name % gap} is missing, though later ones are there. Copy it, number them anew, "
                f"or start behind it",
                frame=gap,
            )

    def read(self) -> Frame | None:
        """The next image. Raises DriverError (``missing``, ``corrupt``, ``image_size``)."""
        number = self._next
        if number > self._last:
            return None
        path = self._place.path.with_name(self._place.path.name % number)
        image = self._decoded(path, number)
        check_size(self._place, self._options, image.shape[1], image.shape[0])
        self._next += 1
        t_ns = round(number / self._options.rate_hz * 1e9)
        return Frame(self._camera, number, t_ns - round(self._options.latency_s * 1e9), t_ns, image)

    def _decoded(self, path: Path, number: int) -> ImageArray:
        check_file(self._place, path)
        image: ImageArray | None = None
        size = path.stat().st_size
        if size > LARGEST_PICTURE:
            raise self._place.error(
                "frame_too_large", f"{path.name} has {size} bytes; at most {LARGEST_PICTURE} are read", frame=number
            )
        data = path.read_bytes()
        if path.suffix.lower() not in (".jpg", ".jpeg") or jpeg_size(data) is not None:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), PICTURE_FLAG)
        if image is None:
            raise self._place.error(
                "corrupt", f"{path.name} is no whole picture: cut off, damaged, or of another kind", frame=number
            )
        return image

    def close(self) -> None:
        """No effect: no file is open between images."""


class EpisodePictures:
    """Pictures of one camera of an episode of a LeRobot data set; stamps are the data set's, from 0 on.

    ``period_ns``: time after which the episode restarts, if it does.
    """

    def __init__(self, place: Place, options: VideoOptions, camera: str) -> None:
        self._place = place
        self._options = options
        self._camera = camera
        assert options.episode is not None  # of such a place
        with refused(place.shown):
            self._episode = episode_of(place.path, options.episode)
            info = self._episode.info
            wanted = options.feature or camera
            (key,) = lerobot.camera_features(info, place.path, [wanted]).values()
            self._pictures = lerobot.pictures(place.path, info, key, self._episode.rows, gray=options.channel == "gray")
        if options.rate_hz != info.fps:
            raise place.error("rate", f"rate_hz = {options.rate_hz!r}; the data set has {info.fps!r} frames a second")
        self.period_ns = self._episode.period_ns

    def read(self) -> Frame | None:
        """The next frame. Raises DriverError."""
        return self.read_from(0)

    def read_from(self, t_ns: int) -> Frame | None:
        """The next frame from a time [ns] on; None if there is none. Raises DriverError."""
        with refused(self._place.shown):
            for row, decoded in self._pictures:
                received_ns = int(self._episode.stamps_ns[row])
                if received_ns < t_ns:
                    continue
                image = decoded()
                check_size(self._place, self._options, image.shape[1], image.shape[0])
                number = int(self._episode.rows.frame[row])
                shutter_ns = received_ns - round(self._options.latency_s * 1e9)
                return Frame(self._camera, number, shutter_ns, received_ns, image)
        return None

    def close(self) -> None:
        """Close the files."""
        self._pictures.close()


def _numbers(place: Place) -> Iterator[int]:
    head, tail = re.split(r"%(?:0\d+)?d", place.path.name)
    pattern = re.compile(re.escape(head) + r"(\d+)" + re.escape(tail))
    try:
        for entry in place.path.parent.iterdir():
            found = pattern.fullmatch(entry.name)
            if found and place.path.name % int(found[1]) == entry.name:
                yield int(found[1])
    except OSError as error:
        code = "missing" if isinstance(error, FileNotFoundError) else "permission"
        raise place.error(code, f"directory {place.path.parent} cannot be read ({error.strerror})") from error


def _translated(place: Place, error: ImageFileError) -> DriverError:
    code = {"size": "image_size", "video": "not_a_video"}.get(error.code, error.code)
    return DriverError(code, str(error), source=place.shown, frame=error.frame, **error.data)
