"""What particles add to the stress of a suspension: their stresslets."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .flow.base import spin_and_strain, velocity_and_gradient
from .instant import Time
from .loads import load_on_fluid
from .scene import Scene
from .state import State, check_single

__all__ = ["particle_stress"]


def particle_stress(t: Time, state: State, scene: Scene) -> Float[Array, "fibres dim dim"]:
    """Stresslet of each fibre [force length], positive where it resists extension:

        S = -sum of [(r F + F r)/2 - (r.F) I/3] + sum of (20 pi/3) mu a^3 E

    over its beads: r from the fibre's centre (the mean of its beads) to a bead, F the force that the
    bead exerts on the fluid (all those of forces and constraints, as M sees them; torques make the
    antisymmetric part, which is left out), E the ambient rate of strain at the bead, which a sphere
    resists. The second sum is that of the tensor C: it is left out where the mobility has none, as
    `FreeDraining` and `RPY(strained=False)`.

    The mean of S, times the number of fibres per volume, is what they add to the stress of a dilute
    suspension. Stress that contact or weight carries from one fibre to another is not in it: where a
    net force acts on a fibre, S depends on what is called its centre.

    **Arguments**: time, state and scene. **Returns** `(fibres, dim, dim)`, symmetric; without a trace
    in space, and in the plane that part of the tensor in space.

    Source: Batchelor, J. Fluid Mech. 41 (1970) 545; of a sphere Einstein's, Kim & Karrila,
    Microhydrodynamics, section 2.2.

    >>> import jaxbeads as jb
    >>> scene = jb.Scene(jb.Chain(radius=1.0, fibres=[1, 1]), 3.0, flow=jb.flow.Shear(2.0))
    >>> pair = jb.State([[0.0, 0.0], [5.0, 1.0]])  # each has 20 pi at entry (x, y)
    >>> print(jb.stress.particle_stress(0.0, pair, scene)[1].round(4))
    [[ 0.     62.8319]
     [62.8319  0.    ]]
    """
    check_single(state)
    return _stresslets(jnp.asarray(t), state, scene)


@eqx.filter_jit
def _stresslets(t: Array, state: State, scene: Scene) -> Array:
    chain, position = scene.chain, state.position
    beads, dim = position.shape
    each = jnp.zeros((beads, dim, dim), position.dtype)
    force = load_on_fluid(t, state, scene).force
    if force is not None:
        arm = position - chain.centres(position)[chain.fibre_of_bead]
        moment = arm[:, :, None] * force[:, None, :]
        trace = jnp.sum(arm * force, axis=1)[:, None, None] * jnp.eye(dim)[None]
        each = trace / 3 - (moment + jnp.swapaxes(moment, 1, 2)) / 2
    if scene.flow is not None:
        _, gradient = velocity_and_gradient(scene.flow, t, position, chain.radius)
        _, strain = spin_and_strain(gradient)
        if scene.operator(state).disturbance(strain) is not None:
            volume = (4 * np.pi / 3) * chain.radii[:, None, None] ** 3
            strain = strain if strain.ndim == 3 else strain[None]
            each = each + 5 * scene.viscosity * volume * strain
    fibres = jnp.zeros((len(chain.fibres), dim, dim), each.dtype)
    return fibres.at[chain.fibre_of_bead].add(each)
