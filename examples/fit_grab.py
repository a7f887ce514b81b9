"""Fit an avatar to posed meshes of one person, and evaluate it on held-out motion.

Without arguments, this uses the bundled body and capture and the preset `quick`. It takes less than
ten minutes on two CPU cores.

    python examples/fit_grab.py
    python examples/fit_grab.py --model-dir MODELS --data GRAB_SUBJECT --out out/s1
    python examples/fit_grab.py --resume        # after Ctrl-C, or with more --steps

`--data` takes a folder with train/*.npz and test/*.npz (AMASS "SMPL-X G" or GRAB), a subject's
folder of such files, a folder written by X-Avatar's preparation, or meshes with parameters. SMPL-X
is licensed: download it from https://smpl-x.is.tue.mpg.de and pass its folder as --model-dir
(MODELS/smplx/SMPLX_NEUTRAL.npz), or one file as --body.

This script is the same as `xavatar fit`. `xavatar_jax.cli.fit.run` contains the main steps: load a
capture, `xa.fit`, `avatar.save`, `xa.evaluate` on held-out frames, images and meshes.
"""

import sys

from xavatar_jax.cli import fit, run_command

if __name__ == "__main__":
    sys.exit(run_command(fit, prog="fit_grab.py", description=__doc__))
