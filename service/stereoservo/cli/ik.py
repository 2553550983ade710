"""Command ``stereoservo ik``: all postures in which the learnt arm reaches a goal, with what each costs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stereoservo.cli.goal import make_goal, target_tree
from stereoservo.cli.output import CellArgument, CommandError, JsonOption, OperatorOption, SetPointsOption, emit
from stereoservo.client import Client
from stereoservo.client.errors import RefusedError
from stereoservo.messages.cell_file import CellFile, load_cell_file
from stereoservo.messages.directories import cell_directories
from stereoservo.messages.discovery import find_daemon

if TYPE_CHECKING:
    from stereoservo.kinematics.inverse.postures import Postures
    from stereoservo.kinematics.model import CellModel
    from stereoservo.numerics.arrays import FloatArray

OWN_SIGMA_PX = 0.1
"""Difference of images and model in addition to the stated noise [px], if the fit does not report it."""


@dataclass(frozen=True, eq=False)
class LearntArm:
    """A cell on this host: its file, its model and the current joints ``now`` by name, None if no daemon runs it."""

    cell: CellFile
    model: CellModel
    now: dict[str, float] | None

    @property
    def limits(self) -> FloatArray:
        """Joint limits (n, 2) [rad or m], infinite if the cell file has none."""
        import numpy as np

        stated = {limit.joint: (limit.min, limit.max) for limit in self.cell.safety.limit}
        margin = self.cell.safety.position_margin
        ends = np.array([stated.get(name, (-math.inf, math.inf)) for name in self.model.joint_names])
        return np.asarray(ends + np.array([margin, -margin]), dtype=np.float64)


def ik(
    cell: CellArgument,
    name: Annotated[str, typer.Argument(metavar="[GOAL]", help="Name of a taught goal.")] = "",
    set_points: SetPointsOption = None,
    operator: OperatorOption = None,
    json: JsonOption = False,
) -> None:
    """List all postures in which the learnt arm reaches a goal: room to the limits, and of a live cell the way there.

    `stereoservo goal CELL GOAL --posture N` goes to one of them. Run it on the cell's host; CELL may be its cell file.
    """
    target = target_tree(name, None, set_points, {}, None, None)
    arm = learnt_arm(cell, operator)
    found = postures_of(arm, target)
    rows = [_row(arm, found, number) for number in range(len(found.images.solutions))]
    if not rows:
        raise CommandError("no_posture", _why_none(arm, found))
    if arm.now is not None:
        with Client(arm.cell.cell.name, operator=operator) as client:
            for row in rows:
                row |= _way(client, target, row["joints"])
    emit(
        {
            "case": found.recognition.case,
            "outcome": found.found.outcome,
            "postures": rows,
            "model_epoch": arm.model.epoch,
        },
        _text(arm, found, rows),
        json,
    )


def posture(cell: str, target: dict[str, Any], number: int, operator: str | None) -> dict[str, float]:
    """Joints by name of the posture ``number``, counted as `ik` lists them. Raises CommandError."""
    arm = learnt_arm(cell, operator)
    found = postures_of(arm, target)
    solutions = found.images.solutions
    if not 1 <= number <= len(solutions):
        told = _why_none(arm, found) if not solutions else f"1 to {len(solutions)} are valid: see `stereoservo ik`"
        raise CommandError("usage", f"--posture {number}: {told}")
    return dict(zip(arm.model.joint_names, solutions[number - 1].q.tolist(), strict=True))


def learnt_arm(cell: str, operator: str | None) -> LearntArm:
    """Cell file, model and current joints of a cell on this host.

    Raises CommandError, NotRunningError, CellFileError, ClientError.
    """
    from stereoservo.gateway.persistence import ModelStore

    live = not cell.endswith(".toml")
    described = load_cell_file(Path(find_daemon(cell).cell_path) if live else Path(cell))
    directory, now = cell_directories(described.cell.name).models, None
    models = ModelStore(directory)
    epochs = models.epochs() if directory.is_dir() else []
    if live:
        with Client(cell, operator=operator) as client:
            status = client.status()
        epochs, now = [status.model_epoch] * bool(status.model_epoch), dict(status.joints)
    for epoch in reversed(epochs):
        if (model := models.of_epoch(epoch)) is not None:
            return LearntArm(described, model, now)
    damaged = f"; damaged: {', '.join(str(models.path(epoch)) for epoch in epochs)}" if epochs else ""
    raise CommandError(
        "no_model",
        f"the cell {described.cell.name} has no model{damaged}: "
        f"`stereoservo calibrate {described.cell.name}` makes one",
    )


def postures_of(arm: LearntArm, target: dict[str, Any]) -> Postures:
    """All postures that reach a ``target`` in wire format; their numbers do not change when the arm moves."""
    import numpy as np

    from stereoservo.kinematics.inverse.postures import postures

    pixels, sigma = _images(arm, target)
    seed = None if arm.now is None else np.array([arm.now[name] for name in arm.model.joint_names])
    return postures(arm.model, pixels, sigma, limits=arm.limits, seed=seed)


def _images(arm: LearntArm, target: dict[str, Any]) -> tuple[FloatArray, FloatArray]:
    """Pixels (c, m, 2) of the model's markers and their standard deviations (c, m) [px]."""
    import numpy as np

    from stereoservo.daemon.taught_goals import load_taught

    model = arm.model
    shape = len(model.cameras), len(model.marker_ids)
    pixels, sigma = np.full((*shape, 2), np.nan), np.zeros(shape)
    stated: dict[str, dict[int, float]] = {}
    if target["kind"] == "taught":
        goals = load_taught(cell_directories(arm.cell.cell.name).taught)
        if target["name"] not in goals:
            raise CommandError(
                "unknown_goal", f"no taught goal {target['name']!r}; taught: {', '.join(sorted(goals)) or 'none'}"
            )
        goal = goals[target["name"]]
        seen, stated = goal.target.set_points, goal.sigmas
    else:
        seen = {
            camera: {int(k): tuple(v) for k, v in points.items()} for camera, points in target["set_points"].items()
        }
    names = [camera.name for camera in model.cameras]
    unknown = sorted(set(seen) - set(names))
    if unknown:
        raise CommandError("unknown_camera", f"the model has no camera {', '.join(unknown)}; it has {', '.join(names)}")
    for c, name in enumerate(names):
        for m, marker in enumerate(model.marker_ids):
            if marker in seen.get(name, {}):
                pixels[c, m] = seen[name][marker]
                sigma[c, m] = stated.get(name, {}).get(marker, 0.0)
    own = OWN_SIGMA_PX if model.statistics is None else max(OWN_SIGMA_PX, model.statistics.rms_px)
    return pixels, np.asarray(np.hypot(sigma, own), dtype=np.float64)


def _row(arm: LearntArm, found: Postures, number: int) -> dict[str, Any]:
    import numpy as np

    model, answer = arm.model, found.images.solutions[number]
    limits = arm.limits
    room = np.minimum(answer.q - limits[:, 0], limits[:, 1] - answer.q)
    nearest = int(room.argmin())
    return {
        "number": number + 1,
        "joints": dict(zip(model.joint_names, answer.q.tolist(), strict=True)),
        "deviations": dict(zip(model.joint_names, answer.deviations.tolist(), strict=True)),
        "cost": answer.cost,
        "nearest_limit": model.joint_names[nearest],
        "room": float(room[nearest]) if math.isfinite(room[nearest]) else None,
    }


def _way(client: Client, target: dict[str, Any], joints: dict[str, float]) -> dict[str, Any]:
    """Reply of a live cell to a plan that ends in the posture, without motion."""
    goal = make_goal(target, posture=joints)
    try:
        plan = client.check(goal).plan
    except RefusedError as refused:
        return {"refused": refused.reply.message, "seconds": None, "approaches": []}
    if plan is None:
        return {"refused": None, "seconds": None, "approaches": []}
    return {"refused": None, "seconds": plan.seconds, "approaches": list(plan.approaches)}


def _text(arm: LearntArm, found: Postures, rows: list[dict[str, Any]]) -> str:
    """The table as text."""
    answer = found.found
    how = f"{answer.case.replace('_', ' ')}, {'searched' if answer.case == 'numerical' else 'in closed form'}"
    lines = [f"{len(rows)} postures on model {arm.model.epoch} ({how}); {len(answer.beyond_limits)} beyond the limits"]
    if not rows:
        return lines[0]
    names = arm.model.joint_names
    width = max(8, *(len(name) for name in names))
    lines.append("  N  " + " ".join(name.rjust(width) for name in names) + "  nearest limit")
    for row in rows:
        at = " ".join(f"{row['joints'][name]:.4f}".rjust(width) for name in names)
        room = "none" if row["room"] is None else f"{row['nearest_limit']}, {row['room']:.3f} away"
        lines.append(f"{row['number']:3}  {at}  {room}")
        if arm.now is not None:
            lines.append("     " + _way_text(row))
    if answer.outcome == "continuum":
        free = sorted({names[j] for joints in answer.free_joints for j in joints})
        lines.append(f"the goal leaves {', '.join(free)} free: each posture is one of a continuous range")
    return "\n".join(lines)


def _way_text(row: dict[str, Any]) -> str:
    if row["refused"] is not None:
        return f"no straight way there from here: {row['refused']}"
    if row["seconds"] is None:
        return "the arm is there"
    kinds = {
        "JOINT_LIMIT": "joint limits",
        "KEEP_OUT": "keep-outs",
        "FIELD_OF_VIEW": "the images' borders",
        "FACE_HIDDEN": "a face turned away",
        "BEHIND_CAMERA": "a camera's plane",
    }
    near = [f"{kinds[a.code]} {a.room:.3g} {a.unit} ({a.subject})" for a in row["approaches"] if a.code in kinds]
    return f"{row['seconds']:.1f} s from here; room on the way: " + ("; ".join(near) or "no limit is near")


def _why_none(arm: LearntArm, found: Postures) -> str:
    """Text on why no posture reaches the goal, and what would help."""
    answer, names = found.found, arm.model.joint_names
    if answer.outcome == "beyond_limits":
        q, limits = answer.beyond_limits[0], arm.limits
        over = [
            f"{name} at {at:.4g}, {low:.4g} to {high:.4g} is allowed"
            for name, at, (low, high) in zip(names, q, limits, strict=True)
            if not low <= at <= high
        ]
        return (
            f"all {len(answer.beyond_limits)} postures are beyond the limits of the cell file; the nearest has "
            + "; ".join(over)
        )
    if found.images.refused:
        return f"the arm comes near the goal, but not to its images: {found.images.refused[0][1]}"
    short = answer.shortfall
    told = "the goal is out of the arm's reach"
    if short is None:
        return told
    if short.joint is not None and short.excess is not None:
        told += f": joint {names[short.joint]} would have to reach {100.0 * short.excess:.3g} % farther than it can"
    nearest = ", ".join(f"{name}={at:.4f}" for name, at in zip(names, short.joints, strict=True))
    return f"{told}; it comes nearest at {nearest}"
