"""Files: atomic writing, the cache folder, pickles and archives read under restriction."""

from .atomic import atomic_folder as atomic_folder
from .atomic import atomic_path as atomic_path
from .cache import cache_dir as cache_dir
from .cache import cache_path as cache_path
from .trees import flatten_named as flatten_named
from .trees import load_arrays as load_arrays
from .trees import load_header as load_header
from .trees import refuse_newer as refuse_newer
from .trees import save_arrays as save_arrays
from .trees import unflatten_named as unflatten_named
from .unpickle import UnsafePickleError as UnsafePickleError
from .unpickle import load_npz as load_npz
from .unpickle import load_pickle as load_pickle
