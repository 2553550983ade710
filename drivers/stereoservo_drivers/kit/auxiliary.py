"""Auxiliary joints and digital outputs of a driver: verified commands, and motion at the joints' own velocities."""

from __future__ import annotations

from collections.abc import Mapping

from stereoservo.messages.goals import AuxiliarySpec
from stereoservo.ports.devices import DriverError


def verify_order(values: Mapping[str, float], specs: tuple[AuxiliarySpec, ...]) -> None:
    """Raise DriverError (``auxiliary``) for an unknown name, or a value outside its limits."""
    known = {spec.name: spec for spec in specs}
    for name, value in values.items():
        spec = known.get(name)
        if spec is None:
            raise DriverError("auxiliary", f"no auxiliary {name!r}; there are: {', '.join(known) or 'none'}", name=name)
        allowed = value in (0.0, 1.0) if spec.kind == "digital" else spec.low <= value <= spec.high
        if not allowed:
            raise DriverError(
                "auxiliary", f"{name}: {value:g}; {spec.low:g} to {spec.high:g} is valid", name=name, value=value
            )


def verify_specs(specs: tuple[AuxiliarySpec, ...]) -> None:
    """Raise DriverError (``options``) for a duplicate name, an empty range, or a joint that would never move."""
    names = [spec.name for spec in specs]
    for spec in specs:
        if names.count(spec.name) > 1:
            raise DriverError(
                "options", f"auxiliary name {spec.name!r} occurs {names.count(spec.name)} times; once is valid"
            )
        if spec.kind != "digital" and not (spec.low < spec.high and spec.velocity > 0.0):
            raise DriverError(
                "options",
                f"auxiliary {spec.name!r}: low {spec.low:g}, high {spec.high:g}, velocity {spec.velocity:g}; low below "
                "high and a velocity above 0 are valid",
            )


class AuxiliaryMotion:
    """Simulated auxiliary joints, which move to commanded positions at their velocities, and outputs, which switch at
    once.

    Initially every joint is at the bound nearer to zero, and outputs are off. Raises DriverError (``options``).
    """

    def __init__(self, specs: tuple[AuxiliarySpec, ...]) -> None:
        verify_specs(specs)
        self.specs = specs
        self._values = {spec.name: min(max(0.0, spec.low), spec.high) for spec in specs}
        self._orders = dict(self._values)
        self._now_ns: int | None = None

    def order(self, values: Mapping[str, float], now_ns: int) -> None:
        """Store a command. Raises DriverError (``auxiliary``)."""
        verify_order(values, self.specs)
        self.values(now_ns)
        self._orders |= values

    def stop(self, now_ns: int) -> None:
        """Stop the joints at their positions; outputs keep their state."""
        self._orders = self.values(now_ns)

    def values(self, now_ns: int) -> dict[str, float]:
        """Positions and outputs at ``now_ns``, by name."""
        dt = 0.0 if self._now_ns is None else max(now_ns - self._now_ns, 0) * 1e-9
        self._now_ns = now_ns
        for spec in self.specs:
            value, order = self._values[spec.name], self._orders[spec.name]
            step = abs(order - value) if spec.kind == "digital" else spec.velocity * dt
            self._values[spec.name] = value + min(max(order - value, -step), step)
        return dict(self._values)
