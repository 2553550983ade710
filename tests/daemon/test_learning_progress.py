"""Accuracies stated during the trial motions, against the exact pixels of synthetic arms."""

import io

import msgspec
import numpy as np
import pytest
from scipy.stats import chi2

from stereoservo.calibration.self_calibration import fit_model
from stereoservo.core.cycle import Event
from stereoservo.daemon.ipc_messages import store_event, stored_events
from stereoservo.daemon.jobs.learning_progress import (
    first_joints,
    learnt_accuracy,
    moved_alone,
    moved_together,
    predicted_rms,
)
from stereoservo.kinematics.covariance import predicted_pixels
from stereoservo_sim.world import synthetic

SIGMA, SEEDS = 0.05, 4


def trials_of(cell, seed, stops=13, joints=None):
    """Trials of which only the first ``joints`` are done; the base is the first stop, as in a calibration."""
    positions, moved = cell.stops(stops)
    done = moved < (len(cell.home) if joints is None else joints)
    positions, moved = np.vstack([cell.home, positions[done]]), np.concatenate([[-1], moved[done]])
    return cell.trials(SIGMA, np.random.default_rng([seed, 7]), positions=(positions, moved))


def true_rms(cell, model, positions):
    """Rms error [px an axis] of a model of the first joints at ``positions`` (s, k), in the images."""
    whole = np.tile(cell.home, (len(positions), 1))
    whole[:, : positions.shape[1]] = positions
    kept = [marker - synthetic.FIRST_MARKER for marker in model.marker_ids]
    exact = cell.pixels(whole)[:, :, kept]
    inside = ((exact >= -0.5) & (exact <= np.array([cell.width, cell.height]) - 0.5)).all(axis=-1)
    return float(np.sqrt(((predicted_pixels(model, positions) - exact)[inside] ** 2).mean()))


@pytest.mark.parametrize("make", [synthetic.rx90, synthetic.scara, synthetic.gantry])
def test_stated_accuracy_is_the_error(make):
    """The sum over seeds of squared errors, relative to those stated, is a weighted sum of chi-squares. Its spread is
    largest if each seed's error has one direction: chi-square with a degree of freedom a seed.
    """
    cell = make()
    n = len(cell.home)
    for count in (1, n):
        ratios = []
        for seed in range(SEEDS):
            trials = trials_of(cell, seed, joints=count)
            part = first_joints(trials, count)
            model = fit_model(part, epoch=0).model
            sets = (moved_together(part), moved_alone(part, count - 1))
            stated = [predicted_rms(model, trials, positions) for positions in sets]
            if not seed:
                found = learnt_accuracy(trials, count)
                assert [found.predicted_px, found.joints[cell.joint_names[count - 1]]] == pytest.approx(stated)
            ratios.append([(true_rms(cell, model, at) / px) ** 2 for at, px in zip(sets, stated, strict=True)])
        together, alone = np.sum(ratios, axis=0)
        low, high = chi2.ppf([1e-4, 1.0 - 1e-4], SEEDS)
        print(f"{make.__name__}, {count} of {n} joints: {together / SEEDS:.2f} together, {alone / SEEDS:.2f} alone")
        assert low < together < high
        assert low < alone < high


def test_more_stops_of_the_same_joints_are_more_accurate():
    """A subset of the stops, with the same noise each, holds less information on every pixel."""
    cell = synthetic.rx90()
    few, many = (learnt_accuracy(trials_of(cell, 0, stops), 6) for stops in (9, 33))
    assert many.predicted_px < few.predicted_px
    assert all(many.joints[name] < few.joints[name] for name in cell.joint_names)
    assert few.coverage["cam0"] <= many.coverage["cam0"] <= 1.0
    assert few.coverage["cam0"] > 0.0


def test_a_joint_that_has_not_finished_is_left_out_and_poor_data_state_why():
    cell = synthetic.rx90()
    trials = trials_of(cell, 0, joints=3)
    assert first_joints(trials, 2).trials.max() == 1
    assert learnt_accuracy(trials, 2).joints.keys() == {"j1", "j2"}
    # A spread joint that is away from the base at every stop of the others leaves no stop for them alone.
    spread = trials.positions.copy()
    spread[1:, 5] += 0.3
    found = learnt_accuracy(msgspec.structs.replace(trials, positions=spread), 3)
    assert found.predicted_px is None
    assert "at least 16 are needed" in found.note
    blind = msgspec.structs.replace(trials, pixels=np.full_like(trials.pixels, np.nan))
    found = learnt_accuracy(blind, 3)
    assert found.predicted_px is None
    assert found.note
    assert found.coverage == {"cam0": 0.0, "cam1": 0.0}


def test_an_event_that_is_still_being_written_is_left_for_the_next_call(tmp_path):
    path = tmp_path / "events"
    events = [Event(k, k, "calibration_sample", id="one", joints=np.arange(3.0) + k) for k in range(3)]
    written = io.BytesIO()
    for event in events:
        store_event(written, event)
    whole = written.getvalue()
    path.write_bytes(whole[:-5])
    with path.open("rb") as file, path.open("ab") as more:
        assert [event.seq for event in stored_events(file)] == [0, 1]
        assert list(stored_events(file)) == []
        more.write(whole[-5:])
        more.flush()
        (last,) = stored_events(file)
    assert last.seq == 2
    assert (last.joints == events[2].joints).all()
