"""Versions, device and memory, for the head of every result."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

_PACKAGES = ("xavatar-jax", "jax", "jaxlib", "equinox", "optimistix", "optax", "numpy", "libigl")


def describe_machine() -> dict[str, Any]:
    """Device, cores, commit, peak memory and package versions, as plain values."""
    import jax

    device = jax.devices()[0]
    return {
        "device": f"{device.platform}: {device.device_kind}",
        "cores": os.cpu_count(),
        "platform": platform.platform(),
        "peak_rss_mb": peak_rss_mb(),
        "commit": _commit(),
        "versions": {"python": platform.python_version(), **_versions()},
    }


def peak_rss_mb() -> float | None:
    """Largest resident memory of this process so far, MiB; None where it cannot be read."""
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024 if sys.platform != "darwin" else 1024**2)


def _versions() -> dict[str, str | None]:
    found: dict[str, str | None] = {}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = None
    return found


def _commit() -> str | None:
    """The commit of the source tree, or None outside of one."""
    here = Path(__file__).resolve().parent
    try:
        done = subprocess.run(
            ["git", "-C", str(here), "describe", "--always", "--dirty", "--abbrev=12"],
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None
