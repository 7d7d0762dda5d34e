"""What the beads are, do and bear: `State`, `Motion`, `Load`.

Arrays have one row per bead. `dim` is 2 (a planar scene) or 3; `spins` is 1 or 3 accordingly: in the
plane a bead turns about the normal only, in the same three-dimensional fluid.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._checks import fail, finite
from ._typing import float_array, optional_float_array


class State(eqx.Module):
    """Configuration of all beads.

    **Arguments**

    - `position`: centres of the beads, shape `(beads, dim)`, [length].
    - `director`: unit vectors fixed to the beads, shape `(beads, dim)`, or `None` where no term of
      the scene needs orientations.
    - `frame`: a unit vector d_1 normal to the fibre at each bead in space, shape `(beads, 3)`, fixed to
      the material, or `None` (see `material`). A run adds it where a force needs it, see `with_frames`.
    - `own`: numbers that forces own, one array (or `None`) for each force of the scene, or `None` (see
      `AbstractForce.begin`). A run adds them; a force finds its own array here.

    The rules of all but the positions are in `carried`.

    **Raises** `ValueError` for a position that is not of shape `(beads, 2 or 3)`, another shape of the
    directors, and numbers that are not finite.

    >>> import jaxbeads as jb
    >>> state = jb.State([[0.0, 0.0], [2.0, 0.0]])
    >>> print(state.position.shape, state.director)
    (2, 2) None
    """

    position: Float[Array, "beads dim"] = eqx.field(converter=float_array)
    director: Float[Array, "beads dim"] | None = eqx.field(
        converter=optional_float_array, default=None
    )
    frame: Float[Array, "beads dim"] | None = eqx.field(
        converter=optional_float_array, default=None
    )
    own: Any = None

    def __check_init__(self) -> None:
        shape = self.position.shape
        if len(shape) != 2 or shape[1] not in (2, 3) or shape[0] < 1:
            fail("position", "have shape (beads, 2) or (beads, 3)", f"it has shape {shape}")
        finite("position", self.position)
        if self.director is not None:
            other = self.director.shape
            if other != shape:
                fail("director", f"have the position's shape {shape}", f"it has {other}")
            finite("director", self.director)
        if self.frame is not None:
            if shape[1] != 3 or self.frame.shape != shape:
                must = "have the position's shape, in space"
                fail("frame", must, f"it has {self.frame.shape} beside positions of {shape}")
            finite("frame", self.frame)


def check_single(state: State) -> None:
    """Refuse a state with an axis of times where one instant is meant."""
    if (shape := jnp.shape(state.position))[2:]:
        must = "be one state (of many: `jax.vmap` over `solution.ts, solution.states`)"
        fail("state", must, f"its positions have shape {shape}")


class Motion(eqx.Module):
    """Velocities [length/time], shape `(beads, dim)`, and spins [1/time], shape `(beads, spins)`.

    `spin` is `None` in scenes in which no term turns beads.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> print(jb.Motion(velocity=jnp.zeros((3, 2))).spin)
    None
    """

    velocity: Float[Array, "*batch beads dim"]
    spin: Float[Array, "*batch beads spins"] | None = None


class Load(eqx.Module):
    """Forces [force], shape `(beads, dim)`, and torques [force length], shape `(beads, spins)`.

    `None` stands for "none at all" and costs nothing.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> load = jb.Load(force=jnp.array([[0.0, -1.0], [0.0, -1.0]]))
    >>> print(load.force.sum(axis=0), load.torque)
    [ 0. -2.] None
    """

    force: Float[Array, "*batch beads dim"] | None = None
    torque: Float[Array, "*batch beads spins"] | None = None


def spins(dim: int) -> int:
    """Number of spin components of a bead: 1 in the plane, 3 in space."""
    return 1 if dim == 2 else 3


def _sum(a: Array | None, b: Array | None) -> Array | None:
    return b if a is None else a if b is None else a + b


def add_loads(*loads: Load) -> Load:
    """Sum of loads; absent parts stay absent."""
    force = torque = None
    for load in loads:
        force, torque = _sum(force, load.force), _sum(torque, load.torque)
    return Load(force, torque)


def add_motions(a: Motion, b: Motion) -> Motion:
    """Sum of motions; an absent spin stays absent."""
    return Motion(a.velocity + b.velocity, _sum(a.spin, b.spin))


def zero_motion(state: State, rotational: bool) -> Motion:
    """Beads at rest."""
    beads, dim = state.position.shape
    spin = jnp.zeros((beads, spins(dim)), state.position.dtype) if rotational else None
    return Motion(jnp.zeros_like(state.position), spin)
