"""Arms of URDF files as they are: each read, compared with pybullet, learnt in lockstep, and sent to one goal.

`python tests/sim/world/urdf_survey.py OUT.jsonl PLACE…` appends a line for each file that OUT.jsonl does not have yet,
and prints the totals. `--copied` copies each file alone to an empty folder first, as people do; `--read`
reads and compares only. A file of several arms
is tried with the first flange that the refusal names. Files without a chain of two joints are no arms, nor are those
whose joints are spherical.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np

from stereoservo.daemon.lockstep import LockstepCell
from stereoservo.messages.cell_file import CellFile, check_cell
from stereoservo_sim.demonstration.lockstep_operator import LockstepOperator
from stereoservo_sim.demonstration.truth import true_cell
from stereoservo_sim.experiments.lockstep_cells import end_error, taught_and_reached
from stereoservo_sim.world.arms.arm_goals import goals_of
from stereoservo_sim.world.history import TrueJointHistory
from stereoservo_sim.world.physics import PybulletPlant
from stereoservo_sim.world.robots import Robot, flange_pose
from stereoservo_sim.world.urdf_file import UrdfError, load_urdf

CLOSE_M = 1e-6


def cell_of_file(path: Path, flange: str) -> CellFile:
    """A cell of ideal drives and cameras around the arm of a file."""
    options = {"urdf": path.name, "flange": flange, "rate_hz": 50.0}
    return check_cell(
        {
            "schema": 1, "cell": {"name": "survey"}, "joints": {"driver": "fake", "options": options},
            "camera": [{"name": side, "driver": "fake"} for side in ("left", "right")],
            "servo": {"gain": 2.0, "rate_hz": 50.0}, "safety": {}, "calibration": {"min_markers": 7, "frames": 2},
        }
    )  # fmt: skip


def engine_difference(robot: Robot) -> float:
    """Largest difference [m, and of rotations' entries] of the flange's pose from pybullet's at random positions."""
    low, high = ([getattr(joint, f"position_{side}") for joint in robot.joints] for side in ("min", "max"))
    drawn = np.random.default_rng(3).uniform(low, high, (5, len(robot.joints)))
    engine = PybulletPlant(robot, drawn[0], 1e-3)
    try:
        worst = 0.0
        for q in drawn:
            engine.place(q)
            worst = max(worst, float(np.abs(engine.flange() - flange_pose(robot, q)).max()))
        return worst
    finally:
        engine.close()


def reached(path: Path, flange: str) -> dict[str, object]:
    """Result of learning the arm and reaching a goal. Raises whatever the cell raises."""
    cell = cell_of_file(path, flange)
    truth = true_cell(cell, path.parent)
    goal = goals_of(truth)["near"]
    history = TrueJointHistory.in_memory(len(truth.base), capacity=1 << 16)
    with (
        tempfile.TemporaryDirectory() as scratch,
        LockstepCell(
            cell, cell_dir=path.parent, runtime_dir=Path(scratch), seed=0, services={"world": history}
        ) as lockstep,
    ):
        operator = LockstepOperator(lockstep, seed=0)
        lockstep.run_for(0.4)
        operator.enable()
        operator.calibrate()
        event, _ = taught_and_reached(operator, truth.base, "stereo", goal)
        return {
            "end": event.kind,
            "error_px": round(end_error(truth, history, goal), 3),
        }


def surveyed(path: Path, learns: bool) -> dict[str, object]:
    """Line of the survey for a file."""
    begin = time.process_time()
    line: dict[str, object] = {"file": str(path), "flange": ""}
    try:
        try:
            robot = load_urdf(path)
        except UrdfError as error:
            line["refused"] = str(error).replace(str(path), path.name)
            flanges = re.findall(r"flange = '([^']+)'", str(error))
            if not flanges:
                return line
            line["flange"] = flanges[0]
            robot = load_urdf(path, flange=flanges[0])
        line |= {"joints": len(robot.joints), "notes": len(robot.notes)}
        line["read_s"] = round(time.process_time() - begin, 2)
        line["difference"] = engine_difference(robot)
        line |= reached(path, str(line["flange"])) if learns else {}
    except Exception as error:  # the survey lists what happened and goes on
        line["failed"] = f"{type(error).__name__}: {error}"[:300]
    line["cpu_s"] = round(time.process_time() - begin, 1)
    return line


def usable(line: dict) -> bool:
    """Whether an arm's kinematics are pybullet's, and it was learnt and reached its goal if that was tried."""
    learnt = line.get("end", "goal_reached") == "goal_reached" and line.get("error_px", 0.0) < 1.0
    return learnt and "failed" not in line and line["difference"] < CLOSE_M


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("places", type=Path, nargs="+", help="files, or folders of such")
    parser.add_argument("--copied", action="store_true")
    parser.add_argument("--read", action="store_true")
    asked = parser.parse_args()
    asked.out.touch()
    lines = [json.loads(text) for text in asked.out.read_text().splitlines()]
    done = {line["file"] for line in lines}
    found = sorted(
        {path.resolve() for place in asked.places for path in ([place] if place.is_file() else place.rglob("*.urdf"))}
    )
    for path in found:
        if str(path) in done:
            continue
        with tempfile.TemporaryDirectory() as scratch:
            tried = Path(shutil.copy(path, scratch)) if asked.copied else path
            lines.append({**surveyed(tried, not asked.read), "file": str(path)})
        with asked.out.open("a") as out:
            out.write(json.dumps(lines[-1]) + "\n")
        print(json.dumps(lines[-1]), flush=True)
    arms = [line for line in lines if line.get("joints", 0) >= 2]
    good = sum(map(usable, arms))
    alone = sum(not line["flange"] for line in arms)
    print(f"{len(lines)} files, {len(arms)} arms: {good} usable; {alone} need no option")


if __name__ == "__main__":
    main()
