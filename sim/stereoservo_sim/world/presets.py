"""Names of the mechanics presets, for commands that offer them before they import anything heavier."""

from __future__ import annotations

from typing import Literal

MechanicsPreset = Literal["strain_wave", "planetary_qdd", "serial_servo"]
"""Names of shipped mechanics, `world.mechanics.PRESETS`."""
