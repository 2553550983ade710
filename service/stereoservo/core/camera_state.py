"""State of each camera from step to step: its estimate and its newest frame. Both are numbers and arrays in the block
(`core.block`), where kernels access them by the number of the camera.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from typing import Any, Self

import numpy as np

from stereoservo.numerics.arrays import FloatArray, IntArray

KINDS: Mapping[str, Any] = {"int": ctypes.c_int64, "float": ctypes.c_double, "bool": ctypes.c_bool}


class Kept(ctypes.Structure):
    """Numbers with their arrays, all of which are written out by name, in the order of the class."""

    def kept(self) -> dict[str, Any]:
        """All values by name."""
        return {name: getattr(self, name) for name in type(self).__annotations__}

    def count_as(self, other: Self) -> None:
        """Copy the numbers of another one."""
        ctypes.memmove(ctypes.byref(self), ctypes.byref(other), ctypes.sizeof(self))

    def become(self, other: Self) -> None:
        """Copy numbers and arrays of another one, of the same size. Raises ValueError."""
        self.count_as(other)
        for name, array in vars(self).items():
            array[:] = getattr(other, name)


class CameraEstimate(Kept):
    """Estimate from the frames of one camera, for each marker of the model.

    ``innovation`` (m, 2) [px]: filtered difference observed - predicted.
    ``sigma`` (m,) [px]: of one observation.
    ``seen_ns`` (m,): shutter time of the last accepted observation, 0 = never.
    """

    innovation: FloatArray
    sigma: FloatArray
    seen_ns: IntArray
    last_seq: int
    last_visible: int
    accepted_ns: int
    """Shutter time of the last frame with three or more accepted markers."""
    frames: int
    rejected_frames: int
    """Consecutive frames of which the gate rejected more than half of the markers."""
    agreeing_frames: int
    """Consecutive frames that the model explains well: required for a suspect model to be trusted again."""
    rms_px: float
    offset_ns: int
    """Delay of its shutter relative to its stamps [ns], as far as known."""
    _fields_ = [(name, KINDS[kind]) for name, kind in __annotations__.items() if kind in KINDS]

    def __init__(self, markers: int, offset_ns: int = 0) -> None:
        """No observations of ``markers`` markers; ``offset_ns``: of the shutter stamps."""
        super().__init__(last_seq=-1, offset_ns=offset_ns)
        self.innovation, self.sigma = np.zeros((markers, 2)), np.ones(markers)
        self.seen_ns = np.zeros(markers, np.int64)


class CameraTiming(Kept):
    """Sums over frames of one camera, weighted: ``product`` of velocities and innovations, ``square`` of velocities."""

    product: float
    square: float
    seen_ns: int
    _fields_ = [(name, KINDS[kind]) for name, kind in __annotations__.items()]


class CameraMonitor(Kept):
    """Residuals of one camera's newest frame from the prediction at its shutter time: markers of the model, then static
    points.

    ``innovation`` (k, 2) [px], ``spread`` (k, 2, 2): covariance from detector and timing, ``seen`` (k,) 1 or 0,
    ``velocity`` (k, 2) [px/s].
    ``q`` (n,): joints.
    ``timing``: timing sums from moving markers.
    ``fresh``: the frame arrived in this step.
    ``looked``: a round has examined it.
    ``chi2`` per degree of freedom, ``rms_px`` and the ``worst`` row: of this frame alone.
    """

    innovation: FloatArray
    spread: FloatArray
    seen: FloatArray
    velocity: FloatArray
    q: FloatArray
    timing: CameraTiming
    t_ns: int
    fresh: bool
    looked: bool
    chi2: float
    rms_px: float
    worst: int
    worst_px: float
    _fields_ = [
        *((name, KINDS[kind]) for name, kind in __annotations__.items() if kind in KINDS),
        ("timing", CameraTiming),
    ]

    def __init__(self, rows: int, joints: int) -> None:
        """No observations of ``rows`` markers and static points."""
        super().__init__(looked=True, worst=-1)
        self.innovation, self.spread, self.seen = np.zeros((rows, 2)), np.zeros((rows, 2, 2)), np.zeros(rows)
        self.velocity, self.q = np.zeros((rows, 2)), np.zeros(joints)


NOTHING_KNOWN, NOTHING_SEEN = CameraEstimate(0), CameraMonitor(0, 0)
"""Read-only."""


def camera_read(kind: type, kept: Mapping[str, Any]) -> CameraEstimate | CameraMonitor:
    """The estimate or the frame from the values ``kept`` written by `kept`; numbers that are missing are initial ones.
    Raises ValueError or TypeError if ``kept`` is invalid.
    """
    sizes = ("sigma",) if kind is CameraEstimate else ("seen", "q")
    if not all(isinstance(kept.get(name), np.ndarray) for name in sizes):
        raise ValueError(f"a camera without {' and '.join(sizes)}")
    found: CameraEstimate | CameraMonitor = kind(*(len(kept[name]) for name in sizes))
    for name, array in vars(found).items():
        if getattr(kept.get(name), "shape", None) != array.shape:
            raise ValueError(f"a camera without {name} of shape {array.shape}")
        array[:] = kept[name]
    for name, value in kept.items():
        if name == "timing":
            for number, stored in value.items():
                setattr(found.timing, number, stored)
        elif name in type(found).__annotations__ and name not in vars(found):
            setattr(found, name, value)
    return found
