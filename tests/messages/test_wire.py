"""Messages: strict at the intake, tolerant at readers, finite on both sides."""

import math
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereoservo.messages.goals import (
    AcknowledgeGoal,
    AdaptiveGain,
    Approach,
    FeatureTarget,
    Goal,
    Hold,
    Jog,
    JointTarget,
    PlanReport,
    UpdateGoal,
)
from stereoservo.messages.wire import (
    COMMANDS,
    MAX_PAYLOAD_BYTES,
    SCHEMAS,
    EventMessage,
    MessageError,
    Reply,
    decode,
    decode_command,
    encode,
    read,
    require_finite,
    schema,
)

ID = "12345678-1234"
GOAL = {"id": ID, "target": {"kind": "features", "set_points": {"left": {"3": [1.5, 2.5]}}}}


def test_a_goal_survives_the_wire() -> None:
    goal = Goal(ID, FeatureTarget({"left": {3: (1.5, 2.5)}}), law="stereo", lease_s=1.0)
    assert decode(encode(goal), Goal) == goal
    assert decode(msgspec.json.encode(GOAL), Goal).target == goal.target


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"law": ""}, "law: Expected `str` of length >= 1"),
        ({"gain": -1.0}, "gain: Expected `float` >= 0.0001"),
        ({"speed_scale": 1.5}, "speed_scale: Expected `float` <= 1"),
        ({"hurry": True}, "unknown field `hurry`"),
        ({"id": "x"}, "id: Expected `str` matching regex"),
        ({"target": {"kind": "wish"}}, "target"),
        ({"target": {"kind": "features", "set_points": {"left": {"three": [1, 2]}}}}, "set_points"),
        ({"lease_s": 0.01}, "lease_s: Expected `float` >= 0.3"),
    ],
)
def test_the_intake_refuses_and_names_the_place(change: dict[str, Any], text: str) -> None:
    with pytest.raises(MessageError) as caught:
        decode(msgspec.json.encode(GOAL | change), Goal)
    assert text in str(caught.value)


@pytest.mark.parametrize("word", [b"NaN", b"Infinity", b"-Infinity", b"1e999", b"null"])
def test_numbers_that_are_none_are_refused_by_name(word: bytes) -> None:
    with pytest.raises(MessageError) as caught:
        decode_command("jog", b'{"velocities": {"j1": %s}}' % word)
    if word in (b"NaN", b"Infinity", b"-Infinity"):
        assert f"{word.decode()} is not a JSON number" in str(caught.value)


def test_a_name_that_contains_nan_is_no_number() -> None:
    with pytest.raises(MessageError, match="is not JSON"):
        decode(b'{"id": "12345678", "nan" oops}', Goal)


def test_size_is_bounded() -> None:
    with pytest.raises(MessageError, match=f"at most {MAX_PAYLOAD_BYTES}"):
        decode(b" " * (MAX_PAYLOAD_BYTES + 1), Goal)


@given(st.binary(min_size=1, max_size=200).filter(lambda junk: junk.strip(b" \t\r\n")[:1] != b"{"))
def test_junk_is_refused_with_a_message_and_nothing_else(junk: bytes) -> None:
    for verb in COMMANDS:
        with pytest.raises(MessageError, match=r"\S"):
            decode_command(verb, junk)


HOSTILE = {
    "not UTF-8 behind a misfit": b'{"id":5,"x":"\xff"}',
    "not UTF-8": b'{"id":"\xff"}',
    "a key that is not UTF-8": b'{"\xff":1}',
    "nested behind a misfit": b'{"id":' + b"[" * 60_000,
    "nested, whole": b'{"id":' + b"[" * 30_000 + b"]" * 30_000 + b"}",
    "objects behind a misfit": b'{"id":' + b'{"a":' * 12_000,
    "half a surrogate": b'{"id":"\\ud800"}',
    "two first halves": b'{"id":"\\ud800\\ud800"}',
    "many digits": b'{"id":' + b"9" * 60_000 + b"}",
    "a byte order mark": b"\xef\xbb\xbf{}",
    "zeros": b"\0" * 16,
    "too long": b" " * (MAX_PAYLOAD_BYTES + 1),
}


@pytest.mark.parametrize("payload", HOSTILE.values(), ids=HOSTILE)
def test_whatever_the_bytes_are_they_are_refused(payload: bytes) -> None:
    for verb in COMMANDS:
        with pytest.raises(MessageError, match=r"\S"):
            decode_command(verb, payload)
    with pytest.raises(MessageError, match=r"\S"):
        decode(payload, Goal)
    with pytest.raises(MessageError, match=r"\S"):
        read(payload, Reply)


def test_a_refusal_states_what_is_wrong_with_the_bytes() -> None:
    with pytest.raises(MessageError, match="not UTF-8: invalid start byte 0xff"):
        decode(b'{"id":"\xff"}', Goal)
    with pytest.raises(MessageError, match="nested too deeply"):
        read(b"[" * 60_000, Any)
    with pytest.raises(MessageError, match="id: Expected `str`, got `int`"):
        decode(b'{"id":5,"x":"\xff"}', Goal)


@given(st.binary(max_size=60))
def test_junk_behind_a_misfit_is_refused_too(junk: bytes) -> None:
    with pytest.raises(MessageError, match=r"\S"):
        decode(b'{"id":5,"x":' + junk, Goal)


def test_commands_without_arguments_take_an_empty_payload() -> None:
    assert decode_command("hold", b"") == Hold()
    assert decode_command("hold", b'{"command": "hold"}') == Hold()
    with pytest.raises(MessageError, match="Invalid value 'resume'"):
        decode_command("hold", b'{"command": "resume"}')
    assert decode_command("jog", b'{"velocities": {"a": 1}}') == Jog({"a": 1.0})


def test_readers_take_fields_that_they_do_not_know() -> None:
    reply = msgspec.json.decode(b'{"accepted": true, "mood": "good"}', type=Reply)
    assert reply == Reply(True)
    event = msgspec.json.decode(
        b'{"seq":1,"boot":"b","t_ns":1,"t_wall":1,"kind":"new-kind","more":[1]}', type=EventMessage
    )
    assert event.kind == "new-kind"


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_writer_cannot_send_what_json_would_turn_into_null(value: float) -> None:
    with pytest.raises(MessageError, match=r"target\.positions\.j2 is (nan|-?inf)"):
        encode(Goal(ID, JointTarget({"j1": 0.0, "j2": value})))
    with pytest.raises(MessageError, match=r"set_points\.left\.3\[1\]"):
        encode(Goal(ID, FeatureTarget({"left": {3: (0.0, value)}})))


def test_require_finite_looks_everywhere() -> None:
    require_finite({"a": [1, 2.0, {"b": (3.0,)}], "c": "nan"})
    with pytest.raises(MessageError, match=r"a\[1\]\.b\[0\]"):
        require_finite({"a": [1, {"b": (math.nan,)}]})


def test_every_schema_is_a_json_schema_and_unknown_ones_get_the_known() -> None:
    for name in SCHEMAS:
        tree = msgspec.json.decode(schema(name, ("stereo",)))
        assert "$defs" in tree
    assert "lease_s" in schema("goal", ("stereo",)).decode()
    with pytest.raises(MessageError, match=r"no schema 'gaol'; there are: goal"):
        schema("gaol", ())


def test_the_schema_lists_the_laws_that_the_daemon_has() -> None:
    tree = msgspec.json.decode(schema("goal", ("stereo", "mine")))
    law, null = tree["$defs"]["Goal"]["properties"]["law"]["anyOf"]
    assert law["enum"] == ["stereo", "mine"]
    assert null == {"type": "null"}


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"law": 5}, "law: Expected `str | null`, got `int`"),
        ({"gain": -1}, "gain: Expected `float` >= 0.0001, got -1"),
        ({"zz": 1}, "unknown field `zz`; known: id, target, law"),
        (
            {"target": {"kind": "taught", "name": "a", "relative_to": "table"}},
            "target.relative_to: Invalid enum value 'table'; valid: cameras, workpiece",
        ),
        (
            {"target": {"kind": "wish"}},
            "target.kind: Invalid value 'wish'; valid: features, points, displacement, step, taught, joints, incidence",
        ),
        (
            {"target": {"kind": "features", "set_points": {"left": {"abc": [1, 2]}}}},
            "a key of target.set_points",
        ),
    ],
)
def test_a_refusal_names_the_value_and_what_would_have_been_valid(change: dict[str, Any], text: str) -> None:
    tree = {"id": "0" * 8, "target": {"kind": "taught", "name": "park"}} | change
    with pytest.raises(MessageError) as refused:
        decode(msgspec.json.encode(tree), Goal)
    assert text in str(refused.value)


def test_an_integer_that_no_later_stage_can_carry_is_refused() -> None:
    payload = b'{"id": "00000000", "target": {"kind": "features", "set_points": {}, "model_epoch": 1%s}}' % (b"0" * 30)
    with pytest.raises(MessageError, match="1000000000000000000000000000000"):
        decode(payload, Goal)


def test_a_plan_survives_the_wire_and_old_readers_do_without() -> None:
    plan = PlanReport(
        "cartesian3",
        "linear",
        3.25,
        (Approach("FIELD_OF_VIEW", "left", 12.0, 5.0, 7.0, "px", 0.4, 3),),
        (0.0, 1.0),
        {"j1": (0.1, 0.2)},
        {"left": {3: ((1.0, 2.0), (3.0, 4.0))}},
    )
    reply = Reply(True, "the goal would be accepted", plan=plan)
    assert msgspec.json.decode(encode(reply), type=Reply) == reply

    class OldReply(msgspec.Struct, frozen=True):
        accepted: bool
        message: str = ""

    assert msgspec.json.decode(encode(reply), type=OldReply) == OldReply(True, "the goal would be accepted")
    assert msgspec.json.decode(b'{"accepted": true}', type=Reply).plan is None


def test_commands_about_goals_are_distinguished_by_their_tag() -> None:
    set_points = {"kind": "features", "set_points": {"left": {"3": [1.5, 2.5]}}}
    update = decode_command("update", msgspec.json.encode({"id": ID, "target": set_points, "stamp_s": 2.5}))
    assert update == UpdateGoal(ID, FeatureTarget({"left": {3: (1.5, 2.5)}}), 2.5)
    assert decode_command("acknowledge", b'{"id": "%s"}' % ID.encode()) == AcknowledgeGoal(ID)
    with pytest.raises(MessageError, match="Invalid value 'taught'"):
        decode_command("update", msgspec.json.encode({"id": ID, "target": {"kind": "taught", "name": "a"}}))


def test_a_gain_is_a_number_or_falls_with_the_error() -> None:
    gain = {"near": 4, "far": 0.8, "slope": 30}
    assert decode(msgspec.json.encode(GOAL | {"gain": gain}), Goal).gain == AdaptiveGain(4.0, 0.8, 30.0)
    assert decode(msgspec.json.encode(GOAL | {"gain": 2}), Goal).gain == 2.0
    with pytest.raises(MessageError, match="far"):
        decode(msgspec.json.encode(GOAL | {"gain": {"near": 4}}), Goal)


@given(
    st.dictionaries(st.sampled_from(Goal.__struct_fields__[2:]), st.none() | st.text() | st.floats() | st.integers())
)
def test_any_goal_is_taken_as_it_is_or_refused_with_the_field(tree: dict[str, Any]) -> None:
    data = msgspec.json.encode(GOAL | tree)
    try:
        goal, refused = decode(data, Goal), ""
    except MessageError as error:
        goal, refused = Goal(ID, JointTarget({})), str(error)
    if refused:
        assert any(field in refused for field in tree) or "out of range" in refused
    else:
        assert decode(encode(goal), Goal) == goal
