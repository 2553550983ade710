"""The source of a live camera's pictures, by the kind of its place."""

from __future__ import annotations

from stereoservo.ports.devices import Clock
from stereoservo_drivers.video.genicam import GenicamSource
from stereoservo_drivers.video.mjpeg import MjpegSource
from stereoservo_drivers.video.options import Place, VideoOptions
from stereoservo_drivers.video.sources import CaptureSource, LiveSource


def live_source(place: Place, options: VideoOptions, clock: Clock) -> LiveSource:
    """A source for a ``place`` that delivers images by itself; not connected yet."""
    if place.kind == "http":
        return MjpegSource(place, options, clock)
    if place.kind == "genicam":
        return GenicamSource(place, options, clock)
    return CaptureSource(place, options, clock)
