"""Tables of CiA 402 and CiA 301 against the standards' own way of writing them."""

from __future__ import annotations

import pytest

from stereoservo_drivers.canopen.cia402_words import (
    ABORT_CODES,
    ENABLE_STEPS,
    ERROR_CODES,
    FAULTY,
    POWER_OFF,
    ControlWord,
    DriveState,
    abort_hint,
    abort_words,
    drive_state,
    error_hint,
    error_words,
    is_communication_error,
    nmt_words,
)

PATTERNS = {
    "xxxx xxxx x0xx 0000": DriveState.NOT_READY_TO_SWITCH_ON,
    "xxxx xxxx x1xx 0000": DriveState.SWITCH_ON_DISABLED,
    "xxxx xxxx x01x 0001": DriveState.READY_TO_SWITCH_ON,
    "xxxx xxxx x01x 0011": DriveState.SWITCHED_ON,
    "xxxx xxxx x01x 0111": DriveState.OPERATION_ENABLED,
    "xxxx xxxx x00x 0111": DriveState.QUICK_STOP_ACTIVE,
    "xxxx xxxx x0xx 1111": DriveState.FAULT_REACTION_ACTIVE,
    "xxxx xxxx x0xx 1000": DriveState.FAULT,
}
"""Statusword coding as CiA 402-2 prints it, bit 15 first."""


def matches(word: int, pattern: str) -> bool:
    return all(want in ("x", bit) for bit, want in zip(f"{word:016b}", pattern.replace(" ", ""), strict=True))


def test_every_status_word_has_the_one_state_that_the_standard_prints() -> None:
    for word in range(1 << 16):
        states = [state for pattern, state in PATTERNS.items() if matches(word, pattern)]
        assert len(states) <= 1
        assert drive_state(word) is (states[0] if states else DriveState.UNKNOWN)


def test_all_states_occur() -> None:
    assert {drive_state(word) for word in range(128)} == set(DriveState)


def test_no_step_towards_enabled_can_reset_a_fault() -> None:
    assert not any(word & 0x80 for word in ENABLE_STEPS.values())
    assert not FAULTY & set(ENABLE_STEPS)


def test_steps_towards_enabled_are_the_transitions_2_3_and_4() -> None:
    # command -> bits 7, 3, 2, 1, 0 of the control word (CiA 402-2, command coding)
    commands = {"shutdown": "0x110", "switch on": "00111", "enable operation": "01111"}
    for state, name in (
        (DriveState.SWITCH_ON_DISABLED, "shutdown"),
        (DriveState.READY_TO_SWITCH_ON, "switch on"),
        (DriveState.SWITCHED_ON, "enable operation"),
    ):
        word = f"{ENABLE_STEPS[state]:08b}"
        bits = word[0] + word[4:]
        assert all(want in ("x", bit) for bit, want in zip(bits, commands[name], strict=True)), (state, bits)


def test_quick_stop_and_disable_voltage_are_what_they_are_called() -> None:
    assert ControlWord.QUICK_STOP & 0b0000_0110 == 0b10  # quick stop bit low, enable voltage high
    assert ControlWord.DISABLE_VOLTAGE & 0b10 == 0


def test_power_is_off_exactly_where_the_standard_takes_torque_away() -> None:
    on = {
        DriveState.SWITCHED_ON,
        DriveState.OPERATION_ENABLED,
        DriveState.QUICK_STOP_ACTIVE,
        DriveState.FAULT_REACTION_ACTIVE,
        DriveState.UNKNOWN,
    }
    assert set(DriveState) - on == POWER_OFF


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (0x2310, "over-current"),
        (0x3210, "DC link over-voltage"),
        (0x3220, "DC link under-voltage"),
        (0x4310, "drive over-temperature"),
        (0x7305, "incremental encoder"),
        (0x8130, "heartbeat"),
        (0x8611, "following error"),
        (0x8250, "RPDO"),
    ],
)
def test_error_codes_in_words(code: int, words: str) -> None:
    assert error_words(code).startswith(f"0x{code:04X} ")
    assert words in error_words(code)
    assert error_hint(code)


def test_every_code_has_words_and_a_hint() -> None:
    for code in range(1 << 16):
        text = error_words(code)
        assert text.startswith(f"0x{code:04X} ")
        assert len(text) > 9
        assert error_hint(code) or code == 0
    assert all(0 <= code <= 0xFFFF and words for code, (words, _) in ERROR_CODES.items())


def test_codes_without_an_entry_take_their_group_s() -> None:
    assert error_words(0x3299) == "0x3299 voltage"
    assert error_words(0xFF77) == "0xFF77 manufacturer's error"
    assert "does not define" in error_words(0xA000)
    assert error_hint(0x8199) == error_hint(0x8100)
    assert "0xA000" in error_hint(0xA000)


def test_communication_errors_are_those_of_the_bus() -> None:
    assert all(is_communication_error(code) for code in (0x8110, 0x8120, 0x8130, 0x8140, 0x8210, 0x8250, 0x8700))
    assert not any(is_communication_error(code) for code in (0, 0x2310, 0x8311, 0x8400, 0x8611, 0xFF01))


def test_abort_codes_in_words() -> None:
    assert abort_words(0x06090030) == "0x06090030 value range exceeded"
    assert "unknown" in abort_words(0x12345678)
    assert all(abort_hint(code) for code in (*ABORT_CODES, 0x12345678))


def test_nmt_states_in_words() -> None:
    assert [nmt_words(state) for state in (0, 4, 5, 127)] == [
        "boot-up",
        "stopped",
        "operational",
        "pre-operational",
    ]
    assert "99" in nmt_words(99)
