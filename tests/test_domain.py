"""A domain is asked for what separates two points and where its boundary is, whatever uses them."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import MOBILITIES, bent, name

import jaxbeads as jb
from jaxbeads import Chain, Configuration, Load, Scene, Setting, State, dynamics, tensors
from jaxbeads.constraint import Gears
from jaxbeads.domain import SYMMETRIES, AbstractDomain, Unbounded
from jaxbeads.force import Bending, Contact, Weight
from jaxbeads.geometry import smallest_gap
from jaxbeads.mobility import RPY, FreeDraining


class Channel(AbstractDomain):
    """Periodic along x, with a floor at y = 0."""

    symmetries: ClassVar[frozenset[str]] = frozenset()
    period: jax.Array = eqx.field(converter=jnp.asarray)

    def nearest(self, separation, unit):
        x, *others = separation
        period = self.period / unit
        return [x - period * jnp.round(x / period), *others]

    def clearance(self, position, radius):
        return position[:, 1] - radius


class Everywhere(RPY):
    """RPY between nearest images, which is wrong physics and a good test."""

    domains: ClassVar = (Unbounded, Channel)


CHAIN = Chain(1.0, (1, 1))
CHANNEL = Channel(20.0)
APART = State(jnp.array([[0.5, 3.0], [19.0, 3.2]]))  # 1.51 apart through the ends
CONTACT = Contact(2.0, 0.5, 0.3)


def test_contact_acts_through_the_ends():
    near = State(jnp.array([[0.5, 3.0], [-1.0, 3.2]]))
    expected = CONTACT.load(jnp.zeros(()), near, Setting(CHAIN, 1.0)).force
    assert np.abs(expected).max() > 0.1
    found = CONTACT.load(jnp.zeros(()), APART, Setting(CHAIN, 1.0, domain=CHANNEL)).force
    assert np.abs(found - expected).max() < 1e-14
    assert not np.any(CONTACT.load(jnp.zeros(()), APART, Setting(CHAIN, 1.0)).force)


def test_a_bead_that_passes_through_another_beyond_the_end_is_noticed():
    before, after = ([[18.0, 3.0], [0.0, 3.0]], [[22.0, 3.0], [0.0, 3.0]])
    states = [State(jnp.array(x)) for x in (before, after)]
    setting = Setting(CHAIN, 1.0, domain=CHANNEL)
    assert Contact(2.0, 0.5, 0.3).passed(*states, setting)
    assert not Contact(2.0, 0.5, 0.3).passed(*states, Setting(CHAIN, 1.0))


def test_gaps_are_those_of_nearest_images():
    x, radii = np.asarray(APART.position), np.ones(2)
    gap, *_ = smallest_gap(x, radii, CHANNEL)
    assert abs(gap - (np.hypot(1.5, 0.2) - 2)) < 1e-14
    scene = Scene(CHAIN, 1.0, FreeDraining(), domain=CHANNEL)
    with pytest.raises(ValueError, match=r"beads 0 and 1 overlap by 0\.487"):
        jb.check(scene, APART, overlap=False)


@pytest.mark.parametrize("mobility", [RPY(), Everywhere()], ids=["RPY", "Everywhere"])
def test_a_mobility_refuses_domains_that_it_does_not_serve(mobility):
    scene = Scene(CHAIN, 1.0, mobility, domain=CHANNEL)
    if isinstance(mobility, Everywhere):
        return jb.check(scene, APART)
    with pytest.raises(ValueError, match="for the mobility RPY, but its domain is Channel"):
        jb.check(scene, APART)


def test_a_start_beyond_the_boundary_is_refused():
    scene = Scene(CHAIN, 1.0, FreeDraining(), domain=CHANNEL)
    beyond = State(jnp.array([[0.5, 3.0], [9.0, -0.25]]))
    with pytest.raises(ValueError, match=r"centre of bead 1 lies 0\.25 outside"):
        jb.check(scene, beyond)
    jb.check(Scene(CHAIN, 1.0, FreeDraining()), beyond)


@pytest.mark.parametrize("radius", [1.0, [1.0, 0.6]], ids=["equal", "unequal"])
def test_pair_sums_see_nearest_images(radius):
    """The same product of the mobility, tables, strain and derivatives, wherever the image lies."""
    near = APART.position.at[1, 0].add(-20.0)
    one = Configuration(APART.position, radius, 1.0, True, CHANNEL)
    other = Configuration(near, radius, 1.0)
    load = Load(jnp.array([[1.0, 2.0], [0.3, -1.0]]), jnp.array([[0.2], [0.7]]))
    strain = jnp.array([[0.2, 0.4], [0.4, -0.2]])
    shifts = jnp.array([[[0.1, 0.2], [-0.3, 0.5]]])
    for function in (
        lambda c: tensors.rpy_motion(c, load),
        lambda c: tensors.rpy(c).motion(load),
        lambda c: tensors.shear_disturbance(c, strain),
        lambda c: tensors.rpy_gradient(c, load, lambda x: strain, shifts),
    ):
        for a, b in zip(*map(jax.tree.leaves, (function(one), function(other))), strict=True):
            assert np.abs(a - b).max() < 1e-13


def test_a_run_in_a_domain():
    # A fibre that crosses the end moves as one that does not.
    chain = Chain(1.0, 6)
    terms = {"constraints": [Gears()], "forces": [Bending(30.0), Weight([0.3, 0.1]), CONTACT]}
    inside = Scene(chain, 1.0, Everywhere(), **terms, domain=Channel(60.0))
    outside = Scene(chain, 1.0, RPY(), **terms)
    start = bent(chain, 2, centre=[57.0, 9.0])
    ts = np.linspace(0.0, 5.0, 3)
    ends = [jb.rollout(scene, start, ts).final.position for scene in (inside, outside)]
    assert np.abs(ends[0] - ends[1]).max() < 1e-9
    found = [dynamics.motion(0.0, start, scene).velocity for scene in (inside, outside)]
    assert np.abs(found[0] - found[1]).max() < 1e-13


@pytest.mark.parametrize("mobility", MOBILITIES, ids=name)
def test_what_a_mobility_declares(mobility):
    """Each symmetry that is declared holds; the contract tests of scenes rest on it."""
    rng = np.random.default_rng(0)
    x, load = rng.normal(size=(5, 3)) * 2, rng.normal(size=(2, 5, 3))
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.linalg.det(turn)
    maps = {
        "translation": (np.eye(3), np.array([3.0, -1.0, 0.5]), 1.0),
        "rotation": (turn, np.zeros(3), 1.0),
        "reflection": (np.diag([-1.0, 1.0, 1.0]), np.zeros(3), -1.0),
    }
    assert set(maps) == SYMMETRIES and mobility.symmetries <= SYMMETRIES

    def moved(x, load):
        return mobility.motion(Configuration(x, 1.0, 1.3), Load(*map(jnp.asarray, load)))

    plain = moved(x, load)
    for symmetry in mobility.symmetries:
        q, shift, sign = maps[symmetry]
        found = moved(x @ q.T + shift, (load[0] @ q.T, sign * load[1] @ q.T))
        assert np.abs(found.velocity - plain.velocity @ q.T).max() < 1e-13
        assert np.abs(found.spin - sign * plain.spin @ q.T).max() < 1e-13
