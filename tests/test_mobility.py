"""Mobility: against quadrature of its definition, pygrpy, and its symmetries (gates T1-T3)."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import MOBILITIES, name
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from sphere_average import mobility_motion

from jaxbeads import Configuration, Load, tensors
from jaxbeads.mobility import RPY

with warnings.catch_warnings():
    # Its docstrings hold a backslash of which Python warns where it compiles them.
    warnings.filterwarnings("ignore", ".*invalid escape sequence")
    import pygrpy.grpy_tensors


def motion(mobility, position, radius, load, viscosity=1.0, rotational=True):
    spheres = Configuration(position, radius, viscosity, rotational)
    return mobility.operator(spheres).kept().motion(load)


def carried_by(position, radius, strain):
    return tensors.shear_disturbance(Configuration(position, radius, 1.0), strain)


def dense(mobility, position, radius, viscosity=1.0):
    """(6N, 6N) in space, (3N, 3N) in the plane; ordered (forces of all, torques of all)."""
    beads, dim = position.shape
    turns = 1 if dim == 2 else 3

    def column(unit):
        load = Load(
            unit[: beads * dim].reshape(beads, dim), unit[beads * dim :].reshape(beads, turns)
        )
        moved = motion(mobility, position, radius, load, viscosity)
        return jnp.concatenate([moved.velocity.ravel(), moved.spin.ravel()])

    return np.asarray(jax.vmap(column)(jnp.eye(beads * (dim + turns)))).T


def cloud(seed, beads=6, spread=2.0):
    """Random spheres: separate, overlapping and one within the other."""
    rng = np.random.default_rng(seed)
    position = rng.normal(size=(beads, 3)) * spread
    position[1] = position[0] + 0.1 * rng.normal(size=3)
    return rng, position


@pytest.mark.parametrize("equal", [True, False])
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("given", ["force", "torque", "both"])
def test_the_form_that_is_differentiated_is_the_same_motion(given, dim, equal):
    # Pair by pair, without the tables that the quadrature vouches for.
    rng, position = cloud(5)
    position, turns = jnp.asarray(position[:, :dim]), 1 if dim == 2 else 3
    radius = jnp.asarray(1.3) if equal else jnp.asarray(rng.uniform(0.3, 2.0, 6))
    force, torque = jnp.asarray(rng.normal(size=(6, dim))), jnp.asarray(rng.normal(size=(6, turns)))
    load = Load(None if given == "torque" else force, None if given == "force" else torque)
    one = RPY().motion(Configuration(position, radius, 1.7), load)
    two = motion(RPY(), position, radius, load, 1.7)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        assert np.abs(a - b).max() < 1e-14


@pytest.mark.parametrize("equal", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_matches_quadrature_of_the_definition(seed, equal):
    # Closed forms against surface averages; the quadrature converges to 1e-12.
    rng, position = cloud(seed)
    radius = np.full(6, 1.3) if equal else rng.uniform(0.3, 2.0, 6)
    force, torque = rng.normal(size=(2, 6, 3))
    gradient = rng.normal(size=(3, 3))
    strain = 0.5 * (gradient + gradient.T) - np.trace(gradient) / 3 * np.eye(3)
    given_radius = jnp.asarray(1.3) if equal else jnp.asarray(radius)
    load = Load(jnp.asarray(force), jnp.asarray(torque))
    moved = motion(RPY(), position, given_radius, load, 0.7)
    carried = carried_by(position, given_radius, jnp.asarray(strain))
    velocity, spin = mobility_motion(position, radius, 0.7, force, torque, strain)
    scale = np.abs(velocity).max(), np.abs(spin).max()
    assert np.abs(moved.velocity + carried.velocity - velocity).max() < 1e-11 * scale[0]
    assert np.abs(moved.spin + carried.spin - spin).max() < 1e-11 * scale[1]


@pytest.mark.parametrize("equal", [True, False])
def test_matches_pygrpy(equal):
    # Gate T1: an independent published implementation, relative 1e-12.
    # It knows separate and overlapping spheres, not one within the other (quadrature covers that).
    for seed in range(10):
        rng, position = cloud(seed)
        position[1] = position[0] + np.array([0.7, 0.4, -0.3])
        radius = np.full(6, 1.3) if equal else rng.uniform(0.8, 1.2, 6)
        ours = dense(RPY(), position, 1.3 if equal else radius)
        theirs = pygrpy.grpy_tensors.mu(position, radius)
        assert np.abs(ours - theirs).max() < 1e-12 * np.abs(theirs).max()


def test_single_bead():
    for mobility in MOBILITIES:
        load = Load(jnp.array([[1.0, 2.0, 3.0]]), jnp.array([[3.0, 1.0, -1.0]]))
        moved = motion(mobility, np.zeros((1, 3)), 0.5, load, 2.0)
        assert np.allclose(moved.velocity, load.force / (6 * np.pi), rtol=1e-14)
        assert np.allclose(moved.spin, load.torque / (2 * np.pi), rtol=1e-14)


@pytest.mark.parametrize("mobility", MOBILITIES, ids=name)
def test_symmetric_and_positive_definite(mobility):
    # Gate T2: 500 configurations, from apart to fully overlapping.
    operator = jax.jit(
        lambda position, radius: jax.vmap(
            lambda f: jnp.concatenate(
                jax.tree.leaves(
                    mobility.motion(Configuration(position, radius, 1.0), Load(f[:, :3], f[:, 3:]))
                ),
                axis=1,
            ).ravel()
        )(jnp.eye(36).reshape(36, 6, 6))
    )
    for seed in range(250):
        for equal in (True, False):
            rng = np.random.default_rng(seed)
            position = rng.normal(size=(6, 3)) * rng.choice([0.0, 0.01, 0.3, 1.0, 5.0])
            radius = 1.0 if equal else rng.uniform(0.2, 2.0, 6)
            matrix = np.asarray(operator(jnp.asarray(position), jnp.asarray(radius)))
            norm = np.linalg.norm(matrix, 2)
            assert np.abs(matrix - matrix.T).max() <= 1e-15 * norm
            # The scale of translation and rotation differs by a^2; measure eigenvalues without it.
            size = np.repeat(np.broadcast_to(radius, 6), 6) ** np.tile([0.5] * 3 + [1.5] * 3, 6)
            values = np.linalg.eigvalsh(matrix * np.outer(size, size))
            assert values[0] > -1e-14 * values[-1]


@settings(deadline=None, max_examples=25, derandomize=True)
@given(seed=st.integers(0, 10_000), mobility=st.sampled_from(MOBILITIES))
def test_equivariance(seed, mobility):
    # Gate T3: rotate, translate, relabel, mirror.
    rng, position = cloud(seed, spread=1.0)
    force, torque = rng.normal(size=(2, 6, 3))
    radius = jnp.asarray(0.8)

    def moved(x, f, t):
        out = motion(mobility, x, radius, Load(jnp.asarray(f), jnp.asarray(t)))
        return np.asarray(out.velocity), np.asarray(out.spin)

    v, w = moved(position, force, torque)
    turn = Rotation.random(random_state=seed).as_matrix()
    order = rng.permutation(6)
    mirror = np.diag([1.0, -1.0, 1.0])
    changed = [
        (moved(position @ turn.T, force @ turn.T, torque @ turn.T), (v @ turn.T, w @ turn.T)),
        (moved(position + rng.normal(size=3), force, torque), (v, w)),
        (moved(position[order], force[order], torque[order]), (v[order], w[order])),
        # Torques and spins are axial vectors.
        (moved(position @ mirror, force @ mirror, -torque @ mirror), (v @ mirror, -w @ mirror)),
    ]
    for got, wanted in changed:
        for a, b in zip(got, wanted, strict=True):
            assert np.abs(a - b).max() < 1e-12 * max(1.0, np.abs(b).max())


@pytest.mark.parametrize("equal", [True, False])
def test_planar_is_a_part_of_spatial(equal):
    rng = np.random.default_rng(3)
    planar = rng.normal(size=(7, 2)) * 2
    spatial = np.pad(planar, ((0, 0), (0, 1)))
    radius = jnp.asarray(0.9 if equal else rng.uniform(0.4, 1.5, 7))
    force, torque = rng.normal(size=(7, 2)), rng.normal(size=(7, 1))
    strain = jnp.array([[0.3, 0.7], [0.7, -0.3]])
    flat = motion(RPY(), planar, radius, Load(jnp.asarray(force), jnp.asarray(torque)))
    load = Load(jnp.pad(force, ((0, 0), (0, 1))), jnp.pad(torque, ((0, 0), (2, 0))))
    full = motion(RPY(), spatial, radius, load)
    assert np.abs(flat.velocity - full.velocity[:, :2]).max() < 1e-15
    assert np.abs(flat.spin - full.spin[:, 2:]).max() < 1e-15
    assert np.abs(full.velocity[:, 2]).max() == 0
    flat = carried_by(planar, radius, strain)
    full = carried_by(spatial, radius, jnp.pad(strain, ((0, 1), (0, 1))))
    assert np.abs(flat.velocity - full.velocity[:, :2]).max() < 1e-14
    assert np.abs(flat.spin - full.spin[:, 2:]).max() < 1e-14


def test_translation_only_is_a_part_of_the_whole():
    rng, position = cloud(5)
    force = jnp.asarray(rng.normal(size=(6, 3)))
    alone = motion(RPY(), position, 0.7, Load(force), rotational=False)
    whole = motion(RPY(), position, 0.7, Load(force))
    assert alone.spin is None
    assert np.abs(alone.velocity - whole.velocity).max() == 0


def test_strain_at_each_bead_equals_the_sum_over_sources():
    rng, position = cloud(2)
    strains = rng.normal(size=(6, 3, 3))
    strains = strains + strains.transpose(0, 2, 1)
    position = jnp.asarray(position)
    for radius in (jnp.asarray(0.7), jnp.asarray(rng.uniform(0.3, 1.5, 6))):
        whole = carried_by(position, radius, jnp.asarray(strains))
        parts = np.zeros((6, 3))
        for j in range(6):
            only = np.zeros_like(strains)
            only[j] = strains[j]
            part = carried_by(position, radius, jnp.asarray(only))
            parts += np.asarray(part.velocity)
        assert np.abs(parts - whole.velocity).max() < 1e-13
        same = jnp.broadcast_to(jnp.asarray(strains[0]), (6, 3, 3))
        one = carried_by(position, radius, jnp.asarray(strains[0]))
        each = carried_by(position, radius, same)
        assert np.abs(one.spin - each.spin).max() < 1e-14


@pytest.mark.parametrize("equal", [True, False])
@pytest.mark.parametrize("kind", ["apart", "touching", "overlapping", "coincident"])
def test_derivatives_are_finite_and_right(kind, equal):
    # Against central differences where the mobility is smooth; finite where it has a kink.
    gap = {"apart": 3.7, "touching": 2.0, "overlapping": 1.2, "coincident": 0.0}[kind]
    position = jnp.array([[0.0, 0.0, 0.0], [gap, 0.0, 0.0], [5.0, 4.0, 3.0]])
    radius = jnp.asarray(1.0) if equal else jnp.array([1.0, 1.0, 0.6])
    rng = np.random.default_rng(1)
    load = Load(jnp.asarray(rng.normal(size=(3, 3))), jnp.asarray(rng.normal(size=(3, 3))))
    strain = jnp.asarray(np.diag([1.0, -0.5, -0.5]))
    weight = jnp.asarray(rng.normal(size=(3, 6)))

    def value(position, radius):
        moved = motion(RPY(), position, radius, load)
        carried = carried_by(position, radius, strain)
        both = jnp.concatenate(
            [moved.velocity + carried.velocity, moved.spin + carried.spin], axis=1
        )
        return jnp.sum(weight * both)

    reverse = jax.grad(value, argnums=(0, 1))(position, radius)
    forward = jax.jacfwd(value, argnums=(0, 1))(position, radius)
    for a, b in zip(reverse, forward, strict=True):
        assert np.all(np.isfinite(a))
        assert np.abs(a - b).max() < 1e-14
    if kind != "coincident":
        h = 1e-6
        for index in np.ndindex(3, 3):
            bump = jnp.zeros((3, 3)).at[index].set(h)
            slope = (value(position + bump, radius) - value(position - bump, radius)) / (2 * h)
            assert abs(slope - reverse[0][index]) < 1e-8
