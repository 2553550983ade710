"""Objects of an emulated CiA 402 drive, bound to its motion: measured values, commands, refusals, stored
parameters.
"""

from __future__ import annotations

from functools import partial

from stereoservo_sim.emulators.nodes.dictionary import Abort, Dictionary, SdoError, Value
from stereoservo_sim.emulators.nodes.drive_motion import (
    CYCLIC_VELOCITY,
    PROFILE_POSITION,
    PROFILE_VELOCITY,
    DriveMotion,
)
from stereoservo_sim.emulators.nodes.node import NodeSettings
from stereoservo_sim.emulators.nodes.state_machine import PowerMachine

MODES = (PROFILE_POSITION, PROFILE_VELOCITY, CYCLIC_VELOCITY)
SUPPORTED_MODES = sum(1 << mode - 1 for mode in MODES)
SAVE, LOAD = 0x65766173, 0x64616F6C
"""Signatures of 0x1010 and 0x1011: "save", "load"."""
OPTION_CODES = {
    0x6007: range(4), 0x605A: range(9), 0x605B: range(2), 0x605C: range(2), 0x605D: range(1, 5), 0x605E: range(5),
}  # fmt: skip
"""What this drive offers of each."""


class DriveObjects:
    """Binds a dictionary to the drive; keeps what 0x1010 has saved."""

    def __init__(
        self,
        dictionary: Dictionary,
        machine: PowerMachine,
        motion: DriveMotion,
        identity: dict[int, int],
        settings: NodeSettings,
    ) -> None:
        self._dictionary = dictionary
        self._identity = identity
        self._settings = settings
        self._stored: dict[tuple[int, int], Value] = {}
        for index, value in (
            (0x6041, motion.status),
            (0x6064, motion.position),
            (0x606B, motion.velocity_demand),
            (0x606C, motion.velocity),
            (0x6077, motion.torque),
            (0x6078, motion.torque),
            (0x60F4, motion.following_error),
            (0x60FD, motion.digital_inputs),
        ):
            dictionary.live(index, 0, value)
        dictionary.changed(0x6040, lambda sub, value: (machine.control(value), motion.take_set_point()))
        dictionary.guard(0x6060, self._check_mode)
        dictionary.changed(0x6060, lambda sub, value: dictionary.set(0x6061, 0, value))
        for index in OPTION_CODES:
            dictionary.guard(index, partial(self._check_option, index))
        dictionary.guard(0x1005, self._check_sync)
        dictionary.guard(0x1010, lambda sub, value: self._check_signature(sub, value, SAVE))
        dictionary.changed(0x1010, lambda sub, value: self._save())
        dictionary.guard(0x1011, lambda sub, value: self._check_signature(sub, value, LOAD))
        dictionary.changed(0x1011, lambda sub, value: self._forget())

    @staticmethod
    def _check_mode(sub: int, value: int) -> None:
        if value not in (0, *MODES):
            raise SdoError(Abort.INVALID_VALUE)

    @staticmethod
    def _check_option(index: int, sub: int, value: int) -> None:
        if value not in OPTION_CODES[index]:
            raise SdoError(Abort.INVALID_VALUE)

    @staticmethod
    def _check_sync(sub: int, value: int) -> None:
        if value >> 11:
            raise SdoError(Abort.INVALID_VALUE)  # it does not produce SYNC, and knows 11 bits only

    @staticmethod
    def _check_signature(sub: int, value: int, signature: int) -> None:
        if not sub or value != signature:
            raise SdoError(Abort.NOT_STORABLE)

    def _save(self) -> None:
        self._dictionary.set(0x1010, 1, 1)
        self._stored = self._dictionary.storable()

    def _forget(self) -> None:
        self._dictionary.set(0x1011, 1, 1)
        self._stored = {}

    def power_on(self) -> None:
        """Set all objects to their values at power on."""
        self._dictionary.restore(0x0000, 0xFFFF, self._stored)
        self._dictionary.set(0x6502, 0, SUPPORTED_MODES)
        self._dictionary.set(0x6061, 0, self._dictionary.get(0x6060))
        self._fix()

    def reset_communication(self) -> None:
        """Set the communication profile's objects to their values at power on; errors and their history stay."""
        keys = [key for key in self._dictionary.entries if key[0] in (0x1001, 0x1003)]
        errors = {key: self._dictionary.get(*key) for key in keys}
        self._dictionary.restore(0x1000, 0x1FFF, self._stored)
        for key, value in errors.items():
            self._dictionary.set(*key, value)
        self._fix()

    def _fix(self) -> None:
        for sub, value in self._identity.items():
            self._dictionary.set(0x1018, sub, value)
        if not self._settings.pdos_by_default:
            for index in (*range(0x1400, 0x1404), *range(0x1800, 0x1804)):
                self._dictionary.set(index, 1, self._dictionary.get(index, 1) | 1 << 31)
