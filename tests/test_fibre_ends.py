"""Fibres end where they end, lie apart, and are held together by something; otherwise it is said."""

import re
import warnings
from typing import ClassVar

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

from jaxbeads import (
    Chain,
    Scene,
    Setting,
    State,
    check,
    dynamics,
    from_directors,
    from_tangents,
    rollout,
    simulate,
    steady_state,
    straight,
)
from jaxbeads.actuation import TravellingWave
from jaxbeads.coincidence import coincidence
from jaxbeads.constraint import (
    Gears,
    Inextensible,
    Joint,
    PrescribedDirection,
    PrescribedLengths,
    PrescribedPosition,
    PrescribedSpin,
    clamped,
)
from jaxbeads.flow import LinearFlow
from jaxbeads.force import (
    AbstractPotential,
    Bending,
    BendingEnergy,
    DrivingMoment,
    ForceField,
    JointBending,
    Potential,
    Spring,
    Weight,
)
from jaxbeads.geometry import bond_lengths
from jaxbeads.mobility import RPY, FreeDraining
from jaxbeads.observables import holding_load

TWO = Chain(1.0, (5, 5))
APART = straight(TWO, [1.0, 0.0], [[0.0, 0.0], [0.0, 9.0]])
TIMES = np.linspace(0.0, 0.1, 3)


@pytest.fixture(autouse=True)
def as_for_users(monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


def model(chain, *constraints, forces=(), **options):
    forces = [Weight([0.0, -1.0]), *forces]
    return Scene(chain, 1.0, constraints=[Gears(), *constraints], forces=forces, **options)


def sentence(call, says):
    with pytest.raises(ValueError, match=re.escape(says)) as caught:
        call()
    text = str(caught.value)
    assert re.fullmatch(r"Argument `[\w.-]+` must [^\n]+, but [^\n]+[^.\s]\.", text), text
    assert not re.search(r"[.!?] [A-Z]", text), text


# Bonds

BONDS = "`PrescribedDirection.bond` must be a bond within a fibre, "
NO_BOND = {
    "clamped end of the first": (
        TWO,
        clamped(4),
        BONDS + "0 to 3 or 5 to 8, but bond 4 leads from",
    ),
    "clamped start of the second": (TWO, clamped(-5), BONDS + "0 to 3 or 5 to 8, but bond -5"),
    "direction": (
        TWO,
        [PrescribedDirection(lambda t: [jnp.cos(t), jnp.sin(t)], bond=4)],
        "but bond 4 leads from fibre 0 (bead 4) to 1 (bead 5)",
    ),
    "last fibre of one bead": (
        Chain(1.0, (5, 1)),
        clamped(-1),
        BONDS + "0 to 3, but bond -1 leads from fibre 0 (bead 4) to 1 (bead 5)",
    ),
    "first fibre of one bead": (Chain(1.0, (1, 3)), clamped(), BONDS + "1 to 2, but bond 0 leads"),
    "spinless": (Chain(1.0, (1, 3)), clamped(spinless=True), BONDS + "1 to 2, but bond 0 leads"),
    "in turn": (Chain(1.0, (1, 2, 1, 2)), clamped(2), BONDS + "1 or 4, but bond 2 leads"),
    "one bead": (Chain(1.0, 1), clamped(), "it is 0 and none of its fibres has two beads"),
    "single beads": (Chain(1.0, (1, 1)), clamped(-1), "it is -1 and none of its fibres has two"),
    "beyond": (TWO, [PrescribedDirection(bond=9)], "must lie between -9 and 8, but it is 9"),
}


def side_by_side(chain):
    count = len(chain.fibres)
    return straight(chain, [1.0, 0.0], 9.0 * np.arange(count)[:, None] * np.array([0.0, 1.0]))


@pytest.mark.parametrize("chain, ends, says", NO_BOND.values(), ids=NO_BOND)
def test_a_bond_between_fibres_is_none(chain, ends, says):
    scene, state = model(chain, *ends), side_by_side(chain)
    for go in (
        lambda: simulate(scene, state, TIMES, progress=False),
        lambda: rollout(scene, state, TIMES),
        lambda: steady_state(scene, state),
    ):
        sentence(go, says)


@pytest.mark.parametrize("end", [0, -1, 2, 5, -6], ids=str)
def test_clamped_beads_keep_the_directions_of_their_own_bonds(end):
    bead = end % 10
    bond = (bead, bead + 1) if end >= 0 else (bead - 1, bead)
    assert TWO.fibre_of_bead[bond[0]] == TWO.fibre_of_bead[bond[1]]
    moved = dynamics.motion(0.0, APART, model(TWO, *clamped(end)))
    assert np.abs(moved.velocity[np.array(bond)]).max() < 1e-12
    assert np.abs(moved.spin[bead]).max() < 1e-12
    assert np.abs(moved.velocity).max() > 1e-2


@pytest.mark.parametrize("kind", [Bending, DrivingMoment, BendingEnergy])
def test_what_is_given_between_fibres_has_no_effect(kind):
    chain = Chain(1.0, (4, 3))
    e = [[1.0, 0.1], [1.0, 0.4], [1.0, 0.0], [0.0, 1.0], [0.3, 1.0], [0.5, 1.0]]
    state = State(from_tangents(chain, e, [[0.0, 0.0], [20.0, 0.0]]))
    numbers = np.array([0.1, 0.2, 1e6, -1e6, 0.3])
    wave = TravellingWave(numbers, 0.3, 0.2)

    def loads(values):
        made = kind(values) if kind is DrivingMoment else kind(3.0, values)
        return jax.tree.leaves(made.load(jnp.zeros(()), state, Setting(chain, 1.0)))

    for given in (numbers, wave):
        inner = numbers[~chain.joint_mask]
        assert len(inner) == 2
        masked = np.where(chain.joint_mask, numbers, 0.0)
        other = masked if given is numbers else TravellingWave(masked, 0.3, 0.2)
        for a, b in zip(loads(given), loads(other), strict=True):
            assert np.abs(a).max() > 0 and np.array_equal(a, b)


# Places


def fibres(directions, centres):
    return straight(TWO, directions, centres)


def folded(at):
    chain = Chain(1.0, 6)
    e = np.ones((5, 1)) * [0.6, 0.8]
    e[at:] *= -1
    return chain, State(from_tangents(chain, e, [30.0, -7.0]))


HOW = "must hold no bond in the place of another, but "
ALIKE = {
    "by default": (TWO, fibres([1.0, 0.0], None), "fibres 0 and 1 coincide: beads 0 and 5 are in"),
    "along -x": (TWO, fibres([-1.0, 0.0], None), "fibres 0 and 1 coincide: beads 0 and 5 are in"),
    "mirrored": (
        TWO,
        fibres([[0.6, 0.8], [-0.6, -0.8]], [[1e3, 3.0]] * 2),
        "fibres 0 and 1 coincide: beads",
    ),
    "in part": (
        TWO,
        fibres([1.0, 0.0], [[0.0, 0.0], [6.0, 0.0]]),
        "fibres 0 and 1 lie on one another in part: beads 3 and 5 are in one place",
    ),
    "in part, mirrored": (
        TWO,
        fibres([[1.0, 0.0], [-1.0, 0.0]], [[0.0, 0.0], [6.0, 0.0]]),
        "fibres 0 and 1 lie on one another in part: beads",
    ),
    "in space": (TWO, fibres([0.0, 0.6, 0.8], None), "fibres 0 and 1 coincide: beads 0 and 5"),
    "two of three": (
        Chain(1.0, (2, 3, 3)),
        straight(Chain(1.0, (2, 3, 3)), [1.0, 0.0], [[0.0, 9.0], [0.0, 0.0], [0.0, 0.0]]),
        "fibres 1 and 2 coincide: beads 2 and 5 are in one place",
    ),
    "short on long": (
        Chain(1.0, (5, 3)),
        straight(Chain(1.0, (5, 3)), [1.0, 0.0]),
        "fibres 0 and 1 lie on one another in part: beads 1 and 5 are in one place",
    ),
    "folded": (*folded(2), "fibre 0 is folded back onto itself: beads 1 and 3 are in one place"),
    "folded at its end": (*folded(4), "fibre 0 is folded back onto itself: beads 3 and 5 are in"),
}


@pytest.mark.parametrize("scale", [1.0, 1e-6])
@pytest.mark.parametrize("chain, state, says", ALIKE.values(), ids=ALIKE)
def test_fibres_in_one_place_are_named(chain, state, says, scale):
    chain, state = jax.tree.map(lambda x: scale * x, (chain, state))
    for constraint in (Gears(), Inextensible()):
        scene = Scene(chain, 1.0, constraints=[constraint])
        for go in (simulate, rollout):
            sentence(lambda go=go, scene=scene: go(scene, state, TIMES), HOW + says)
        sentence(lambda scene=scene: steady_state(scene, state), HOW + says)
    check(Scene(chain, 1.0, FreeDraining(), [Gears()]), state)  # there they are independent


def test_fibres_in_one_place_in_single_precision():
    chain, state = jax.tree.map(lambda x: x.astype(jnp.float32), (TWO, fibres([1.0, 1.0], None)))
    scene = jax.tree.map(lambda x: x.astype(jnp.float32), Scene(chain, 1.0, constraints=[Gears()]))
    sentence(
        lambda: check(scene, state, single_precision=True),
        "fibres 0 and 1 coincide: beads 0 and 5 are in one place",
    )


def test_chains_of_joints_in_one_place_are_named():
    directors = jnp.tile(jnp.array([[1.0, 0.0]]), (10, 1))
    state = from_directors(TWO, directors)
    scene = Scene(TWO, 1.0, constraints=[Joint()], forces=[JointBending(1.0)])
    sentence(lambda: rollout(scene, state, TIMES), "fibres 0 and 1 coincide: beads 0 and 5")


def test_beads_that_meet_or_differ_in_size_are_allowed():
    crossed = fibres([[1.0, 0.0], [0.0, 1.0]], None)
    how = "fibres 0 and 1 cross in the centre of a bead: beads 2 and 7 are in one place"
    assert str(coincidence(crossed, TWO)).startswith(how)
    unequal = Chain([1.0, 1.0, 1.1, 1.1], (2, 2))
    for chain, state in ((TWO, crossed), (unequal, straight(unequal, [1.0, 0.0]))):
        scene = model(chain)
        check(scene, state)
        assert np.all(np.isfinite(dynamics.motion(0.0, state, scene).velocity))


def test_single_beads_in_one_place_cannot_be_held_apart():
    chain = Chain(1.0, (1, 1))
    state = straight(chain, [1.0, 0.0])
    free = Scene(chain, 1.0, forces=[Weight([0.0, -1.0])])
    assert np.all(np.isfinite(rollout(free, state, TIMES).final.position))
    held = [PrescribedPosition(bead=0), PrescribedPosition(bead=1)]
    says = "fibres 0 and 1 coincide: beads 0 and 1 are in one place"
    for mobility in (RPY(), RPY(dense=False)):
        how = dynamics.redundancy(0.0, state, Scene(chain, 1.0, mobility, held))
        assert str(how).startswith(says)
    sentence(
        lambda: simulate(Scene(chain, 1.0, constraints=held), state, TIMES, progress=False), says
    )
    # Without interactions each is held by itself; what is demanded twice is still called that.
    apart = Scene(chain, 1.0, FreeDraining(), held)
    assert dynamics.redundancy(0.0, state, apart) is None
    twice = Scene(chain, 1.0, constraints=[PrescribedSpin(), PrescribedSpin()])
    how = str(dynamics.redundancy(0.0, state, twice))
    assert how.startswith("PrescribedSpin(bead=0) + PrescribedSpin(bead=0) are redundant")


def test_checks_look_at_known_numbers_within_jit():
    # What is computed from them there is traced.
    flow = LinearFlow(np.diag([0.1, 0.2, -0.3]))
    state = straight(TWO, [1.0, 0.0, 0.0], [[0.0, 0.0, 0.0], [0.0, 9.0, 0.0]])
    scene = Scene(TWO, 1.0, constraints=[Gears()], flow=flow)
    jax.eval_shape(lambda: (check(scene, state, overlap=False), 0)[1])
    both = straight(TWO, [1.0, 0.0, 0.0])
    sentence(lambda: jax.eval_shape(lambda: check(scene, both)), "fibres 0 and 1 coincide")


# What holds neighbours together


class Tether(AbstractPotential):
    """A user's springs."""

    rotational: ClassVar[bool] = False
    links: ClassVar[bool] = True

    def energy(self, t, state, scene):
        return jnp.sum((bond_lengths(state.position) - 2.0) ** 2)


CHAIN = Chain(1.0, 4)
LINE = straight(CHAIN, [1.0, 0.0])
LOOSE = "Bending bends fibres whose beads nothing holds together: add a chain constraint"


@pytest.mark.parametrize("go", [simulate, rollout, check])
@pytest.mark.parametrize(
    "force", [Bending(1.0), BendingEnergy([1.0, 0.0])], ids=["torques", "energy"]
)
def test_loose_beads_are_warned_of_once(go, force):
    scene = Scene(CHAIN, 1.0, forces=[force, BendingEnergy(2.0)])
    options = {} if go is check else {"ts": TIMES, "substeps": 1}
    with pytest.warns(
        UserWarning, match="nothing holds together: add a chain constraint"
    ) as caught:
        go(scene, LINE, **options)
    assert len(caught) == 1 and str(caught[0].message).startswith(type(force).__name__ + " bends")


def test_steady_states_of_loose_beads_are_warned_of():
    scene = Scene(CHAIN, 1.0, forces=[BendingEnergy(1.0), ForceField(lambda t, r: -r)])
    with pytest.warns(UserWarning, match=LOOSE.replace("Bending", "BendingEnergy", 1)):
        check(scene, LINE)


HELD = {
    "gears": {"constraints": [Gears()]},
    "lengths": {"constraints": [PrescribedLengths(lambda t: [2, 2, 2])]},
    "springs": {"forces": [Bending(1.0), Spring(1.0)]},
    "user's class": {"forces": [Bending(1.0), Tether()]},
    "user's energy": {"forces": [Bending(1.0), Potential(lambda t, r: 0.0, links=True)]},
    "user's force": {"forces": [Bending(1.0), ForceField(lambda t, r: 0 * r, links=True)]},
    "no rigidity": {"forces": [Bending(0.0), BendingEnergy([0.0, 0.0])]},
    "no joint": {"chain": Chain(1.0, (2, 1, 1))},
}


@pytest.mark.parametrize("terms", HELD.values(), ids=HELD)
def test_beads_that_are_held_are_not(terms):
    terms = {"chain": CHAIN, "forces": [Bending(1.0)]} | terms
    scene = Scene(viscosity=1.0, **terms)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check(scene, side_by_side(scene.chain))


THREE = Chain(1.0, (4, 3, 5))
ROW = straight(THREE, [0.3, 1.0], [[0.0, 0.0], [9.0, 1.0], [18.0, 0.0]])


def in_space(state):
    return State(jnp.pad(state.position, ((0, 0), (0, 1))))


@pytest.mark.parametrize("dim, last", [(2, False), (3, True)], ids=["first", "last"])
def test_several_ends_are_held_as_one_by_one(dim, last):
    ends = THREE.last_beads if last else THREE.first_beads
    assert ends == ((-9, -6, -1) if last else (0, 4, 7))
    state = ROW if dim == 2 else in_space(ROW)
    forces = [Weight([1.0, 0.2, 0.4][:dim]), Bending(30.0)]
    found, loads = [], []
    for held in (clamped(ends), [c for k in ends for c in clamped(k)]):
        scene = Scene(THREE, 1.0, constraints=[Gears(), *held], forces=forces)
        check(scene, state)
        assert dynamics.redundancy(0.0, state, scene) is None
        found.append(dynamics.motion(0.0, state, scene))
        loads.append([jax.tree.leaves(holding_load(0.0, state, scene, k)) for k in ends])
    assert len(scene.constraints) == 10
    for one, other in zip(*map(jax.tree.leaves, found), strict=True):
        assert np.abs(one - other).max() < 1e-13
    assert np.abs(found[0].velocity[np.array(ends)]).max() < 1e-13
    for one, other in zip(*map(jax.tree.leaves, loads), strict=True):
        assert np.abs(one - other).max() < 1e-11


def test_several_ends_follow_laws_of_their_own():
    # Rows of cilia: each base swings about its bond's direction, at its own phase.
    def directions(t):
        angle = 0.3 * jnp.sin(t + jnp.arange(3.0)) - 0.3 * jnp.sin(jnp.arange(3.0))
        e = jnp.asarray([0.3, 1.0]) / jnp.sqrt(1.09)
        c, s = jnp.cos(angle), jnp.sin(angle)
        return jnp.stack([c * e[0] - s * e[1], s * e[0] + c * e[1]], axis=1)

    base = THREE.first_beads
    held = PrescribedPosition(bead=base), PrescribedSpin(bead=base)
    driven = PrescribedDirection(directions, base)
    terms = {"constraints": [Gears(), *held, driven], "forces": [Bending(100.0)]}
    run = rollout(Scene(THREE, 1.0, **terms), ROW, np.linspace(0.0, 1.0, 3))
    assert run.code == 0
    position = np.asarray(run.final.position)
    first = np.array(base)
    assert np.abs(position[first] - ROW.position[first]).max() < 1e-5
    e = (position[first + 1] - position[first]) / 2
    assert np.abs(e - directions(1.0)).max() < 1e-5


@pytest.mark.parametrize(
    "build, says",
    [
        (lambda: PrescribedPosition(bead=()), "`bead` must name at least one, but it is empty"),
        (lambda: PrescribedSpin(bead=(0, 0.5)), "`bead` must be a whole number, but it is 0.5"),
        (
            lambda: check(Scene(THREE, 1.0, constraints=[Gears(), *clamped((0, 3))]), ROW),
            "`PrescribedDirection.bond` must be a bond within a fibre, .* but bond 3 leads",
        ),
        (
            lambda: check(
                Scene(
                    THREE,
                    1.0,
                    constraints=[PrescribedPosition(lambda t: jnp.zeros(2), (0, 4))],
                ),
                ROW,
            ),
            r"`PrescribedPosition.law` must have shape \(2, 2\), but it has shape \(2,\)",
        ),
    ],
)
def test_several_ends_that_cannot_be_held(build, says):
    with pytest.raises(ValueError, match=says):
        build()
