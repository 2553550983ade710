"""``bench ik``: duration of the inverse kinematics of images (`stereoservo ik`) on models that arms of several families
learn at 0.1 px, and whether all postures of the true model for noise-free images are found.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from stereoservo.kinematics.inverse.postures import Postures, postures
from stereoservo.kinematics.inverse.recognition import recognise
from stereoservo.kinematics.inverse.solutions import InverseKinematicsError
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.benchmarks.timing import summary
from stereoservo_sim.kept_models import model_of_trials
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.world import synthetic
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.synthetic import SyntheticCell

SIGMA = 0.1
"""Noise [px] of the trials and of the goals' images."""
STOPS = 20
EACH = 20
"""Poses per family and repetition: 1000 are of 50."""
SHARE = 0.7
"""Share of the calibration ranges from which poses are drawn."""
SAME = 0.1
"""Largest joint difference [rad or m] of a posture by the learnt model from that by the true one."""
FREEDOMS = 6
RANGES = {"revolute": np.pi, "prismatic": 1.0}
"""Limits to either side of home [rad or m]."""
FAMILIES: dict[str, Callable[[], SyntheticCell]] = {
    "six revolute, spherical wrist": synthetic.rx90,
    "gantry with wrist": synthetic.gantry_with_wrist,
    "gantry": synthetic.gantry,
    "pan-tilt": synthetic.pan_tilt,
    "SCARA": synthetic.scara,
    "six revolute, offset wrist": synthetic.offset_wrist,
    "seven revolute": synthetic.seven,
}


def run_ik(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """For every family: milliseconds a goal, and share of the true model's postures that are found."""
    poses = EACH * repetitions
    rows = []
    for k, (name, make) in enumerate(FAMILIES.items()):
        rows.append(family(name, make(), poses, np.random.default_rng([seed, k])))
        progress("families", k + 1, len(FAMILIES))
    return {"noise_px": SIGMA, "families": rows}


def family(name: str, cell: SyntheticCell, poses: int, rng: np.random.Generator) -> dict[str, Any]:
    """The figures of one family, for ``poses`` goals on the model that its arm learns."""
    learnt, exact = model_of_trials(cell.trials(SIGMA, rng, STOPS)).model, exact_model(cell)
    began = time.perf_counter()
    known = recognise(learnt)
    recognition_s = time.perf_counter() - began
    truth = recognise(exact)
    limits = limits_of(cell)
    joints = cell.held_out(rng, poses, SHARE)
    images = np.moveaxis(cell.pixels(joints), 1, 0)
    wall, cpu = [], []
    found = true = reached = 0
    refused: list[str] = []
    for q, pixels in zip(joints, images, strict=True):
        noisy = pixels + SIGMA * rng.standard_normal(pixels.shape)
        at, work = time.perf_counter(), time.process_time()
        try:
            answer = postures(learnt, noisy, SIGMA, limits=limits, recognition=known)
        except InverseKinematicsError as error:
            refused.append(str(error))
            continue
        cpu.append(time.process_time() - work)
        wall.append(time.perf_counter() - at)
        redundant = len(q) > FREEDOMS  # any posture of a continuum that shows the images counts
        reached += bool(answer.images.solutions if redundant else near(cell, q[None], answer)[0])
        if not redundant:
            right = postures(exact, pixels, SIGMA, limits=limits, recognition=truth).images.solutions
            same = near(cell, np.array([one.q for one in right]).reshape(-1, len(q)), answer)
            found, true = found + int(same.sum()), true + len(same)
    return {
        "family": name, "case": known.case, "stratum": learnt.stratum, "poses": poses, "poses_found": reached,
        "postures_found": found, "postures": true, "refused": len(refused), "first_refusal": (refused or [""])[0],
        "wall_ms": summary(wall, 1e3), "cpu_ms": summary(cpu, 1e3), "recognition_s": round(recognition_s, 3),
    }  # fmt: skip


def limits_of(cell: SyntheticCell) -> FloatArray:
    """Limits (n, 2) [rad or m] about home."""
    room = np.array([RANGES[kind] for kind in cell.kinds])
    return np.column_stack([cell.home - room, cell.home + room])


def near(cell: SyntheticCell, joints: FloatArray, answer: Postures) -> FloatArray:
    """Mask (s,) of the ``joints`` (s, n) that are among the postures of ``answer``."""
    others = np.array([one.q for one in answer.images.solutions]).reshape(-1, len(cell.kinds))
    apart = joints[:, None] - others
    turns = np.array([kind == "revolute" for kind in cell.kinds])
    apart = np.abs(np.where(turns, np.mod(apart + np.pi, 2.0 * np.pi) - np.pi, apart))
    return np.asarray(apart.max(axis=2).min(axis=1, initial=np.inf) < SAME)
