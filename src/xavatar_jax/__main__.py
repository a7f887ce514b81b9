"""`python -m xavatar_jax` is `xavatar`."""

import sys

from .cli import main

if __name__ == "__main__":
    sys.exit(main())
