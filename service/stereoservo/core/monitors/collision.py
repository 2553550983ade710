"""Collision thresholds of joint efforts and following errors, stated in the cell file or learnt from the calibration
motion, and the test of the current loads against them.

What `core.monitor` watches, joint by joint, while the arm moves by itself:

- the *departure* of the effort from its own moving mean over ``MEAN_S``. Gravity changes an effort with the posture by
  far more than a contact does, but slowly; a contact is fast. So no model of masses is needed, and a slow push goes
  unseen.
- the following error, set less actual position, from zero.

A joint is in contact when ``samples`` samples one after the other are beyond the same side of its threshold. If one
sample in a thousand is wrong, independently, that happens in fewer than 1e-15 of all windows of five: once in 10 000
years at 250 Hz with six joints and both signals; in windows of three, every four days. Five samples are 20 ms there.

Thresholds: the cell file's, else ``factor`` times what the trial motions showed, plus a floor. There joints move alone,
in motion several do, with speeds that were not tried: the departures that each joint causes are added up, each
raised by its speed allowed now over its speed tried.
"""

from __future__ import annotations

import numpy as np

from stereoservo.core.block import Block
from stereoservo.core.settings import ContactSettings, CoreSettings
from stereoservo.core.state import CoreState, JointLoadStatistics
from stereoservo.kinematics.model import JointLoads
from stereoservo.messages.reasons import Reason
from stereoservo.numerics.arrays import FloatArray

ALONE = 0.05  # of the fastest joint's speed: what a joint that only holds its place may have
EFFORT_FLOOR = 0.01
"""Of the largest effort of any joint with the same unit: what a joint without weight may always do."""


def collision_thresholds(
    settings: CoreSettings, loads: JointLoads | None
) -> tuple[FloatArray, FloatArray] | None:
    """Thresholds (n,) of efforts' departures and of following errors, infinite where none is known; None: no watch."""
    contact = settings.contact
    if contact is None or not contact.enabled:
        return None
    efforts, following = learnt_collision_thresholds(settings, loads)
    return (
        np.where(np.isnan(contact.efforts), efforts, contact.efforts),
        np.where(np.isnan(contact.following_errors), following, contact.following_errors),
    )


def learnt_collision_thresholds(
    settings: CoreSettings, loads: JointLoads | None
) -> tuple[FloatArray, FloatArray]:
    """Thresholds (n,), (n,) from what the trial motions showed; infinite where they showed nothing."""
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
    """What the trial motions showed; None where the drives tell nothing."""
    loads, block = state.loads, state.block
    if loads is None or loads.id != trials_id or not (block.tells_efforts or block.tells_following):
        return None
    return JointLoads(
        velocities=loads.velocities.copy(),
        efforts=loads.efforts.copy() if block.tells_efforts else None,
        largest_efforts=loads.largest_efforts.copy() if block.tells_efforts else None,
        following_errors=loads.following_errors.copy() if block.tells_following else None,
    )


def _largest_alike(contact: ContactSettings, largest: FloatArray) -> FloatArray:
    """For each joint, the largest of the efforts that are in its own unit (n,)."""
    units = contact.effort_units
    return np.array([max(largest[k] for k in range(len(units)) if units[k] == unit) for unit in units])


def stated_thresholds(settings: CoreSettings) -> tuple[FloatArray, FloatArray]:
    """Thresholds while others are learnt: those of the cell file alone, for the arm may carry something else now."""
    unlimited = np.full(len(settings.joint_names), np.inf)
    return collision_thresholds(settings, None) or (unlimited, unlimited)


def _lasting(window: FloatArray) -> FloatArray:
    """How far all samples of a window (samples, n) are beyond on one side, (n,)."""
    least: FloatArray = np.maximum(window.min(axis=0), -window.max(axis=0))
    return np.maximum(least, 0.0)


def learn_loads(
    trials_id: str, state: CoreState, speed: FloatArray, efforts: FloatArray, following: FloatArray
) -> None:
    """Note what a threshold would have had to bear: the same quantities as are watched."""
    n = speed.size
    loads, block = state.loads, state.block
    if loads is None or loads.id != trials_id:
        loads = state.loads = JointLoadStatistics(
            trials_id, np.zeros(n), np.zeros((n, n)), np.zeros(n), np.zeros(n)
        )
    loads.velocities = np.maximum(loads.velocities, speed)
    loads.largest_efforts = np.maximum(loads.largest_efforts, np.abs(efforts))
    mover = int(speed.argmax())
    if int((speed > ALONE * speed[mover]).sum()) == 1:  # from one joint's stops to the next one's, two move
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
    assert settings.contact is not None  # else there were no limits
    way = "is something in its way? Clear it, or resume and jog away from it; where nothing was, "
    way += "raise safety.contact." if learning else "calibrate anew, or raise safety.contact."
    if effort:
        value, limit = float(efforts[joint]), float(effort_limits[joint])
        unit = settings.contact.effort_units[joint]
        hint = (
            f"joint {name} pushes with {value:.4g} {unit} more than a moment before, {limit:.4g} is allowed: "
        )
        return Reason("CONTACT_EFFORT", "hold", name, value, limit, unit, f"{hint}{way}effort")
    value, limit = float(following[joint]), float(following_limits[joint])
    unit = settings.joint_unit(joint)
    hint = f"joint {name} is {value:.4g} {unit} from its set-point, {limit:.4g} is allowed: "
    return Reason("CONTACT_FOLLOWING", "hold", name, value, limit, unit, f"{hint}{way}following")


# -- monitors -----------------------------------------------------------------------------------------------
