"""Pictures of meshes by ray casting on the CPU; needs no display and no OpenGL."""

from .camera import Camera as Camera
from .camera import frame_view as frame_view
from .camera import orbit_views as orbit_views
from .camera import part_view as part_view
from .colormaps import WEIGHT_RAMP as WEIGHT_RAMP
from .colormaps import bone_palette as bone_palette
from .colormaps import color_bar as color_bar
from .colormaps import error_colors as error_colors
from .colormaps import weight_colors as weight_colors
from .draw import SKIN_COLOR as SKIN_COLOR
from .draw import TRUTH_COLOR as TRUTH_COLOR
from .draw import render_mesh as render_mesh
from .draw import render_sequence as render_sequence
from .draw import render_views as render_views
from .draw import turntable as turntable
from .images import draw_text as draw_text
from .images import grid_picture as grid_picture
from .images import save_gif_animation as save_gif_animation
from .images import save_png as save_png
from .images import save_webp_animation as save_webp_animation
from .shading import to_linear as to_linear
