"""Terms without a finite value or derivative are named at once, with the bead and a remedy."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import bent

from jaxbeads import (
    Chain,
    Rosenbrock,
    Scene,
    SimulationError,
    State,
    periodic_state,
    rollout,
    simulate,
    steady_state,
    straight,
)
from jaxbeads.constraint import Gears, PrescribedPosition
from jaxbeads.faults import not_finite, not_smooth
from jaxbeads.flow import VelocityField
from jaxbeads.force import Bending, ForceField, Potential, Weight
from jaxbeads.geometry import norm
from jaxbeads.mobility import FreeDraining
from jaxbeads.solver import Diffrax
from jaxbeads.state import Motion

CHAIN = Chain(1.0, 5)
MIDDLE = straight(CHAIN, [1.0, 0.0])  # bead 2 is at the origin


def inward(t, r):
    return -r * jnp.linalg.norm(r, axis=-1, keepdims=True)


def smooth(t, r):
    return -r * norm(r)[:, None]


def shallow(t, r):
    return jnp.sum(jnp.sum(r * r, axis=-1) ** 1.25)


def speed(t, x):
    return jnp.sqrt(x[0] * x[0] + x[1] * x[1]) * x


def late(t, arclength, length):
    return 0.1 * jnp.sqrt(t) * jnp.sin(arclength)


def start_of_law(t):
    return jnp.stack([t**1.5, 0.0 * t])


class Kinked(FreeDraining):
    """A mobility whose derivative is not finite where a bead is at the origin."""

    def motion(self, configuration, load):
        moved = super().motion(configuration, load)
        extra = 1 + 0 * jnp.linalg.norm(configuration.position, axis=1, keepdims=True)
        return Motion(moved.velocity * extra, moved.spin)


def scene(*forces, constraints=(), **options):
    options.setdefault("mobility", FreeDraining())
    held = [Gears(), *constraints]
    return Scene(CHAIN, 1.0, constraints=held, forces=[Bending(4.0), *forces], **options)


CASES = {
    "ForceField": (
        scene(ForceField(inward)),
        "ForceField",
        "its load by the positions is not finite at bead 2",
        2,
    ),
    "Potential": (
        scene(Potential(shallow)),
        "Potential",
        "its load by the positions is not finite at bead 2",
        2,
    ),
    "VelocityField": (
        scene(flow=VelocityField(lambda t, x: speed(t, x) * jnp.linalg.norm(x))),
        "VelocityField",
        "",
        2,
    ),
    "curvature": (
        Scene(CHAIN, 1.0, constraints=[Gears()], forces=[Bending(4.0, late)]),
        "Bending",
        "its load by the time is not finite at bead 0",
        0,
    ),
    "law": (
        scene(constraints=[PrescribedPosition(start_of_law)]),
        "PrescribedPosition(bead=0)",
        "what it prescribes by the time is not finite",
        None,
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_what_has_no_derivative_is_named_at_once(name):
    model, term, how, bead = CASES[name]
    with pytest.raises(SimulationError) as caught:
        simulate(model, MIDDLE, [0.0, 1.0], progress=False, solver=Rosenbrock())
    cause, said = caught.value.cause, str(caught.value)
    assert int(caught.value.solution.steps) <= 1 and cause.step <= 1
    assert cause.term == term and cause.bead == bead and how in said
    if name != "VelocityField":
        assert f"Term: {term}, the derivative of" in said
        assert "`jaxbeads.geometry.norm`" in said and "Tsit5" in said
        assert "tolerance" not in said
        # An explicit solver needs none.
        run = rollout(model, MIDDLE, [0.0, 0.01], solver=diffrax.Tsit5())
        assert int(run.code) == 0


def test_steps_that_are_equal():
    model, term, how, bead = CASES["ForceField"]
    with pytest.raises(SimulationError) as caught:
        simulate(model, MIDDLE, [0.0, 1.0], progress=False, solver=Rosenbrock(substeps=4))
    assert caught.value.cause.term == term and how in str(caught.value)
    assert caught.value.cause.bead == bead and "substeps" not in str(caught.value)


def test_the_remedy_helps():
    run = rollout(scene(ForceField(smooth)), MIDDLE, [0.0, 1.0], solver=Rosenbrock())
    assert int(run.code) == 0
    assert not_smooth(0.0, MIDDLE, scene(ForceField(smooth))) is None
    moved = State(MIDDLE.position + 0.1)
    assert not_smooth(0.0, moved, CASES["ForceField"][0]) is None


def test_what_else_may_fail():
    beads = straight(CHAIN, [1.0, 0.0])

    def fault(model, state=beads):
        return not_finite(0.0, state, model)

    assert fault(scene(ForceField(lambda t, r: r / norm(r)[:, None]))).bead == 2
    assert "its velocity" in fault(scene(flow=VelocityField(lambda t, x: x / norm(x)))).how
    assert "gradient" in fault(scene(flow=VelocityField(speed_of_root))).how
    law = PrescribedPosition(lambda t: jnp.stack([jnp.sqrt(t), 0 * t]))
    assert "what it prescribes" in fault(scene(constraints=[law])).how
    assert fault(scene(Weight([0.0, -1.0]), flow=VelocityField(lambda t, x: x))) is None
    found = not_smooth(0.0, beads, scene(Weight([0.0, -1.0]), mobility=Kinked()))
    assert found.term == "Kinked" and found.bead == 2
    assert not_smooth(0.0, bent(CHAIN), scene(Weight([0.0, -1.0]))) is None


def speed_of_root(t, x):
    return jnp.sqrt(x * x)


def test_searches_name_the_term():
    model, term, how, _ = CASES["ForceField"]
    with pytest.raises(RuntimeError, match=f"No steady state .* {term}, .*{how}.*norm"):
        steady_state(model, MIDDLE, moving=False)
    options = {"moving": False, "turning": False, "solver": Rosenbrock(substeps=4)}
    with pytest.raises(RuntimeError, match=f"No periodic state .* {term}, .*{how}.*norm"):
        periodic_state(model, MIDDLE, 1.0, **options)
    options["solver"] = Diffrax(diffrax.Heun(), substeps=4)
    broken = scene(ForceField(lambda t, r: jnp.where(t > 0.6, jnp.nan, -r)))
    with pytest.raises(RuntimeError, match=r"No periodic state .* ForceField, its load is not"):
        periodic_state(broken, MIDDLE, 1.0, **options)


def test_a_start_that_is_too_far_is_no_fault():
    with pytest.raises(RuntimeError, match="No steady state was found in 1 steps"):
        steady_state(scene(ForceField(smooth)), bent(CHAIN), moving=False, max_steps=1)
    assert np.all(np.isfinite(MIDDLE.position))
