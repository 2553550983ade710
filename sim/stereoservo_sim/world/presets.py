"""Names of the mechanics presets, separate so that commands can offer them without heavy imports."""

from __future__ import annotations

from typing import Literal

MechanicsPreset = Literal["strain_wave", "planetary_qdd", "serial_servo"]
"""Names of shipped mechanics, `world.mechanics.PRESETS`."""
