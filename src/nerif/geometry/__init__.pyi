"""The names that are here, and their homes."""

from .camera import Camera as Camera
from .camera import Plane as Plane
from .grid import Box as Box
from .grid import Grid as Grid
from .interfaces import Interface as Interface
from .lens import Lens as Lens
from .lens import LensDiscs as LensDiscs
from .lens import spread_points as spread_points
from .projection import PERSPECTIVE as PERSPECTIVE
from .projection import PROJECTIONS as PROJECTIONS
from .projection import TELECENTRIC as TELECENTRIC
from .projection import Projection as Projection
from .projection import projection_named as projection_named
from .rays import BackgroundPoints as BackgroundPoints
from .rays import Rays as Rays
from .rig import Ring as Ring
from .rig import paper_rig as paper_rig
