"""Derivatives of runs at a wall by the wall itself and by what drives filaments on it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeads as jb
from jaxbeads import Chain, Configuration, Load, NoSlipWall, Scene
from jaxbeads.actuation import TwoStrokes
from jaxbeads.constraint import Gears
from jaxbeads.force import Bending, Weight
from jaxbeads.mobility import RPY
from jaxbeads.mobility.base import AbstractMobility

CHAIN = Chain(1.0, (4, 4))


def pumped(numbers: jax.Array) -> jax.Array:
    """Where two filaments that beat by a wall get to, of its height, its tilt and their lag."""
    height, tilt, lag = numbers
    wall = NoSlipWall(jnp.stack([0.3, height]), jnp.stack([tilt, 1.0]))
    phase = lag * jnp.asarray(CHAIN.fibre_of_bead[1:-1])  # of the joints
    bending = Bending(20.0, TwoStrokes(1.2, 0.05, phase))
    forces = [bending, Weight([0.1, -0.3])]
    scene = Scene(CHAIN, 0.8, constraints=[Gears()], forces=forces, domain=wall)
    state = jb.straight(CHAIN, [0.3, 1.0], [[0.0, 5.5], [4.0, 5.7]])
    end = jb.rollout(scene, state, [0.0, 4.0], substeps=40).final.position
    return jnp.sum(end * jnp.linspace(-1.0, 1.0, end.size).reshape(end.shape))


@pytest.fixture(scope="module")
def differences():
    at, step = np.array([0.2, -0.15, 0.8]), 1e-4
    value = jax.jit(pumped)
    shifts = step * np.eye(3)
    return at, np.array([(value(at + s) - value(at - s)) / (2 * step) for s in shifts])


@pytest.mark.parametrize("mode", [jax.grad, jax.jacfwd], ids=["reverse", "forward"])
def test_by_the_walls_height_its_normal_and_a_lag(mode, differences):
    at, slopes = differences
    found = jax.jit(mode(pumped))(jnp.asarray(at))
    assert np.abs(slopes).min() > 1e-2
    assert np.abs(found / slopes - 1).max() < 1e-6


@pytest.mark.parametrize("dim", [2, 3])
def test_derivatives_of_the_mobility_are_found_for_pairs(dim):
    """Beads of different radii, two of which overlap the wall, in the plane in a strain that varies:
    against the derivative of the whole."""
    rng = np.random.default_rng(dim)
    x = rng.uniform(-2.0, 2.0, (4, dim))
    normal, point = np.eye(dim)[1] + 0.2, 0.1 * np.ones(dim)
    up = normal / np.linalg.norm(normal)
    heights, radii = np.array([0.4, 0.7, 1.5, 2.2]), np.array([1.0, 0.8, 0.9, 1.1])
    x += (heights - (x - point) @ up)[:, None] * up
    turns = 1 if dim == 2 else 3
    load = Load(*(jnp.asarray(rng.normal(size=(4, k))) for k in (dim, turns)))
    shifts = jnp.asarray(rng.normal(size=(3, 4, dim)))

    def strain(y):
        rate = jnp.sin(y[:, :, None] + y[:, None, :])
        return rate - jnp.trace(rate, axis1=1, axis2=2)[:, None, None] * jnp.eye(dim)[None] / dim

    @eqx.filter_jit
    def both(radius):
        spheres = Configuration(x, radius, 0.7, True, NoSlipWall(point, normal))
        parts = load, strain if dim == 2 else None, shifts
        generic = AbstractMobility.gradient(RPY(), spheres, *parts)
        return RPY().gradient(spheres, *parts), generic

    for one, two in zip(*map(jax.tree.leaves, both(radii)), strict=True):
        assert np.abs(one - two).max() < 1e-13 * np.abs(two).max()
