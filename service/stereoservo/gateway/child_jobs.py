"""Child processes that fit or check a model, polled without blocking for their progress, result or failure."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import IO, Any

import msgspec

from stereoservo.calibration.fit_assessment import Acceptance
from stereoservo.calibration.trial_data import TrialData, figures_file, report_folder, save_trials, trials_file
from stereoservo.daemon.process_control import child_environment, write_log
from stereoservo.kinematics.model import CellModel, load_model
from stereoservo.messages.check_report import CheckReport, ZeroReset
from stereoservo.messages.decoding import RecordBoundary
from stereoservo.messages.wire import CalibrationResult

FIT_TIMEOUT_S = 600.0


class FitFailedError(Exception):
    """A fit yielded no model, or a check no report; ``code`` is the calibration's error code."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


class FitProgress(msgspec.Struct, frozen=True):
    """Progress of a fit."""

    progress: float
    message: str


class ChildJob:
    """A child process that prints JSON objects, one per line. ``said`` holds all of them except progress."""

    timeout_s = FIT_TIMEOUT_S

    def __init__(self, module: str, *arguments: str) -> None:
        self._started = time.monotonic()
        self._errors: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - read when the process has ended
        self._process = subprocess.Popen(
            [sys.executable, "-m", module, *arguments, "--parent", str(os.getpid())],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            env=child_environment(),
        )
        assert self._process.stdout is not None
        self._output = self._process.stdout
        os.set_blocking(self._output.fileno(), False)
        self._buffer = b""
        self._boundary = RecordBoundary(f"output of {module}", partial(write_log, "gateway"))
        self.output: dict[str, Any] = {}

    def poll(self) -> Iterator[FitProgress]:
        """Progress printed since the last poll."""
        while chunk := (b"" if self._output.closed else self._output.read()):
            self._buffer += chunk
        *lines, self._buffer = self._buffer.split(b"\n")
        for line in lines:
            message: dict[str, Any] = {}
            step: FitProgress | None = None
            with self._boundary:  # a library may print, too
                message = msgspec.json.decode(line, type=dict[str, Any])
                step = msgspec.convert(message, FitProgress) if "progress" in message else None
            if step is not None:
                yield step
            else:
                self.output |= message

    @property
    def seconds(self) -> float:
        """Run time of the process [s]."""
        return time.monotonic() - self._started

    @property
    def ended(self) -> bool:
        """Whether the process has ended (it is killed after ``timeout_s``)."""
        if self.seconds > self.timeout_s:
            self.cancel()
        return self._process.poll() is not None

    def finished(self) -> bool:
        """Whether the process has ended, with all its output read; its progress is dropped."""
        ended = self.ended  # read first, so that output printed before the end is processed, too
        for _ in self.poll():
            pass
        return ended

    def require(self, key: str) -> Any:
        """The value printed under ``key``. Raises FitFailedError with the child's own error or exit status."""
        if key in self.output:
            return self.output[key]
        if failure := self.output.get("error"):
            raise FitFailedError(failure["code"], failure["message"])
        code = self._process.wait()
        self._errors.seek(0)
        errors = self._errors.read().decode(errors="replace").strip()
        last = errors.splitlines()[-1] if errors else "no message"
        raise FitFailedError("fit_process", f"the process ended with exit code {code}: {last}")

    def close(self) -> None:
        """Terminate the process and release its resources. Idempotent."""
        self.cancel()
        self._output.close()
        self._errors.close()

    def cancel(self) -> None:
        """Terminate the process. Idempotent."""
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()


class FitJob(ChildJob):
    """A running fit: yields a model or the cause of its failure, and later a report."""

    def __init__(self, trials: TrialData, model_path: Path, epoch: int, known_length: str = "") -> None:
        self.model_path = model_path
        self.trials_path = trials_file(model_path, epoch)
        self.report_path = report_folder(model_path) / "index.html"
        save_trials(trials, self.trials_path)
        super().__init__(
            "stereoservo.daemon.jobs.fit_job",
            str(self.trials_path),
            str(model_path),
            "--epoch",
            str(epoch),
            *(["--known-length", known_length] if known_length else []),
        )
        self._seconds: float | None = None

    @property
    def decided(self) -> bool:
        """Whether the model, or the cause of the failure, is available."""
        return "model" in self.output or "error" in self.output or self.ended

    def model(self) -> tuple[CellModel, Acceptance, float]:
        """The model, its notes, and the duration of the fit [s]. Raises FitFailedError, ModelFileError."""
        self.require("model")
        if self._seconds is None:
            self._seconds = self.seconds
        return load_model(self.model_path), msgspec.convert(self.output["verdict"], Acceptance), self._seconds


class CheckJob(ChildJob):
    """A running check of a model. ``reset_to``: file for a model, with ``epoch``, with drifted joint zeros reset."""

    def __init__(
        self, check: TrialData, model_path: Path, history: Path, limit_px: float, *, body_moves: bool = False,
        reset_to: Path | None = None, epoch: int = 0,
    ) -> None:  # fmt: skip
        path = model_path.with_name("check.npz")
        save_trials(check, path)
        self.reset_to = reset_to
        reset_arguments = [] if reset_to is None else ["--reset-to", str(reset_to), "--epoch", str(epoch)]
        reset_arguments += ["--body-moves"] if body_moves else []
        super().__init__(
            "stereoservo.daemon.jobs.check_job",
            str(path),
            str(model_path),
            str(history),
            "--limit-px",
            repr(limit_px),
            *reset_arguments,
        )

    def report(self) -> CheckReport:
        """The report of the check. Raises FitFailedError."""
        return msgspec.convert(self.require("check"), CheckReport)

    def reset(self) -> tuple[CellModel, ZeroReset]:
        """The model with corrected zeros, and the corrections. Raises FitFailedError, ModelFileError."""
        reset = msgspec.convert(self.require("reset"), ZeroReset)
        return load_model(Path(reset.model)), reset


def calibration_result(
    model: CellModel,
    path: Path,
    verdict: Acceptance,
    report: Path | None,
    trials: Path | None,
    seconds: float,
) -> CalibrationResult:
    """Figures of a fit for clients. Raises FitFailedError if the model has no statistics."""
    statistics = model.statistics
    if statistics is None:
        raise FitFailedError("no_statistics", f"{path}: the fitted model carries no statistics")
    return CalibrationResult(
        rms_px=statistics.rms_px,
        per_joint_px={joint.name: joint.rms_px for joint in statistics.joints},
        covariance_ok=statistics.chi2_ok,
        model=str(path),
        epoch=model.epoch,
        stratum=model.stratum,
        chi2=statistics.chi2,
        degrees_of_freedom=statistics.degrees_of_freedom,
        measurements=statistics.measurements,
        parameters=statistics.parameters,
        outliers=statistics.outliers,
        joints=len(model.joint_names),
        images=statistics.images,
        seconds=seconds,
        verdict=verdict.text,
        grade=verdict.grade,
        report="" if report is None else str(report),
        trials="" if trials is None else str(trials),
        figures=str(figures_file(path)),
    )
