"""Taught goals (set-points observed at teaching, with the cameras of the model at that time), and the JSON file that
stores them by name, with migration of older files.

Schema 2 stores, in addition to the set-points of the moving body, all other observed markers (of the workpiece and the
tool) and the cameras of the model, so that a goal can be transferred to the workpiece's current pose or to other
cameras. Files of schema 1 are read; missing data are taken from the model file of their epoch, if it still exists.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgspec
import numpy as np

from stereoservo.core.cycle import Event
from stereoservo.kinematics.model import CellModel, Stratum
from stereoservo.messages.decoding import DamagedError, decoding
from stereoservo.messages.files import read_bounded, verify_checksum, with_checksum, write_atomically
from stereoservo.messages.goals import FeatureTarget, MarkerId, Pixel

SCHEMA = 2
READABLE_SCHEMAS = (1, 2)
MAX_TAUGHT_BYTES = 1 << 26
ModelOf = Callable[[int], CellModel | None]
"""The model of an epoch, None if its file no longer exists."""


class TaughtFileError(DamagedError):
    """The file of taught goals cannot be used."""


class TaughtCamera(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A camera at the time of teaching: ``matrix`` 3x4 row by row, ``lens`` as in a model, image size [px]."""

    name: str
    matrix: tuple[float, ...]
    lens: tuple[float, ...]
    width: int
    height: int


class TaughtModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The part of the model at the time of teaching that interprets the pixels: its cameras and its frame.

    ``plane_at_infinity`` (4,), ``projective_to_euclidean`` 4x4 row by row, if the stratum has it.
    """

    epoch: int
    stratum: Stratum
    cameras: tuple[TaughtCamera, ...]
    plane_at_infinity: tuple[float, ...]
    projective_to_euclidean: tuple[float, ...] | None = None


class TaughtGoal(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One taught goal, pixels raw.

    ``target``: set-points of the moving body by camera and marker; ``others``: pixels of all other markers, in the same
    form; ``sigmas``: standard deviations [px] of both, if known. ``joints`` and ``created`` (wall time): at the time of
    teaching. ``tool``: the features that define the goal, if they are not the body's own markers. ``model`` is None for
    a file of schema 1 whose model file no longer exists.
    """

    target: FeatureTarget
    joints: tuple[float, ...] = ()
    created: str = ""
    others: dict[str, dict[int, Pixel]] = {}
    sigmas: dict[str, dict[int, float]] = {}
    tool: tuple[MarkerId, ...] = ()
    model: TaughtModel | None = None


class TaughtFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Content of the file of taught goals. ``crc32``: see `messages.files.with_checksum`."""

    schema: int
    goals: dict[str, TaughtGoal] = {}
    crc32: str = ""


def feature_target(event: Event, epoch: int, body: tuple[int, ...] | None = None) -> FeatureTarget:
    """Set-points of a ``taught`` event: of the markers ``body``, or of all."""
    seen = _pixels(event)
    return FeatureTarget(seen if body is None else _some(seen, body, of_body=True), model_epoch=epoch)


def taught_goal(event: Event, model: CellModel, created: str, tool: tuple[MarkerId, ...] = ()) -> TaughtGoal:
    """The goal to store for a ``taught`` event, with the model that was in use."""
    return TaughtGoal(
        feature_target(event, model.epoch, model.marker_ids),
        () if event.joints is None else tuple(float(q) for q in event.joints),
        created,
        _some(_pixels(event), model.marker_ids, of_body=False),
        {
            sample.camera: {
                int(marker): float(np.sqrt(0.5 * np.trace(covariance)))
                for marker, covariance in zip(sample.ids, sample.covariances, strict=True)
            }
            for sample in event.samples
        },
        tool,
        taught_model(model),
    )


def taught_model(model: CellModel) -> TaughtModel:
    """The part of a model that is stored with a taught goal."""
    upgrade = model.projective_to_euclidean
    return TaughtModel(
        model.epoch,
        model.stratum,
        tuple(
            TaughtCamera(
                camera.name,
                tuple(camera.matrix.ravel().tolist()),
                tuple(camera.lens.tolist()),
                camera.width,
                camera.height,
            )
            for camera in model.cameras
        ),
        tuple(model.plane_at_infinity.tolist()),
        None if upgrade is None else tuple(upgrade.ravel().tolist()),
    )


def refined_goal(goal: TaughtGoal, used: CellModel, model: CellModel) -> TaughtGoal:
    """The goal after an on-line refinement of model ``used`` to ``model``. Its pixels are unchanged, because nothing
    moved; its cameras, if they are those of ``used``, are replaced by the refined ones.
    """
    if goal.model is None:
        return goal
    before, after = taught_model(used), taught_model(model)
    known = dict(zip(before.cameras, after.cameras, strict=True))
    cameras = tuple(known.get(camera, camera) for camera in goal.model.cameras)
    if goal.model.epoch != used.epoch:
        return msgspec.structs.replace(goal, model=msgspec.structs.replace(goal.model, cameras=cameras))
    return msgspec.structs.replace(
        goal, model=after, target=msgspec.structs.replace(goal.target, model_epoch=model.epoch)
    )


def _pixels(event: Event) -> dict[str, dict[int, Pixel]]:
    return {
        sample.camera: {
            int(marker): (float(pixel[0]), float(pixel[1]))
            for marker, pixel in zip(sample.ids, sample.pixels, strict=True)
        }
        for sample in event.samples
    }


def _some(pixels: dict[str, dict[int, Pixel]], body: tuple[int, ...], *, of_body: bool) -> dict[str, dict[int, Pixel]]:
    """Pixels of the body's markers, or of the others; cameras without any are left out."""
    kept = {
        camera: {marker: pixel for marker, pixel in points.items() if (marker in body) == of_body}
        for camera, points in pixels.items()
    }
    return {camera: points for camera, points in kept.items() if points}


def load_taught(path: Path, model_of: ModelOf = lambda _: None) -> dict[str, TaughtGoal]:
    """All taught goals of a cell; empty if there is no file. ``model_of``: returns the model of an epoch, for goals of
    schema 1.

    Raises TaughtFileError.
    """
    if not path.exists():
        return {}
    with decoding(partial(TaughtFileError, path)):
        data = read_bounded(path, MAX_TAUGHT_BYTES)
        found = msgspec.json.decode(data, type=TaughtFile)
        if found.schema not in READABLE_SCHEMAS:
            known = " and ".join(str(schema) for schema in READABLE_SCHEMAS)
            raise TaughtFileError(path, f"schema {found.schema}; this program reads {known}")
        for name, goal in found.goals.items():
            _check_shapes(path, name, goal.model)
        verify_checksum(data)
        if found.schema == 1:
            return {name: migrated(goal, model_of(goal.target.model_epoch or 0)) for name, goal in found.goals.items()}
        return dict(found.goals)


def migrated(goal: TaughtGoal, model: CellModel | None) -> TaughtGoal:
    """A goal of schema 1, in which all markers are set-points, with the data that its ``model`` adds."""
    if model is None:
        return goal
    seen = goal.target.set_points
    return msgspec.structs.replace(
        goal,
        target=FeatureTarget(_some(seen, model.marker_ids, of_body=True), goal.target.model_epoch),
        others=_some(seen, model.marker_ids, of_body=False),
        model=taught_model(model),
    )


def _check_shapes(path: Path, name: str, model: TaughtModel | None) -> None:
    if model is None:
        return
    upgrade = model.projective_to_euclidean
    sizes = [("plane_at_infinity", model.plane_at_infinity, 4)]
    sizes += [] if upgrade is None else [("projective_to_euclidean", upgrade, 16)]
    lens = 7 if model.cameras and len(model.cameras[0].lens) == 7 else 4
    for camera in model.cameras:
        sizes += [(f"{camera.name}.matrix", camera.matrix, 12), (f"{camera.name}.lens", camera.lens, lens)]
    for what, values, size in sizes:
        if len(values) != size:
            raise TaughtFileError(path, f"goals.{name}.model: {what} has {len(values)} numbers; {size} are needed")


def save_taught(path: Path, goals: dict[str, TaughtGoal]) -> None:
    """Write all taught goals, atomically. Raises OSError."""
    document = msgspec.json.format(msgspec.json.encode(TaughtFile(SCHEMA, goals)), indent=1)
    write_atomically(path, with_checksum(document))
