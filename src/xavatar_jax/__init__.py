"""xavatar_jax: animatable implicit avatars of one person, in JAX."""

from typing import TYPE_CHECKING, Any

from ._version import __version__ as __version__

if TYPE_CHECKING:
    from .avatar import Avatar as Avatar
    from .avatar import CellSizes as CellSizes
    from .avatar import evaluate as evaluate
    from .avatar import load_avatar as load_avatar
    from .avatar import occupancy as occupancy
    from .avatar import query as query
    from .body import BodyModel as BodyModel
    from .body import BodyParams as BodyParams
    from .body import body_from_model as body_from_model
    from .body import bone_transforms as bone_transforms
    from .body import canonical_params as canonical_params
    from .body import load_body as load_body
    from .body import params_from_model as params_from_model
    from .body import pose_body as pose_body
    from .correspondence import Broyden as Broyden
    from .correspondence import find_correspondences as find_correspondences
    from .correspondence import part_groups as part_groups
    from .datasets import load_data as load_data
    from .datasets import load_frames as load_frames
    from .export import read_mesh as read_mesh
    from .export import write_obj as write_obj
    from .export import write_ply as write_ply
    from .frames import Frame as Frame
    from .frames import Frames as Frames
    from .kinematics import skin_points as skin_points
    from .meshing import Mesh as Mesh
    from .methods import Fit as Fit
    from .methods import fit as fit
    from .methods.xavatar import FitConfig as FitConfig
    from .methods.xavatar import paper as paper
    from .methods.xavatar import quick as quick
    from .motion import Motion as Motion
    from .motion import MotionNotice as MotionNotice
    from .motion import concat as concat
    from .motion import load_motion as load_motion
    from .motion import save_motion as save_motion
    from .synthetic import synthetic_body as synthetic_body
    from .synthetic import synthetic_capture as synthetic_capture
    from .viewer import HtmlPage as HtmlPage
    from .viewer import Viewer as Viewer
    from .viewer import view as view
    from .viewer import view_html as view_html

# What is imported on first use, so that `xavatar --help` does not wait for JAX.
_HOMES = {
    "avatar": ("Avatar", "CellSizes", "evaluate", "load_avatar", "occupancy", "query"),
    "body": (
        "BodyModel",
        "BodyParams",
        "body_from_model",
        "bone_transforms",
        "canonical_params",
        "load_body",
        "params_from_model",
        "pose_body",
    ),
    "correspondence": ("Broyden", "find_correspondences", "part_groups"),
    "datasets": ("load_data", "load_frames"),
    "export": ("read_mesh", "write_obj", "write_ply"),
    "frames": ("Frame", "Frames"),
    "kinematics": ("skin_points",),
    "meshing": ("Mesh",),
    "methods": ("Fit", "fit"),
    "methods.xavatar": ("FitConfig", "paper", "quick"),
    "motion": ("Motion", "MotionNotice", "concat", "load_motion", "save_motion"),
    "synthetic": ("synthetic_body", "synthetic_capture"),
    "viewer": ("HtmlPage", "Viewer", "view", "view_html"),
}
_NAMES = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    """A public name from its package, imported now; or a package itself."""
    from importlib import import_module
    from importlib.util import find_spec

    if name in _NAMES:
        value = getattr(import_module(f".{_NAMES[name]}", __name__), name)
    elif not name.startswith("_") and find_spec(f"{__name__}.{name}") is not None:
        value = import_module(f".{name}", __name__)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_NAMES})
