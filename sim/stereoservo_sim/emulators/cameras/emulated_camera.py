"""One emulated camera: shutters, images, and their sending times; identical in virtual and in real time."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from stereoservo.messages.cell_file import Mount
from stereoservo.numerics.arrays import ImageArray
from stereoservo.ports.devices import Clock, DriverContext, Frame
from stereoservo_drivers.pybullet import PybulletCameraDriver
from stereoservo_sim.emulators.cameras.stream_settings import CamerasSettings, StreamSettings
from stereoservo_sim.emulators.fault_engine import EmulationError
from stereoservo_sim.world.workpiece import Moved


@dataclass(frozen=True)
class StreamPicture:
    """A JPEG and its stamps: shutter and sending time [ns], ``seq`` on the camera's grid of shutters."""

    seq: int
    t_shutter_ns: int
    t_send_ns: int
    data: bytes = field(repr=False)


@dataclass
class CameraCondition:
    """Fault state of a camera. ``look``: ``black``, ``white``, ``flip``, ``mirror``, or empty.

    ``gone``: its images are lost. ``truncate``, ``corrupt``: number of the next JPEGs to be damaged.
    """

    frozen: bool = False
    gone: bool = False
    look: str = ""
    size: tuple[int, int] | None = None
    gain: float = 1.0
    lamp: bool = False
    latency_ns: int = 0
    jitter_ns: int = 0
    truncate: int = 0
    corrupt: int = 0

    def words(self) -> str:
        """The state as text."""
        marks = [name for name in ("frozen", "gone", "lamp") if getattr(self, name)]
        marks += [self.look] if self.look else []
        marks += [f"{self.size[0]}x{self.size[1]}"] if self.size else []
        marks += [f"exposure {self.gain:g}"] if self.gain != 1.0 else []
        return ", ".join([*marks, f"latency {self.latency_ns * 1e-6:g} ms", f"jitter {self.jitter_ns * 1e-6:g} ms"])


class EmulatedView(PybulletCameraDriver):
    """A simulated camera whose shutter grid and loss rate may change while it runs."""

    driver = "emulated"

    def change(self, **options: Any) -> None:
        """Change ``phase_s`` or ``drop_rate`` from the next shutter on."""
        self._options = msgspec.structs.replace(self._options, **options)

    @property
    def phase_s(self) -> float:
        """Delay of its shutters relative to those of a camera without skew."""
        return self._options.phase_s

    @property
    def drop_rate(self) -> float:
        """Probability that an image is lost."""
        return self._options.drop_rate

    def next_shutter_ns(self) -> int:
        """Time of the next shutter without an image."""
        return self._shutter(self._next)


class EmulatedCamera:
    """Camera with images of one view of the simulated cell, whose arm's history is in ``runtime_dir``.

    ``services``: holds the arm's history in this process instead. Raises DriverError if the rig has no such view.
    """

    def __init__(
        self,
        stream: StreamSettings,
        settings: CamerasSettings,
        *,
        clock: Clock,
        mount: Mount = "eye_to_hand",
        runtime_dir: Path = Path(),
        services: dict[str, Any] | None = None,
        cell_dir: Path = Path(),
        arm: Mapping[str, Any] | None = None,
    ) -> None:
        self.name = stream.name
        self.stream = stream.stream
        self.rate_hz = stream.rate_hz
        self.quality = settings.quality
        self.condition = self._fresh(stream)
        self._stream = stream
        self._clock = clock
        self._seed = settings.seed
        self._moved = stream.moved
        self._sent_ns = 0
        self._last = b""
        self._light: npt.NDArray[np.float32] | None = None
        options = {
            "view": stream.view, "k1": stream.k1, "moved": msgspec.to_builtins(stream.moved), "rate_hz": stream.rate_hz,
            "phase_s": stream.skew_ms * 1e-3, "latency_s": 0.0, "drop_rate": stream.drop_rate, "noise": settings.noise,
            "blur": settings.blur, "background": settings.background, "workpiece": settings.workpiece,
        }  # fmt: skip
        context = DriverContext(
            clock=clock, cell="emulated", runtime_dir=runtime_dir, cell_dir=cell_dir, camera=stream.name,
            seed=settings.seed, services=services or {}, mount=mount, arm=arm or {},
        )  # fmt: skip
        self.view = EmulatedView(options, context)

    @staticmethod
    def _fresh(stream: StreamSettings) -> CameraCondition:
        return CameraCondition(
            gain=stream.gain, latency_ns=round(stream.latency_ms * 1e6), jitter_ns=round(stream.jitter_ms * 1e6)
        )

    def open(self) -> None:
        """Load the renderer and start the shutters."""
        self.view.configure()
        self.view.activate()

    def close(self) -> None:
        """Release. Idempotent."""
        self.view.close()

    def due_ns(self) -> int:
        """Time of the next shutter."""
        return self.view.next_shutter_ns()

    def expose(self) -> StreamPicture | None:
        """Image of the newest shutter, once the arm's history reaches it; None before, and for a lost image."""
        frames = self.view.poll()
        if not frames or self.condition.gone:
            return None
        (frame,) = frames
        assert isinstance(frame, Frame)
        data = self._developed(frame)
        rng = np.random.default_rng((self._seed, zlib.crc32(self.name.encode()), frame.seq, 1))
        return StreamPicture(frame.seq, frame.t_shutter_ns, self._sending_ns(frame, rng), self._spoilt(data, rng))

    def _developed(self, frame: Frame) -> bytes:
        if not (self.condition.frozen and self._last):
            self._last = jpeg(self._disturbed(frame.image), self.quality)
        return self._last

    def _disturbed(self, image: ImageArray) -> ImageArray:
        condition = self.condition
        if condition.lamp:
            if self._light is None:
                self._light = lamp_light(*image.shape)
            image = lit(image, self._light)
        image = exposed(image, condition.gain)
        if condition.look in ("black", "white"):
            image = even(image, 0 if condition.look == "black" else 255)
        image = turned(image, condition.look)
        return image if condition.size is None else resized(image, condition.size)

    def _sending_ns(self, frame: Frame, rng: np.random.Generator) -> int:
        """Sending time; jitter does not change the order of the images."""
        condition = self.condition
        jitter = round(condition.jitter_ns * float(rng.uniform(-1.0, 1.0)))
        self._sent_ns = max(self._sent_ns, frame.t_shutter_ns + max(condition.latency_ns + jitter, 0))
        return self._sent_ns

    def _spoilt(self, data: bytes, rng: np.random.Generator) -> bytes:
        condition = self.condition
        if condition.truncate > 0:
            condition.truncate -= 1
            return cut(data)
        if condition.corrupt > 0:
            condition.corrupt -= 1
            return corrupted(data, rng)
        return data

    def bump(self, turn_deg: float, shift_m: float, axis: int) -> None:
        """Rotate about its own ``axis`` (0 x, 1 y, 2 z) and shift along its x, in addition to earlier bumps."""
        turns, shifts = list(self._moved.turn_deg), list(self._moved.shift_m)
        turns[axis] += turn_deg
        shifts[0] += shift_m
        self._move(Moved((shifts[0], shifts[1], shifts[2]), (turns[0], turns[1], turns[2])))

    def _move(self, moved: Moved) -> None:
        self._moved = moved
        self.view.bump(moved)

    def put_back(self) -> None:
        """Restore the initial pose."""
        self._move(self._stream.moved)

    def clear(self) -> None:
        """Restore the cell file's settings, except the camera's pose."""
        self.condition = self._fresh(self._stream)
        self.view.change(phase_s=self._stream.skew_ms * 1e-3, drop_rate=self._stream.drop_rate)


# -- effects -------------------------------------------------------------------------------------------------
# Image faults: exposure, light, orientation, size, and damaged JPEG data.


LAMP_LEVEL = 110.0
LAMP_REACH = 0.45
"""Sigma of the lamp's light, in image widths, about the upper left corner."""
CUT_SHARE = 0.5
FLIPPED_BYTES = 40
HEADER = 700
"""[bytes] The tables at the start of a JPEG; with bytes inverted behind them, it decodes to a wrong image."""


def exposed(image: ImageArray, gain: float) -> ImageArray:
    """``image`` (h, w) with exposure ``gain``, clipped at white."""
    if gain == 1.0:
        return image
    return np.asarray(cv2.convertScaleAbs(image, alpha=gain), dtype=np.uint8)


def lamp_light(height: int, width: int, level: float = LAMP_LEVEL) -> npt.NDArray[np.float32]:
    """Light (h, w) [grey levels] of a lamp beyond the upper left corner."""
    v, u = np.mgrid[0:height, 0:width].astype(np.float32) / (LAMP_REACH * width)
    return np.asarray(level * np.exp(-0.5 * (u * u + v * v)), dtype=np.float32)


def lit(image: ImageArray, light: npt.NDArray[np.float32]) -> ImageArray:
    """``image`` (h, w) with ``light`` (h, w) added, clipped at white."""
    return np.asarray(cv2.add(image, light, dtype=cv2.CV_8U), dtype=np.uint8)


def turned(image: ImageArray, how: str) -> ImageArray:
    """``flip``: the image upside down; ``mirror``: left and right exchanged; else unchanged."""
    if how == "flip":
        return np.ascontiguousarray(image[::-1, ::-1])
    if how == "mirror":
        return np.ascontiguousarray(image[:, ::-1])
    return image


def even(image: ImageArray, level: int) -> ImageArray:
    """Uniform image of the same size, of grey ``level``."""
    return np.full_like(image, level)


def resized(image: ImageArray, size: tuple[int, int]) -> ImageArray:
    """``image`` resampled to ``size`` (width, height)."""
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def jpeg(image: ImageArray, quality: int) -> bytes:
    """Encode ``image`` (h, w) as a JPEG. Raises EmulationError."""
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise EmulationError(f"an image of {image.shape} cannot be written as JPEG")
    return bytes(data)


def cut(data: bytes) -> bytes:
    """First half of a JPEG's data."""
    return data[: int(len(data) * CUT_SHARE)]


def corrupted(data: bytes, rng: np.random.Generator) -> bytes:
    """A JPEG with some of its bytes inverted, behind its tables."""
    spoilt = bytearray(data)
    for at in rng.integers(min(HEADER, len(data) - 1), len(data), FLIPPED_BYTES).tolist():
        spoilt[at] ^= 0xFF
    return bytes(spoilt)
