"""How a broken clause is told."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NoReturn

from vjm.errors import EffectError, SimulationDivergedError


@dataclass(frozen=True)
class Clause:
    """One clause of the contract, as an effect is held to it.

    Attributes:
        effect: the effect's id, or its class where it has none.
        name: of the clause.
    """

    effect: str
    name: str

    def broken(self, found: str, expected: str) -> NoReturn:
        """Say so.

        Raises:
            EffectError: always.
        """
        raise EffectError(self.effect, self.name, found, expected)

    def holds(self, condition: object, found: str, expected: str) -> None:
        """Nothing, where a condition holds.

        Raises:
            EffectError: it does not hold.
        """
        if not condition:
            self.broken(found, expected)

    @contextmanager
    def running(self, what: str) -> Iterator[None]:
        """While something that an effect's author wrote is running: whatever goes wrong there breaks the clause.

        Raises:
            EffectError: it has raised an error; of the clause `inputs` where it wrote into an array that it was given.
        """
        try:
            yield
        except EffectError:
            raise
        except SimulationDivergedError as error:
            raise EffectError(self.effect, self.name, f"{what} diverges: {error}", "finite motion") from error
        except Exception as error:
            if isinstance(error, ValueError) and "read-only" in str(error):
                found = f"{what} writes into an array that it was given"
                raise EffectError(self.effect, "inputs", found, "a new array") from error
            found = f"{what} raises {type(error).__name__}: {error}"
            raise EffectError(self.effect, self.name, found, "no error") from error
