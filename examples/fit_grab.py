"""Learn an avatar of one person from posed meshes, and test it on motion it has not seen.

Without arguments: the bundled body and capture and the preset `quick`, in less than ten minutes on
two CPU cores.

    python examples/fit_grab.py
    python examples/fit_grab.py --model-dir MODELS --data GRAB_SUBJECT --out out/s1
    python examples/fit_grab.py --resume        # after Ctrl-C, or to raise --steps

`--data` takes a folder with train/*.npz and test/*.npz (AMASS "SMPL-X G" or GRAB), a subject's
own folder of such files, the folders that X-Avatar's preparation makes, or meshes with
parameters. SMPL-X itself is licensed: get it from https://smpl-x.is.tue.mpg.de and name its
folder by --model-dir (MODELS/smplx/SMPLX_NEUTRAL.npz), or one file by --body.

This is `xavatar fit` as a script. The whole way stands in `xavatar_jax.cli.fit.run`: `load` a
capture, `xa.fit`, `avatar.save`, `xa.evaluate` on held-out frames, pictures and meshes.
"""

import sys

from xavatar_jax.cli import fit, run_command

if __name__ == "__main__":
    sys.exit(run_command(fit, prog="fit_grab.py", description=__doc__))
