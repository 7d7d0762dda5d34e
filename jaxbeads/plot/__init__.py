"""Pictures: shapes over time, an observable, a kymograph of curvature, the flow, a movie.

Each function takes a solution (or a flow) and returns a `matplotlib` figure, or writes a file. Spatial
scenes are drawn in space, as lit spheres; `View` has the direction, or names a plane instead. Lengths
are in units of the first fibre's length unless said. Imported on demand only (`import jaxbeads.plot`).
"""

from .animation import can_encode as can_encode
from .animation import movie as movie
from .animation import movies as movies
from .base import View as View
from .centrelines import shapes as shapes
from .charts import kymograph as kymograph
from .charts import observable as observable
from .page import html as html
from .streamlines import flow as flow
