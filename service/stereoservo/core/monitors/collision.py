"""Collision thresholds of joint efforts and following errors, stated in the cell file or learnt from the calibration
motion, and the test of the current loads against them.

Monitored by `core.monitor`, joint by joint, while the arm moves on its own:

- the *departure* of the effort from its own moving mean over ``MEAN_S``. Gravity changes an effort with the posture by
  far more than a collision does, but slowly; a collision is fast. So no model of masses is needed, but a slow push is
  not detected.
- the following error, set less actual position, from zero.

A joint is in collision if ``samples`` consecutive samples exceed its threshold on the same side. If one sample in a
thousand is wrong, independently, that happens in fewer than 1e-15 of all windows of five: once in 10 000 years at 250
Hz with six joints and both signals; with windows of three, every four days. Five samples are 20 ms there.

Thresholds: the cell file's, else ``factor`` times the loads observed in the trial motions, plus a floor. Trial motions
move joints alone, but in normal motion several joints move, at speeds that were not tried. Therefore the departures
caused by the joints are added, each multiplied by the ratio of the allowed speed to the tried speed.
"""

from __future__ import annotations

import numpy as np

from stereoservo.core.block import Block
from stereoservo.core.settings import ContactSettings, CoreSettings
from stereoservo.core.state import CoreState, JointLoadStatistics
from stereoservo.kinematics.model import JointLoads
from stereoservo.messages.reasons import Reason
from stereoservo.numerics.arrays import FloatArray

ALONE = 0.05  # of the fastest joint's speed: limit for a joint that only holds its position
EFFORT_FLOOR = 0.01
"""Fraction of the largest effort of any joint with the same unit: least threshold, also for joints without load."""


def collision_thresholds(settings: CoreSettings, loads: JointLoads | None) -> tuple[FloatArray, FloatArray] | None:
    """Thresholds (n,) of efforts' departures and of following errors, infinite where unknown; None: no monitoring."""
    contact = settings.contact
    if contact is None or not contact.enabled:
        return None
    efforts, following = learnt_collision_thresholds(settings, loads)
    return (
        np.where(np.isnan(contact.efforts), efforts, contact.efforts),
        np.where(np.isnan(contact.following_errors), following, contact.following_errors),
    )


def learnt_collision_thresholds(settings: CoreSettings, loads: JointLoads | None) -> tuple[FloatArray, FloatArray]:
    """Thresholds (n,), (n,) from the trial motions; infinite for joints without data."""
    n = len(settings.joint_names)
    efforts, following = np.full(n, np.inf), np.full(n, np.inf)
    if loads is None or settings.contact is None:
        return efforts, following
    factor = settings.contact.factor
    speeds = settings.limits.velocity_max * settings.limits.speed_scale
    tried = np.where(loads.velocities > 0.0, loads.velocities, speeds)
    faster = np.maximum(speeds / tried, 1.0)
    if loads.efforts is not None and loads.largest_efforts is not None and loads.largest_efforts.any():
        together = (loads.efforts * faster).sum(axis=1)
        efforts = factor * together + EFFORT_FLOOR * _largest_alike(settings.contact, loads.largest_efforts)
    if loads.following_errors is not None and loads.following_errors.any():
        # Samples of set and actual position may be a cycle apart.
        following = factor * loads.following_errors * faster + speeds / settings.rate_hz
    return efforts, following


def learnt_loads(trials_id: str, state: CoreState) -> JointLoads | None:
    """The loads observed in the trial motions; None if the drives report none."""
    loads, block = state.loads, state.block
    if loads is None or loads.id != trials_id or not (block.numbers.tells_efforts or block.numbers.tells_following):
        return None
    return JointLoads(
        velocities=loads.velocities.copy(),
        efforts=loads.efforts.copy() if block.numbers.tells_efforts else None,
        largest_efforts=loads.largest_efforts.copy() if block.numbers.tells_efforts else None,
        following_errors=loads.following_errors.copy() if block.numbers.tells_following else None,
    )


def _largest_alike(contact: ContactSettings, largest: FloatArray) -> FloatArray:
    """For each joint, the largest of the efforts with its own unit (n,)."""
    units = contact.effort_units
    return np.array([max(largest[k] for k in range(len(units)) if units[k] == unit) for unit in units])


def stated_thresholds(settings: CoreSettings) -> tuple[FloatArray, FloatArray]:
    """Thresholds while others are learnt: those of the cell file alone, because the arm may carry another load now."""
    unlimited = np.full(len(settings.joint_names), np.inf)
    return collision_thresholds(settings, None) or (unlimited, unlimited)


def _lasting(window: FloatArray) -> FloatArray:
    """By how much all samples of a window (samples, n) exceed zero on one side, (n,)."""
    least: FloatArray = np.maximum(window.min(axis=0), -window.max(axis=0))
    return np.maximum(least, 0.0)


def learn_loads(
    trials_id: str, state: CoreState, speed: FloatArray, efforts: FloatArray, following: FloatArray
) -> None:
    """Record the loads that a threshold must tolerate: the same quantities as are monitored."""
    n = speed.size
    loads, block = state.loads, state.block
    if loads is None or loads.id != trials_id:
        loads = state.loads = JointLoadStatistics(trials_id, np.zeros(n), np.zeros((n, n)), np.zeros(n), np.zeros(n))
    loads.velocities = np.maximum(loads.velocities, speed)
    loads.largest_efforts = np.maximum(loads.largest_efforts, np.abs(efforts))
    mover = int(speed.argmax())
    if int((speed > ALONE * speed[mover]).sum()) == 1:  # two joints move between two joints' stops
        loads.efforts[:, mover] = np.maximum(loads.efforts[:, mover], _lasting(block.effort_excess))
    loads.following_errors = np.maximum(loads.following_errors, _lasting(block.following_excess))


def worst_contact(
    block: Block,
    settings: CoreSettings,
    effort_limits: FloatArray,
    following_limits: FloatArray,
    learning: bool,
) -> Reason | None:
    efforts, following = _lasting(block.effort_excess), _lasting(block.following_excess)
    by_effort, by_following = efforts / effort_limits, following / following_limits
    if max(by_effort.max(), by_following.max()) <= 1.0:
        return None
    effort = bool(by_effort.max() >= by_following.max())
    joint = int((by_effort if effort else by_following).argmax())
    name = settings.joint_names[joint]
    assert settings.contact is not None  # otherwise there were no limits
    remedy = "is something in its way? Clear it, or resume and jog away from it; where nothing was, "
    remedy += "raise safety.contact." if learning else "calibrate again, or raise safety.contact."
    if effort:
        value, limit = float(efforts[joint]), float(effort_limits[joint])
        unit = settings.contact.effort_units[joint]
        hint = f"joint {name} pushes with {value:.4g} {unit} more than just before, {limit:.4g} is allowed: "
        return Reason("CONTACT_EFFORT", "hold", name, value, limit, unit, f"{hint}{remedy}effort")
    value, limit = float(following[joint]), float(following_limits[joint])
    unit = settings.joint_unit(joint)
    hint = f"joint {name} is {value:.4g} {unit} from its set-point, {limit:.4g} is allowed: "
    return Reason("CONTACT_FOLLOWING", "hold", name, value, limit, unit, f"{hint}{remedy}following")


# -- monitors -----------------------------------------------------------------------------------------------
