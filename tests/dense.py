"""An independent route to the motion of one instant: dense elimination of the saddle-point system."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeads import Load, Motion, dynamics
from jaxbeads.state import zero_motion


def flat(motion):
    return np.concatenate([np.ravel(x) for x in jax.tree.leaves(motion)])


def dense_motion(t, state, scene):
    """Independent route: the whole saddle-point system (M^-1, J^T; J, 0) by dense elimination."""
    beads, dim = state.position.shape
    rest = zero_motion(state, scene.rotational)
    sizes = [np.size(x) for x in jax.tree.leaves(rest)]

    def unflat(vector):
        parts = jnp.split(jnp.asarray(vector), np.cumsum(sizes)[:-1])
        return [p.reshape(beads, -1) for p in parts]

    operator = scene.operator(state)
    mobility = np.stack(
        [flat(operator.motion(Load(*unflat(unit)))) for unit in np.eye(sum(sizes))], axis=1
    )

    def slip(vector):
        return np.concatenate(
            [
                np.ravel(c.slip(jnp.asarray(t), state, Motion(*unflat(vector)), scene.chain))
                for c in scene.constraints
            ]
        )

    offset = slip(np.zeros(sum(sizes)))
    jacobian = np.stack([slip(unit) - offset for unit in np.eye(sum(sizes))], axis=1)
    live = np.abs(jacobian).max(axis=1) > 0  # rows between two fibres say nothing
    jacobian, offset = jacobian[live], offset[live]
    load = dynamics.applied_load(t, state, scene)
    ambient = dynamics.ambient_motion(t, state, scene)
    blank = [np.zeros((beads, dim)), np.zeros_like(rest.spin) if rest.spin is not None else None]
    parts = [load.force, load.torque]
    applied = [b if p is None else p for p, b in zip(parts, blank, strict=True) if b is not None]
    free = flat(ambient) if ambient is not None else np.zeros(sum(sizes))
    resistance, rows = np.linalg.inv(mobility), len(jacobian)
    system = np.block([[resistance, -jacobian.T], [jacobian, np.zeros((rows, rows))]])
    right = np.concatenate(
        [np.concatenate([np.ravel(a) for a in applied]) + resistance @ free, -offset]
    )
    return np.linalg.solve(system, right)[: sum(sizes)]
