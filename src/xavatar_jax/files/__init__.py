"""Files: atomic writing, the cache folder, and reading of pickles and archives as data."""

from .archives import is_torch as is_torch
from .archives import load_json as load_json
from .archives import load_npy as load_npy
from .archives import load_npz as load_npz
from .archives import load_torch as load_torch
from .archives import parse_json as parse_json
from .atomic import atomic_folder as atomic_folder
from .atomic import atomic_path as atomic_path
from .cache import CacheNotice as CacheNotice
from .cache import cache_path as cache_path
from .cache import cached as cached
from .limits import Limits as Limits
from .limits import TooLargeError as TooLargeError
from .pickles import UnsafePickleError as UnsafePickleError
from .pickles import load_pickle as load_pickle
from .trees import flatten_named as flatten_named
from .trees import header_entry as header_entry
from .trees import load_arrays as load_arrays
from .trees import load_header as load_header
from .trees import refuse_newer as refuse_newer
from .trees import save_arrays as save_arrays
from .trees import unflatten_named as unflatten_named
