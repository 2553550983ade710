"""Pictures that are later than their stamps tell, which nobody stated: shown by trial motions, applied in the core."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from stereoservo.calibration.shutter_offset import shutter_offsets
from stereoservo.kinematics.model import ShutterOffset
from stereoservo_sim.experiments.late_drives import run_late_pictures
from stereoservo_sim.tasks.driven_cell import DrivenCell, Imperfections
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.mechanics import Mechanics
from stereoservo_sim.world.synthetic import rx90

NOISE_PX = 0.05


def late_cell(late_s: float, jitter_s: float = 0.0, play: float = 0.0) -> Imperfections:
    gears = [Mechanics(play=play, play_friction=1.0)] * 6 if play else None
    return Imperfections(gears, late_s=late_s, jitter_s=jitter_s, noise_px=NOISE_PX)


@pytest.mark.parametrize(
    ("late_s", "jitter_s", "play"), [(0.0, 0.0, 0.0), (0.15, 0.02, 0.0), (0.06, 0.0, np.radians(0.5))]
)
def test_trial_motions_show_how_late_pictures_are(late_s: float, jitter_s: float, play: float) -> None:
    cell = rx90()
    trials = DrivenCell(cell, None, cell.home, 1, late_cell(late_s, jitter_s, play)).trials()
    assert trials.way is not None
    found = shutter_offsets(exact_model(cell), trials.way)
    assert [offset.camera for offset in found] == ["cam0", "cam1"]
    for offset in found:
        assert abs(offset.offset_s + late_s + 0.5 * jitter_s) < 2e-3, offset
        assert offset.deviation_s < 1e-3
    # The second camera sees nothing on the first half of the ways: they tell of the other one as before.
    way = trials.way
    kept = (way.cameras == 0) | (way.ways > np.median(way.ways))
    frames = {name: getattr(way, name)[kept] for name in ("ways", "cameras", "times", "markers", "pixels")}
    fewer = shutter_offsets(exact_model(cell), msgspec.structs.replace(way, **frames))
    assert fewer[0] == found[0]
    assert [offset.camera for offset in fewer[1:]] == ["cam1"]


def driven(known_s: float | None, late_s: float) -> tuple[DrivenCell, np.ndarray]:
    cell = rx90()
    offsets = () if known_s is None else tuple(ShutterOffset(f"cam{c}", known_s, 1e-4) for c in range(2))
    model = msgspec.structs.replace(exact_model(cell), shutter_offsets=offsets)
    place = cell.home + 0.8 * cell.ranges * np.array([1, -1, 1, -1, 1, -1])
    return DrivenCell(cell, model, cell.home, 2, late_cell(late_s)), cell.pixels(place[None])[:, 0]


def test_a_goal_ends_by_its_pictures_where_the_model_states_how_late_they_are() -> None:
    cell, wanted = driven(None, 0.1)
    assert "MODEL_SUSPECT" in cell.run_goal(wanted).codes  # as before
    cell, wanted = driven(-0.1, 0.1)
    assert cell.run_goal(wanted).kind == "goal_reached"
    shown, _ = cell.rest(0.5)
    assert np.linalg.norm(shown - wanted, axis=-1).max() < 2.0 * cell.settings.tolerance_px


def test_the_offset_is_followed_within_its_bound() -> None:
    for known_s, late_s, within in ((-0.05, 0.06, -0.06), (-0.05, 0.075, -0.07)):
        cell, wanted = driven(known_s, late_s)
        assert cell.run_goal(wanted).kind == "goal_reached"
        for estimate in cell.core.state.cameras:
            assert abs(1e-9 * estimate.offset_ns - within) < 3e-3


@pytest.mark.slow
def test_offsets_are_learnt_end_to_end() -> None:
    answer = run_late_pictures(seeds=20)
    assert not answer["beyond"]
    assert answer["mean_error_px"]["learnt"] <= 1.1 * answer["mean_error_px"]["true"]
