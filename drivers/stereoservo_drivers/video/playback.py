"""Playback of a recording on the clock, in the caller's thread: due frames with their stamps."""

from __future__ import annotations

from stereoservo.ports.devices import Clock, DriverError, Frame
from stereoservo_drivers.video.options import Place, VideoOptions, frozen_frames
from stereoservo_drivers.video.pictures import one_channel
from stereoservo_drivers.video.recorded import EpisodePictures, Recording, open_recording
from stereoservo_drivers.video.sources import Settings
from stereoservo_drivers.video.stream_monitor import Watch

MOST_A_POLL = 8
"""Frames that one poll passes over when it comes late: a bound of its time."""


class Playback:
    """Frames of a recording at their times; the first one is due when delivery begins.

    With pace ``every`` each poll gives the next frame with the recording's own stamps, whatever the clock's time.
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
        """Start delivery: the next frame is due now; of an episode that is played again and again, the one that the
        clock's time is of. Raises DriverError.
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
        """The frame to deliver; None where it repeats the last image."""
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
