"""Pictures of meshes by ray casting on the CPU: no display, no OpenGL."""

from xavatar_jax.render.camera import Camera as Camera
from xavatar_jax.render.camera import frame_view as frame_view
from xavatar_jax.render.camera import part_view as part_view
from xavatar_jax.render.colormap import color_bar as color_bar
from xavatar_jax.render.colormap import error_colors as error_colors
from xavatar_jax.render.picture import render_mesh as render_mesh
from xavatar_jax.render.save import save_png as save_png
from xavatar_jax.render.save import save_webp_animation as save_webp_animation
from xavatar_jax.render.sheet import grid_picture as grid_picture
