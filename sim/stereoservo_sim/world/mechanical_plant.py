"""A plant behind imperfect mechanics: its drives' set-points reach the links through gears, encoders see one side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.world.mechanics import Mechanics, Transmission, gravity_load, horizontal_load
from stereoservo_sim.world.robots import Robot
from stereoservo_sim.world.velocity_drives import Plant


class MechanicalPlant:
    """``links`` moved through ``mechanics``, a joint each; otherwise as :class:`velocity_drives.Plant`.

    ``robot``: whose weight the joints bear; None: each joint bears an arm that is level at its zero.
    """

    def __init__(self, links: Plant, mechanics: Sequence[Mechanics], robot: Robot | None) -> None:
        load: Callable[[FloatArray], FloatArray] = (
            horizontal_load if robot is None else partial(gravity_load, robot)
        )
        self.links = links
        self.transmission = Transmission(mechanics, links.positions, load)
        self._offset_rates = np.zeros_like(links.positions)

    @property
    def positions(self) -> FloatArray:
        """Links (n,): the truth."""
        return self.links.positions

    @property
    def velocities(self) -> FloatArray:
        """Velocities of the links (n,)."""
        return self.links.velocities

    @property
    def efforts(self) -> FloatArray:
        """Efforts (n,) of what moves the links."""
        return self.links.efforts

    @property
    def motors(self) -> FloatArray:
        """Angles of the motors (n,), in units of the joints."""
        return self.transmission.motor

    @property
    def readings(self) -> FloatArray:
        """Angles at the encoders (n,), before they are rounded to steps."""
        return self.links.positions + self.transmission.reading_offset

    @property
    def reading_rates(self) -> FloatArray:
        """Velocities at the encoders (n,)."""
        return self.links.velocities + self._offset_rates

    def follow(self, set_positions: FloatArray, set_velocities: FloatArray, h: float) -> None:
        """Advance by ``h`` [s] towards the drives' set-points at its end, (n,), (n,)."""
        gear = self.transmission
        link, offset = gear.link, gear.reading_offset
        gear.follow(set_positions, h)
        self._offset_rates = (gear.reading_offset - offset) / h
        self.links.follow(gear.link, (gear.link - link) / h, h)

    def rest(self, h: float) -> bool:
        """Let ``h`` [s] pass if nothing moves or is about to; whether that is so."""
        return self.links.rest(h) and self.transmission.rest(h)

    def close(self) -> None:
        """Release resources."""
        self.links.close()
