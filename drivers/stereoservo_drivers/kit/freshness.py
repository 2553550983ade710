"""Freshness of a device's samples: the newest sample, and a fault once it is too old."""

from __future__ import annotations

from stereoservo.ports.devices import DriverError, JointState


class Freshness:
    """Stores the newest sample. If it is older than ``limit_s``, reading it is a fault."""

    def __init__(self, limit_s: float) -> None:
        self._limit_ns = round(limit_s * 1e9)
        self._newest: JointState | None = None

    def put(self, sample: JointState) -> JointState:
        """Store a new sample, and return it."""
        self._newest = sample
        return sample

    def newest(self, now_ns: int) -> JointState:
        """The newest sample. Raises DriverError: ``no_sample`` before the first, ``stale`` beyond the limit."""
        if self._newest is None:
            raise DriverError("no_sample", "the device has told no positions yet", retry=True)
        age_ns = now_ns - self._newest.t_ns
        if age_ns > self._limit_ns:
            raise DriverError(
                "stale",
                f"the newest positions are {age_ns * 1e-6:.0f} ms old, {self._limit_ns * 1e-6:.0f} ms are allowed; is "
                "the device powered and its cable whole?",
                retry=True,
                age_ms=age_ns * 1e-6,
            )
        return self._newest
