"""The vision loop of one camera: polls the driver, detects the markers near their predicted pixels, publishes the
newest observation, and records images on request.

`camera_loop` is the loop on given links and clock; `main` is the entry of its process. After an error of the camera,
the loop reports it and reconnects with growing pauses; it never ends.
``python -m stereoservo.daemon.vision RUNTIME_DIRECTORY PARENT_PID CAMERA``.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Generator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from stereoservo.core.cycle import check_observation
from stereoservo.daemon.camera_setup import make_camera
from stereoservo.daemon.channels.reports import Reporter
from stereoservo.daemon.heartbeat import CAMERA_OPENS_S, VISION_HANG_S, HeartbeatWriter
from stereoservo.daemon.ipc_messages import (
    OBSERVATION_CAPACITY,
    OBSERVATION_LAYOUT,
    PRIOR_LAYOUT,
    PlanError,
    RunPlan,
    decode_prior,
    encode_observation,
    load_plan,
    rounded,
)
from stereoservo.daemon.links import VisionLinks
from stereoservo.daemon.pacing import release_memory
from stereoservo.daemon.process_control import Termination, die_with_parent, write_log
from stereoservo.daemon.seqlock import SlotError, SlotReader, SlotWriter
from stereoservo.messages.decoding import RecordBoundary, cause_of
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.locks import AlreadyRunningError, ChannelLock, hardware_lock_path
from stereoservo.messages.recording_request import request_path
from stereoservo.messages.servo_state import STALE_PERIODS
from stereoservo.numerics.arrays import ImageArray
from stereoservo.ports import plugins
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import (
    CameraDriver,
    CameraObservation,
    Clock,
    Detector,
    DriverError,
    Frame,
    Prior,
)

if TYPE_CHECKING:
    from stereoservo.daemon.preview import PreviewEncoder
    from stereoservo.recording.image_recording import ImageRecorder


FIRST_PAUSE_S = 0.2
LONGEST_PAUSE_S = 5.0
SILENT_CAMERA_S = 2.0
"""Time without data after which a camera is closed and reopened [s]."""
QUIET_PERIODS = 0.6
"""Fraction of a camera's period after a frame without polling: an earlier frame is received a little later."""
POLLS = 2
"""Number of unsuccessful polls per frame above which polling for the next frame starts later."""
PRIOR_MAX_AGE_S = 0.5
EXIT_SETUP = 3


class VisionSlots:
    """`VisionLinks` of a vision process: slots in shared memory. Raises SlotError if another process writes."""

    def __init__(self, directories: CellDirectories, camera: str) -> None:
        self._observations = SlotWriter(directories.observation_slot(camera), OBSERVATION_CAPACITY, OBSERVATION_LAYOUT)
        self._priors = SlotReader(directories.prior_slot(camera), PRIOR_LAYOUT)
        self._boundary = RecordBoundary(directories.prior_slot(camera).name, partial(write_log, "vision"))
        self._prior: Prior | None = None

    def newest_prior(self) -> Prior | None:
        """The newest prior that decodes, of any age; None before the first."""
        data = self._priors.poll()
        if data is not None:
            try:
                self._prior = decode_prior(data)
            except Exception as error:  # a decoder may raise anything
                self._boundary.refuse(error)
        return self._prior

    def publish_observation(self, observation: CameraObservation) -> None:
        """Replace the observation."""
        self._observations.write(encode_observation(observation))

    def close(self) -> None:
        """Release both slots. Idempotent."""
        self._observations.close()
        self._priors.close()


class CameraPipeline:
    """Driver and detector of one camera: publishes the observation of the newest frame; ``images`` records all frames;
    ``preview`` receives the newest. ``beat``: called at every call with the time limit of its next call [s].
    """

    def __init__(
        self,
        driver: CameraDriver,
        detector: Detector | None,
        links: VisionLinks,
        clock: Clock,
        images: ImageRecorder | None = None,
        beat: Callable[[float], None] = lambda limit_s: None,
        preview: PreviewEncoder | None = None,
    ) -> None:
        self._driver = driver
        self._beat = beat
        self._images = images
        self._preview = preview
        self._detector = detector
        self._links = links
        self._clock = clock
        self._light = LightWatch()
        self.frames = 0
        self.written = 0
        self.light: tuple[str, str] | None = None
        """New finding on the light of the newest frame: code and text."""

    def open(self) -> None:
        """Connect and start. Raises DriverError."""
        self._beat(CAMERA_OPENS_S)
        self._driver.configure()
        self._driver.activate()

    def close(self) -> None:
        """Stop and release; idempotent."""
        self._beat(CAMERA_OPENS_S)
        try:
            self._driver.deactivate()
        except DriverError as error:
            write_log("vision", f"camera did not deactivate: {error}")
        finally:
            self._driver.close()

    def poll(self) -> bool:
        """Process the frames that arrived; True if an observation was published. Raises DriverError: the driver's, and
        with code ``frame`` for all other exceptions of driver or detector.
        """
        self._beat(VISION_HANG_S if self.written else CAMERA_OPENS_S)
        try:
            arrived = self._driver.poll()
            if not arrived:
                return False
            self.frames += len(arrived)
            observation = self._observed(arrived[-1])
            check_observation(observation)
            if self._detector is not None:
                observation = rounded(observation)
        except DriverError:
            raise
        except Exception as error:  # a third party's driver or detector may raise anything
            raise DriverError("frame", f"a frame cannot be used: {cause_of(error)}", retry=True) from error
        self._links.publish_observation(observation)
        self.written += 1
        if self._images is not None:
            self._images.take(arrived)
        newest = arrived[-1]
        if isinstance(newest, Frame):
            self.light = self._light.see(newest.image, len(observation.ids), newest.t_shutter_ns)
            if self._preview is not None:
                self._preview.offer(newest, self._clock.now_ns())
        return True

    def _observed(self, newest: Frame | CameraObservation) -> CameraObservation:
        if not isinstance(newest, Frame):
            return newest
        if self._detector is None:
            raise DriverError("no_detector", "the camera delivers frames and the cell file names no detector")
        return self._detector.detect(newest, self._fresh_prior())

    def _fresh_prior(self) -> Prior | None:
        prior = self._links.newest_prior()
        if prior is None or (self._clock.now_ns() - prior.t_ns) * 1e-9 > PRIOR_MAX_AGE_S:
            return None
        return prior


class Quiet:
    """Adaptive pause in the polling of a camera after a frame. It starts at ``QUIET_PERIODS`` of the camera's period
    and grows until a frame arrives after ``POLLS`` unsuccessful polls; it is shortened at once if a frame may have
    waited. ``period_s`` 0: no pause.
    """

    def __init__(self, period_s: float, poll_s: float) -> None:
        self._least_s, self._most_s, self._poll_s = QUIET_PERIODS * period_s, period_s, poll_s
        self._polls = 0
        self._s = self._least_s

    def unsuccessful_poll(self) -> None:
        """Count a poll without a frame."""
        self._polls += 1

    def after_frame(self) -> float:
        """Pause after a poll that returned a frame [s]."""
        if self._polls == 0:
            self._s = max(self._s - POLLS * self._poll_s, self._least_s)
        elif self._polls > POLLS:
            self._s = min(self._s + 0.5 * self._poll_s, self._most_s)
        self._polls = 0
        return self._s


def poll_interval_s(rate_hz: float) -> float:
    """Seconds between two polls of a camera of ``rate_hz`` that has delivered nothing."""
    return min(0.002, 0.1 / rate_hz)


def camera_loop(
    pipeline: CameraPipeline,
    report: Callable[[str, str], None],
    now_ns: Callable[[], int],
    *,
    camera: str,
    poll_s: float,
    period_s: float = 0.0,
) -> Generator[float]:
    """Generator that runs a camera forever and yields the seconds to wait before it is resumed; closing it closes the
    camera. It is polled every ``poll_s``, except during the pause after a frame if frames arrive every ``period_s``
    (`Quiet`).

    Every failure is reported once and followed by a reconnect after a growing pause.
    """
    pause_s = FIRST_PAUSE_S
    quiet = Quiet(period_s, poll_s)
    silent_s = max(SILENT_CAMERA_S, STALE_PERIODS * period_s)
    down = False
    while True:
        try:
            pipeline.open()
            heard_ns = now_ns()
            yield 0.0
            while True:
                polled_ns = now_ns()
                if pipeline.poll():
                    heard_ns = now_ns()
                    pause_s = FIRST_PAUSE_S
                    if down:
                        down = False
                        report("camera_back", f"camera {camera} delivers again")
                    if pipeline.light is not None:
                        report(pipeline.light[0], f"camera {camera} {pipeline.light[1]}")
                    yield max(quiet.after_frame() - (heard_ns - polled_ns) * 1e-9, 0.0)
                elif (now_ns() - heard_ns) * 1e-9 > silent_s:
                    raise DriverError("silent", f"no image for {silent_s:g} s", retry=True)
                else:
                    quiet.unsuccessful_poll()
                    yield poll_s
        except DriverError as error:
            if not down:
                report("camera_lost", f"camera {camera}: {error}; trying again")
            down = True
        finally:
            pipeline.close()
        until = now_ns() + int(pause_s * 1e9)
        while now_ns() < until:
            yield min(0.05, pause_s)
        pause_s = min(2 * pause_s, LONGEST_PAUSE_S)


def run_camera(
    loop: Generator[float],
    ended: Callable[[], bool],
    *,
    sleep: Callable[[float], None],
    between: Callable[[], None],
) -> None:
    """Run a `camera_loop` until ``ended``, calling ``between`` after each of its steps; closes the camera."""
    with closing(loop):
        while not ended():
            pause_s = next(loop)
            between()
            if pause_s > 0.0:
                sleep(pause_s)


def run(plan: RunPlan, camera: str, termination: Termination) -> None:
    """Run the process of ``camera`` until terminated."""
    directories = plan.directories
    clock = MonotonicClock()
    section = next(section for section in plan.cell.camera if section.name == camera)
    description = next(description for description in plan.cameras if description.name == camera)
    path = hardware_lock_path(directories.runtime.parent, section.driver, section.options)
    lock = ChannelLock(path, f"camera driver {section.driver!r} with these options") if path is not None else None
    driver, detector = make_camera(section, plan.driver_context(clock, section))
    reporter = Reporter(directories.reports_socket, f"vision-{camera}", clock)
    images: ImageRecorder | None = None
    preview: PreviewEncoder | None = None
    if description.delivers == "frames":
        # OpenCV: not needed for cameras without images
        from stereoservo.daemon.preview import PreviewEncoder
        from stereoservo.recording.image_recording import ImageRecorder

        order = request_path(directories)
        images = ImageRecorder(order, camera, section.driver, description.rate_hz, reporter.report)
        preview = PreviewEncoder(directories, camera)

    def between() -> None:
        if images is not None:
            images.poll_request(clock.now_ns())
        reporter.flush()

    release_memory()
    try:
        with (
            closing(VisionSlots(directories, camera)) as links,
            closing(HeartbeatWriter(directories.heartbeat_slot(f"vision-{camera}"))) as heartbeat,
        ):
            pipeline = CameraPipeline(driver, detector, links, clock, images, heartbeat.beat, preview)
            loop = camera_loop(
                pipeline,
                reporter.report,
                clock.now_ns,
                camera=camera,
                poll_s=poll_interval_s(description.rate_hz),
                period_s=1.0 / description.rate_hz,
            )
            run_camera(loop, lambda: termination.asked, sleep=clock.sleep, between=between)
    finally:
        if images is not None:
            images.close()
        if preview is not None:
            preview.close()
        if lock is not None:
            lock.release()


def main() -> int:
    """Entry of the process."""
    runtime, parent, camera = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
    die_with_parent(parent, signal.SIGKILL)  # no cleanup is needed, and a hung driver must not survive
    termination = Termination()
    try:
        run(load_plan(runtime), camera, termination)
    except (AlreadyRunningError, DriverError, PlanError, SlotError, plugins.PluginError) as error:
        write_log(f"vision-{camera}", str(error))
        return EXIT_SETUP
    return 0


# -- light of images -----------------------------------------------------------------------------------------
# Causes of undetected markers: an image that is too dark, or too bright.


UNSEEN_S = 1.0
"""Time without a marker after which the image is examined, and then the interval of examinations [s]."""
LEAST_CONTRAST = 30.0
"""Grey levels between dark and bright that the shipped detectors require."""
SATURATED, MUCH_SATURATED = 254, 0.3
"""Grey level of a saturated pixel, and the fraction of such pixels that hides markers."""
STRIDE = 4
"""Subsampling: each n-th row and column is examined."""


def judge_light(image: ImageArray) -> tuple[str, str] | None:
    """Code and text of a fault of the light in ``image`` (h, w), None if there is none."""
    grey = image[::STRIDE, ::STRIDE]
    dark, bright = (float(level) for level in np.percentile(grey, [1.0, 99.5]))
    cut = float((grey >= SATURATED).mean())
    if cut > MUCH_SATURATED:
        return "camera_glare", (
            f"{100 * cut:.0f} % of its pixels are white to the limit, at most {100 * MUCH_SATURATED:.0f} % are well: "
            "shorten the exposure, lower the gain, close the iris, or turn the lamp away"
        )
    if bright - dark < LEAST_CONTRAST and bright < 128.0:
        return "camera_dark", (
            f"its picture has {bright - dark:.0f} grey levels between dark and bright, the brightest {bright:.0f} of "
            f"255; {LEAST_CONTRAST:.0f} are needed: more light, a longer exposure, more gain, or take off the cap"
        )
    return None


class LightWatch:
    """Reports once when a camera sees no marker because of its light, and once when it sees one again."""

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._code = ""

    def see(self, image: ImageArray, markers: int, t_ns: int) -> tuple[str, str] | None:
        """Code and text of a change of the light, given an image taken at ``t_ns`` with ``markers`` detected markers:
        ``camera_dark``, ``camera_glare``, ``camera_light``; else None.
        """
        if self._last_ns is None or markers:
            self._last_ns = t_ns
        if markers:
            was, self._code = self._code, ""
            return ("camera_light", "sees markers again") if was else None
        if (t_ns - self._last_ns) * 1e-9 < UNSEEN_S:
            return None
        self._last_ns = t_ns
        found = judge_light(image)
        code = "" if found is None else found[0]
        new, self._code = code != self._code, code or self._code
        return (code, f"sees no marker: {found[1]}") if found is not None and new else None


if __name__ == "__main__":
    sys.exit(main())
