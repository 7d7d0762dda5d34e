"""Scenes in which everything acts at once, for what must hold in all of them."""

import jax.numpy as jnp
import numpy as np
from cases import bent, jointed, scene

import jaxbeads as jb
from jaxbeads import Chain, NoSlipWall, Scene, State
from jaxbeads.actuation import PlanarBeat, TravellingWave
from jaxbeads.constraint import (
    Gears,
    Inextensible,
    Joint,
    PrescribedDirection,
    PrescribedPosition,
    PrescribedSpin,
    clamped,
)
from jaxbeads.flow import OscillatingShear, Poiseuille, Shear, VelocityField
from jaxbeads.force import (
    Bending,
    BendingEnergy,
    Contact,
    JointBending,
    JointRepulsion,
    Spring,
    Weight,
)
from jaxbeads.mobility import FreeDraining


def swimmers():
    """Two fibres of unequal beads that nearly touch, driven by a wave, in an unsteady flow."""
    chain = Chain(np.linspace(0.8, 1.1, 7), (4, 3))
    wave = TravellingWave(0.2, 0.4, 1.5, 0.3)
    forces = [Weight([0.1, -0.4]), Bending(3.0, wave), Contact(5.0, 2.5, 1.0)]
    flow = OscillatingShear(0.7, 2.0, 0.3)
    model = Scene(chain, 1.3, constraints=[Gears()], forces=forces, flow=flow)
    return model, bent(chain, centre=[[0.0, 0.0], [0.0, 2.3]])


def joints():
    """The Joint Model in space, its repulsion at work, in a shear."""
    chain = Chain(1.0, 4, 0.1)
    elastic = JointBending(3.0, 0.02, repulsion=JointRepulsion(0.5, 0.5, 2.0, 0.5))
    forces = [Weight([0.1, -0.4, 0.2]), elastic]
    model = Scene(chain, 1.3, constraints=[Joint()], forces=forces, flow=Shear(0.3))
    return model, jointed(chain, 3)


def held():
    """A fibre whose base is held, its direction prescribed in time, in a curved flow."""
    chain = Chain(1.0, 5)
    base = PrescribedDirection(PlanarBeat(0.4, 1.3))
    constraints = [Gears(), PrescribedPosition(), PrescribedSpin(), base]
    flow = Poiseuille(1.3, 8.0)
    return Scene(chain, 1.0, constraints=constraints, forces=[Bending(4.0)], flow=flow), bent(chain)


def spun():
    """Gears in space that carry directors along, held at the last bead."""
    chain = Chain(1.0, 4)
    model = scene(chain, 3, constraints=[Gears(), *clamped(-1)])
    return model, State(bent(chain, 3).position, jnp.eye(3)[jnp.array([2, 2, 1, 0])])


def springs():
    """Beads without a constraint in a flow that varies in time and space."""
    chain = Chain(1.0, 4)
    flow = VelocityField(lambda t, x: jnp.sin(0.1 * x[::-1] + t))
    model = Scene(chain, 1.0, forces=[Spring(20.0), BendingEnergy(3.0)], flow=flow)
    return model, State(1.1 * bent(chain).position)


def draining():
    """Distances alone, in space, without hydrodynamic interactions."""
    chain = Chain(1.0, 5)
    forces = [BendingEnergy(3.0, 0.1), Weight([0.1, -0.4, 0.3])]
    free = FreeDraining()
    return Scene(chain, 1.0, constraints=[Inextensible()], forces=forces, mobility=free), bent(
        chain, 3
    )


def walled():
    """Above a tilted wall, in shear along it, near enough to touch."""
    chain = Chain([1.0, 0.8, 1.2, 1.0], 4)
    wall = NoSlipWall([0.0, 0.0], [-0.3, 1.0])
    forces = [Bending(20.0), Weight([0.1, -0.4]), Contact(5.0, 2.5, 1.0)]
    flow = jb.flow.LinearFlow(0.3 * np.outer([1.0, 0.3], [-0.3, 1.0]))
    options = {"constraints": [Gears()], "forces": forces, "flow": flow, "domain": wall}
    return Scene(chain, 1.2, **options), bent(chain, 2, centre=[0.0, 3.0])


EXAMPLES = [swimmers, joints, held, spun, springs, draining, walled]
