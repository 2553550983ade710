"""Runs the fit in its own process and follows it without waiting."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import msgspec

from stereoservo.gateway.messages import CalibrationResult
from stereoservo.kinematics.calibration.trials import TrialData, save_trials
from stereoservo.kinematics.model import CellModel, load_model
from stereoservo.runtime.supervisor import child_environment

FIT_TIMEOUT_S = 600.0


class FitFailedError(Exception):
    """A fit gave no model; ``code`` is the calibration's."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


class FitProgress(msgspec.Struct, frozen=True):
    """How far a fit is."""

    progress: float
    message: str


class Fit:
    """One running fit. ``poll`` gives its progress; ``result`` its model once it has ended."""

    def __init__(self, trials: TrialData, model_path: Path, epoch: int) -> None:
        self.model_path = model_path
        self.epoch = epoch
        self._trials_path = model_path.with_name(f"trials-{epoch:06d}.npz")
        save_trials(trials, self._trials_path)
        self._started = time.monotonic()
        self._errors: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - read when the fit has ended
        self._process = subprocess.Popen(
            [
                sys.executable, "-m", "stereoservo.runtime.fit", str(self._trials_path), str(model_path),
                "--epoch", str(epoch), "--parent", str(os.getpid()),
            ],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=self._errors, env=child_environment(),
        )  # fmt: skip
        assert self._process.stdout is not None
        self._output = self._process.stdout
        os.set_blocking(self._output.fileno(), False)
        self._buffer = b""
        self._last: dict[str, Any] = {}

    def poll(self) -> Iterator[FitProgress]:
        """What it said since the last poll."""
        while chunk := self._output.read():
            self._buffer += chunk
        *lines, self._buffer = self._buffer.split(b"\n")
        for line in lines:
            self._last = msgspec.json.decode(line)
            if "progress" in self._last:
                yield msgspec.convert(self._last, FitProgress)

    @property
    def ended(self) -> bool:
        """Whether the process has ended (it is ended after ``FIT_TIMEOUT_S``)."""
        if time.monotonic() - self._started > FIT_TIMEOUT_S:
            self.cancel()
        return self._process.poll() is not None

    def result(self) -> tuple[CellModel, float]:
        """The model and the seconds it took. Raises FitFailedError, ModelFileError."""
        for _ in self.poll():
            pass
        code = self._process.wait()
        self._output.close()
        self._errors.seek(0)
        said = self._errors.read().decode(errors="replace").strip()
        self._errors.close()
        if failure := self._last.get("error"):
            raise FitFailedError(failure["code"], failure["message"])
        if code != 0:
            last = said.splitlines()[-1] if said else "no message"
            raise FitFailedError("fit_process", f"the fit process ended with exit code {code}: {last}")
        return load_model(self.model_path), time.monotonic() - self._started

    def cancel(self) -> None:
        """End it. Idempotent."""
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()


def calibration_result(model: CellModel, path: Path, seconds: float) -> CalibrationResult:
    """The figures of a fit that clients want. Raises FitFailedError where the model carries no statistics."""
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
    )
