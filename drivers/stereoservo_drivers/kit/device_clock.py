"""Stamps of devices that send a time of their own with their samples, in the time of this computer."""

from __future__ import annotations


class DeviceClock:
    """Brings the times of a device's own clock to ``context.clock``, by the samples that came through fastest.

    ``drift``: the two clocks run apart by less than this share. What the fastest sample took stays in the stamps, which
    are that much late.
    """

    def __init__(self, drift: float = 2e-4) -> None:
        self._drift = drift
        self._offset_ns = self._device_ns = self._stamp_ns = 0

    def stamp(self, device_s: float, now_ns: int) -> int:
        """Time [ns] of the sample that the device measured at its own time ``device_s`` and that is here at ``now_ns``.

        It is never later than ``now_ns`` and never goes back. A device whose time goes back has started anew.
        """
        device_ns = round(device_s * 1e9)
        lateness_ns = now_ns - device_ns
        if not self._stamp_ns or device_ns < self._device_ns:
            self._offset_ns = lateness_ns
        else:
            widened_ns = self._offset_ns + round(self._drift * (device_ns - self._device_ns))
            self._offset_ns = min(widened_ns, lateness_ns)
        self._device_ns = device_ns
        self._stamp_ns = max(self._stamp_ns, device_ns + self._offset_ns)
        return self._stamp_ns
