"""jaxbeads: differentiable bead models of flexible fibres and micro-swimmers in Stokes flow.

Pure functions of equinox Modules that only hold parameters: build a `Scene`, give it a `State`, and
`rollout` (pure) or `simulate` (with progress, files and checks). Method: Delmotte, Climent &
Plouraboué, J. Comput. Phys. 286 (2015) 14-37. Equations are numbered as there; dimensions stand in
brackets. Examples take 64-bit numbers, `jax.config.update("jax_enable_x64", True)`.
"""

from importlib import metadata as _metadata

from . import actuation as actuation
from . import body as body
from . import constraint as constraint
from . import dimensionless as dimensionless
from . import dynamics as dynamics
from . import flow as flow
from . import force as force
from . import geometry as geometry
from . import locomotion as locomotion
from . import magnetism as magnetism
from . import material as material
from . import mobility as mobility
from . import neighbours as neighbours
from . import objectives as objectives
from . import observables as observables
from . import pairs as pairs
from . import quaternions as quaternions
from . import scenes as scenes
from . import solver as solver
from . import stress as stress
from . import tensors as tensors
from .assembly import Assembly as Assembly
from .assembly import Pose as Pose
from .body import Body as Body
from .breakdown import SimulationError as SimulationError
from .cache import enable_cache as enable_cache
from .chain import Chain as Chain
from .chain import from_directors as from_directors
from .chain import from_tangents as from_tangents
from .chain import straight as straight
from .configuration import Configuration as Configuration
from .domain import FreeSurface as FreeSurface
from .domain import NoSlipWall as NoSlipWall
from .domain import Unbounded as Unbounded
from .files import load as load
from .fluid import AverageFlowField as AverageFlowField
from .fluid import FlowField as FlowField
from .fluid import average_flow_field as average_flow_field
from .fluid import flow_field as flow_field
from .material import with_frames as with_frames
from .optimise import optimise as optimise
from .optimum import Optimum as Optimum
from .outcome import Outcome as Outcome
from .paraview import flow_to_paraview as flow_to_paraview
from .paraview import to_paraview as to_paraview
from .periodic import PeriodicState as PeriodicState
from .periodic import periodic_state as periodic_state
from .rollout import rollout as rollout
from .scene import Scene as Scene
from .scene import check as check
from .setting import Setting as Setting
from .simulate import resume as resume
from .simulate import simulate as simulate
from .solution import Solution as Solution
from .solver import AB3 as AB3
from .solver import ESDIRK as ESDIRK
from .solver import Diffrax as Diffrax
from .solver import Rosenbrock as Rosenbrock
from .state import Load as Load
from .state import Motion as Motion
from .state import State as State
from .steady import SteadyState as SteadyState
from .steady import steady_state as steady_state
from .sweep import sweep as sweep
from .tables import to_csv as to_csv
from .travel import Journey as Journey
from .travel import travel as travel
from .vary import vary as vary

try:
    __version__ = _metadata.version("jaxbeads")
except _metadata.PackageNotFoundError:  # a checkout that is not installed
    __version__ = "0+unknown"
