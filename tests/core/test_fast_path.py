"""Steps by the fast path and by the stages: the same bits in outputs and state, whatever happens; and what the fast
path began and left to the stages is as if it had not begun.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import numpy as np
import pytest

from stereoservo.core import servo_core
from stereoservo.core.cycle import StepInputs, StepOutputs, encode
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.settings import ContactSettings
from stereoservo.core.state_encoding import decode_state, encode_state
from stereoservo.messages.goals import FeatureTarget, Hold, Jog, Resume

WAY = np.array([0.18, -0.15, 0.2, 0.3, -0.25, 0.35])


class Twins:
    """The core of a bench, and one beside it that goes by the stages alone; every step of both is compared.

    ``ways``: how many steps went by the fast path, were left to the stages after it had looked, or never looked at.
    """

    def __init__(self, core: ServoCore, monkeypatch: pytest.MonkeyPatch) -> None:
        self.core, self.ways = core, Counter[str]()
        self.twin = ServoCore(core.settings, decode_state(encode_state(core.state)), fast=False)
        self._step, fast_path, look = (
            core.step,
            servo_core.fast_path,
            servo_core.fast_path.__globals__["begin_step"],
        )
        looked: list[bool] = []

        def watched_look(*arguments: Any) -> Any:
            looked.append(True)
            return look(*arguments)

        def watched(context: Any, limits: Any) -> Any:
            looked.clear()
            before = context.state.block.record.tobytes()
            found = fast_path(context, limits)
            self.ways["fast" if found is not None else "left" if looked else "stages"] += 1
            assert found is not None or context.state.block.record.tobytes() == before
            return found

        monkeypatch.setattr(servo_core, "fast_path", watched)
        monkeypatch.setitem(fast_path.__globals__, "begin_step", watched_look)
        core.step = self.step  # type: ignore[method-assign]

    def step(self, inputs: StepInputs) -> StepOutputs:
        outputs, other = self._step(inputs), self.twin.step(inputs)
        for name, one, beside in (
            ("outputs", encode(outputs), encode(other)),
            ("state", encode_state(self.core.state), encode_state(self.twin.state)),
        ):
            assert one == beside, (
                f"{name}: {differing(msgspec.msgpack.decode(one), msgspec.msgpack.decode(beside))}"
            )
        return outputs


def differing(one: Any, beside: Any) -> Any:
    """What is not the same in two values made of dictionaries."""
    if not isinstance(one, dict):
        return (one, beside)
    return {name: differing(one[name], beside.get(name)) for name in one if one[name] != beside.get(name)}


@pytest.fixture
def twins(bench: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Twins]]:
    def made(**changed: Any) -> Twins:
        bench.settings = msgspec.structs.replace(bench.settings, **changed)
        bench.core = ServoCore(bench.settings)
        found = Twins(bench.core, monkeypatch)
        bench.ready()
        return found

    return made


@pytest.mark.parametrize(
    ("law", "damping"),
    [
        ("stereo", None),
        ("image", None),
        ("points", 0.3),
        ("cartesian3", None),
        ("cartesian3", 0.5),
        ("cartesian2", None),
    ],
)
def test_a_goal_has_the_same_bits_from_rest_to_its_end(
    bench: Any, twins: Any, law: str, damping: float | None
) -> None:
    found = twins()
    bench.noise_px, bench.dead_speed = 0.05, 0.002
    target = FeatureTarget(bench.features(bench.q + WAY))
    assert bench.reply(bench.goal(target, law=law, damping=damping)).accepted
    assert bench.ended().kind == "goal_reached"
    bench.run(0.3)
    assert found.ways["fast"] > 0.4 * sum(found.ways.values())


def contact(bench: Any) -> None:
    bench.loads = lambda b: (np.full(6, 30.0 if len(b.commands) > 150 else 1.0), np.zeros(6))


def nan(bench: Any) -> None:
    bench.loads = lambda b: (np.full(6, 1.0), np.full(6, np.nan if len(b.commands) > 150 else 0.0))


def blind(bench: Any) -> None:
    bench.marker_mask[:6] = False


def dark(bench: Any) -> None:
    bench.cameras_on = [False] * 4


def stuck(bench: Any) -> None:
    bench.frozen_joint, bench.dead_speed = 1, 1.0


def jump(bench: Any) -> None:
    bench.zero_offset = np.full(6, 0.8)


def silent(bench: Any) -> None:
    bench.joints_on = False


def late(bench: Any) -> None:
    bench.joints_stamped_late_ns = 10**9


def slipped(bench: Any) -> None:
    bench.bias_px = np.zeros((8, 2))
    bench.bias_px[3] = 4.0


WATCHED = ContactSettings(
    True, np.array([np.nan, 10.0, *[np.nan] * 4]), np.full(6, np.nan), 1.5, 5, ("N m",) * 6
)
EVENTS = [contact, nan, blind, dark, stuck, jump, silent, late, slipped]


@pytest.mark.parametrize("event", EVENTS, ids=[event.__name__ for event in EVENTS])
def test_whatever_happens_on_the_way_is_found_by_both(bench: Any, twins: Any, event: Any) -> None:
    found = twins(contact=WATCHED) if event in (contact, nan) else twins()
    goal = bench.goal(FeatureTarget(bench.features(bench.q + WAY)), law="stereo", gain=0.5)
    assert bench.reply(goal).accepted
    bench.run(0.8)
    before = len(bench.events)
    event(bench)
    last = bench.run(1.5)
    assert len(bench.events) > before or last.status.reasons
    assert found.ways["fast"] > 40
    if event in (stuck, contact, jump, nan):
        assert found.ways["left"] > 0


def test_late_drives_held_and_jogged_arms_have_the_same_bits(bench: Any, twins: Any) -> None:
    found = twins()
    bench.delay_s = 0.08
    for _ in range(3):
        assert bench.reply(
            bench.goal(FeatureTarget(bench.features(bench.q + 0.3 * WAY)), law="stereo")
        ).accepted
        bench.run(0.7)
        bench.step(Hold())
        bench.run(0.3)
        bench.step(Resume())
        bench.ended()
        bench.step(Jog({"j2": 0.2}, lease_s=0.2))
        bench.run(0.4)
    assert any(bench.core.state.block.delay_s > 0.0)
    assert found.ways["fast"] > 200


def test_a_law_whose_kernel_raises_ends_its_goal_as_by_the_stages(bench: Any, twins: Any) -> None:
    found = twins()
    assert bench.reply(bench.goal(FeatureTarget(bench.features(bench.q + WAY)), law="stereo")).accepted
    bench.run(0.5)
    while bench.seq % 4 != 3:  # the next step has no frame
        bench.step()

    def raises(*arguments: Any) -> None:
        raise RuntimeError("no answer")

    for core in (found.core, found.twin):
        laws = dict(core._derived.laws)
        law = laws["stereo"]
        laws["stereo"] = type(law)(**{
            name: raises if name == "kernel" else getattr(law, name)
            for name, field in law.__dataclass_fields__.items() if field.init
        })  # fmt: skip
        core._derived.laws = laws
    event = bench.ended(0.2)
    assert event.kind == "goal_aborted"
    assert "no answer" in event.reasons[0].hint
    assert found.ways["left"] > 0
