"""A recording replays bit for bit; a damaged one says how far it is good."""

from __future__ import annotations

import dataclasses
import uuid
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from core.former_states import without_a_block
from oracles.former_recording import FormerRecorder
from oracles.former_recording import encode_step as former_step
from stereoservo.control.law import LawStep, Options, Scene, Task
from stereoservo.control.law_registry import LAWS
from stereoservo.core.cycle import DriverFault, Event, ModelUpdate, encode
from stereoservo.core.state import STATE_VERSION
from stereoservo.core.state_encoding import (
    OLDEST_VERSION,
    StateVersionError,
    decode_state,
    encode_state,
    is_recorded,
)
from stereoservo.messages.goals import DEFAULT_LAW, Enable, FeatureTarget, Goal, Request, RunGoal
from stereoservo.messages.reasons import Reason
from stereoservo.numerics.compilation import overloads
from stereoservo.recording.compression import StepBlocks
from stereoservo.recording.flight_recorder import FlightRecorder
from stereoservo.recording.recorded_motion import read_motion
from stereoservo.recording.replay import RecordingError, replay
from stereoservo.recording.step_layout import decode_step, encode_step, outputs_crc, result_crc
from stereoservo.recording.step_messages import Fingerprint
from stereoservo.recording.step_records import fingerprint


def record(
    bench: Any,
    path: Path,
    *,
    seconds: float = 6.0,
    gap_at: int = -1,
    tamper_at: int = -1,
    foreign: bool = False,
    laws: dict[str, str] | None = None,
) -> int:
    """Fly a goal and record it; returns the number of steps."""
    bench.ready()
    print_of = fingerprint()
    if foreign:
        print_of = msgspec.structs.replace(print_of, processor="another")
    if laws is not None:
        print_of = msgspec.structs.replace(print_of, laws=laws)
    target = bench.q + np.array([0.2, -0.1, 0.1, 0.2, -0.2, 0.3])
    goal = Goal(str(uuid.UUID(int=1)), FeatureTarget(bench.features(target)))
    with FlightRecorder(path, bench.settings, print_of) as recorder:
        for k in range(round(seconds * bench.settings.rate_hz)):
            if k % 100 == 0:
                recorder.checkpoint(bench.core.state.step + 1, encode_state(bench.core.state), bench.now_ns)
            outputs = bench.step(*([RunGoal(goal)] if k == 5 else []))
            inputs = bench.log[-1][0]
            if k == gap_at:
                recorder.gap(50, inputs.now_ns)
            if gap_at <= k < gap_at + 50 and gap_at >= 0:
                continue
            if k == tamper_at:
                inputs = msgspec.structs.replace(
                    inputs,
                    joints=msgspec.structs.replace(inputs.joints, positions=inputs.joints.positions * (1 + 1e-12)),
                )
            recorder.step(encode_step(inputs, outputs), inputs.now_ns)
        return recorder.steps


@pytest.mark.parametrize(
    ("change", "identical"),
    [
        ({"points": "stereoservo 0.0.9 0123456789abcdef"}, True),  # not used
        ({"mine": "mine 1.0 0123456789abcdef"}, True),  # not used
        ({DEFAULT_LAW: "stereoservo 0.0.9 0123456789abcdef"}, None),
        (None, True),  # recorded before laws were
    ],
)
def test_only_a_law_that_ran_makes_a_recording_another_programs(
    benches: Any, tmp_path: Path, change: dict[str, str] | None, identical: bool | None
) -> None:
    bench = benches(3, noise_px=0.1)
    laws = {} if change is None else fingerprint().laws | change
    record(bench, tmp_path / "flight.mcap", seconds=1.0, laws=laws)
    assert bench.settings.law == DEFAULT_LAW
    assert replay(tmp_path / "flight.mcap").identical is identical


def test_a_recording_without_the_field_is_read(benches: Any, tmp_path: Path) -> None:
    tree = msgspec.to_builtins(fingerprint())
    assert set(tree.pop("laws")) == set(LAWS)
    assert msgspec.convert(tree, Fingerprint).laws == {}


def test_a_law_that_raises_ends_its_goal_and_not_the_loop(benches: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def step(scene: Scene, task: Task, options: Options) -> LawStep:
        raise ZeroDivisionError("by zero")

    bench = benches(3, noise_px=0.1)
    bench.ready()
    raising = dataclasses.replace(LAWS[DEFAULT_LAW], step=step, kernel=None)
    monkeypatch.setitem(LAWS.usable(), DEFAULT_LAW, raising)
    target = bench.q + np.array([0.2, -0.1, 0.1, 0.2, -0.2, 0.3])
    goal = Goal(str(uuid.UUID(int=1)), FeatureTarget(bench.features(target)))
    events = [event for k in range(50) for event in bench.step(*([RunGoal(goal)] if k == 5 else [])).events]
    (aborted,) = [event for event in events if event.kind == "goal_aborted"]
    assert aborted.reasons[0].code == "LAW_FAILED"
    assert "ZeroDivisionError: by zero" in aborted.reasons[0].hint
    assert not np.any(bench.core.state.block.command)


def test_a_law_whose_numbers_are_of_another_type_compiles_nothing_in_the_loop(
    benches: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    law = dataclasses.replace(LAWS[DEFAULT_LAW], kernel=None)

    def step(scene: Scene, task: Task, options: Options) -> LawStep:
        found = law.step(scene, task, options)
        velocity = np.repeat(found.velocity.astype(np.float32), 2)[::2]
        velocity.flags.writeable = False
        return found._replace(velocity=velocity)

    compiled = []
    for number, used in enumerate((law, dataclasses.replace(law, step=step))):
        monkeypatch.setitem(LAWS.usable(), DEFAULT_LAW, used)
        bench = benches(3, noise_px=0.1).ready()
        target = bench.q + np.array([0.2, -0.1, 0.1, 0.2, -0.2, 0.3])
        bench.step(RunGoal(Goal(str(uuid.UUID(int=1 + number)), FeatureTarget(bench.features(target)))))
        bench.run(0.3)
        assert np.any(bench.core.state.block.command)
        compiled.append(set(overloads()))
    assert compiled[0] == compiled[1]


def test_replay_is_identical(benches: Any, tmp_path: Path) -> None:
    bench = benches(3, noise_px=0.1)
    steps = record(bench, tmp_path / "flight.mcap")
    result = replay(tmp_path / "flight.mcap")
    assert result.identical is True
    assert (result.steps, result.gaps, result.max_relative_error) == (steps, 0, 0.0)
    assert result.checkpoints == 6


def test_replay_notices_one_changed_bit_of_an_input(benches: Any, tmp_path: Path) -> None:
    record(benches(3, noise_px=0.1), tmp_path / "flight.mcap", tamper_at=250)
    result = replay(tmp_path / "flight.mcap")
    assert result.identical is False
    assert result.first_difference is not None
    assert result.first_difference > 250


def test_replay_goes_on_after_a_gap_from_the_next_checkpoint(benches: Any, tmp_path: Path) -> None:
    steps = record(benches(4), tmp_path / "flight.mcap", gap_at=220)
    result = replay(tmp_path / "flight.mcap")
    assert result.identical is True
    assert result.gaps == 1
    assert steps - 100 <= result.steps < steps


def test_replay_on_another_machine_reports_the_largest_error(benches: Any, tmp_path: Path) -> None:
    record(benches(3), tmp_path / "flight.mcap", seconds=2.0, foreign=True)
    result = replay(tmp_path / "flight.mcap")
    assert result.identical is None
    assert result.max_relative_error == 0.0


@pytest.mark.parametrize("share", [0.01, 0.3, 0.7, 0.999])
def test_truncated_recording_says_how_far_it_is_good(benches: Any, tmp_path: Path, share: float) -> None:
    path = tmp_path / "flight.mcap"
    record(benches(3), path, seconds=4.0)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * share)])
    with pytest.raises(RecordingError, match=r"truncated|header") as caught:
        replay(path)
    assert str(path) in str(caught.value)
    assert path.read_bytes() == whole[: int(len(whole) * share)]


def test_flipped_bytes_are_noticed(benches: Any, tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    record(benches(3), path, seconds=4.0)
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 0xFF
    path.write_bytes(bytes(data))
    with pytest.raises(RecordingError):
        replay(path)


@pytest.mark.parametrize("content", [b"", b"hello", b"\x89MCAP0\r\n"])
def test_foreign_file_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "x.mcap").write_bytes(content)
    with pytest.raises(RecordingError):
        replay(tmp_path / "x.mcap")
    with pytest.raises(RecordingError, match="cannot be read"):
        replay(tmp_path / "missing.mcap")


def without_groups(data: bytes) -> bytes:
    """A message or state with a model in it, as it was before models had coplanar groups."""
    tree = msgspec.msgpack.decode(data)

    def strip(value: Any) -> None:
        for item in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
            strip(item)
        if isinstance(value, dict):
            value.pop("marker_groups", None)

    strip(tree)
    return msgspec.msgpack.encode(tree)


def test_a_recording_of_before_models_had_groups_replays(benches: Any, tmp_path: Path) -> None:
    bench = benches(3, noise_px=0.1)
    bench.truth.model = msgspec.structs.replace(bench.truth.model, marker_groups=None)
    bench.run(0.1)
    path = tmp_path / "flight.mcap"
    goal = Goal(str(uuid.UUID(int=1)), FeatureTarget(bench.features(bench.q + 0.1)))
    with FormerRecorder(path, bench.settings, fingerprint()) as recorder:
        for k in range(300):
            if k % 100 == 0:
                state = without_groups(encode_state(bench.core.state))
                recorder.checkpoint(bench.core.state.step + 1, state, bench.now_ns)
            update = ModelUpdate(bench.truth.model) if k == 5 else None
            commands = {10: [Enable()], 60: [RunGoal(goal)]}.get(k, [])
            outputs = bench.step(*commands, model_update=update)
            inputs = bench.log[-1][0]
            recorder.step(without_groups(former_step(inputs, outputs)), inputs.now_ns)
    result = replay(path)
    assert (result.identical, result.steps, result.checkpoints) == (True, 300, 3)
    assert bench.core.state.source.goal.id == goal.id
    changed = msgspec.msgpack.decode(without_groups(encode_state(bench.core.state)))
    assert is_recorded(bench.core.state, msgspec.msgpack.encode(changed))
    changed["model"]["epoch"] += 1
    assert not is_recorded(bench.core.state, msgspec.msgpack.encode(changed))


def test_a_state_of_before_goals_were_resolved_in_parts_is_read(bench: Any) -> None:
    bench.ready()
    bench.step(RunGoal(Goal(str(uuid.UUID(int=1)), FeatureTarget(bench.features(bench.q + 0.1)))))
    state = without_a_block(encode_state(bench.core.state))
    del state["planning"]["goal"], state["planning"]["resolution"]
    state["version"] = 7
    of_then = msgspec.msgpack.encode(state)
    assert is_recorded(bench.core.state, of_then)
    assert encode_state(decode_state(of_then)) == encode_state(bench.core.state)
    bench.core.state.block.silent_s[0] += 1.0
    assert not is_recorded(bench.core.state, of_then)
    planned = decode_state(of_then).planning
    assert planned is not None
    assert planned.goal.id == str(uuid.UUID(int=1))
    state["source"]["type"] = "trials"  # whose course was another one then
    with pytest.raises(StateVersionError):
        decode_state(msgspec.msgpack.encode(state))


def test_a_state_of_before_frames_were_in_the_block_is_read(bench: Any) -> None:
    """It has them in the same places, but does not say how many rows they have; of cameras, damage is told."""
    bench.ready()
    bench.run(0.1)
    state = msgspec.msgpack.decode(encode_state(bench.core.state))
    assert state["block"].pop("rows") == len(bench.core.state.watching.sightings[0].seen) > 0
    of_then = msgspec.msgpack.encode(state)
    assert is_recorded(bench.core.state, of_then)
    assert encode_state(decode_state(of_then)) == encode_state(bench.core.state)
    for held, name in (
        (state["cameras"][0], "sigma"),
        (state["cameras"][1], "innovation"),
        (state["watching"]["sightings"][0], "q"),
    ):
        value = held.pop(name)
        with pytest.raises(msgspec.ValidationError, match=name):
            decode_state(msgspec.msgpack.encode(state))
        held[name] = value
    state["cameras"][0]["frames"] = "many"
    with pytest.raises(msgspec.ValidationError):
        decode_state(msgspec.msgpack.encode(state))


def of_version(version: int) -> bytes:
    """A state of another version, which holds other fields, too."""
    return msgspec.msgpack.encode({"version": version, "step": 3, "something_else": [1, 2]})


def test_a_recording_of_another_version_says_so_and_what_to_do(bench: Any, tmp_path: Path) -> None:
    path = tmp_path / "old.mcap"
    older = msgspec.structs.replace(fingerprint(), stereoservo="0.0.1")
    with FlightRecorder(path, bench.settings, older) as recorder:
        recorder.checkpoint(3, of_version(OLDEST_VERSION - 1), 1)
    with pytest.raises(RecordingError) as caught:
        replay(path)
    said = str(caught.value)
    assert f"state is of version {OLDEST_VERSION - 1}, this program works with version {STATE_VERSION}" in said
    assert "written by stereoservo 0.0.1" in said
    assert "Replay it with the version that wrote it, or record again" in said
    assert "not damaged" in said
    with pytest.raises(StateVersionError) as error:
        decode_state(of_version(STATE_VERSION + 1))
    assert error.value.version == STATE_VERSION + 1


class OtherSettings(msgspec.Struct):
    """Settings of another version."""

    rate_hz: float


def test_settings_of_another_version_are_told_from_damage(bench: Any, tmp_path: Path) -> None:
    for version, said in (("0.0.1", "written by stereoservo 0.0.1"), (None, "damaged")):
        print_of = fingerprint()
        if version is not None:
            print_of = msgspec.structs.replace(print_of, stereoservo=version)
        path = tmp_path / f"{version}.mcap"
        with FlightRecorder(path, OtherSettings(1.0), print_of):  # type: ignore[arg-type]
            pass
        with pytest.raises(RecordingError, match=said):
            replay(path)


def test_a_recording_of_format_1_is_read(tmp_path: Path) -> None:
    """Made by the version before format 2: 60 steps of an arm with a goal, two cameras."""
    path = Path(__file__).parents[1] / "recordings" / "flight-1.mcap"
    result = replay(path)
    assert (result.steps, result.checkpoints, result.gaps) == (60, 1, 0)
    assert result.identical is not False
    assert result.max_relative_error < 1e-9
    motion = read_motion(path)
    assert np.array_equal(np.diff(motion.now_ns), np.full(59, 10_000_000))
    assert not motion.asked.all(), "the arm sets out in it"


def test_a_step_record_holds_all_inputs_bit_for_bit(benches: Any) -> None:
    """Usual ones in their places, all else beside them: compared with their encoding in msgpack."""
    bench = benches(3, noise_px=0.1)
    bench.ready()
    bench.step(RunGoal(Goal(str(uuid.UUID(int=1)), FeatureTarget(bench.features(bench.q + 0.1)))))
    bench.run(0.2)
    inputs, outputs = next(pair for pair in reversed(bench.log) if pair[0].observations)
    joints, (sight, *_) = inputs.joints, inputs.observations
    variants = [inputs, *(pair[0] for pair in bench.log[:60])]
    for changed in (
        msgspec.structs.replace(joints, positions=joints.positions.astype(np.float32)),
        msgspec.structs.replace(joints, velocities=np.arange(12.0)[::2]),
        msgspec.structs.replace(joints, positions=np.array([-0.0, np.nan]), velocities=np.zeros(3)),
        msgspec.structs.replace(joints, t_ns=2**63 - 1, efforts=np.array([np.nan] * 6)),
        msgspec.structs.replace(joints, efforts=-joints.positions, following_errors=joints.positions),
        msgspec.structs.replace(joints, positions=np.zeros(0), velocities=np.zeros(0)),
        None,
    ):
        variants.append(msgspec.structs.replace(inputs, joints=changed, now_ns=-(2**62)))
    for seen in (
        msgspec.structs.replace(sight, ids=sight.ids.astype(np.int32)),
        msgspec.structs.replace(sight, pixels=np.asfortranarray(sight.pixels)),
        msgspec.structs.replace(sight, camera="häuslich, long", seq=-1),
        msgspec.structs.replace(sight, t_shutter_ns=-(2**63), covariances=np.zeros((1, 2))),
    ):
        variants.append(msgspec.structs.replace(inputs, observations=(seen, sight)))
    variants.append(
        msgspec.structs.replace(
            inputs, stop=True, driver_active=False, driver_configured=False, compiling=True, parameter_epoch=9,
            driver_fault=DriverFault("bus", "off"), requests=(Request(1, "me", Enable()),),
            model_update=ModelUpdate(bench.truth.model, ("left",)),
        )
    )  # fmt: skip
    records = [encode_step(one, outputs) for one in variants]
    for one, record in zip(variants, records, strict=True):
        again = decode_step(record)
        assert encode(again.inputs) == encode(one)
        assert encode(again.command) == encode(outputs.command)
        assert (again.step, again.outputs_crc) == (outputs.status.step, outputs_crc(outputs))
    writer, reader = StepBlocks(), StepBlocks()
    for k in range(0, len(records), 20):
        assert reader.restore(writer.compress(records[k : k + 20])) == records[k : k + 20]


def test_the_checksum_sees_every_bit_of_what_a_step_has_come_to(bench: Any) -> None:
    bench.ready()
    outputs = bench.step()
    status = outputs.status
    known = outputs_crc(outputs)
    assert known == result_crc(bench.core.newest)  # of the core itself, where no outputs were made
    for name in ("command_raw", "velocities"):
        other = getattr(status, name).copy()
        other[3] = np.nextafter(other[3], 1.0)
        changed = msgspec.structs.replace(outputs, status=msgspec.structs.replace(status, **{name: other}))
        assert outputs_crc(changed) != known, name
    changed = msgspec.structs.replace(outputs, status=msgspec.structs.replace(status, error_px=0.0))
    assert outputs_crc(changed) != known
    told = Event(1, 1, "warning")
    for name, value in (("driver_request", "reset"), ("events", (told,))):
        assert outputs_crc(msgspec.structs.replace(outputs, **{name: value})) != known, name


def test_the_checksum_of_layout_2_sees_every_bit_of_the_outputs(bench: Any) -> None:
    bench.ready()
    outputs = bench.step()
    status = outputs.status
    known = outputs_crc(outputs, 2)
    for name in status.__struct_fields__:
        value = getattr(status, name)
        if name in ("t_ns", "step"):  # compared by themselves, or the inputs'
            continue
        if isinstance(value, np.ndarray):
            other: Any = np.concatenate([value.ravel(), [-0.0]])
        elif isinstance(value, dict):
            other = {key: number + 1 for key, number in value.items()} or {"left": 1}
        elif isinstance(value, str | tuple):
            other = value + ("x" if isinstance(value, str) else (Reason("CODE", "info"),))  # type: ignore[operator]
        elif name == "health":
            other = msgspec.structs.replace(value, size=value.size + 1e-9)
        else:
            other = 0.5 if value is None else value + 1
            if name in ("efforts", "following_errors", "effort_limits", "following_limits"):
                other = np.zeros(6)
        changed = msgspec.structs.replace(outputs, status=msgspec.structs.replace(status, **{name: other}))
        assert outputs_crc(changed, 2) != known, name
    assert outputs_crc(msgspec.structs.replace(outputs, driver_request="reset"), 2) != known
    assert outputs_crc(msgspec.structs.replace(outputs, command=None), 2) != known


@pytest.mark.parametrize("told", range(16))
def test_loads_that_drives_do_not_tell_are_no_zeros(bench: Any, told: int) -> None:
    names = ("efforts", "following_errors", "effort_limits", "following_limits")
    outputs = bench.ready().step()
    given = {name: np.zeros(6) if told >> k & 1 else None for k, name in enumerate(names)}
    fewer = msgspec.structs.replace(outputs, status=msgspec.structs.replace(outputs.status, **given))
    all_told = msgspec.structs.replace(outputs.status, **dict.fromkeys(names, np.zeros(6)))
    whole = msgspec.structs.replace(outputs, status=all_told)
    assert (outputs_crc(fewer, 2) == outputs_crc(whole, 2)) == (told == 15)
