"""Rotations, forward kinematics and linear blend skinning on a tree of joints."""

from .inverse import determinant_3x3 as determinant_3x3
from .inverse import inverse_3x3 as inverse_3x3
from .inverse import inverse_rigid as inverse_rigid
from .inverse import solve_3x3 as solve_3x3
from .rotations import TO_Y_UP as TO_Y_UP
from .rotations import axis_angle_to_matrix as axis_angle_to_matrix
from .rotations import matrix_to_axis_angle as matrix_to_axis_angle
from .skinning import blend_transforms as blend_transforms
from .skinning import forward_kinematics as forward_kinematics
from .skinning import relative_transforms as relative_transforms
from .skinning import skin_points as skin_points
from .skinning import transform_point as transform_point
from .skinning import unskin_points as unskin_points
from .tree import KinematicTree as KinematicTree
