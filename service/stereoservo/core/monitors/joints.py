"""Has the arm met something? The joints' efforts and following errors against thresholds; learns these, too.

What is watched, joint by joint, while the arm moves by itself:

- the effort's *departure* from its own moving mean over ``MEAN_S``. Gravity changes an effort with the posture by far
  more than a contact does, but slowly; a contact is fast. So no model of masses is needed, and a slow push goes unseen.
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

from stereoservo.core.context import Finding, StepContext
from stereoservo.core.settings import ContactSettings, CoreSettings
from stereoservo.core.state import CalibrationMotion, Contact, CoreState, JointLoadStatistics
from stereoservo.kinematics.model import JointLoads
from stereoservo.messages.reasons import Reason
from stereoservo.messages.status import Lifecycle
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import JointState

MEAN_S = 0.25
"""Time constant of the moving mean in motion: a full brake ramp is done in it, gravity hardly changes."""
REST_S = 0.05
"""And at rest, where brakes open and people lean on the arm: nothing is watched."""
LEAVE_S = 1.0
"""Of motion after a contact, in which what it brought may go again: a retreat is no contact."""
MOVING = 1e-3  # [rad/s or m/s] of commanded velocity
ALONE = 0.05  # of the fastest joint's speed: what a joint that only holds its place may have
GAP_S = 0.5  # without a sample for so long, means are of another time
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


def detect_collision(
    state: CoreState,
    settings: CoreSettings,
    limits: tuple[FloatArray, FloatArray] | None,
    sample: JointState | None,
) -> Reason | None:
    """Account for one step; the reason where a joint (worst first) is in contact.

    ``state.command`` is still that of the last step. ``limits``: see ``thresholds``.
    """
    contact = state.contact
    if sample is None or sample.t_ns <= contact.seen_ns:
        return None
    elapsed_s = (sample.t_ns - contact.seen_ns) * 1e-9 if contact.seen_ns else np.inf
    contact.seen_ns = sample.t_ns
    contact.efforts = None if sample.efforts is None else sample.efforts.copy()
    contact.following_errors = None if sample.following_errors is None else sample.following_errors.copy()
    speed = np.abs(state.command)
    if elapsed_s > GAP_S or state.lifecycle != Lifecycle.ACTIVE:
        _forget(contact, sample)
        return None
    efforts, following = _readings(contact, sample)
    if state.stopped or not bool((speed > MOVING).any()):
        if contact.leave_s > 0.0:
            _absorb(contact, efforts, following)
        _clear(contact)
        contact.mean_efforts = _nearer(contact.mean_efforts, efforts, elapsed_s / (elapsed_s + REST_S))
        return None
    contact.leave_s = max(0.0, contact.leave_s - elapsed_s)
    excess, lag = _excess(contact, efforts, following)
    learning = isinstance(state.source, CalibrationMotion)
    effort_limits, following_limits = _stated(settings) if learning else limits or _unlimited(speed.size)
    beyond = np.abs(excess) > effort_limits
    share = np.where(beyond, 0.0, elapsed_s / (elapsed_s + MEAN_S))  # a contact is no new mean
    contact.mean_efforts = _nearer(contact.mean_efforts, efforts, share)
    contact.effort_excess = _pushed(contact.effort_excess, excess)
    contact.following_excess = _pushed(contact.following_excess, lag)
    if isinstance(state.source, CalibrationMotion):
        _learn(state.source.id, contact, speed, efforts, following)
    if limits is None:
        return None
    reason = _worst(contact, settings, effort_limits, following_limits, learning)
    if reason is not None:
        contact.low = np.array([np.minimum(contact.mean_efforts, efforts), np.minimum(following, 0.0)])
        contact.high = np.array([np.maximum(contact.mean_efforts, efforts), np.maximum(following, 0.0)])
        contact.leave_s = LEAVE_S
        _clear(contact)
    return reason


def learnt_loads(trials_id: str, contact: Contact) -> JointLoads | None:
    """What the trial motions showed; None where the drives tell nothing."""
    loads = contact.loads
    if (
        loads is None
        or loads.id != trials_id
        or (contact.efforts is None and contact.following_errors is None)
    ):
        return None
    return JointLoads(
        velocities=loads.velocities.copy(),
        efforts=None if contact.efforts is None else loads.efforts.copy(),
        largest_efforts=None if contact.efforts is None else loads.largest_efforts.copy(),
        following_errors=None if contact.following_errors is None else loads.following_errors.copy(),
    )


def _largest_alike(contact: ContactSettings, largest: FloatArray) -> FloatArray:
    """For each joint, the largest of the efforts that are in its own unit (n,)."""
    units = contact.effort_units
    return np.array([max(largest[k] for k in range(len(units)) if units[k] == unit) for unit in units])


# -- parts --------------------------------------------------------------------------------------------------


def _unlimited(n: int) -> tuple[FloatArray, FloatArray]:
    return np.full(n, np.inf), np.full(n, np.inf)


def _stated(settings: CoreSettings) -> tuple[FloatArray, FloatArray]:
    """Thresholds while others are learnt: those of the cell file alone, for the arm may carry something else now."""
    return collision_thresholds(settings, None) or _unlimited(len(settings.joint_names))


def _readings(contact: Contact, sample: JointState) -> tuple[FloatArray, FloatArray]:
    """Efforts and following errors; as expected where the driver has none, or one that is not a number."""
    efforts = contact.mean_efforts if sample.efforts is None else sample.efforts
    following = np.zeros_like(efforts) if sample.following_errors is None else sample.following_errors
    return (
        np.where(np.isfinite(efforts), efforts, contact.mean_efforts),
        np.where(np.isfinite(following), following, 0.0),
    )


def _excess(contact: Contact, efforts: FloatArray, following: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Signed distances from what is expected: the mean and zero, or anything that a contact brought of late."""
    mean = contact.mean_efforts
    if contact.leave_s <= 0.0:
        return efforts - mean, following
    low, high = np.minimum(mean, contact.low[0]), np.maximum(mean, contact.high[0])
    behind, ahead = np.minimum(contact.low[1], 0.0), np.maximum(contact.high[1], 0.0)
    return (
        efforts - np.minimum(np.maximum(efforts, low), high),
        following - np.minimum(np.maximum(following, behind), ahead),
    )


def _nearer(mean: FloatArray, value: FloatArray, share: float | FloatArray) -> FloatArray:
    nearer: FloatArray = mean + share * (value - mean)
    return nearer


def _pushed(window: FloatArray, newest: FloatArray) -> FloatArray:
    return np.concatenate([window[1:], newest[None]])


def _lasting(window: FloatArray) -> FloatArray:
    """How far all samples of a window (samples, n) are beyond on one side, (n,)."""
    least: FloatArray = np.maximum(window.min(axis=0), -window.max(axis=0))
    return np.maximum(least, 0.0)


def _clear(contact: Contact) -> None:
    contact.effort_excess = np.zeros_like(contact.effort_excess)
    contact.following_excess = np.zeros_like(contact.following_excess)


def _absorb(contact: Contact, efforts: FloatArray, following: FloatArray) -> None:
    """What comes while the arm brakes and stands after a contact belongs to it."""
    contact.low = np.minimum(contact.low, np.array([efforts, following]))
    contact.high = np.maximum(contact.high, np.array([efforts, following]))


def _forget(contact: Contact, sample: JointState) -> None:
    """The mean begins anew: the drives were off, or nothing was heard for long."""
    efforts, _ = _readings(contact, sample)
    contact.mean_efforts = efforts.copy()
    contact.leave_s = 0.0
    _clear(contact)


def _learn(
    trials_id: str, contact: Contact, speed: FloatArray, efforts: FloatArray, following: FloatArray
) -> None:
    """Note what a threshold would have had to bear: the same quantities as are watched."""
    n = speed.size
    loads = contact.loads
    if loads is None or loads.id != trials_id:
        loads = contact.loads = JointLoadStatistics(
            trials_id, np.zeros(n), np.zeros((n, n)), np.zeros(n), np.zeros(n)
        )
    loads.velocities = np.maximum(loads.velocities, speed)
    loads.largest_efforts = np.maximum(loads.largest_efforts, np.abs(efforts))
    mover = int(speed.argmax())
    if int((speed > ALONE * speed[mover]).sum()) == 1:  # from one joint's stops to the next one's, two move
        loads.efforts[:, mover] = np.maximum(loads.efforts[:, mover], _lasting(contact.effort_excess))
    loads.following_errors = np.maximum(loads.following_errors, _lasting(contact.following_excess))


def _worst(
    contact: Contact,
    settings: CoreSettings,
    effort_limits: FloatArray,
    following_limits: FloatArray,
    learning: bool,
) -> Reason | None:
    efforts, following = _lasting(contact.effort_excess), _lasting(contact.following_excess)
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
    unit = "rad" if settings.joint_kinds[joint] == "revolute" else "m"
    hint = f"joint {name} is {value:.4g} {unit} from its set-point, {limit:.4g} is allowed: "
    return Reason("CONTACT_FOLLOWING", "hold", name, value, limit, unit, f"{hint}{way}following")


MEMORY_S = 1.0  # after which a missing travel is forgotten: drives have gain errors of per cents
LAG_S = 0.15  # a healthy drive lags by less than this at full speed


def forget_travel(state: CoreState) -> None:
    """Begin anew: what the drives did of late was not what they were sent."""
    state.missing_travel[:] = 0.0
    state.untold_travel[:] = 0.0
    state.last_positions = None


def detect_following_error(
    state: CoreState, settings: CoreSettings, q: FloatArray, dt_s: float
) -> Reason | None:
    """Account for ``dt_s`` since the last step; the reason where a joint (worst first) does not follow.

    ``state.command`` is still that of the last step. A joint's missing travel is its commanded minus its measured one,
    forgotten over ``MEMORY_S``; it may reach ``LAG_S`` at full speed. Without a new joint sample nothing is concluded:
    stale samples are the safety stage's affair.
    """
    state.untold_travel = state.untold_travel + state.command * dt_s
    if state.last_joints_ns == state.last_followed_ns:
        return None
    state.last_followed_ns = state.last_joints_ns
    last = q if state.last_positions is None else state.last_positions
    keep = max(0.0, 1.0 - dt_s / MEMORY_S)
    state.missing_travel = keep * (state.missing_travel + state.untold_travel - (q - last))
    state.untold_travel[:] = 0.0
    state.last_positions = q.copy()
    allowed = LAG_S * settings.limits.velocity_max
    joint = int((np.abs(state.missing_travel) / allowed).argmax())
    missing, limit = float(state.missing_travel[joint]), float(allowed[joint])
    if abs(missing) <= limit:
        return None
    name = settings.joint_names[joint]
    unit = "rad" if settings.joint_kinds[joint] == "revolute" else "m"
    state.missing_travel[:] = 0.0
    return Reason(
        "JOINT_NOT_FOLLOWING", "fault", name, abs(missing), limit, unit,
        f"joint {name} lacks {missing:+.3f} {unit} of the travel it was sent (up to {limit:.3f} is lag): "
        "check its encoder, brake and drive; then reset and enable",
    )  # fmt: skip


# -- monitors -----------------------------------------------------------------------------------------------


def monitor_collision(context: StepContext) -> tuple[Finding, ...]:
    """The arm has met something: it stops with its drives on, as if a person had stopped it."""
    reason = detect_collision(
        context.state, context.settings, context.derived.load_limits, context.ingested.joints
    )
    if reason is None:
        return ()
    return (Finding("stop", reason, reason.hint, f"contact: {reason.hint}"),)


def monitor_following(context: StepContext) -> tuple[Finding, ...]:
    """A joint that does not go where it is sent: its encoder, brake or drive is at fault, and so is the cell."""
    state = context.state
    if not context.settings.watch_following or state.history.count == 0:
        return ()
    reason = detect_following_error(state, context.settings, context.q, context.ingested.elapsed_s)
    if reason is None or state.lifecycle != Lifecycle.ACTIVE:
        return ()  # an arm that is off may be moved by hand
    return (Finding("fault", reason, reason.hint, reason.hint),)
