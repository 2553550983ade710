"""Taught goals: what the cameras saw when a goal was shown, by name, with the model's epoch; one JSON file a cell."""

from __future__ import annotations

from pathlib import Path

import msgspec

from stereoservo.kinematics.model import write_atomically
from stereoservo.runtime.commands import FeatureTarget
from stereoservo.runtime.cycle import Event

SCHEMA = 1


class TaughtFileError(Exception):
    """The file of taught goals cannot be used: names the file and the cause."""


class TaughtGoal(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One taught goal: set-points by camera and marker (raw pixels), joints at that moment, wall time of teaching."""

    target: FeatureTarget
    joints: tuple[float, ...] = ()
    created: str = ""


class TaughtFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The whole file."""

    schema: int
    goals: dict[str, TaughtGoal] = {}


def feature_target(event: Event, epoch: int) -> FeatureTarget:
    """Set-points of a ``taught`` event."""
    return FeatureTarget(
        {
            sample.camera: {
                int(marker): (float(pixel[0]), float(pixel[1]))
                for marker, pixel in zip(sample.ids, sample.pixels, strict=True)
            }
            for sample in event.samples
        },
        model_epoch=epoch,
    )


def taught_goal(event: Event, epoch: int, created: str) -> TaughtGoal:
    """A ``taught`` event as it is stored."""
    joints = () if event.joints is None else tuple(float(q) for q in event.joints)
    return TaughtGoal(feature_target(event, epoch), joints, created)


def load_taught(path: Path) -> dict[str, TaughtGoal]:
    """All taught goals of a cell; none where there is no file. Raises TaughtFileError."""
    if not path.exists():
        return {}
    try:
        found = msgspec.json.decode(path.read_bytes(), type=TaughtFile)
    except (OSError, msgspec.MsgspecError) as error:
        raise TaughtFileError(
            f"{path}: cannot be read ({error}); move it away to start without taught goals"
        ) from error
    if found.schema != SCHEMA:
        raise TaughtFileError(f"{path}: schema {found.schema}; this program reads {SCHEMA}")
    return dict(found.goals)


def save_taught(path: Path, goals: dict[str, TaughtGoal]) -> None:
    """Write all taught goals, atomically. Raises OSError."""
    write_atomically(path, msgspec.json.format(msgspec.json.encode(TaughtFile(SCHEMA, goals)), indent=1))
