"""Ends of a fibre that are held: sets of constraints."""

from collections.abc import Sequence
from typing import Any

from .base import AbstractConstraint
from .prescribed import (
    PrescribedDirection,
    PrescribedPosition,
    PrescribedRoll,
    PrescribedSpin,
    indices,
)


def clamped(
    end: int | Sequence[int] = 0, *, spinless: bool = False, roll: Any = None
) -> tuple[AbstractConstraint, ...]:
    """Constraints that clamp an end: its bead and the direction of its bond are held.

    **Arguments**

    - `end`: 0 for the first bead, -1 for the last. Of several fibres, bead `end` of all, with the bond
      to the next bead if it is counted from the first, with that from the bead before if it is counted
      from the last, as -1. Several ends as a sequence: `chain.first_beads`, `chain.last_beads`.
    - `spinless`: for scenes without rotation; otherwise the bead's spin is held too, eq. (59).
    - `roll`: of a fibre in space that is turned about its axis there, as in `PrescribedRoll`.

    >>> import jaxbeads as jb
    >>> from jaxbeads.constraint import Gears, clamped
    >>> from jaxbeads.force import Bending, Weight
    >>> for held in clamped():
    ...     print(jb.dynamics.named(held))
    PrescribedPosition(bead=0)
    PrescribedDirection(bond=0)
    PrescribedSpin(bead=0)
    >>> beam = jb.Scene(
    ...     jb.Chain(radius=1.0, fibres=5),
    ...     viscosity=1.0,
    ...     constraints=[Gears(), *clamped()],
    ...     forces=[Bending(100.0), Weight([0.0, -0.1])],
    ... )
    """
    end = indices(end)
    held = (PrescribedPosition(bead=end), PrescribedDirection(bond=end))
    if roll is not None:
        return (*held, PrescribedRoll(roll, bead=end, across=True))
    return held if spinless else (*held, PrescribedSpin(bead=end))


def hinged(end: int | Sequence[int] = 0) -> tuple[AbstractConstraint, ...]:
    """Constraints that hinge an end, or several as for `clamped`: its bead is held, free to turn.

    >>> import jaxbeads as jb
    >>> from jaxbeads.constraint import hinged
    >>> print([jb.dynamics.named(held) for held in hinged(-1)])
    ['PrescribedPosition(bead=-1)']
    """
    return (PrescribedPosition(bead=indices(end)),)
