"""A running daemon goes with a part on a conveyor: it is met while it moves, waited for where it leaves the view,
followed where it comes again; when the belt stands, the goal is reached. Cameras on the arm, fakes, the exact model.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from stereoservo.client import Client
from stereoservo.messages.directories import cell_directories
from stereoservo.messages.discovery import DaemonProcess
from stereoservo.messages.goals import FeatureTarget
from stereoservo_sim.demonstration.belt import Belt
from stereoservo_sim.demonstration.truth import TruthLog
from stereoservo_sim.world.conveyor import Conveyor
from stereoservo_sim.world.exact_model import exact_simulated_model
from stereoservo_sim.world.simulated_cell import hand_cell

from .conftest import cell_of_fakes, eventually, processes, recover

pytestmark = pytest.mark.process

NAME = "belt"
NOISE_PX = 0.1
SEED = 0
SPEED_M_S = 0.02


def belt_cell(folder: Path) -> Path:
    """The shipped cell with fakes, and a model already learnt."""
    return cell_of_fakes(folder, "conveyor", NAME, NOISE_PX, exact_simulated_model(hand_cell(), SEED))


def goal_pixels() -> dict[str, dict[int, tuple[float, float]]]:
    """What the cameras see from the base of the part where it stands in the cell."""
    world = hand_cell()
    return {
        name: {int(i): (float(u), float(v)) for i, (u, v) in zip(world.body.ids, pixels, strict=True)}
        for name, pixels in world.truth_pixels(world.base).items()
    }


def test_part_on_a_conveyor_is_met_waited_for_and_reached(roots: Path) -> None:
    world, directories = hand_cell(), cell_directories(NAME)
    path = belt_cell(roots)
    conveyor = Conveyor(velocity_m_s=(0.0, SPEED_M_S, 0.0), begin_m=(0.0, -0.1, 0.0), for_s=600.0)
    belt = Belt(conveyor, directories.runtime, time.monotonic_ns)
    belt.put()
    with DaemonProcess(path, log=roots / "belt.log") as daemon:
        daemon.wait_ready()
        truth = TruthLog.of_directory(directories.runtime)
        with Client(NAME) as client:
            recover(client)
            first = client.events(1 << 60).next

            def told(*kinds: str) -> list[str]:
                return [e.kind for e in client.events(first).events if e.kind in kinds]

            belt.run()
            handle = client.goal(
                FeatureTarget(goal_pixels()),
                law="stereo",
                follow_markers=tuple(int(i) for i in world.body.ids),
            )
            eventually("the part is met", lambda: "target_met" in told("target_met"), 60.0)
            begin_ns = time.monotonic_ns()
            time.sleep(2.0)
            end_ns = time.monotonic_ns()
            truth.take()
            assert told("goal_reached") == []

            belt.clear()
            eventually("it is missed", lambda: told("target_unseen") == ["target_unseen"])
            assert [reason.code for reason in client.status().reasons if reason.code == "TARGET_UNSEEN"]
            eventually("the arm rests", lambda: not any(client.status().command.values()))
            belt.put()  # the next part
            belt.run()
            eventually("it is seen again", lambda: len(told("target_seen")) == 2)
            eventually("it is met again", lambda: len(told("target_met")) == 2, 60.0)
            belt.place(belt.moved(time.monotonic_ns()))
            assert handle.wait(60.0).outcome == "reached"
            verdicts = [e.name for e in client.events(first).events if e.kind == "health"]
            assert client.status().health.verdict == "ok"
        times, positions = truth.end()
    eventually("no process is left", lambda: not processes(directories))
    goal = world.truth_pixels(world.base)
    judged = (times >= begin_ns) & (times <= end_ns)
    assert judged.sum() > 100
    errors = [
        np.linalg.norm(belt.cell_at(world, int(t)).truth_pixels(q)[name] - goal[name], axis=1)
        for t, q in zip(times[judged][::10], positions[judged][::10], strict=True)
        for name in goal
    ]
    rms, largest = float(np.sqrt(np.mean(np.square(errors)))), float(np.max(errors))
    print(f"seed {SEED}: {rms:.2f} px rms, {largest:.2f} px at most while the part moved at {SPEED_M_S} m/s")
    assert rms < 1.0  # not followed: 60 px
    assert verdicts == []


def test_the_belt_is_run_by_a_command_and_stands_at_its_end(roots: Path) -> None:
    directories = cell_directories("conveyor")
    command = [sys.executable, "-m", "stereoservo.cli.main", "emulate", "conveyor", "conveyor", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            ready = json.loads(process.stdout.readline())
            assert ready["velocity_m_s"] == [0.0, 0.02, 0.0]
            moving = json.loads((directories.runtime / "simulated-workpiece.json").read_text())
            assert moving["since_ns"] == ready["t_ns"]
            process.send_signal(signal.SIGINT)
            stands = json.loads(process.stdout.readline())
            assert process.wait(60) == 0
        finally:
            process.kill()
    assert json.loads((directories.runtime / "simulated-workpiece.json").read_text())["shift_m"] == stands["shift_m"]
    assert -0.12 <= stands["shift_m"][1] <= 0.12
