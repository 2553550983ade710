"""Conversion of stamps of devices with a clock of their own to the time of this computer."""

from __future__ import annotations


class DeviceClock:
    """Converts times of a device's own clock to ``context.clock``, by the samples with the shortest delay.

    ``drift``: upper bound of the relative drift of the two clocks. The delay of the fastest sample remains in the
    stamps, which are late by it.
    """

    def __init__(self, drift: float = 2e-4) -> None:
        self._drift = drift
        self._offset_ns = self._device_ns = self._stamp_ns = 0

    def stamp(self, device_s: float, now_ns: int) -> int:
        """Time [ns] of the sample that the device measured at its own time ``device_s`` and that was received at
        ``now_ns``.

        It is never later than ``now_ns`` and never goes back. A device whose time goes back has restarted.
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
