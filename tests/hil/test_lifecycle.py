"""The daemon as real processes: starts that fail, modes, and the death of each process."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from stereoservo.cli.status import describe
from stereoservo.client import (
    Client,
    DaemonLostError,
    EventWatch,
    FailedError,
    NoReplyError,
    RefusedError,
)
from stereoservo.client.goal_handle import TERMINAL
from stereoservo.client.session import SessionError
from stereoservo.daemon.seqlock import StopSlot
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.discovery import (
    DaemonError,
    DaemonProcess,
    NotRunningError,
    find_daemon,
    live_cells,
)
from stereoservo.messages.goals import Goal, JointTarget
from stereoservo.messages.wire import EventMessage
from stereoservo.recording.replay import replay

from .conftest import CELL, at_rest, eventually, moved_away, processes

pytestmark = pytest.mark.process

Start = Callable[..., DaemonProcess]

# -- starts that fail ---------------------------------------------------------------------------------------


def test_two_daemons_on_one_cell(live: DaemonProcess, start: Start, calibrated: Path) -> None:
    second = start(calibrated, ready=False)
    assert second.process.wait(60.0) == 1
    assert f"cell '{CELL}' is already in use by process {live.process.pid}" in second.output()
    assert f"kill {live.process.pid}" in second.output()
    assert live.process.poll() is None
    with Client(CELL) as client:
        assert client.status().servo_alive


def changed(cell_file: Path, old: str, new: str) -> Path:
    text = cell_file.read_text()
    assert old in text
    path = cell_file.with_name("changed.toml")
    path.write_text(text.replace(old, new))
    return path


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[servo]", "[servo]\nspeed = 1", "unknown field `speed`"),
        ('driver = "fake"\n[joints', 'driver = "kuka"\n[joints', "no joint driver 'kuka'; there are:"),
        ('joint = "j6"', 'joint = "j7"', "j6"),
        (
            'driver = "fake"\nmount',
            'driver = "fake"\ndetector = "dots"\nmount',
            "delivers observations; leave the detector out",
        ),
        ("schema = 1", "schema = 1\n[zenoh]\nendpoints = ['tcp/0.0.0.0:7447']", "every host"),
    ],
)
def test_a_cell_that_cannot_run_says_why_and_leaves_nothing(
    old: str, new: str, message: str, cell_file: Path, start: Start, directories: CellDirectories
) -> None:
    daemon = start(changed(cell_file, old, new), ready=False)
    assert daemon.process.wait(90.0) == 1
    assert message in daemon.output()
    assert not processes(directories)
    assert not directories.daemon.exists()


def moving(client: Client) -> None:
    """A slow goal that is under way."""
    moved_away(client)
    client.goal("park", gain=0.05, time_limit_s=300.0, tolerance_px=0.01).abandon()
    eventually("the arm moves", lambda: not at_rest(client))


# -- deaths -------------------------------------------------------------------------------------------------


def answers(client: Client) -> bool:
    """Whether the daemon answers."""
    try:
        client.status()
    except NoReplyError:
        return False
    return True


def codes(client: Client) -> set[str]:
    """Codes of the reasons in the cell's state."""
    return {reason.code for reason in client.status().reasons}


def test_a_hung_gateway_means_hold(own: Client, directories: CellDirectories) -> None:
    moving(own)
    gateway = processes(directories)["gateway"]
    os.kill(gateway, signal.SIGSTOP)
    try:
        with pytest.raises(NoReplyError):
            own.status()
    finally:
        os.kill(gateway, signal.SIGCONT)
    # The client's own link may have been given up meanwhile; it comes back by itself.
    eventually("the cell answers and is held", lambda: answers(own) and "HELD" in codes(own))
    assert at_rest(own)
    own.resume()
    eventually("the goal goes on", lambda: not at_rest(own))


def test_a_stop_needs_no_gateway(own: Client, directories: CellDirectories) -> None:
    moving(own)
    gateway = processes(directories)["gateway"]
    os.kill(gateway, signal.SIGSTOP)
    try:
        slot = StopSlot(directories.stop_slot)
        word = slot.raise_stop()
        eventually("the servo process has seen it", lambda: slot.acknowledged(word))
    finally:
        os.kill(gateway, signal.SIGCONT)
    eventually("the arm rests", lambda: answers(own) and at_rest(own))


def test_a_killed_gateway_holds_the_arm_and_comes_back_with_its_events(
    own: Client, directories: CellDirectories
) -> None:
    moving(own)
    old = processes(directories)["gateway"]
    with EventWatch(own) as watch:
        os.kill(old, signal.SIGKILL)
        eventually("a new gateway", lambda: processes(directories).get("gateway", old) != old)
        with pytest.raises(DaemonLostError):
            watch.wait(lambda e: False, "nothing", 30.0)

    def held() -> bool:
        try:
            with Client(CELL) as again:
                events = again.events(1).events
        except (NoReplyError, SessionError, NotRunningError, RefusedError):
            return False
        found: list[EventMessage] = [event for event in events if event.kind == "held"]
        return bool(found) and any(event.kind == "goal_started" for event in events)

    eventually("its events are there again, with the hold", held)
    with Client(CELL) as again:
        assert at_rest(again)
        assert [taught.name for taught in again.info().taught] == ["park"]


def test_a_goal_outlives_gateways_that_die_and_what_dies_meanwhile_is_told_once(
    own: Client, directories: CellDirectories
) -> None:
    """Its client lived and renewed, and the goal ended since the client "did not renew its lease"; of the second death
    and what came after it nobody was told.
    """
    moved_away(own)
    goal = own.goal("park", gain=0.05, time_limit_s=300.0, tolerance_px=0.01, lease_s=1.0)
    deaths = [text.partition(" (")[0] for text in told(directories, "process_ended")]  # of tests before
    for victim in ("gateway", "gateway", "vision-left"):
        old = processes(directories)[victim]
        os.kill(old, signal.SIGKILL)
        deaths.append(f"{victim} ended by signal SIGKILL")
        eventually("a new one", lambda: processes(directories).get(victim, old) != old, 60.0)  # noqa: B023
        eventually("the cell answers", lambda: answers(own), 60.0)
    eventually("all is told", lambda: len(told(directories, "process_ended")) >= len(deaths), 60.0)
    assert [text.partition(" (")[0] for text in told(directories, "process_ended")] == deaths
    assert ends(directories, goal.id) == []
    own.resume()
    eventually("the goal goes on", lambda: not at_rest(own))
    goal.cancel()
    eventually("it ends", lambda: bool(ends(directories, goal.id)))
    (end,) = ends(directories, goal.id)
    assert end["kind"] == "goal_cancelled"
    goal.abandon()


def test_a_killed_vision_process_comes_back(own: Client, directories: CellDirectories) -> None:
    old = processes(directories)["vision-left"]
    with EventWatch(own) as watch:
        os.kill(old, signal.SIGKILL)
        event = watch.wait(lambda e: e.kind == "process_ended", "the report", 20.0)
        assert "vision-left ended by signal SIGKILL" in event.message
    eventually("a new one", lambda: processes(directories).get("vision-left", old) != old)
    eventually("it sees", lambda: own.status().visible.get("left", 0) > 0)
    own.goal("park", tolerance_px=0.5, hold_frames=3).reached(60.0)


def test_a_dead_camera_process_is_a_reason_at_once_and_what_it_saw_is_unknown(
    own: Client, directories: CellDirectories
) -> None:
    def silent() -> dict[str, str]:
        return {r.subject: r.hint for r in own.status().reasons if r.code == "CAMERA_SILENT"}

    def both_see() -> bool:
        state = own.status()
        return set(state.visible) == {"left", "right"} and state.health.verdict == "ok" and not silent()

    eventually("both see", both_see, 60.0)
    assert not own.status().goal
    os.kill(processes(directories)["vision-left"], signal.SIGKILL)
    eventually("it is named", lambda: "its process has ended" in silent().get("left", ""))
    eventually("it sees again", both_see, 60.0)
    both = [processes(directories)[f"vision-{name}"] for name in ("left", "right")]
    for pid in both:
        os.kill(pid, signal.SIGSTOP)  # until the supervisor kills them

    def blind() -> bool:
        state = own.status()
        return (state.visible, state.innovation_px, state.health.verdict) == ({}, {}, "unknown")

    eventually("nobody sees the arm", blind)
    state = own.status()
    assert {r.subject for r in state.reasons if r.code == "CAMERA_SILENT"} == {"left", "right"}
    assert state.level != "ok"
    assert "left unknown (no frame for" in describe(state)
    eventually("both see again", both_see, 60.0)


def test_a_killed_servo_process_ends_everything_with_an_error(
    live: DaemonProcess, directories: CellDirectories
) -> None:
    os.kill(processes(directories)["servo"], signal.SIGKILL)
    assert live.process.wait(30.0) == 1
    assert "the servo process ended by signal SIGKILL" in live.output()
    assert not processes(directories)
    assert live_cells() == []


def journal(directories: CellDirectories) -> list[dict[str, str]]:
    """Events in the cell's journal."""
    return [json.loads(line) for line in directories.journal.read_text().splitlines()]


def told(directories: CellDirectories, kind: str) -> list[str]:
    """Messages of the events of a kind in the cell's journal."""
    return [event["message"] for event in journal(directories) if event["kind"] == kind]


def ends(directories: CellDirectories, goal: str) -> list[dict[str, str]]:
    """Terminal events of a goal in the cell's journal."""
    return [event for event in journal(directories) if event["id"] == goal and event["kind"] in TERMINAL]


@pytest.mark.parametrize(
    ("how", "victims", "cause"),
    [
        (signal.SIGSTOP, ("servo",), "the servo process hung: it gave no sign of life for"),
        (signal.SIGKILL, ("servo",), "the servo process ended by signal SIGKILL (signal 9)"),
        (signal.SIGKILL, (), "the supervisor"),
    ],
    ids=["a servo process that hangs", "a killed servo process", "all killed"],
)
def test_a_goal_has_one_end_with_its_cause_whatever_dies(
    how: signal.Signals, victims: tuple[str, ...], cause: str, own: Client, live: DaemonProcess,
    calibrated: Path, directories: CellDirectories, start: Start,
) -> None:  # fmt: skip
    moved_away(own)
    goal = own.goal("park", gain=0.05, time_limit_s=300.0, tolerance_px=0.01)
    goal.abandon()
    eventually("the arm moves", lambda: not at_rest(own))
    found = processes(directories)
    pids = [found[name] for name in victims] or [found.pop("gateway"), *found.values(), live.process.pid]
    for pid in pids:
        os.kill(pid, how)
    assert live.process.wait(60.0) == (1 if victims else -signal.SIGKILL)
    eventually("no process is left", lambda: not processes(directories))
    with pytest.raises(NotRunningError, match=re.escape(f"{cause}")):
        find_daemon(CELL)
    assert len(ends(directories, goal.id)) == (1 if victims else 0)  # told at once, or by the next run
    assert start(calibrated).stop() == 0
    (end,) = ends(directories, goal.id)
    assert end["kind"] == "goal_aborted"
    assert cause in end["message"]


@pytest.mark.parametrize("name", ["gateway", "vision-left"])
def test_a_process_that_hangs_is_replaced(name: str, own: Client, directories: CellDirectories) -> None:
    old = processes(directories)[name]
    os.kill(old, signal.SIGSTOP)
    eventually("a new one", lambda: processes(directories).get(name, old) != old, 90.0)  # 60 s in a request

    def told() -> bool:
        try:
            with Client(CELL) as client:
                events = client.events(1).events
        except (NoReplyError, SessionError, NotRunningError, RefusedError):
            return False
        return any(e.kind == "process_hung" and e.message.startswith(f"{name} hung") for e in events)

    eventually("it is told", told, 60.0)


def test_a_supervisor_that_hangs_is_told_until_it_goes_on(own: Client, live: DaemonProcess) -> None:
    def told() -> bool:
        return any("the supervisor has given no sign of life" in note for note in own.status().notes)

    assert not told()
    os.kill(live.process.pid, signal.SIGSTOP)
    try:
        eventually("it is told", told, 30.0)
        assert own.stop().accepted
    finally:
        os.kill(live.process.pid, signal.SIGCONT)
    eventually("it is over", lambda: not told(), 30.0)


def test_a_killed_supervisor_leaves_no_orphan(live: DaemonProcess, directories: CellDirectories) -> None:
    live.process.kill()
    live.process.wait()
    eventually("no process is left", lambda: not processes(directories))


@pytest.mark.parametrize(("how", "code"), [(signal.SIGTERM, 0), (signal.SIGINT, 130)])
def test_a_signal_ends_it_with_the_arm_stopped(
    how: signal.Signals, code: int, own: Client, live: DaemonProcess, directories: CellDirectories
) -> None:
    moving(own)
    assert live.stop(how) == code
    assert not processes(directories)
    assert not directories.daemon.exists()
    events = [json.loads(line) for line in directories.journal.read_text().splitlines()]
    last = [event["kind"] for event in events if event["boot"] == events[-1]["boot"]]
    assert "stopped" in last
    with pytest.raises(NotRunningError):
        find_daemon(CELL)


def test_ctrl_c_while_it_starts_leaves_nothing(start: Start, directories: CellDirectories) -> None:
    for wait in ("cell_preparation", "servo"):
        daemon = start(ready=False)
        eventually(f"{wait} runs", lambda name=wait: name in processes(directories))  # type: ignore[misc]
        assert daemon.stop(signal.SIGINT) == 130
        assert not processes(directories)


# -- modes --------------------------------------------------------------------------------------------------


def test_a_recording_replays_bit_for_bit_and_so_does_the_ring(
    calibrated: Path, start: Start, directories: CellDirectories, tmp_path: Path
) -> None:
    path = tmp_path / "flight.mcap"
    daemon = start(calibrated, "--record", str(path))
    with Client(CELL) as client:
        client.enable()
        moved_away(client)
        client.goal("park", tolerance_px=0.5, hold_frames=3).reached(60.0)
        assert client.info().recording == str(path)
    assert daemon.stop() == 0
    result = replay(path)
    assert result.identical is True
    assert result.steps > 500
    assert result.checkpoints >= 1
    newest = max((directories.recordings / "ring").glob("*.mcap"))
    assert replay(newest).identical is True


def test_a_live_cell_is_recorded_on_demand(own: Client) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "stereoservo.cli.main", "record", CELL, "--seconds", "0.5", "--json"],
        capture_output=True,
        text=True,
        check=True,
    )
    file = Path(json.loads(done.stdout)["file"])
    assert own.info().recording == ""
    result = replay(file)
    assert result.identical is True
    assert result.steps > 10


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("[camera.options]\nmarker_drop_rate = 1.0", r"shows 0 markers .* at the base"),
        ("faults = { drop_writes_after = 40 }", r"j\d"),
    ],
)
def test_a_calibration_that_cannot_succeed_ends_with_its_reason_and_the_arm_at_rest(
    options: str, message: str, cell_file: Path, start: Start
) -> None:
    old = "[servo]" if options.startswith("[") else "command_timeout_s"
    start(changed(cell_file, old, f"{options}\n{old}"))
    with Client(CELL) as client:
        client.enable()
        with pytest.raises((FailedError, RefusedError), match=message):
            client.calibrate(timeout_s=60.0)
        eventually("the arm rests", lambda: at_rest(client))
        assert client.status().goal == ""


def test_a_dry_run_moves_nothing(calibrated: Path, start: Start) -> None:
    start(calibrated, "--dry-run")
    with Client(CELL) as client:
        client.enable()
        before = client.status().joints
        handle = client.send(Goal("abcdef00", JointTarget({"j1": before["j1"] + 0.2}), time_limit_s=1.0))
        assert handle.wait(30.0).outcome == "aborted"
        assert client.status().joints == before
        assert client.info().dry_run


def test_commissioning_caps_the_speed(calibrated: Path, start: Start) -> None:
    start(calibrated, "--commissioning")
    with Client(CELL) as client:
        client.enable()
        limit = {joint.name: joint.velocity_max for joint in client.info().joints}
        fastest = 0.0
        client.goal({"j1": client.status().joints["j1"] + 0.5}, time_limit_s=2.0).abandon()
        eventually("the goal is active", lambda: client.status().goal)
        while client.status().goal:
            fastest = max(fastest, abs(client.status().command["j1"]))
        assert 0.0 < fastest <= 0.05 * limit["j1"] * (1 + 1e-9)


def test_a_daemon_that_does_not_start_tells_its_starter(cell_file: Path, start: Start) -> None:
    daemon = start(
        changed(cell_file, "command_timeout_s = 0.4", "colour = 'red'"),
        ready=False,
    )
    with pytest.raises(DaemonError, match="colour") as caught:
        daemon.wait_ready()
    assert caught.value.code == 1
