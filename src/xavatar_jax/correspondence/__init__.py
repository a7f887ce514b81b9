"""Correspondence search: from posed points to canonical ones, with implicit gradients."""

from .batched import polish as polish
from .batched import search_field as search_field
from .batched import search_grid as search_grid
from .broyden import Broyden as Broyden
from .broyden import BroydenState as BroydenState
from .implicit import implicit_root as implicit_root
from .lanes import Solved as Solved
from .lanes import solve_lanes as solve_lanes
from .nearby import RowFinder as RowFinder
from .newton import ClosedFormNewton as ClosedFormNewton
from .plain import Correspondences as Correspondences
from .plain import find_correspondences as find_correspondences
from .plain import pull_back as pull_back
from .roots import Outcome as Outcome
from .roots import Roots as Roots
from .starts import PAIR_ROWS as PAIR_ROWS
from .starts import Group as Group
from .starts import StartSet as StartSet
from .starts import StartTable as StartTable
from .starts import check_bones as check_bones
from .starts import part_groups as part_groups
from .starts import start_table as start_table
