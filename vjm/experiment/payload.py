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


def as_payload(value: float | Payload) -> Payload:
    """Return what a user gives for a payload, a mass [kg] or a body, as a body.

    Raises:
        ShapeError: it is neither.
    """
    body = value if isinstance(value, Payload) else Payload(value)
    valid = all(map(is_number, body)) and min(body.mass, body.inertia) >= 0 and (body.mass > 0 or body == NO_PAYLOAD)
    expected = "a mass, zero or positive [kg], or a vjm.Payload of mass [kg], offset [m] and inertia [kg m^2]"
    require("payload", value, valid, expected)
    return body
