"""The calibration programme as a motion source: each joint alone, stop after stop.

From the base, joint l goes in equal steps to one side, then to the other (thesis 5.4.1, fig. 5.13). How far it goes is
stated in the cell file, or found out on the way (`trial_planning`): as far as the markers stay in every view. At a stop
the pixels are averaged at rest; a spread joint, where there is one, visits several positions there (fig. 5.16). A step
that loses the markers is taken back and that side is closed.
"""

from __future__ import annotations

import numpy as np

from stereoservo.control.reasons import Reason
from stereoservo.runtime.contact import learnt
from stereoservo.runtime.cycle import Sample
from stereoservo.runtime.motion import Motion, Present
from stereoservo.runtime.ports import FloatArray
from stereoservo.runtime.settings import CoreSettings, TrialSettings
from stereoservo.runtime.state import Trials
from stereoservo.runtime.trial_planning import (
    enough_inside,
    extrapolated,
    image_motion,
    marker_pixels,
    plan_sides,
    probe_size,
    room,
    too_little,
)
from stereoservo.runtime.visiting import (
    blocked,
    enter,
    first_visit,
    look,
    markers_lost,
    mean_joints,
    onwards,
    there,
    too_few_seen,
    too_slow,
    trial_settings,
    unseen_at_base,
)

NO_STEP = 1e-9  # a side that nothing is planned on
MOST_STOPS = 1.5  # of calibration.stops, where a joint turns out to have more room than planned


def start_trials(goal_id: str, q: FloatArray, now_ns: int, settings: CoreSettings) -> Trials:
    """The programme before its first move: to the base."""
    trials = trial_settings(settings)
    n = q.size
    # One more than the positions of the spread joint: the last is that joint at its base.
    unseen = np.full(
        (len(trials.spread_offsets) + 1, len(settings.cameras), len(settings.marker_ids), 2), np.nan
    )
    return Trials(
        id=goal_id, lease_s=None, lease_until_ns=0, joint=-1, side=1, k=0, count=0, step=0.0, reach=np.zeros(2),
        turn=-1, seen_turns=0, base_pixels=unseen, last=unseen.copy(), last_at=0.0, before=unseen.copy(),
        before_at=0.0, lowest=trials.base.copy(), highest=trials.base.copy(), stops=np.zeros(n, np.int64),
        motion_sigmas=np.zeros(n), sigma_px=0.0,
        **first_visit(trials.base, q, now_ns, settings),  # type: ignore[arg-type]
    )  # fmt: skip


def trials_step(trials: Trials, present: Present) -> Motion:
    """One step of the programme."""
    settings = trial_settings(present.settings)
    if trials.phase in ("move", "return", "finish"):
        return _move(trials, present, settings)
    samples = look(trials, present, settings)
    if samples is None:
        return _rest(present)
    return _stop_done(trials, present, settings, samples)


def _rest(present: Present, *, finished: bool = False) -> Motion:
    return Motion(np.zeros_like(present.q), finished=finished)


def _move(trials: Trials, present: Present, settings: TrialSettings) -> Motion:
    if there(trials, present):
        if trials.phase == "finish":
            present.emit(
                "calibration_finished", id=trials.id, message="trial motions done", progress=1.0,
                loads=learnt(trials.id, present.state.contact),
            )  # fmt: skip
            return _rest(present, finished=True)
        if trials.phase == "return":
            return _next(trials, present, settings)
        enter(trials, "settle", present)
        return _rest(present)
    reason = too_slow(trials, present, settings)
    if reason is not None:
        return _abort(trials, present, reason)
    if trials.phase == "move" and trials.joint >= 0 and markers_lost(trials, present, settings):
        return _turn_done(trials, present, settings, "in motion")
    return onwards(trials, present, settings)


def _stop_done(
    trials: Trials, present: Present, settings: TrialSettings, samples: tuple[Sample, ...]
) -> Motion:
    poorest = too_few_seen(samples, settings, present.settings.scene_ids)
    if poorest is not None:
        if trials.joint < 0 and trials.turn < 0:
            return _abort(trials, present, unseen_at_base(poorest, settings, present.settings.scene_ids))
        return _turn_done(trials, present, settings, "at the stop")
    mean = mean_joints(trials)
    # The base with the spread joint turned is a stop of that joint's own.
    trial = settings.spread_joint if trials.joint < 0 and trials.turn >= 0 else trials.joint
    present.emit(
        "calibration_sample", id=trials.id, joints=mean, samples=samples, trial=trial,
        progress=_progress(trials, settings),
    )  # fmt: skip
    _remember(trials, present, settings, samples)
    trials.seen_turns += 1
    return _turn_done(trials, present, settings, "", mean)


def _remember(trials: Trials, present: Present, settings: TrialSettings, samples: tuple[Sample, ...]) -> None:
    """Keep the pixels for the extrapolation to the next stop, and how far the markers moved."""
    pixels, sigmas = marker_pixels(samples, present.settings)
    slot = _slot(trials, present, settings)
    if trials.joint < 0:
        trials.base_pixels[slot] = pixels
        stated = sigmas[np.isfinite(sigmas)]
        trials.sigma_px = max(trials.sigma_px, float(np.median(stated)))
        return
    trials.last[slot] = pixels
    moved = image_motion(trials.base_pixels[slot], pixels, sigmas)
    trials.motion_sigmas[trials.joint] = max(trials.motion_sigmas[trials.joint], moved)


def _progress(trials: Trials, settings: TrialSettings) -> float:
    done = 0.0
    if trials.joint >= 0:
        done = trials.joint + min(1.0, float(trials.stops[trials.joint]) / settings.stops)
    return min(1.0, done / len(trials.stops))


# -- one stop: the positions of the spread joint ------------------------------------------------------------


def _turns(trials: Trials, present: Present, settings: TrialSettings) -> int:
    """How many positions the spread joint visits at a stop of the present joint; 0: it stays at its base."""
    spread = settings.spread_joint
    if spread < 0 or trials.joint == spread:
        return 0
    if trials.joint < 0:
        return len(settings.spread_offsets)
    # Only joints on the far side of the spread joint move the turned plate as one body.
    rides = all(camera.mount == "eye_in_hand" for camera in present.settings.cameras)
    far = trials.joint > spread if rides else trials.joint < spread
    return len(settings.spread_offsets) if far else 0


def _slot(trials: Trials, present: Present, settings: TrialSettings) -> int:
    """Which position the spread joint has now, counted from its lowest; the last number is its base."""
    count = len(settings.spread_offsets)
    if trials.turn < 0 or _turns(trials, present, settings) == 0:
        return count
    return trials.turn if trials.k % 2 == 0 else count - 1 - trials.turn


def _turn_to(trials: Trials, present: Present, settings: TrialSettings, turn: int) -> None:
    """Aim the spread joint: there and back from stop to stop."""
    trials.turn = turn
    slot = _slot(trials, present, settings)
    if slot < len(settings.spread_offsets):
        spread = settings.spread_joint
        trials.target[spread] = settings.base[spread] + settings.spread_offsets[slot]


def _turn_done(
    trials: Trials, present: Present, settings: TrialSettings, lost: str, mean: FloatArray | None = None
) -> Motion:
    """Go on to the next position of the spread joint; after the last, the stop is done."""
    turns = _turns(trials, present, settings)
    if lost and turns:
        name = present.settings.joint_names[settings.spread_joint]
        present.emit(
            "warning", id=trials.id,
            message=f"calibration: position {trials.turn + 1} of joint {name} loses the markers {lost}; left out",
        )  # fmt: skip
    if trials.turn + 1 < turns:
        _turn_to(trials, present, settings, trials.turn + 1)
        enter(trials, "move", present)
        return _rest(present)
    if trials.joint < 0:
        return _next(trials, present, settings)
    if trials.seen_turns == 0:
        return _back_off(trials, present, settings, lost)
    trials.stops[trials.joint] += 1
    if mean is not None:
        trials.lowest = np.minimum(trials.lowest, mean)
        trials.highest = np.maximum(trials.highest, mean)
    if trials.step == 0.0:
        _plan(trials, present, settings)
    return _next(trials, present, settings)


# -- one joint: its two sides -------------------------------------------------------------------------------


def _next(trials: Trials, present: Present, settings: TrialSettings) -> Motion:
    """Choose the next stop: further on this side, the other side, the next joint, or home."""
    while True:
        if trials.joint >= 0:
            if trials.step == 0.0:  # how far it may go is not known yet
                size = probe_size(present.settings.joint_kinds[trials.joint])
                if _aim(trials, present, settings, trials.side * size):
                    return _rest(present)
                _probe_failed(trials)
                continue
            if _further(trials, present, settings):
                return _rest(present)
            if trials.side > 0:
                _other_side(trials, settings)
                continue
            poor = _poor(trials, present, settings)
            if poor is not None:
                return _abort(trials, present, poor)
        trials.joint += 1
        if trials.joint == len(trials.stops):
            trials.target = settings.base.copy()
            enter(trials, "finish", present)
            return _rest(present)
        _begin_joint(trials, present, settings)


def _planned(trials: Trials, settings: TrialSettings) -> bool:
    return not np.isfinite(settings.range[trials.joint])


def _begin_joint(trials: Trials, present: Present, settings: TrialSettings) -> None:
    """The joint's steps, or step 0: a probe is to tell them."""
    trials.side, trials.k, trials.step, trials.count = 1, 0, 0.0, 0
    _at_base(trials)
    if _planned(trials, settings):
        trials.reach = room(trials.joint, present.settings, settings)
        return
    trials.step = float(2.0 * settings.range[trials.joint] / (settings.stops - 1))
    trials.count = settings.stops // 2


def _at_base(trials: Trials) -> None:
    trials.last, trials.last_at = trials.base_pixels.copy(), 0.0
    trials.before, trials.before_at = np.full_like(trials.base_pixels, np.nan), 0.0


def _probe_failed(trials: Trials) -> None:
    trials.reach[0 if trials.side > 0 else 1] = 0.0
    if trials.side < 0:
        trials.step, trials.count = NO_STEP, 0
    trials.side = -1


def _plan(trials: Trials, present: Present, settings: TrialSettings) -> None:
    """After the probe: the steps of both sides; the upper one first."""
    trials.reach, steps, counts = plan_sides(
        trials.base_pixels, trials.last, trials.last_at, trials.reach, present.settings, settings
    )
    trials.side, trials.k, trials.count, trials.step = 1, 0, counts[0], max(float(steps[0]), NO_STEP)
    _at_base(trials)


def _other_side(trials: Trials, settings: TrialSettings) -> None:
    """The lower side: with the stated steps, or with what the upper one has left of the joint's stops."""
    trials.side, trials.k = -1, 0
    _at_base(trials)
    if not _planned(trials, settings):
        trials.count = settings.stops - 1 - settings.stops // 2
        return
    left = max(settings.stops - 1 - int(trials.stops[trials.joint]), 2)
    trials.count = left if trials.reach[1] > 0.0 else 0
    trials.step = max(float(trials.reach[1]) / left, NO_STEP)


def _further(trials: Trials, present: Present, settings: TrialSettings) -> bool:
    """Set out for the next stop of this side, where the markers will be seen there."""
    offset = trials.side * (trials.k + 1) * trials.step
    if not _planned(trials, settings):
        if trials.k >= trials.count:
            return False
    elif not _promising(trials, present, settings, offset):
        return False
    trials.k += 1
    if _aim(trials, present, settings, offset):
        return True
    trials.k -= 1
    return False


def _promising(trials: Trials, present: Present, settings: TrialSettings, offset: float) -> bool:
    """Whether a planned joint goes on to ``offset``: the plan, or the last two stops, say that the markers stay.

    The plan's straight lines are corrected on the way: a side that turns out longer gets more stops.
    """
    if trials.k == 0 or trials.count == 0:
        return trials.count > 0
    most = room(trials.joint, present.settings, settings)[0 if trials.side > 0 else 1]
    crowded = int(trials.stops[trials.joint]) >= MOST_STOPS * settings.stops
    if trials.k >= trials.count and (abs(offset) > most or crowded):
        return False
    ahead = extrapolated(trials.last, trials.last_at, trials.before, trials.before_at, offset)
    return enough_inside(ahead, present.settings, settings)


def _aim(trials: Trials, present: Present, settings: TrialSettings, offset: float) -> bool:
    """Set out for ``offset`` from the base, unless a limit or a keep-out forbids it."""
    target = settings.base.copy()
    target[trials.joint] += offset
    why = blocked(target, [trials.joint], present)
    if why:
        name = present.settings.joint_names[trials.joint]
        present.emit(
            "warning", id=trials.id,
            message=f"calibration: joint {name} does not go to {target[trials.joint]:+.3f} {why}; its stops end there",
        )  # fmt: skip
        return False
    trials.target = target
    trials.before, trials.before_at = trials.last, trials.last_at
    trials.last, trials.last_at = np.full_like(trials.base_pixels, np.nan), offset
    trials.seen_turns = 0
    trials.turn = -1
    if _turns(trials, present, settings):
        _turn_to(trials, present, settings, 0)
    enter(trials, "move", present)
    return True


def _back_off(trials: Trials, present: Present, settings: TrialSettings, where: str) -> Motion:
    """Take the last step back; this side ends there, or goes on in smaller steps where it has only begun."""
    name = present.settings.joint_names[trials.joint]
    present.emit(
        "warning", id=trials.id,
        message=f"calibration: joint {name} loses the markers {where} at {present.q[trials.joint]:+.3f}; backing off",
    )  # fmt: skip
    trials.target = settings.base.copy()
    if trials.step == 0.0:
        _probe_failed(trials)
    else:
        trials.k -= 1
        trials.target[trials.joint] += trials.side * trials.k * trials.step
        smallest = 2.0 * probe_size(present.settings.joint_kinds[trials.joint])
        if _planned(trials, settings) and trials.k == 0 and trials.step > smallest:
            trials.step *= 0.5
            _at_base(trials)
        else:
            trials.count = 0
    enter(trials, "return", present)
    return _rest(present)


def _poor(trials: Trials, present: Present, settings: TrialSettings) -> Reason | None:
    j = trials.joint
    visited = float(trials.highest[j] - trials.lowest[j])
    return too_little(
        j, int(trials.stops[j]) + 1, visited, float(trials.motion_sigmas[j]), trials.sigma_px, present.settings,
        settings,
    )  # fmt: skip


def _abort(trials: Trials, present: Present, reason: Reason) -> Motion:
    present.emit("calibration_aborted", id=trials.id, message=reason.hint, reasons=(reason,))
    return _rest(present, finished=True)
