"""Store of learnt models: what was learnt once from the same data by the same code is read again.

A model's key is the hash of all that determines it: what it was learnt from, the source files that did it, and the
versions of the libraries and the processor. So an edit or an upgrade never finds an outdated model.
"""

from __future__ import annotations

import fcntl
import functools
import hashlib
import importlib.metadata
import importlib.util
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import llvmlite.binding
import msgspec
import numpy as np

from stereoservo.calibration.self_calibration import fit_model
from stereoservo.calibration.trial_data import TrialData
from stereoservo.kinematics.model import CellModel, ModelFileError, decode_model, encode_model, load_model
from stereoservo.messages.files import write_atomically
from stereoservo.numerics.kernel_cache import file_hash

CACHE_VARIABLE = "STEREOSERVO_CACHE_DIR"
RELEARN_VARIABLE = "STEREOSERVO_RELEARN"
"""Environment variable by which `relearning` reaches the processes of an experiment."""
LIMIT_BYTES = 64_000_000
"""Of all kept models; those that were not used for the longest time are removed."""
FIT = tuple(f"stereoservo.{package}" for package in ("numerics", "geometry", "kinematics", "calibration"))
"""The packages whose code makes a model of trials."""
WHOLE = ("stereoservo", "stereoservo_drivers", "stereoservo_sim")
"""The packages whose code also moves a simulated arm and takes its pictures."""
LIBRARIES = ("numpy", "scipy", "numba", "opencv-python-headless", "pybullet")


class KeptModel(NamedTuple):
    """A learnt model. ``found``: it was in the store; ``path``: its file there, None if it could not be stored."""

    model: CellModel
    found: bool
    path: Path | None

    @property
    def facts(self) -> dict[str, object]:
        """Which model it is, and when it was learnt, for reports."""
        return {
            "learnt": self.model.created,
            "kept": self.found,
            "file": None if self.path is None else str(self.path),
        }


def models_folder() -> Path:
    """Folder of the kept models in ``$STEREOSERVO_CACHE_DIR``, else ``$XDG_CACHE_HOME/stereoservo``, else
    ``~/.cache/stereoservo``.
    """
    if given := os.environ.get(CACHE_VARIABLE):
        return Path(given).absolute() / "models"
    given = os.environ.get("XDG_CACHE_HOME", "")
    # The specification of these directories requires that a relative path is ignored.
    base = Path(given) if given.startswith("/") else Path.home() / ".cache"
    return base / "stereoservo" / "models"


@contextmanager
def relearning(relearn: bool = True) -> Iterator[None]:
    """With ``relearn``, nothing is read from the store in the meantime, by this process and those that it starts."""
    before = os.environ.get(RELEARN_VARIABLE, "")
    os.environ[RELEARN_VARIABLE] = "1" if relearn else before
    try:
        yield
    finally:
        os.environ[RELEARN_VARIABLE] = before


def model_of_trials(trials: TrialData) -> KeptModel:
    """The model, epoch 1, that is fitted to ``trials``. Raises CalibrationError."""
    return kept_model(trials, lambda: fit_model(trials, epoch=1).model, FIT)


def kept_model(given: object, learn: Callable[[], CellModel], packages: tuple[str, ...] = WHOLE) -> KeptModel:
    """The model that ``learn`` makes of ``given``, by the code of ``packages`` alone.

    ``given``: all its inputs, as msgspec encodes them, with arrays. Processes that need the same model at once wait for
    the first of them. Without a folder to write to, every call learns. Raises what ``learn`` raises.
    """
    key = _key(given, packages)
    path = models_folder() / f"{key}.json"
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        lock = (path.parent / "lock").open("ab")
    except OSError as error:
        _warn_once(f"learnt models are not kept: {path.parent}: {error.strerror}; {CACHE_VARIABLE} sets a directory")
        return KeptModel(_as_stored(learn())[0], False, None)
    with lock:
        fcntl.lockf(lock, fcntl.LOCK_EX, 1, int(key[:8], 16))  # a byte for each key
        found = None if os.environ.get(RELEARN_VARIABLE) else _read(path)
        if found is not None:
            return KeptModel(found, True, path)
        model, data = _as_stored(learn())
        return KeptModel(model, False, path if _write(path, data) else None)


def _read(path: Path) -> CellModel | None:
    """A kept model, which thereby is the last one used; None if there is none, or if its file is damaged."""
    try:
        model = load_model(path)
        os.utime(path)
    except (ModelFileError, OSError):
        return None
    return model


def _as_stored(model: CellModel) -> tuple[CellModel, bytes]:
    """A new model with the time, as it is read from its file again, and its file's content."""
    now = datetime.now(UTC).isoformat(timespec="seconds")
    data = encode_model(msgspec.structs.replace(model, created=now))
    return decode_model(data), data


def _write(path: Path, data: bytes) -> bool:
    """Whether the model could be written; the oldest ones beyond the limit are removed."""
    try:
        write_atomically(path, data)
        sizes = {file: file.stat() for file in path.parent.glob("*.json")}
    except OSError as error:
        _warn_once(f"learnt models are not kept: {path.parent}: {error.strerror}; {CACHE_VARIABLE} sets a directory")
        return False
    total = 0
    for file, status in sorted(sizes.items(), key=lambda item: item[1].st_mtime_ns, reverse=True):
        total += status.st_size
        if total > LIMIT_BYTES and file != path:
            file.unlink(missing_ok=True)
    return True


@functools.cache
def _warn_once(text: str) -> None:
    print(text, file=sys.stderr)


def _key(given: object, packages: tuple[str, ...]) -> str:
    return hashlib.sha256(
        msgspec.msgpack.encode((given, code_hash(packages), _machine()), enc_hook=_exact, order="deterministic")
    ).hexdigest()[:32]


def _exact(value: Any) -> object:
    """Arrays and numbers of numpy to the bit."""
    if isinstance(value, np.ndarray | np.generic) and not value.dtype.hasobject:
        return value.dtype.str, value.shape, value.tobytes()
    raise TypeError(f"a model's inputs cannot have {type(value).__name__}")


@functools.cache
def code_hash(packages: tuple[str, ...]) -> str:
    """Hash of the source files of ``packages``."""
    hashed = hashlib.sha256()
    for name in packages:
        spec = importlib.util.find_spec(name)
        assert spec is not None
        for root in spec.submodule_search_locations or ():
            for file in sorted(Path(root).rglob("*.py")):
                hashed.update(f"{name} {file.relative_to(root)} {file_hash(str(file))}\n".encode())
    return hashed.hexdigest()


@functools.cache
def _machine() -> tuple[str, ...]:
    """Versions of Python and the numerical libraries, and the processor: results depend on them in their last bits."""
    versions = []
    for name in LIBRARIES:
        with suppress(importlib.metadata.PackageNotFoundError):
            versions.append(f"{name} {importlib.metadata.version(name)}")
    return sys.version, llvmlite.binding.get_host_cpu_name(), *versions
