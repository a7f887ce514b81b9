"""Pictures of meshes by ray casting on the CPU: no display, no OpenGL."""

from .camera import Camera as Camera
from .camera import frame_view as frame_view
from .camera import orbit_views as orbit_views
from .camera import part_view as part_view
from .colormap import color_bar as color_bar
from .colormap import error_colors as error_colors
from .picture import SKIN_COLOR as SKIN_COLOR
from .picture import TRUTH_COLOR as TRUTH_COLOR
from .picture import render_mesh as render_mesh
from .save import save_gif_animation as save_gif_animation
from .save import save_png as save_png
from .save import save_webp_animation as save_webp_animation
from .sheet import draw_text as draw_text
from .sheet import grid_picture as grid_picture
from .turntable import turntable as turntable
from .weights import WEIGHT_RAMP as WEIGHT_RAMP
from .weights import bone_palette as bone_palette
from .weights import weight_colors as weight_colors
