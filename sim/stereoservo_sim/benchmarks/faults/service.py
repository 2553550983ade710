"""Fault trials of the whole service in real time. A daemon runs with emulated drives; while the arm moves to a goal,
its processes are killed or hung, its files are damaged, or its clients die or are hostile. The status that a person at
the cell sees is checked, too.

The time to rest is measured on the emulator's true joints. Machines are shared and stall: a trial is void, counted, and
repeated if the arm did not move at the time of the fault, or the machine stalled.

A cell's state may lie on a small disk, which is filled to the last byte, or becomes read-only while files on it are
open. Mounting requires root.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stereoservo.client import Client, ClientError, RefusedError, SessionError
from stereoservo.messages.wire import EventMessage, decode
from stereoservo_drivers.kit.timing import StallWatch
from stereoservo_sim.benchmarks import service_bench
from stereoservo_sim.benchmarks.service_bench import CELL, END, SPEED_SCALE, ServiceBench, VoidTrialError, during, send
from stereoservo_sim.benchmarks.timing import summary
from stereoservo_sim.world.history import TrueJointHistory

DISK_MIB = 64
RECORDS_S = 10.0
"""Time limit for a requested recording to begin."""
GROWS_S = 20.0
"""Time limit for a flight ring to grow again once it can be written."""
FILLS = """
import sys, time
zeros, full = bytes(1 << 20), False
with open(sys.argv[1], "ab", buffering=0) as file:
    while True:
        try:
            file.write(zeros)
        except OSError:
            if not full:
                print("full", flush=True)
            full = True
            time.sleep(0.005)
"""
"""Program that fills a disk to its last byte, including space that becomes free."""
RING, RECORDING = "flight ring", "left out"
"""Texts in the notes that nothing is recorded."""


def memory_disk(bench: ServiceBench) -> None:
    """Put the state directory on a file system in memory. Raises VoidTrialError if mounting is not allowed."""
    _mount(bench, bench.directories.state, "-t", "tmpfs", "-o", f"size={DISK_MIB}m,mode=700", "stereoservo")


def image_disk(bench: ServiceBench) -> None:
    """Put it on an ext4 image, which, unlike a file system in memory, can become read-only while files on it are open,
    as a disk with errors does. Raises VoidTrialError.

    The image is in memory: writes to a disk shared with the trial's drives and slots could delay these.
    """
    memory = bench.folder / "memory"
    _mount(bench, memory, "-t", "tmpfs", "-o", f"size={2 * DISK_MIB}m,mode=700", "stereoservo")
    image = memory / "disk.img"
    with image.open("wb") as file:
        file.truncate(DISK_MIB << 20)
    _called("mkfs.ext4", "-q", "-m", "0", str(image))
    _mount(bench, bench.directories.state, "-o", "loop,errors=remount-ro", str(image))


def _mount(bench: ServiceBench, place: Path, *arguments: str) -> None:
    """Mount at a place, until `ServiceBench.forget_state`."""
    place.mkdir(mode=0o700, parents=True, exist_ok=True)
    _called("mount", *arguments, str(place))
    bench.mounts.callback(_unmount, place)


def _unmount(place: Path) -> None:
    """Unmount now, or, if a process still has files open, for all later accesses."""
    try:
        _called("umount", str(place))
    except VoidTrialError:
        _called("umount", "--lazy", str(place))


def _called(*words: str) -> None:
    try:
        subprocess.run(words, capture_output=True, check=True, text=True)
    except OSError as error:
        raise VoidTrialError(f"{words[0]}: {error.strerror}") from error
    except subprocess.CalledProcessError as error:
        raise VoidTrialError(f"{words[0]}: {error.stderr.strip().splitlines()[0]}") from error


def full_disk(bench: ServiceBench) -> int:
    """Fill the disk while the flight is being recorded."""
    _record(bench)
    filler = bench.directories.state / "filler"
    bench.lasting.callback(filler.unlink)
    t0_ns = time.monotonic_ns()
    bench.start_lasting(FILLS, str(filler))
    return t0_ns


def read_only_disk(bench: ServiceBench) -> int:
    """Make the file system read-only, for open files, too, while the flight is being recorded."""
    _record(bench)
    t0_ns = time.monotonic_ns()
    _called("mount", "-o", "remount,abort,errors=remount-ro", str(bench.directories.state))
    return t0_ns


def _record(bench: ServiceBench) -> None:
    """Record the flight; returns once the file exists. Raises VoidTrialError."""
    with Client(CELL) as client:
        client.record()
        until = time.monotonic() + RECORDS_S
        while not client.info().recording:
            if time.monotonic() > until:
                raise VoidTrialError(f"no recording had begun after {RECORDS_S:g} s")
            time.sleep(0.02)


def records_again(bench: ServiceBench) -> str:
    """Failures of recording after space has become available: the flight ring must continue, and a requested recording
    must begin; empty if none.
    """
    until = time.monotonic() + GROWS_S

    def ring_grows(client: Client) -> bool:
        while any(RING in note for note in client.status().notes):
            if time.monotonic() > until:
                return False
            time.sleep(0.05)
        return True

    if not bench.query(ring_grows):
        return f"the flight ring is not written {GROWS_S:g} s after there was room"
    try:
        _record(bench)
        with Client(CELL) as client:
            file = Path(client.info().recording)
            client.record(on=False)
    except VoidTrialError as error:
        return str(error)
    return unexpected(bench) if file.is_file() and file.stat().st_size else f"nothing is in {file}"


def starts_again(bench: ServiceBench) -> str:
    """Failures of stopping and starting a daemon on a disk that cannot be written; empty if none."""
    code = bench.daemon.stop()
    wrong = [f"the daemon ended with exit code {code}"] if code else []
    wrong.append(unexpected(bench))
    bench.ready()
    wrong.append(unexpected(bench))
    return "; ".join(filter(None, wrong))


def unexpected(bench: ServiceBench) -> str:
    """Lines of the daemon's log not explained by the disk: a process that ended, a traceback; empty if none."""
    words = ("Traceback", "starting again", "Error")
    return "; ".join(line for line in bench.daemon.output().splitlines() if any(word in line for word in words))


# -- trials ----------------------------------------------------------------------------------------------------

SLOW = 0.03
"""Speed scale at which the arm moves for longer than a daemon takes to start."""
RAMP_MS = 60.0
"""From that speed to rest, by the loop's ramp or the drives' own."""
DRIVES_MS = 120.0
"""Time after which drives detect the loss of their master."""
SILENCE_MS = 800.0
"""Time after which the servo process considers the gateway lost."""
JOG_LEASE_MS = 250.0
"""Lease of a jog that is not renewed."""
GOAL_LEASE_MS = 1000.0
"""Lease of a goal that is not renewed."""
SESSION_MS = 100.0
"""Time limit of a stop by an open session."""
STOP_MS = 50.0
COMMAND_MS = 700.0
"""Time limit from the start of `stereoservo stop`."""
WATCHED_S = 2.0
"""Time of observation after the fault."""
ASKED_S = 1.0
"""Time after the fault at which `status` is requested."""
MOVING = 2e-3
"""True speed of any joint above which the arm counts as moving [rad/s]."""
STILL_NS = 50_000_000
TRIES = 5
STALL_S = 0.09
"""Lateness of a sleeping thread that indicates a stall of the machine; below the drives' time-out."""
FASTER = 0.2
"""Speed scale at which the arm reaches its goal some seconds after the trial."""
REACHED_S = 30.0
"""Time limit for a continuing goal to be reached."""
TERMINAL = ("goal_reached", "goal_aborted", "goal_cancelled", "goal_preempted")
JOGS = """
import sys, time
from stereoservo.client import Client
with Client(sys.argv[1]) as client:
    while True:
        client.jog({"j1": 0.1}, lease_s=0.25)
        time.sleep(0.08)
"""
GOES = """
import sys, time
from stereoservo.client import Client
with Client(sys.argv[1]) as client:
    end = -0.85 if client.status().joints["j1"] > 0.0 else 0.85
    print(client.goal({"j1": end}, speed_scale=0.1, lease_s=1.0).id, flush=True)
    time.sleep(60.0)
"""


@dataclass(frozen=True)
class ServiceFault:
    """A fault injected into the service, and its required consequences.

    ``process``, ``signal``: of the daemon's, or ``client``; or an act of the bench by ``act``. ``bound_ms``: to rest;
    None if the arm continues; with ``may_go_on`` it either rests by then or continues. ``after``: allowed results of
    `status` a second later, the lifecycle or the code of its error. ``client``: program of a separate client process
    that moves the arm; else the bench moves it at ``speed_scale``. ``note``: text in a status note once the daemon is
    ready again; its state is then deleted. ``disk``: file system of the state directory while a daemon runs. ``notes``:
    texts in the notes a second later. ``reaches``: the goal continues until it is reached, with the cause present.
    ``check``: failures after the cause is removed. ``trials_a_daemon``: number after which the daemon is ended, 0 if it
    continues.
    """

    name: str
    bound_ms: float | None
    after: tuple[str, ...]
    process: str = ""
    signal: signal.Signals = signal.SIGKILL
    act: Callable[[ServiceBench], int] | None = None
    client: str = ""
    note: str = ""
    notes: tuple[str, ...] = ()
    disk: Callable[[ServiceBench], None] | None = None
    reaches: bool = False
    check: Callable[[ServiceBench], str] = lambda bench: ""
    trials_a_daemon: int = 0
    may_go_on: bool = False
    speed_scale: float = SPEED_SCALE

    @property
    def jogs(self) -> bool:
        """Whether the arm moves without a goal."""
        return self.client == JOGS


ACTIVE = ("active",)
PAUSES = 3
"""Trials with an ended process after which a new daemon is faster than the supervisor's pauses, which grow to 10 s."""
ENDED = ("not_running", "servo_silent")
NOT_RECORDED = ("flight ring", "left out")
NO_GATEWAY = ("no_reply", "session")
FAULTS = (
    ServiceFault("stop slot raised", STOP_MS, ACTIVE, act=service_bench.raise_stop_slot),
    ServiceFault("`stereoservo stop`", COMMAND_MS, ACTIVE, act=service_bench.stop_command),
    ServiceFault("servo killed", DRIVES_MS, ENDED, "servo"),
    ServiceFault("servo hung", DRIVES_MS, ("servo_silent",), "servo", signal.SIGSTOP),
    ServiceFault("gateway killed", SILENCE_MS, NO_GATEWAY, "gateway", trials_a_daemon=PAUSES),
    ServiceFault("gateway hung", SILENCE_MS, NO_GATEWAY, "gateway", signal.SIGSTOP),
    ServiceFault("vision killed", None, ACTIVE, "vision-left", trials_a_daemon=PAUSES),
    ServiceFault("vision hung", None, ACTIVE, "vision-left", signal.SIGSTOP),
    ServiceFault("supervisor killed", DRIVES_MS, ENDED, "supervisor"),
    ServiceFault("supervisor hung", None, ACTIVE, "supervisor", signal.SIGSTOP),
    ServiceFault("client killed while it jogs", JOG_LEASE_MS, ACTIVE, "client", client=JOGS),
    ServiceFault("client hung while it jogs", JOG_LEASE_MS, ACTIVE, "client", signal.SIGSTOP, client=JOGS),
    ServiceFault("client of a goal killed", GOAL_LEASE_MS, ACTIVE, "client", client=GOES),
    ServiceFault("client of a goal hung", GOAL_LEASE_MS, ACTIVE, "client", signal.SIGSTOP, client=GOES),
    ServiceFault("client replaced by another's goal", None, ACTIVE, act=service_bench.second_client),
    ServiceFault("second daemon started", None, ACTIVE, act=service_bench.second_daemon, speed_scale=SLOW),
    ServiceFault(
        "second daemon with other directories", None, ACTIVE, act=service_bench.second_daemon_elsewhere,
        speed_scale=SLOW,
    ),
    ServiceFault(
        "gateway killed, `taught.json` cut", SILENCE_MS, NO_GATEWAY,
        act=service_bench.damaged(service_bench.spoil_taught), note="taught.json", trials_a_daemon=PAUSES,
    ),
    ServiceFault(
        "gateway killed, newest model damaged", SILENCE_MS, NO_GATEWAY,
        act=service_bench.damaged(service_bench.spoil_model), note="is used instead", trials_a_daemon=1,
    ),
    ServiceFault(
        "gateway killed, `handled.slot` damaged", SILENCE_MS, NO_GATEWAY,
        act=service_bench.damaged(service_bench.spoil_handled), note="handled.slot", trials_a_daemon=PAUSES,
    ),
    ServiceFault(
        "disk full", None, ACTIVE, act=full_disk, disk=memory_disk, notes=NOT_RECORDED, reaches=True,
        check=records_again, speed_scale=FASTER,
    ),
    ServiceFault(
        "`stereoservo stop`, disk full", COMMAND_MS, ACTIVE, disk=memory_disk, notes=NOT_RECORDED,
        act=during(full_disk, service_bench.stop_command), check=records_again,
    ),
    ServiceFault(
        "file system read-only", None, ACTIVE, act=read_only_disk, disk=image_disk, notes=NOT_RECORDED,
        reaches=True, check=starts_again, trials_a_daemon=1, speed_scale=FASTER,
    ),
    ServiceFault(
        "`stereoservo stop`, file system read-only", COMMAND_MS, ACTIVE, disk=image_disk, notes=NOT_RECORDED,
        act=during(read_only_disk, service_bench.stop_command), check=unexpected, trials_a_daemon=1,
    ),
    ServiceFault("gateway without memory", SILENCE_MS, (*ACTIVE, *NO_GATEWAY), act=service_bench.memory_exhausted,
                 may_go_on=True),
    ServiceFault(f"{service_bench.SOCKETS} silent TCP sockets", None, ACTIVE, act=service_bench.idle_sockets),
    ServiceFault(
        f"`stereoservo stop`, {service_bench.SOCKETS} silent TCP sockets", COMMAND_MS, ACTIVE,
        act=during(service_bench.idle_sockets, service_bench.stop_command),
    ),
    ServiceFault(
        f"stop by an open TCP session, {service_bench.SOCKETS} silent sockets", SESSION_MS, ACTIVE,
        act=service_bench.stop_by_open_session,
    ),
    ServiceFault("20 000 refused messages", None, ACTIVE, act=service_bench.refused_puts),
    ServiceFault(
        "`stereoservo stop`, 20 000 refused messages", COMMAND_MS, ACTIVE,
        act=during(service_bench.refused_puts, service_bench.stop_command),
    ),
)  # fmt: skip


def run_service(
    repetitions: int, tell: Callable[[dict[str, Any]], None], faults: tuple[ServiceFault, ...] = FAULTS
) -> list[dict[str, Any]]:
    """Rows of all faults, ``repetitions`` trials each; ``tell`` is called with each. A trial after which no daemon
    answers
    is not within its bound; the attempts are then reported in place of `status`.

    Raises ExperimentError if the drives or a daemon do not start.
    """
    rows = []
    with service_bench.running_bench() as bench:
        for fault in faults:
            rows.append(_row(bench, fault, repetitions))
            tell(rows[-1])
    return rows


def _row(bench: ServiceBench, fault: ServiceFault, repetitions: int) -> dict[str, Any]:
    trials: list[dict[str, Any]] = []
    void: list[str] = []
    silent: list[str] = []
    took_s: list[float] = []
    tried, anew = 0, True
    while len(trials) + len(silent) < repetitions and len(void) < TRIES:
        began_s = time.monotonic()
        try:
            if fault.disk is not None and anew:
                bench.end_daemon()
                fault.disk(bench)
                anew = False
            bench.ready()
            if fault.process not in ("", "client"):
                bench.await_process(fault.process)
            trial = _trial(bench, fault)
        except VoidTrialError as error:
            void.append(str(error))
            continue
        except (ClientError, SessionError) as error:
            silent.append(f"no answer: {error}")
            bench.end_daemon()
            continue
        finally:
            bench.lasting.close()
            bench.goals.clear()
            tried += 1
            if fault.trials_a_daemon and tried % fault.trials_a_daemon == 0:
                bench.end_daemon()
                anew = True
            if fault.note or (fault.disk is not None and anew):
                bench.delete_state()
            took_s.append(time.monotonic() - began_s)
        if trial["stall_s"] > STALL_S:
            void.append(f"the machine stalled for {trial['stall_s'] * 1e3:.0f} ms")
        else:
            trials.append(trial)
    if fault.trials_a_daemon or fault.disk is not None:
        bench.end_daemon()
        bench.delete_state()
    rests = [trial["rest_ms"] for trial in trials if trial["rest_ms"] is not None]
    bound = None if fault.bound_ms is None else fault.bound_ms + RAMP_MS
    return {
        "fault": fault.name,
        "bound_ms": bound,
        "rest_ms": summary(rests) if rests else None,
        "within": sum(_is_within(trial["rest_ms"], bound, fault.may_go_on) and not trial["wrong"] for trial in trials),
        "after": sorted({trial["after"] for trial in trials}),
        "status_right": sum(_status_is_right(trial, fault) for trial in trials),
        "status_says": sorted({*(trial["says"] for trial in trials), *silent}),
        "terminal_events": sorted({count for trial in trials for count in trial["terminal"]}),
        "trials": len(trials) + len(silent),
        "void": void,
        "trial_s": summary(took_s),
    }


def _is_within(rest_ms: float | None, bound_ms: float | None, may_go_on: bool) -> bool:
    """Whether the arm rested in time, or, without a bound, continued."""
    if rest_ms is None:
        return bound_ms is None or may_go_on
    return bound_ms is not None and rest_ms <= bound_ms


def _status_is_right(trial: dict[str, Any], fault: ServiceFault) -> bool:
    """Whether `status` a second later was correct, with exit code 1 for an error, and later contained the note."""
    right = trial["after"] in fault.after and trial["code"] == (0 if trial["after"] == "active" else 1)
    right = right and all(any(text in note for note in trial["now"]) for text in fault.notes)
    return right and (not fault.note or any(fault.note in note for note in trial["notes"]))


def _trial(bench: ServiceBench, fault: ServiceFault) -> dict[str, Any]:
    """One trial. Raises VoidTrialError."""
    history = bench.truth()
    child: subprocess.Popen[str] | None = None
    client = Client(CELL)
    told_live: list[EventMessage] = []
    client.session.declare_subscriber(
        client.keys.event, lambda sample: told_live.append(decode(sample.payload.to_bytes(), EventMessage))
    )
    try:
        if fault.client:
            child = subprocess.Popen([sys.executable, "-c", fault.client, CELL], stdout=subprocess.PIPE, text=True)
        if not fault.jogs:
            bench.goals.append(_sent_goal(client, child, fault.speed_scale))
        with StallWatch() as watch:
            _await_motion(history)
            start = history.count
            if fault.act is not None:
                t0 = fault.act(bench)
            else:
                pid = child.pid if child is not None else bench.processes()[fault.process]
                t0 = time.monotonic_ns()
                send(pid, fault.signal)
            _refuse_reached(told_live, "before the fault came")
            time.sleep(max(0.0, ASKED_S - (time.monotonic_ns() - t0) * 1e-9))
            code, told = bench.status()
            time.sleep(max(0.0, WATCHED_S - (time.monotonic_ns() - t0) * 1e-9))
            rest_ms = _rest_ms(history, start, t0)
            if fault.bound_ms is None:
                _refuse_reached(told_live, "while the arm was watched")
            wrong = [_not_reached(told_live)] if fault.reaches else []
        bench.lasting.close()
    finally:
        history.close()
        if child is not None:
            send(child.pid, signal.SIGCONT)
            child.kill()
            child.communicate()
        with suppress(ClientError):
            client.close()
    counts, notes = _afterwards(bench, fault, told_live)
    wrong.append(fault.check(bench))
    says = str(told["error"]["message"]) if "error" in told else _reasons(told)
    now = sorted(note.replace(f"{bench.folder}/", "") for note in told.get("notes", ()))
    for title, more in (
        ("Notes", now if fault.notes else []),
        ("Later", list(notes) if fault.note else []),
        ("Wrong", [text for text in wrong if text]),
    ):
        says += f". {title}: {'; '.join(more)}" if more else ""
    return {
        "rest_ms": rest_ms,
        "after": str(told["error"]["code"] if "error" in told else told["lifecycle"]),
        "code": code,
        "says": says,
        "now": now,
        "notes": notes,
        "wrong": any(wrong),
        "stall_s": watch.longest_s,
        "terminal": counts or (-1,),
    }


def _refuse_reached(events: list[EventMessage], when: str) -> None:
    """Raise VoidTrialError if a goal was reached: the arm then rests for that reason."""
    if any(event.kind == "goal_reached" for event in events):
        raise VoidTrialError(f"the goal was reached {when}")


def _not_reached(events: list[EventMessage]) -> str:
    """Wait for the goal's end; returns what is wrong with it, empty if it was reached."""
    until = time.monotonic() + REACHED_S
    while not (ends := [event for event in events if event.kind in TERMINAL]):
        if time.monotonic() > until:
            return f"the goal was not reached {REACHED_S:g} s later"
        time.sleep(0.02)
    return "; ".join(f"{event.kind}: {event.message}" for event in ends if event.kind != "goal_reached")


def _sent_goal(client: Client, child: subprocess.Popen[str] | None, speed_scale: float) -> str:
    """Id of a goal sent by this process's client, or by the child. Raises VoidTrialError."""
    if child is not None:
        assert child.stdout is not None
        if not (line := child.stdout.readline()):
            raise VoidTrialError("the client of the goal ended")
        return line.strip()
    try:
        end = -END if client.status().joints["j1"] > 0.0 else END
        return client.goal({"j1": end}, speed_scale=speed_scale).id
    except ClientError as error:
        raise VoidTrialError(str(error)) from error


def _reasons(status: dict[str, Any]) -> str:
    return "; ".join(reason["hint"] for reason in status["reasons"]) or "nothing is wrong"


def _afterwards(
    bench: ServiceBench, fault: ServiceFault, told_live: list[EventMessage]
) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """Number of terminal events of each goal, received by listeners from this daemon or the next; and the notes of the
    daemon that is ready again.
    """
    bench.ready()

    def told(client: Client) -> tuple[tuple[EventMessage, ...], tuple[str, ...]]:
        if fault.bound_ms is None or fault.may_go_on:
            for goal in bench.goals:
                with suppress(RefusedError):
                    client.cancel(goal)
        time.sleep(0.3)
        return client.events(0).events, client.status().notes

    events, notes = bench.query(told)
    ended = [event for event in (*told_live, *events) if event.kind in TERMINAL]
    ends = [{(event.boot, event.seq) for event in ended if event.id == goal} for goal in bench.goals]
    return tuple(map(len, ends)), tuple(note.replace(f"{bench.folder}/", "") for note in notes)


def _await_motion(history: TrueJointHistory) -> None:
    until = time.monotonic() + 10.0
    while (newest := history.newest()) is None or np.abs(newest[2]).max() < 10 * MOVING:
        if time.monotonic() > until:
            raise VoidTrialError("the arm did not move within 10 s")
        time.sleep(0.01)
    time.sleep(0.2)
    newest = history.newest()
    if newest is None or np.abs(newest[2]).max() < 10 * MOVING:
        raise VoidTrialError("the arm stopped before the fault came")


def _rest_ms(history: TrueJointHistory, start: int, t0_ns: int) -> float | None:
    """Time from ``t0_ns`` to the last motion [ms] within the time of observation; None if the arm still moves at its
    end.
    """
    end_ns = t0_ns + round(WATCHED_S * 1e9)
    last_ns = newest_ns = t0_ns
    for index in range(start, history.count):
        sample = history.sample(index)
        if sample is None or not t0_ns <= sample[0] <= end_ns:
            continue
        newest_ns = sample[0]
        if np.abs(sample[2]).max() > MOVING:
            last_ns = sample[0]
    return None if newest_ns - last_ns < STILL_NS else (last_ns - t0_ns) * 1e-6
