"""A flexible fibre of bodies with elastic joints."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from .._checks import fail, kind, known, non_negative, whole
from .._checks import shape as check_shape
from .._typing import float_array
from ..geometry import norm
from .base import Body
from .joints import Ball


class Fibre(NamedTuple):
    """Bodies and joints of a flexible fibre; see `fibre`.

    >>> import jaxbeads as jb
    >>> tail = jb.body.fibre(jb.body.rod(3), rigidity=100.0)
    >>> print(isinstance(tail, jb.body.Fibre), len(tail.bodies), len(tail.joints))
    True 3 2
    """

    bodies: tuple[Body, ...]
    """One of each bead."""
    joints: tuple[Ball, ...]
    """Of neighbours."""


def fibre(shape: Body, rigidity: Any, twist_rigidity: Any = None, first: int = 0) -> Fibre:
    """A flexible fibre as a row of bodies, a bead each, with an elastic joint where neighbours touch (or
    as far between their surfaces). It is at rest as it is drawn: straight, or a helix.

    Joints have the stiffness K_b/l, and K_t/l about the line from a bead to the next, with l the
    distance of these: a discrete rod of the energy sum (K_b phi^2 + K_t theta^2)/(2 l), with phi and
    theta the angles by which each joint is bent and twisted. Beads keep touching their joints, so
    where it bends, neighbours come nearer by l (1 - cos(phi/2)). Take `travel(..., implicit=True)`.

    **Arguments**

    - `shape`: its beads one after the other, as of `rod` or `helix`, two at least.
    - `rigidity`: K_b [force length^2], one or one for each joint, `(beads - 1,)`.
    - `twist_rigidity`: K_t [force length^2], the same; by default K_b.
    - `first`: index that its first bead has among the bodies of its `Assembly`.

    **Returns** bodies and joints, to be given to `Assembly` with others. **Raises** `ValueError` for a
    single bead, wrong shapes, and a rigidity that is negative.

    >>> import jaxbeads as jb
    >>> head, tail = jb.body.sphere(6.0, [-7.0, 0.0, 0.0]), jb.body.helix(3.0, 14.0, turns=1)
    >>> tail = jb.body.fibre(tail, rigidity=1e5, first=1)
    >>> motor = jb.body.Motor(0, 1, axis=[1.0, 0.0, 0.0])
    >>> bacterium = jb.Assembly([head, *tail.bodies], 1.0, [motor, *tail.joints])
    >>> print(bacterium.beads, bacterium.unknowns)  # 6 of the head, 3 of each joint
    12 36
    """
    kind("shape", shape, Body)
    if shape.beads < 2:
        fail("shape", "hold two beads at least", "it holds one")
    whole("first", first, 0)
    bonds, radii = shape.beads - 1, shape.radii
    rigidity = float_array(rigidity)
    twisting = rigidity if twist_rigidity is None else float_array(twist_rigidity)
    for name, value in {"rigidity": rigidity, "twist_rigidity": twisting}.items():
        check_shape(name, value, (), (bonds,))
        non_negative(name, value)
    bond = shape.position[1:] - shape.position[:-1]
    length = norm(bond)
    if known(length) and not np.all(np.asarray(length) > 0):
        bead = int(np.argmin(np.asarray(length)))
        fail("shape", "hold no two neighbours in one place", f"beads {bead} and {bead + 1} are")
    ahead = (length + radii[:-1] - radii[1:]) / (2 * length)
    points = shape.position[:-1] + ahead[:, None] * bond
    bending, twisting = (jnp.broadcast_to(x, (bonds,)) / length for x in (rigidity, twisting))
    bodies = tuple(Body(x[None], a) for x, a in zip(shape.position, radii, strict=True))
    joints = tuple(
        Ball(first + k, first + k + 1, points[k], bending[k], twisting[k], bond[k])
        for k in range(bonds)
    )
    return Fibre(bodies, joints)
