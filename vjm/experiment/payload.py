"""Bodies that are known to be on the tip of a link."""

from __future__ import annotations

from typing import NamedTuple

from vjm.errors import is_number, require


class Payload(NamedTuple):
    """A rigid body on the tip of a link."""

    mass: float = 0.0  # [kg]
    offset: float = 0.0  # of its centre beyond the tip, along the link there [m]
    inertia: float = 0.0  # about its centre [kg m^2]

    def with_another(self, other: Payload) -> Payload:
        """Return both as one body."""
        mass = self.mass + other.mass
        if not mass:
            return NO_PAYLOAD
        offset = (self.mass * self.offset + other.mass * other.offset) / mass
        inertia = sum(body.inertia + body.mass * (body.offset - offset) ** 2 for body in (self, other))
        return Payload(mass, offset, inertia)


NO_PAYLOAD = Payload()


def as_payload(value: float | tuple[float, float, float]) -> Payload:
    """Return what a user gives for a payload, a mass [kg] or a body's three numbers, as a body.

    Raises:
        ShapeError: it is neither.
    """
    numbers = value if isinstance(value, tuple) else (value,)
    are_numbers = len(numbers) in (1, 3) and all(map(is_number, numbers))
    body = Payload(*numbers) if are_numbers else NO_PAYLOAD
    possible = body == NO_PAYLOAD or (body.mass > 0 and body.inertia >= 0)
    expected = "a mass, zero or positive [kg], or (mass [kg], offset [m], inertia [kg m^2]) of a body"
    require("payload", value, are_numbers and possible, expected)
    return body
