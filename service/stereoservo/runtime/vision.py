"""The vision process of one camera: driver, detector, priors in, newest observation out.

Errors of the camera are reported and answered by reconnecting with growing pauses, never by ending.
``python -m stereoservo.runtime.vision RUNTIME_DIRECTORY PARENT_PID CAMERA``.
"""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from stereoservo.runtime import plugins
from stereoservo.runtime.cameras import make_camera
from stereoservo.runtime.channel import Channel, ChannelError
from stereoservo.runtime.clock import MonotonicClock
from stereoservo.runtime.handover import SlotError, SlotReader, SlotWriter
from stereoservo.runtime.image_order import RecordedImages, order_path
from stereoservo.runtime.interprocess import (
    OBSERVATION_CAPACITY,
    OBSERVATION_LAYOUT,
    PRIOR_LAYOUT,
    PlanError,
    Report,
    RunPlan,
    encode,
    load_plan,
    prior_decoder,
)
from stereoservo.runtime.lifeline import Termination, die_with_parent, say
from stereoservo.runtime.locks import AlreadyRunningError, FileLock, hardware_lock_path
from stereoservo.runtime.ports import (
    CameraDriver,
    CameraObservation,
    Clock,
    Detector,
    DriverContext,
    DriverError,
    Frame,
    Prior,
)

if TYPE_CHECKING:
    from stereoservo.runtime.image_recording import ImageRecorder

FIRST_PAUSE_S = 0.2
LONGEST_PAUSE_S = 5.0
SILENT_CAMERA_S = 2.0
"""A camera that delivers nothing for so long is closed and opened again."""
PRIOR_MAX_AGE_S = 0.5
EXIT_SETUP = 3


class Reporter:
    """Reports to the gateway, oldest first; what it cannot take yet waits, the oldest give way."""

    def __init__(self, path: Path, origin: str, clock: Clock) -> None:
        self._path = path
        self._origin = origin
        self._clock = clock
        self._waiting: list[bytes] = []
        self._channel: Channel | None = None

    def report(self, kind: str, message: str, images: RecordedImages | None = None) -> None:
        """Queue a report, and log it."""
        say(self._origin, message)
        self._waiting.append(encode(Report(self._origin, kind, message, self._clock.now_ns(), images)))
        del self._waiting[:-64]
        self.flush()

    def flush(self) -> None:
        """Send what waits, as far as the gateway takes it."""
        if not self._waiting:
            return
        if self._channel is None or not self._channel.is_open:
            try:
                self._channel = Channel.connect(self._path)
            except ChannelError:  # the gateway is not up (yet): tried again at the next flush
                return
        while self._waiting and self._channel.send(self._waiting[0]):
            self._waiting.pop(0)


class CameraPipeline:
    """Poll the driver, detect in the newest frame, hand the observation over; then let ``images`` record all frames."""

    def __init__(
        self,
        driver: CameraDriver,
        detector: Detector | None,
        observations: SlotWriter,
        priors: SlotReader,
        clock: Clock,
        images: ImageRecorder | None = None,
    ) -> None:
        self._driver = driver
        self._images = images
        self._detector = detector
        self._observations = observations
        self._priors = priors
        self._clock = clock
        self._prior: Prior | None = None
        self.frames = 0
        self.written = 0

    def open(self) -> None:
        """Connect and start. Raises DriverError."""
        self._driver.configure()
        self._driver.activate()

    def close(self) -> None:
        """Stop and release; idempotent."""
        try:
            self._driver.deactivate()
        except DriverError as error:
            say("vision", f"camera did not deactivate: {error}")
        finally:
            self._driver.close()

    def poll(self) -> bool:
        """Take what arrived; True where an observation was handed over. Raises DriverError."""
        arrived = self._driver.poll()
        if not arrived:
            return False
        newest = arrived[-1]
        self.frames += len(arrived)
        if isinstance(newest, Frame):
            if self._detector is None:
                raise DriverError(
                    "no_detector", "the camera delivers frames and the cell file names no detector"
                )
            observation = self._detector.detect(newest, self._fresh_prior())
        else:
            observation = newest
        assert isinstance(observation, CameraObservation)
        self._observations.write(encode(observation))
        self.written += 1
        if self._images is not None:
            self._images.take(arrived)
        return True

    def _fresh_prior(self) -> Prior | None:
        data = self._priors.poll()
        if data is not None:
            self._prior = prior_decoder.decode(data)
        prior = self._prior
        if prior is None or (self._clock.now_ns() - prior.t_ns) * 1e-9 > PRIOR_MAX_AGE_S:
            return None
        return prior


def run_pipeline(
    pipeline: CameraPipeline,
    report: Callable[[str, str], None],
    ended: Callable[[], bool],
    *,
    camera: str,
    poll_s: float,
    now: Callable[[], int],
    sleep: Callable[[float], None],
    flush: Callable[[], None],
) -> None:
    """Run until ``ended``; every failure is reported once and answered by a reconnect after a growing
    pause.
    """
    pause_s = FIRST_PAUSE_S
    down = False
    while not ended():
        try:
            pipeline.open()
            heard_ns = now()
            while not ended():
                if pipeline.poll():
                    heard_ns = now()
                    pause_s = FIRST_PAUSE_S
                    if down:
                        down = False
                        report("camera_back", f"camera {camera} delivers again")
                elif (now() - heard_ns) * 1e-9 > SILENT_CAMERA_S:
                    raise DriverError("silent", f"no image for {SILENT_CAMERA_S:g} s", retry=True)
                else:
                    sleep(poll_s)
                flush()
        except DriverError as error:
            if not down:
                report("camera_lost", f"camera {camera}: {error}; trying again")
            down = True
        finally:
            pipeline.close()
        until = now() + int(pause_s * 1e9)
        while not ended() and now() < until:
            flush()
            sleep(min(0.05, pause_s))
        pause_s = min(2 * pause_s, LONGEST_PAUSE_S)


def run(plan: RunPlan, camera: str, termination: Termination) -> None:
    """Run the process of ``camera`` until asked to end."""
    directories = plan.directories
    clock = MonotonicClock()
    section = next(section for section in plan.cell.camera if section.name == camera)
    description = next(description for description in plan.cameras if description.name == camera)
    context = DriverContext(
        clock=clock,
        cell=plan.cell.cell.name,
        runtime_dir=Path(plan.runtime),
        cell_dir=Path(plan.cell_path).parent,
        camera=camera,
        seed=plan.seed,
        mount=section.mount,
    )
    path = hardware_lock_path(directories.runtime.parent, section.driver, section.options)
    lock = (
        FileLock(path, f"camera driver {section.driver!r} with these options") if path is not None else None
    )
    driver, detector = make_camera(section, context)
    reporter = Reporter(directories.reports_socket, f"vision-{camera}", clock)
    images: ImageRecorder | None = None
    if description.delivers == "frames":
        from stereoservo.runtime.image_recording import (
            ImageRecorder,
        )  # OpenCV: not for cameras without pictures

        order = order_path(directories)
        images = ImageRecorder(order, camera, section.driver, description.rate_hz, reporter.report)

    def keep() -> None:
        if images is not None:
            images.look(clock.now_ns())
        reporter.flush()

    try:
        with (
            SlotWriter(
                directories.observation_slot(camera), OBSERVATION_CAPACITY, OBSERVATION_LAYOUT
            ) as observations,
            SlotReader(directories.prior_slot(camera), PRIOR_LAYOUT) as priors,
        ):
            run_pipeline(
                CameraPipeline(driver, detector, observations, priors, clock, images),
                reporter.report,
                lambda: termination.asked,
                camera=camera,
                poll_s=min(0.002, 0.1 / description.rate_hz),
                now=clock.now_ns,
                sleep=time.sleep,
                flush=keep,
            )
    finally:
        if images is not None:
            images.close()
        if lock is not None:
            lock.release()


def main() -> int:
    """Entry of the process."""
    runtime, parent, camera = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
    die_with_parent(
        parent, signal.SIGKILL
    )  # nothing to put in order here, and a hung driver must not survive
    termination = Termination()
    try:
        run(load_plan(runtime), camera, termination)
    except (AlreadyRunningError, DriverError, PlanError, SlotError, plugins.PluginError) as error:
        say(f"vision-{camera}", str(error))
        return EXIT_SETUP
    return 0


if __name__ == "__main__":
    sys.exit(main())
