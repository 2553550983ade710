"""Command ``stereoservo home``: moves every joint to the cell's home position; by the pictures, if the joints' zeros
are unknown or wrong (thesis 4.5.4, 4.5.5).
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from stereoservo.cli import interruption
from stereoservo.cli.goal import follow
from stereoservo.cli.ik import OWN_SIGMA_PX, LearntArm, learnt_arm
from stereoservo.cli.output import CELL_OPTIONS, CellArgument, CellOptions, CommandError, emit, log, log_hold
from stereoservo.client import Client
from stereoservo.messages.goals import JointTarget
from stereoservo.messages.wire import FeaturesMessage

if TYPE_CHECKING:
    from stereoservo.kinematics.joint_angles import DistinguishingMotion, JointZeros
    from stereoservo.numerics.arrays import FloatArray

SPEED = 0.5
"""Share of the joints' velocity limits, as without pictures."""
FRAMES, OBSERVATION_S, SETTLE_S = 15, 5.0, 0.4
"""Number of frames averaged per camera, time limit of an observation [s], and time of rest before it [s]."""
MOST_OBSERVATIONS = 6
PROBE = 0.15
"""Longest motion of a joint [rad or m] before the observations agree on one answer."""
LEAST_DIFFERENCE_PX = 2.0
"""Least difference [px] between the pictures of two postures for a motion to be made, in addition to the model's own.
"""
AGREEMENT_SIGMA = 5.0
"""Number of standard deviations within which zeros count as right."""


class Observation(NamedTuple):
    """One observation: joint readings (n,), raw pixels (c, m, 2) of the markers, NaN if unseen, standard deviations (c,
    m) [px].
    """

    readings: FloatArray
    pixels: FloatArray
    sigmas: FloatArray


def home(
    cell: CellArgument,
    by_vision: Annotated[
        bool, typer.Option("--by-vision", help="By the pictures of the home posture; tells by what each zero is off.")
    ] = False,
    check: Annotated[
        bool, typer.Option("--check", help="With --by-vision: only tell the zeros; nothing moves.")
    ] = False,
    speed_scale: Annotated[float, typer.Option(help="Lowers the speed, (0, 1].")] = 1.0,
    options: CellOptions = CELL_OPTIONS,
) -> None:
    """Move every joint to the cell's home position. Ctrl-C cancels.

    With --by-vision, on the cell's host, to where the cameras see what the model says they see there, whatever the
    encoders read.
    """
    if check and not by_vision:
        raise CommandError("usage", "--check goes with --by-vision; without pictures `home` has nothing to tell")
    if by_vision and options.endpoint is not None:
        raise CommandError("usage", "--by-vision reads the cell's model: run it on the cell's host, without --endpoint")
    arm = learnt_arm(cell, options.operator) if by_vision else None
    with options.client(cell, interruption.check) as client:
        if arm is not None:
            _by_vision(client, arm, check, speed_scale, options.json)
            return
        with client.home(speed_scale) as handle:
            follow(handle, options.json, client.cell)


def _by_vision(client: Client, arm: LearntArm, check: bool, speed_scale: float, as_json: bool) -> None:
    if arm.cell.scene.moves:
        raise CommandError("moves", "[scene] moves: the markers move by themselves, and tell no joint's zero")
    target, observations = _home_position(arm), list[Observation]()
    for _ in range(MOST_OBSERVATIONS):
        observations.append(_observe(client, arm))
        found, error_px = _estimate_zeros(arm, observations), _distance_from_home_px(arm, observations[-1], target)
        sure = not found.alternatives and (len(observations) > 1 or _zeros_hold(found))
        telling = _informative_motion(arm, observations[-1], found)
        if check or (sure and error_px <= _tolerance_px(arm)):
            _report(arm, observations, found, telling, error_px, check, as_json)
            return
        displacement = target - found.offset - observations[-1].readings
        if telling is not None:
            displacement = 0.0 * displacement
            displacement[telling.joint] = telling.step
        elif not sure:
            displacement = displacement * min(1.0, PROBE / max(float(abs(displacement).max()), 1e-12))
        _move(client, arm, observations[-1].readings + displacement, SPEED * speed_scale)
    raise CommandError(
        "not_reached",
        f"after {MOST_OBSERVATIONS} looks the pictures are still {error_px:.2f} px from those of the home posture, and "
        f"{1 + len(found.alternatives)} answers are possible: `stereoservo calibrate {client.cell} --check`",
        error_px=error_px,
    )


def _home_position(arm: LearntArm) -> FloatArray:
    """The home position (n,): the cell file's, or the base from which the model was learnt."""
    import numpy as np

    base = {} if arm.cell.calibration is None else arm.cell.calibration.base
    learnt = dict(zip(arm.model.joint_names, arm.model.zero.tolist(), strict=True))
    stated = {**learnt, **base, **arm.cell.joints.home}
    return np.array([stated[name] for name in arm.model.joint_names], dtype=np.float64)


def _observe(client: Client, arm: LearntArm) -> Observation:
    """The markers' mean pixels, with the arm at rest. Raises CommandError if the body is not seen."""
    import numpy as np

    model = arm.model
    cameras = [camera.name for camera in model.cameras]
    row = {marker: m for m, marker in enumerate(model.marker_ids)}
    shape = len(cameras), len(row)
    total, variance, count = np.zeros((*shape, 2)), np.zeros(shape), np.zeros(shape)
    frames = dict.fromkeys(cameras, 0)
    time.sleep(SETTLE_S)
    before = client.joints()
    until = time.monotonic() + OBSERVATION_S
    for message in client.watch(features=True):
        interruption.check()
        if isinstance(message, FeaturesMessage) and message.camera in frames:
            frames[message.camera] += 1
            c = cameras.index(message.camera)
            for marker, pixel, sigma in zip(message.ids, message.pixels, message.sigmas, strict=True):
                if marker in row:
                    total[c, row[marker]] += pixel
                    variance[c, row[marker]] += sigma**2
                    count[c, row[marker]] += 1.0
        if min(frames.values()) >= FRAMES or time.monotonic() > until:
            break
    seen = count >= max(1, FRAMES // 2)
    if not seen.any():
        told = ", ".join(f"{name}: {n} frames" for name, n in frames.items())
        raise CommandError(
            "not_seen",
            f"no camera sees a marker of the body ({told}): bring it into view by `stereoservo jog {client.cell}`, or "
            "look at the light",
        )
    readings = client.joints()
    moved = max(abs(readings[name] - before[name]) for name in model.joint_names)
    if moved > 1e-2:
        raise CommandError("moving", f"the arm moved by {moved:.3f} rad or m during the look: it must rest")
    own = OWN_SIGMA_PX if model.statistics is None else max(OWN_SIGMA_PX, model.statistics.rms_px)
    often = np.maximum(count, 1.0)
    sigmas = np.hypot(np.sqrt(variance) / often, own)
    pixels = np.where(seen[..., None], total / often[..., None], np.nan)
    return Observation(np.array([readings[name] for name in model.joint_names]), pixels, sigmas)


def _estimate_zeros(arm: LearntArm, observations: list[Observation]) -> JointZeros:
    """Corrections of the joint readings, from all observations. Raises CommandError if the pictures do not determine
    them, or if the resulting posture is beyond the cell's limits.
    """
    import numpy as np

    from stereoservo.kinematics.joint_angles import joint_zeros
    from stereoservo.kinematics.joint_reprojection import JointAnglesError, observed_chain

    pixels, sigmas = np.array([look.pixels for look in observations]), np.array([look.sigmas for look in observations])
    readings = np.array([look.readings for look in observations])
    check = f"`stereoservo calibrate {arm.cell.cell.name} --check`"
    try:
        found = joint_zeros(observed_chain(arm.model), arm.model.marker_points, pixels, sigmas, readings)
    except JointAnglesError as error:
        other = f"; zeros alone do not explain them: {check} looks for other causes"
        told = f"the pictures do not tell the joints' zeros: {error}"
        raise CommandError(error.code, told + (other if error.code == "no_agreement" else "")) from error
    beyond = [] if found.alternatives or _zeros_hold(found) else _beyond_limits(arm, readings[-1], found)
    if beyond:
        raise CommandError(
            "outside_limits",
            f"the pictures show {'; '.join(beyond)}: that is no correction of a zero. {check} looks for other causes "
            "(a body, base or camera that moved); where the arm does stand there, bring it within its limits first",
        )
    return found


def _beyond_limits(arm: LearntArm, readings: FloatArray, found: JointZeros) -> list[str]:
    """Joints that are beyond the cell's limits according to the pictures, as text; whole turns cannot be observed."""
    import numpy as np

    at = readings + found.offset
    slack = arm.cell.safety.position_margin + AGREEMENT_SIGMA * found.deviations
    low, high = arm.limits[:, 0] - slack, arm.limits[:, 1] + slack
    turns = np.array([[0.0, 1.0, -1.0] if kind == "revolute" else [0.0] * 3 for kind in arm.model.joint_kinds])
    turned = at[:, None] + 2.0 * np.pi * turns
    inside = ((turned >= low[:, None]) & (turned <= high[:, None])).any(axis=1)
    return [
        f"{arm.model.joint_names[j]} at {at[j]:+.4f}, its limits are {arm.limits[j, 0]:+.4f} to {arm.limits[j, 1]:+.4f}"
        for j in np.flatnonzero(~inside)
    ]


def _informative_motion(arm: LearntArm, look: Observation, found: JointZeros) -> DistinguishingMotion | None:
    """Motion that distinguishes the possible postures of an observation; None if one remains, or no motion does."""
    import numpy as np

    from stereoservo.kinematics.joint_angles import distinguishing_motion

    if not found.alternatives:
        return None
    postures = look.readings + np.array([found.offset, *found.alternatives])
    least_px = LEAST_DIFFERENCE_PX + _tolerance_px(arm)
    return distinguishing_motion(arm.model, postures, look.readings, arm.limits, PROBE, least_px)


def _zeros_hold(found: JointZeros) -> bool:
    return bool((abs(found.offset) <= AGREEMENT_SIGMA * found.deviations).all())


def _tolerance_px(arm: LearntArm) -> float:
    """Tolerance [px] of the distance from the home pictures: the cell's tolerance, or the error of the model."""
    statistics = arm.model.statistics
    own = OWN_SIGMA_PX if statistics is None else max(OWN_SIGMA_PX, statistics.rms_px)
    return max(arm.cell.servo.tolerance_px, 3.0 * own)


def _distance_from_home_px(arm: LearntArm, look: Observation, target: FloatArray) -> float:
    """Largest distance [px] of a marker from its position predicted by the model for the home posture."""
    import numpy as np

    from stereoservo.kinematics.joint_reprojection import observed_chain, predicted_pixels

    wanted = predicted_pixels(observed_chain(arm.model), target[None], arm.model.marker_points)[0]
    return float(np.nanmax(np.linalg.norm(look.pixels - wanted, axis=-1)))


def _move(client: Client, arm: LearntArm, readings: FloatArray, speed_scale: float) -> None:
    positions = dict(zip(arm.model.joint_names, readings.tolist(), strict=True))
    with client.goal(JointTarget(positions), speed_scale=speed_scale) as handle:
        result = handle.wait(progress=lambda event: log_hold(event.kind, event.message, client.cell))
    if result.outcome != "reached":
        raise CommandError(f"goal_{result.outcome}", f"the way home ended: {result.outcome}: {result.why}")


def _report(
    arm: LearntArm,
    observations: list[Observation],
    found: JointZeros,
    telling: DistinguishingMotion | None,
    error_px: float,
    check: bool,
    as_json: bool,
) -> None:
    name, model = arm.cell.cell.name, arm.model
    readings, decided = observations[-1].readings, not found.alternatives
    rows: list[dict[str, Any]] = [
        {
            "joint": joint,
            "reads": float(readings[j]),
            "is_at": float(readings[j] + found.offset[j]) if decided else None,
            "zero_off_by": -float(found.offset[j]) if decided else None,
            "deviation": float(found.deviations[j]) if decided else None,
        }
        for j, joint in enumerate(model.joint_names)
    ]
    postures = [(readings + offset).tolist() for offset in (found.offset, *found.alternatives)]
    lines = _told(arm, rows) if decided else _undecided(arm, rows, postures, telling, _zeros_hold(found))
    state = "not moved" if check else "home"
    lines.append(f"{state}: {error_px:.2f} px from the pictures of the home posture, {len(observations)} looks")
    if decided and not _zeros_hold(found):
        log(
            f"one look may show a body, base or cameras that moved as zeros that are off: `stereoservo home {name} "
            "--by-vision` looks again from elsewhere"
            if len(observations) == 1
            else f"set the encoders' zeros, or move those of the model: `stereoservo calibrate {name} --check "
            "--reset-zeros`"
        )
    emit(
        {
            "home": not check,
            "decided": decided,
            "error_px": error_px,
            "joints": rows,
            "looks": len(observations),
            "alternatives": len(found.alternatives),
            "postures": [dict(zip(model.joint_names, posture, strict=True)) for posture in postures],
            "told_by": None
            if telling is None
            else {"joint": model.joint_names[telling.joint], "by": telling.step, "px": telling.pixels},
            "model_epoch": model.epoch,
        },
        "\n".join(lines),
        as_json,
    )


def _units(arm: LearntArm) -> list[str]:
    return ["m" if kind == "prismatic" else "rad" for kind in arm.model.joint_kinds]


def _told(arm: LearntArm, rows: list[dict[str, Any]]) -> list[str]:
    return [
        f"{row['joint']:>8}  reads {row['reads']:+.4f}, is at {row['is_at']:+.4f}: off by {row['zero_off_by']:+.4f} "
        f"± {row['deviation']:.4f} {unit}"
        for row, unit in zip(rows, _units(arm), strict=True)
    ]


def _undecided(
    arm: LearntArm,
    rows: list[dict[str, Any]],
    postures: list[list[float]],
    telling: DistinguishingMotion | None,
    right: bool,
) -> list[str]:
    """Lines on an observation that several postures explain."""
    lines = [
        f"{row['joint']:>8}  reads {row['reads']:+.4f}, is at "
        + " or ".join(f"{posture[j]:+.4f}" for posture in postures)
        + f" {unit}"
        for j, (row, unit) in enumerate(zip(rows, _units(arm), strict=True))
    ]
    readings = (
        "what the joints read is the first of them: nothing speaks against the zeros"
        if right
        else "what the joints read is none of them: zeros are off, or the body, the base or the cameras moved"
    )
    lines.append(f"not decided: {len(postures)} postures show these pictures; {readings}")
    command = f"stereoservo home {arm.cell.cell.name} --by-vision"
    if telling is None:
        lines.append(f"no motion of one joint by {PROBE:g} tells: stand elsewhere, then `{command}`")
    else:
        joint, unit = rows[telling.joint]["joint"], _units(arm)[telling.joint]
        most = len(postures) * (len(postures) - 1) // 2
        lines.append(
            f"a motion of {joint} by {telling.step:+.2f} {unit} tells {telling.distinguished} of {most} pairs "
            f"of them apart, by {telling.pixels:.1f} px or more: `{command}` makes it and looks again"
        )
    return lines
