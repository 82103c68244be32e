"""The model and the picture in plain float64 NumPy, slow and simple: the reference of the kernels.

Not an independent check of the model; it is itself tested against closed forms and against SciPy's integrators.
"""

from tests.reference.drawing import draw as draw
from tests.reference.drawing import refine as refine
from tests.reference.dynamics import displacements as displacements
from tests.reference.dynamics import elastic_force as elastic_force
from tests.reference.dynamics import energy as energy
from tests.reference.dynamics import force as force
from tests.reference.dynamics import foundation_force as foundation_force
from tests.reference.dynamics import longest_spring as longest_spring
from tests.reference.dynamics import shortest_spring as shortest_spring
from tests.reference.dynamics import simulate as simulate
from tests.reference.dynamics import steps as steps
from tests.reference.dynamics import surgical_force as surgical_force
from tests.reference.dynamics import tangent as tangent
from tests.reference.rest import clearance as clearance
from tests.reference.rest import equilibrium as equilibrium
from tests.reference.rest import equilibrium_outside_tool as equilibrium_outside_tool
from tests.reference.rest import potential as potential
from tests.reference.rest import residual as residual
from tests.reference.rest import stiffness as stiffness
from tests.reference.sheet import sheet as sheet
