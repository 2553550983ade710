"""What `home --by-vision` tells of an arm's zeros: never a posture that the pictures do not tell from the arm's own."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from stereoservo.cli import home
from stereoservo.cli.ik import LearntArm
from stereoservo.cli.output import CommandError
from stereoservo.kinematics.joint_reprojection import observed_chain, predicted_pixels
from stereoservo.messages.cell_file import load_cell_file
from stereoservo_sim.cells import shipped_cell_path
from stereoservo_sim.world.exact_model import exact_simulated_model
from stereoservo_sim.world.simulated_cell import simulated_cell

CELLS = ("demo", "eye_in_hand", "hil-can")
NOISE_PX = 0.02
SIGMA_PX = 0.1


class ArmInPictures:
    """An arm of a shipped cell that reads ``readings`` and stands beyond them by ``off``; looks and moves are exact but
    for the pictures' noise."""

    def __init__(self, name: str, seed: int, off: Any = 0.0, away: float = 0.3) -> None:
        cell = load_cell_file(shipped_cell_path(name))
        world = simulated_cell(cell.camera[0].mount)
        self.arm = LearntArm(cell, exact_simulated_model(world, seed), None)
        self.rng, self.off = np.random.default_rng(seed), np.broadcast_to(off, world.base.shape)
        self.readings = world.base + away * self.rng.uniform(-1, 1, len(world.base)) - self.off
        self.moves: list[np.ndarray] = []

    def look(self, *_: Any) -> home.Observation:
        model = self.arm.model
        pixels = predicted_pixels(observed_chain(model), (self.readings + self.off)[None], model.marker_points)[0]
        pixels += self.rng.normal(0, NOISE_PX, pixels.shape)
        return home.Observation(self.readings.copy(), pixels, np.full(pixels.shape[:2], SIGMA_PX))

    def move(self, client: Any, arm: LearntArm, readings: np.ndarray, speed_scale: float) -> None:
        self.moves.append(readings - self.readings)
        self.readings = readings.copy()


def told(
    one: ArmInPictures, check: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> tuple[dict[str, Any], str]:
    monkeypatch.setattr(home, "_observe", one.look)
    monkeypatch.setattr(home, "_move", one.move)
    client: Any = SimpleNamespace(cell=one.arm.cell.cell.name)
    home._by_vision(client, one.arm, check, 1.0, True)
    said = capsys.readouterr()
    return json.loads(said.out), said.err


@pytest.mark.parametrize("name", CELLS)
def test_a_healthy_arm_is_told_no_zero(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each posture of these cells has seven others that show the same pictures."""
    for seed in range(4):
        one = ArmInPictures(name, seed)
        found, remarks = told(one, True, monkeypatch, capsys)
        off = [row["zero_off_by"] for row in found["joints"]]
        assert off == [None] * 6, (seed, off)
        assert "zeros" not in remarks
        assert found["decided"] is False
        assert len(found["postures"]) == 1 + found["alternatives"] == 8, seed
        # What the joints read comes first.
        assert list(found["postures"][0].values()) == pytest.approx(one.readings, abs=0.05)
        assert not one.moves


@pytest.mark.parametrize("name", CELLS)
def test_the_motion_that_is_named_tells_postures_apart(name: str) -> None:
    for seed in range(2):
        one = ArmInPictures(name, seed)
        observations = [one.look()]
        before = home._estimate_zeros(one.arm, observations)
        motion = home._informative_motion(one.arm, observations[0], before)
        assert motion is not None
        assert motion.distinguished >= 12  # of 28 pairs: half of the postures at least
        one.readings[motion.joint] += motion.step
        after = home._estimate_zeros(one.arm, [*observations, one.look()])
        assert len(after.alternatives) <= len(before.alternatives) // 2, seed
        assert (np.abs(after.offset) <= home.AGREEMENT_SIGMA * after.deviations).all()


@pytest.mark.parametrize("off", [np.zeros(6), np.array([0.06, -0.04, 0.05, -0.2, 0.1, 0.3])], ids=["right", "off"])
@pytest.mark.parametrize("name", CELLS)
def test_looks_after_motions_decide(
    name: str, off: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for seed in range(2):
        one = ArmInPictures(name, seed, off, away=0.1)
        found, remarks = told(one, False, monkeypatch, capsys)
        assert found["home"] is found["decided"] is True
        assert found["alternatives"] == 0
        assert found["looks"] == 1 + len(one.moves) > 1
        for row, true in zip(found["joints"], off, strict=True):
            assert row["zero_off_by"] == pytest.approx(-true, abs=home.AGREEMENT_SIGMA * row["deviation"])
        assert ("--reset-zeros" in remarks) == bool(off.any())


def test_postures_beyond_the_cells_limits_are_no_zeros() -> None:
    """The pictures alone show j2 off by half a radian; where its limits forbid the place, that is no zero's error."""
    off = np.array([0.0, 0.5, 0.0, 0.0, 0.0, 0.0])
    one = ArmInPictures("demo", 0, off, away=0.0)
    observations = [one.look()]
    for joint in (4, 2):
        one.readings[joint] += home.PROBE
        observations.append(one.look())
    assert home._estimate_zeros(one.arm, observations).offset == pytest.approx(off, abs=0.02)
    limits = tuple(
        msgspec.structs.replace(limit, max=-1.6) if limit.joint == "j2" else limit
        for limit in one.arm.cell.safety.limit
    )
    safety = msgspec.structs.replace(one.arm.cell.safety, limit=limits)
    bounded = LearntArm(msgspec.structs.replace(one.arm.cell, safety=safety), one.arm.model, None)
    with pytest.raises(CommandError, match=r"j2 at -1\.30.* no correction of a zero") as caught:
        home._estimate_zeros(bounded, observations)
    assert caught.value.code == "outside_limits"
