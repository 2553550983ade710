"""The power machine against the transition table of CiA 402-2, written down here a second time."""

import pytest

from stereoservo_sim.emulators.nodes.drive_motion import STATUS, Cia402State, PowerMachine

S = Cia402State
COMMANDS = {  # control word: mask, value
    "shutdown": (0x87, 0x06),
    "switch on": (0x8F, 0x07),
    "disable voltage": (0x82, 0x00),
    "quick stop": (0x86, 0x02),
    "enable operation": (0x8F, 0x0F),
}
TRANSITIONS = {  # settled: after brake and ramps
    (S.SWITCH_ON_DISABLED, "shutdown"): S.READY,  # 2
    (S.READY, "switch on"): S.SWITCHED_ON,  # 3
    (S.READY, "enable operation"): S.ENABLED,  # 3, 4
    (S.SWITCHED_ON, "enable operation"): S.ENABLED,  # 4
    (S.ENABLED, "switch on"): S.SWITCHED_ON,  # 5: "disable operation"
    (S.SWITCHED_ON, "shutdown"): S.READY,  # 6
    (S.READY, "disable voltage"): S.SWITCH_ON_DISABLED,  # 7
    (S.READY, "quick stop"): S.SWITCH_ON_DISABLED,  # 7
    (S.ENABLED, "shutdown"): S.READY,  # 8
    (S.ENABLED, "disable voltage"): S.SWITCH_ON_DISABLED,  # 9
    (S.SWITCHED_ON, "disable voltage"): S.SWITCH_ON_DISABLED,  # 10
    (S.SWITCHED_ON, "quick stop"): S.SWITCH_ON_DISABLED,  # 10
    (S.ENABLED, "quick stop"): S.QUICK_STOP,  # 11, with option codes 5 to 8
    (S.QUICK_STOP, "disable voltage"): S.SWITCH_ON_DISABLED,  # 12
    (S.QUICK_STOP, "enable operation"): S.ENABLED,  # 16
}
ROUTES = {
    S.NOT_READY: [],
    S.SWITCH_ON_DISABLED: [0x00],
    S.READY: [0x06],
    S.SWITCHED_ON: [0x06, 0x07],
    S.ENABLED: [0x06, 0x07, 0x0F],
    S.QUICK_STOP: [0x06, 0x07, 0x0F, 0x0B],
}


class Options(dict):
    def __missing__(self, index):
        return {0x605A: 6, 0x605B: 1, 0x605C: 1, 0x605D: 1, 0x605E: 2, 0x6007: 3}[index]


def machine_in(state, options=None, *, clears=True):
    machine = PowerMachine((options or Options()).__getitem__, lambda: clears)
    if state is S.NOT_READY:
        return machine
    machine.ready()
    if state in (S.FAULT, S.FAULT_REACTION):
        for word in ROUTES[S.ENABLED]:
            machine.control(word)
            settle(machine)
        machine.fault()
        if state is S.FAULT:
            settle(machine)
    else:
        for word in ROUTES[state]:
            machine.control(word)
            settle(machine)
    assert machine.state is state
    return machine


def settle(machine):
    """The drive does at once what the machine asks for."""
    for _ in range(4):
        if machine.opening:
            machine.opened()
        elif machine.after is not None:
            machine.rested()


def expected(state, word, before):
    if state is S.FAULT:
        return S.SWITCH_ON_DISABLED if word & 0x80 and not before & 0x80 else S.FAULT
    for name, (mask, value) in COMMANDS.items():
        if word & mask == value:
            return TRANSITIONS.get((state, name), state)
    return state


@pytest.mark.parametrize("state", [s for s in S if s is not S.FAULT_REACTION])
def test_every_control_word_in_every_state(state):
    for word in range(256):
        machine = machine_in(state)
        before = machine.word
        machine.control(word)
        settle(machine)
        assert machine.state is expected(state, word, before), hex(word)


def test_words_in_the_fault_reaction_change_nothing():
    for word in range(256):
        machine = machine_in(S.FAULT_REACTION)
        machine.control(word)
        assert machine.state is S.FAULT_REACTION
        assert machine.powered
        settle(machine)
        assert machine.state is S.FAULT


def test_upper_bits_are_no_commands():
    for word in range(256):
        machine = machine_in(S.SWITCHED_ON)
        machine.control(word | 0xFE00)
        settle(machine)
        assert machine.state is expected(S.SWITCHED_ON, word, 0)


@pytest.mark.parametrize("state", S)
def test_a_fault_from_any_state(state):
    machine = machine_in(state)
    powered = machine.powered
    machine.fault()
    if state is not S.FAULT:
        assert machine.state is (S.FAULT_REACTION if powered else S.FAULT)
    settle(machine)
    assert machine.state is S.FAULT
    assert not machine.powered


def test_fault_reset_is_an_edge():
    machine = machine_in(S.ENABLED)
    machine.control(0x80)  # bit 7 before the fault is no reset of it
    assert machine.state is S.ENABLED
    machine.fault()
    settle(machine)
    machine.control(0x80)
    machine.control(0x8F)
    assert machine.state is S.FAULT
    machine.control(0x0F)
    assert machine.state is S.FAULT
    machine.control(0x8F)
    assert machine.state is S.SWITCH_ON_DISABLED
    machine.control(0x8F)
    machine.control(0x0F)
    assert machine.state is S.SWITCH_ON_DISABLED


def test_fault_reset_while_the_cause_stays():
    machine = machine_in(S.FAULT, clears=False)
    machine.control(0x00)
    machine.control(0x80)
    assert machine.state is S.FAULT


@pytest.mark.parametrize("option", range(9))
def test_quick_stop_options(option):
    machine = machine_in(S.ENABLED, Options({0x605A: option}))
    machine.control(0x02)
    if option == 0:
        assert machine.state is S.SWITCH_ON_DISABLED
        return
    assert machine.state is S.QUICK_STOP
    assert machine.ramp == {1: 1, 2: 2, 3: 3, 4: 4, 5: 1, 6: 2, 7: 3, 8: 4}[option]
    assert machine.after is (S.SWITCH_ON_DISABLED if option < 5 else None)
    machine.control(0x0F)  # transition 16 exists for 5 to 8 only
    assert machine.state is (S.QUICK_STOP if option < 5 else S.ENABLED)


@pytest.mark.parametrize("option", [1, 2, 3, 4])
def test_quick_stop_ends_disabled_with_options_1_to_4(option):
    machine = machine_in(S.ENABLED, Options({0x605A: option}))
    machine.control(0x02)
    machine.rested()
    assert machine.state is S.SWITCH_ON_DISABLED


@pytest.mark.parametrize(("index", "word", "after"), [(0x605B, 0x06, S.READY), (0x605C, 0x07, S.SWITCHED_ON)])
def test_shutdown_and_disable_options(index, word, after):
    coasting = machine_in(S.ENABLED, Options({index: 0}))
    coasting.control(word)
    assert coasting.state is after
    assert not coasting.powered
    braking = machine_in(S.ENABLED, Options({index: 1}))
    braking.control(word)
    assert (braking.state, braking.ramp, braking.after) == (S.ENABLED, 1, after)
    assert braking.powered


@pytest.mark.parametrize("option", range(5))
def test_fault_reaction_options(option):
    machine = machine_in(S.ENABLED, Options({0x605E: option}))
    machine.fault()
    assert machine.state is (S.FAULT_REACTION if option else S.FAULT)
    assert machine.ramp == (option or None)


@pytest.mark.parametrize(
    ("option", "enabled", "switched_on", "fault"),
    [
        (0, S.ENABLED, S.SWITCHED_ON, False),
        (1, S.ENABLED, S.SWITCHED_ON, True),
        (2, S.SWITCH_ON_DISABLED, S.SWITCH_ON_DISABLED, False),
        (3, S.QUICK_STOP, S.SWITCH_ON_DISABLED, False),
    ],
)
def test_abort_connection_options(option, enabled, switched_on, fault):
    for state, becomes in ((S.ENABLED, enabled), (S.SWITCHED_ON, switched_on)):
        machine = machine_in(state, Options({0x6007: option}))
        assert machine.connection_aborted() is fault
        assert machine.state is becomes


def test_a_repeated_enable_does_not_undo_the_drives_own_quick_stop():
    machine = machine_in(S.ENABLED)
    machine.connection_aborted()
    for _ in range(5):
        machine.control(0x0F)
    assert machine.state is S.QUICK_STOP
    machine.control(0x0B)
    machine.control(0x0F)
    assert machine.state is S.ENABLED


def test_commands_wait_for_a_transition_that_brakes_but_stops_do_not():
    machine = machine_in(S.ENABLED)
    machine.control(0x06)
    machine.control(0x0F)
    assert machine.state is S.ENABLED
    assert machine.after is S.READY
    machine.rested()
    assert machine.state is S.SWITCHED_ON  # ready, then 3 and the brake opens for 4
    assert machine.opening
    machine = machine_in(S.ENABLED)
    machine.control(0x06)
    machine.control(0x02)
    assert machine.state is S.QUICK_STOP
    machine = machine_in(S.ENABLED)
    machine.control(0x06)
    machine.control(0x0F)
    machine.control(0x00)
    assert machine.state is S.SWITCH_ON_DISABLED


@pytest.mark.parametrize(
    ("word", "state"),
    [(0x07, S.SWITCHED_ON), (0x06, S.READY), (0x02, S.SWITCH_ON_DISABLED), (0x00, S.SWITCH_ON_DISABLED)],
)
def test_enabling_can_be_given_up(word, state):
    machine = machine_in(S.SWITCHED_ON)
    machine.control(0x0F)
    assert machine.powered
    machine.control(word)
    assert machine.state is state
    assert not machine.powered


def test_status_words_are_the_standards():
    masks = {
        S.NOT_READY: (0x4F, 0x00), S.SWITCH_ON_DISABLED: (0x4F, 0x40), S.READY: (0x6F, 0x21),
        S.SWITCHED_ON: (0x6F, 0x23), S.ENABLED: (0x6F, 0x27), S.QUICK_STOP: (0x6F, 0x07),
        S.FAULT_REACTION: (0x4F, 0x0F), S.FAULT: (0x4F, 0x08),
    }  # fmt: skip
    for state, bits in STATUS.items():
        fitting = [s for s, (mask, value) in masks.items() if bits & mask == value]
        assert fitting == [state]
