"""The daemon as real processes: goals over zenoh, bad goals, clients that die."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from stereoservo.cli import main as cli
from stereoservo.client import Client, ClientError, EventWatch, RefusedError
from stereoservo.geometry.cameras import project
from stereoservo.geometry.distortion import distort
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.model import load_model
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.discovery import DaemonProcess
from stereoservo.messages.goals import DisplacementTarget, FeatureTarget
from stereoservo.messages.wire import Reply, decode
from stereoservo.numerics.arrays import FloatArray

from .conftest import CELL, at_rest, eventually, moved_away, processes

pytestmark = pytest.mark.process


# -- the main line ------------------------------------------------------------------------------------------


def test_a_goal_is_servoed_over_zenoh_by_either_law(client: Client) -> None:
    for law in ("stereo", "cartesian3"):
        moved_away(client)
        result = client.goal("park", law=law, tolerance_px=0.5, hold_frames=3).reached(60.0)  # type: ignore[arg-type]
        assert result.error_px is not None
        assert result.error_px <= 0.5
    info = client.info()
    assert [taught.name for taught in info.taught] == ["park"]
    assert info.model is not None


def test_the_servo_process_maps_no_library_that_could_delay_it(
    shared: DaemonProcess, directories: CellDirectories
) -> None:
    maps = Path(f"/proc/{processes(directories)['servo']}/maps").read_text()
    assert "numba" in maps
    for library in ("zenoh", "cv2", "scipy/optimize", "pybullet", "matplotlib"):
        assert library not in maps, library
    environment = Path(f"/proc/{processes(directories)['servo']}/environ").read_text()
    assert "OPENBLAS_NUM_THREADS=1" in environment


def test_events_are_numbered_and_can_be_read_from_any_number(client: Client) -> None:
    client.hold()
    client.resume()
    page = client.events(1)
    assert [event.seq for event in page.events] == list(range(1, page.next))
    assert {event.boot for event in page.events} == {page.boot}
    later = client.events(page.next - 1)
    assert [event.seq for event in later.events] == [page.next - 1]


@pytest.mark.parametrize("number", ["abc", "-1", "²", "9" * 5000])
def test_a_number_that_is_none_is_refused_and_the_gateway_lives(client: Client, number: str) -> None:
    boot = client.status().boot
    reply = decode(client.query(f"{client.keys.event}?from={number}"), Reply)
    assert not reply.accepted
    assert "a number is valid" in reply.problems[0]
    features = b'{"kind": "features", "set_points": {"left": {"0": [1, 1]}}, "model_epoch": %s}'
    payload = b'{"id": "00000000", "target": ' + features + b"}"
    reply = decode(client.query(client.keys.goal("x"), payload % (b"9" * 30)), Reply)
    assert not reply.accepted
    assert client.status().boot == boot


def test_watch_shows_state_events_and_features(client: Client) -> None:
    seen = set()
    stream = client.watch(features=True)
    client.hold()
    for message in stream:
        seen.add(type(message).__name__)
        if len(seen) == 3:
            break
        client.resume()
        client.hold()
    client.resume()


def test_home_jog_and_cli_verbs(client: Client) -> None:
    moved_away(client)
    before = client.status().joints["j2"]

    def cli(*arguments: str) -> tuple[int, dict[str, object]]:
        done = subprocess.run(
            [sys.executable, "-m", "stereoservo.cli.main", *arguments, "--json"],
            capture_output=True,
            text=True,
            check=False,
        )
        return done.returncode, json.loads(done.stdout)

    code, state = cli("jog", CELL, "j2=0.1", "--seconds", "0.3")
    assert code == 0
    assert state["joints"]["j2"] > before + 0.01  # type: ignore[index]
    code, state = cli("auxiliary", CELL, "gripper=0.02", "light=on")
    assert code == 0
    assert state["auxiliary"] == {"gripper": pytest.approx(0.02, abs=1e-3), "light": 1.0}
    code, refused = cli("auxiliary", CELL, "gripper=0.2")
    assert code == 1
    assert "0 to 0.08 m is valid" in refused["error"]["message"]  # type: ignore[index]
    code, reached = cli("home", CELL)
    assert (code, reached["outcome"]) == (0, "reached")
    code, checked = cli("goal", CELL, "park", "--check")
    assert (code, checked["accepted"]) == (0, True)
    code, stopped = cli("stop", CELL)
    assert (code, stopped["accepted"]) == (0, True)
    code, refused = cli("goal", CELL, "park")
    assert code == 1
    assert "resume" in refused["error"]["message"]  # type: ignore[index]
    assert cli("resume", CELL)[0] == 0
    code, aborted = cli("goal", CELL, "park", "--time-limit", "0.001", "--tolerance", "0.0001")
    assert code == 1
    assert aborted["error"]["code"] == "goal_aborted"  # type: ignore[index]


# -- goals of other kinds -----------------------------------------------------------------------------------


class Model:
    """The daemon's own model: what it says of the body at joints that the test names."""

    def __init__(self, client: Client) -> None:
        info = client.info().model
        assert info is not None
        self.model = load_model(Path(info.path))
        self.chain = ProjectiveChain(self.model.joint_kinds, self.model.generators, self.model.zero)

    def displacement(self, start: FloatArray, end: FloatArray) -> DisplacementTarget:
        """From the pose at ``start`` to that at ``end`` (n,)."""
        there = self.chain.displacement(end) @ np.linalg.inv(self.chain.displacement(start))
        return DisplacementTarget(tuple(there.ravel().tolist()), self.model.epoch)

    def seen(self, q: FloatArray, markers: tuple[int, ...]) -> FeatureTarget:
        """Set-points of the body at ``q`` (n,)."""
        rows = [self.model.marker_ids.index(marker) for marker in markers]
        points = self.model.marker_points[rows] @ self.chain.displacement(q).T
        return FeatureTarget(
            {
                camera.name: dict(
                    zip(
                        markers,
                        map(tuple, distort(camera.lens, project(camera.matrix, points)).tolist()),
                        strict=True,
                    )
                )
                for camera in self.model.cameras
            }
        )


def joints_of(client: Client) -> FloatArray:
    """Joints now (n,)."""
    return np.array(list(client.status().joints.values()))


LENGTH = "baseline:left,right=0.3"
OFFSET = np.array([0.06, -0.04, 0.05, 0.05, -0.04, 0.06])


def test_a_step_is_refused_without_a_length_and_made_with_one(
    client: Client, capfd: pytest.CaptureFixture[str]
) -> None:
    client.goal("park", law="cartesian3", tolerance_px=0.5, hold_frames=3).reached(60.0)
    with pytest.raises(RefusedError, match="turning joints alone leave the model's scale open, and no length is known"):
        client.move(z=0.01)
    handle = client.move(z=0.01, frame="base", length=LENGTH, law="trajectory", tolerance_px=0.1)
    (listed,) = client.running_goals()
    assert listed.goal.target.set_points  # type: ignore[union-attr]
    made = handle.reached(60.0).message.split("in base: asked (0.00, 0.00, 10.00) mm, (0.00, 0.00, 0.00)°; made ")[1]
    assert np.abs(np.array(made.split(")")[0].strip("(").split(","), dtype=float) - (0.0, 0.0, 10.0)).max() < 1.0
    both = ["goal", CELL, "--move", "x=2mm,z=-5mm", "--turn", "z=2deg", "--length", LENGTH, "--check"]
    assert cli.invoke(both) == 0
    turned = ["goal", CELL, "--turn", "z=-5deg", "--in", "camera:left", "--law", "trajectory"]
    assert cli.invoke(turned) == 0
    assert "in camera:left: asked (0.00, 0.00, -5.00)°; made (" in capfd.readouterr().out


def test_a_displacement_is_checked_driven_streamed_and_acknowledged(client: Client, tmp_path: Path) -> None:
    client.goal("park", law="cartesian3", tolerance_px=0.5, hold_frames=3).reached(60.0)
    model, start = Model(client), joints_of(client)
    wanted = client.make_goal(
        model.displacement(start, start + OFFSET), law="cartesian3", tolerance_px=0.5, hold_frames=3, acknowledge_s=30.0
    )  # fmt: skip
    # What it would do, by the library and by the command line, and nothing moves.
    plan = client.check(wanted).plan
    assert plan is not None
    assert plan.seconds > 0.0
    assert np.abs([way[-1] for way in plan.joints.values()] - (start + OFFSET)).max() < 0.02
    assert {approach.code for approach in plan.approaches} & {"JOINT_LIMIT", "FIELD_OF_VIEW"}
    path = tmp_path / "move.json"
    path.write_text(json.dumps({"matrix": wanted.target.matrix, "model_epoch": model.model.epoch}))  # type: ignore[union-attr]
    done = subprocess.run(
        [sys.executable, "-m", "stereoservo.cli.main", "goal", CELL, "--displacement", str(path), "--law", "cartesian3",
         "--check", "--json"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    assert json.loads(done.stdout)["plan"]["way"] == plan.way
    assert np.abs(joints_of(client) - start).max() < 1e-3
    # Driven; the next one waits until it is acknowledged.
    handle = client.send(wanted)
    back = client.goal("park", law="cartesian3", tolerance_px=0.5, hold_frames=3, mode="queue")
    handle.reached(60.0)
    there = joints_of(client)
    assert np.abs(there - (start + OFFSET)).max() < 0.02
    assert not back.progress().active
    handle.acknowledge()
    back.reached(60.0)
    # The same way again, as set-points that a client streams, always ahead of the arm.
    seen = park_points(client)
    markers = tuple(sorted(seen["left"].keys() & seen["right"].keys()))

    def at(share: float) -> FeatureTarget:
        return model.seen(start + share * OFFSET, markers)

    def stream() -> Iterator[tuple[float | None, FeatureTarget]]:
        for k in range(60):
            time.sleep(0.02)
            yield 0.02 * k, at(0.4 + 0.6 * k / 59)

    moving = client.goal(at(0.4), law="cartesian3", tolerance_px=0.5, hold_frames=3, lease_s=3.0)
    assert moving.stream(stream()) == 60
    assert moving.reached(30.0).error_px is not None
    assert np.abs(joints_of(client) - (start + OFFSET)).max() < 0.02


def test_looking_around_with_a_wildcard_reads_everything_and_stops_nothing(client: Client) -> None:
    found = {}
    for reply in client.session.get(f"{client.keys.prefix}/**", timeout=30.0):
        if reply.ok is not None:
            found[str(reply.ok.key_expr)] = reply.ok.payload.to_bytes()
    keys = client.keys
    assert set(found) == {keys.state, keys.info, keys.event, keys.model, keys.goals}
    client.session.put(f"{client.keys.prefix}/command/*", b"{}")
    assert client.goal({"j1": client.status().joints["j1"]}).reached(30.0)
    assert not {"STOPPED", "HELD"} & {reason.code for reason in client.status().reasons}


def test_a_put_stops_too(client: Client) -> None:
    client.session.put(client.keys.stop, b"")
    eventually("stopped", lambda: "STOPPED" in {reason.code for reason in client.status().reasons})
    halt = client.status().halt
    assert halt is not None
    assert halt.words == "stopped by a client that gives no name"
    client.resume()


def test_whoever_stopped_or_held_the_arm_is_named(client: Client) -> None:
    def words() -> str | None:
        halt = client.status().halt
        return None if halt is None else halt.words

    assert words() is None
    with EventWatch(client) as watch:
        client.stop("viewer 2")
        event = watch.wait(lambda e: e.kind == "stopped", "the stop", 10.0)
        assert event.operator == "viewer 2"
    eventually("it is named", lambda: words() == "stopped by viewer 2")
    client.resume()
    eventually("it is over", lambda: words() is None)
    assert cli.invoke(["stop", CELL]) == 0
    eventually("over no wire", lambda: words() == "stopped on the cell's host")
    client.resume()
    client.hold()
    eventually("held", lambda: words() == f"held by {client.operator}")
    client.resume()


def test_schemas_are_served(client: Client) -> None:
    assert b"set_points" in client.schema("goal")
    assert b"no schema 'gaol'; there are: goal, " in client.schema("gaol")


# -- bad input ----------------------------------------------------------------------------------------------


def park_points(client: Client) -> dict[str, dict[int, tuple[float, float]]]:
    """Set-points where the markers are now."""
    points: dict[str, dict[int, tuple[float, float]]] = {}
    for message in client.watch(features=True):
        if type(message).__name__ == "FeaturesMessage":
            points[message.camera] = dict(zip(message.ids, message.pixels, strict=True))  # type: ignore[union-attr]
        if len(points) == 2:
            return points
    raise AssertionError("the stream ended")


def test_goals_that_cannot_be_are_refused_with_what_would_be_valid(client: Client) -> None:
    points = park_points(client)
    wrong_marker = {"left": {**points["left"], 99: (5.0, 5.0)}}
    with pytest.raises(RefusedError, match=r"knows no marker 99; it knows: 0, 1, 2"):
        client.goal(FeatureTarget(wrong_marker))
    with pytest.raises(RefusedError, match=r"pixel \(700, 5\) is outside the image; u from -0\.5 to 639\.5"):
        client.goal(FeatureTarget({"left": {**points["left"], 0: (700.0, 5.0)}}))
    with pytest.raises(RefusedError, match=r"'stereo' works on set-points in images"):
        client.goal({"j1": 0.0}, law="stereo")
    with pytest.raises(RefusedError, match=r"no taught goal 'pork'; taught: park"):
        client.goal("pork")
    with pytest.raises(ValueError, match=r"target\.positions\.j1 is nan"):
        client.goal({"j1": float("nan")})
    raw = b'{"id":"12345678","target":{"kind":"joints","positions":{"j1":NaN}}}'
    for reply in client.session.get(client.keys.goal("raw"), payload=raw, timeout=30.0):
        answer = decode(reply.ok.payload.to_bytes(), Reply)
        assert not answer.accepted
        assert "NaN is not a JSON number" in answer.problems[0]
        break
    else:
        raise AssertionError("no reply")
    with pytest.raises(RefusedError, match="taught with model epoch 77"):
        client.goal(FeatureTarget(points, model_epoch=77))
    assert at_rest(client)
    assert client.status().goal == ""


def test_a_client_that_dies_in_mid_goal_stops_the_arm_when_its_lease_runs_out(client: Client) -> None:
    moved_away(client)
    code = f"""
import time
from stereoservo.client import Client
client = Client({CELL!r})
handle = client.goal("park", gain=0.05, lease_s=0.6, time_limit_s=60.0, tolerance_px=0.01)
print(handle.id, flush=True)
time.sleep(60)
"""
    with EventWatch(client) as watch:
        process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        goal = process.stdout.readline().strip()
        assert goal
        # It lives on its renewals for longer than its lease ...
        with pytest.raises(ClientError, match="nothing within"):
            watch.wait(lambda e: e.id == goal and e.kind != "goal_accepted" and e.kind != "goal_started", "goal", 1.5)
        process.kill()
        process.wait()
        process.stdout.close()
        # ... and not without them.
        event = watch.wait(lambda e: e.id == goal and e.kind == "goal_aborted", "the abort", 10.0)
    assert event.reasons[0].code == "LEASE_EXPIRED"
    eventually("the arm rests", lambda: at_rest(client))


def test_every_goal_has_one_terminal_event(client: Client) -> None:
    moved_away(client)
    ends = ("goal_reached", "goal_aborted", "goal_cancelled", "goal_preempted")
    with EventWatch(client) as watch:
        first = client.goal("park", gain=0.05)
        second = client.goal("park", gain=0.05)
        assert cli.invoke(["cancel", CELL]) == 0  # the active one
        third = client.goal("park", gain=0.05)
        client.stop()
        assert first.wait(10.0).outcome == "preempted"
        assert second.wait(10.0).outcome == "cancelled"
        assert third.wait(10.0).outcome == "aborted"
        client.resume()
        client.goal({"j1": client.status().joints["j1"]}).reached(30.0)
        ended = [event.id for event in watch.poll() if event.kind in ends]
    for handle in (first, second, third):
        assert ended.count(handle.id) == 1


def test_ctrl_c_in_a_goal_cancels_it(client: Client) -> None:
    moved_away(client)
    process = subprocess.Popen(
        [sys.executable, "-m", "stereoservo.cli.main", "goal", CELL, "park", "--gain", "0.05", "--json"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stderr is not None
    assert "accepted" in process.stderr.readline()
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=30.0)
    assert process.returncode == 130
    assert json.loads(out)["error"]["code"] == "interrupted"
    eventually("the arm rests", lambda: at_rest(client) and client.status().goal == "")
