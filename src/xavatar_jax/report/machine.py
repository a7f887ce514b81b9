"""Versions, device and memory, recorded with every result."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

_PACKAGES = ("xavatar-jax", "jax", "jaxlib", "equinox", "optimistix", "optax", "numpy", "libigl")
_CUDA_PLUGINS = ("jax-cuda12-plugin", "jax-cuda13-plugin")


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
    """Peak resident memory of this process, MiB; None where it is not available."""
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024 if sys.platform != "darwin" else 1024**2)


def available_cores() -> int:
    """Number of cores that this process may use, which may be fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def gpu_advice(platforms: set[str]) -> str | None:
    """Advice if there is an NVIDIA GPU that JAX does not use, else None.

    `platforms`: those of JAX's devices ("cpu", "gpu", ...).
    """
    if platforms - {"cpu"} or not nvidia_gpu_present():
        return None
    found = "there is an NVIDIA GPU, but JAX runs on the CPU: "
    if any(_version(plugin) for plugin in _CUDA_PLUGINS):
        return found + (
            "GPU support is installed but does not start; check nvidia-smi and the environment "
            "variables JAX_PLATFORMS and CUDA_VISIBLE_DEVICES"
        )
    return found + 'install GPU support: pip install -e ".[gpu]"'


def nvidia_gpu_present() -> bool:
    """Whether there is an NVIDIA GPU: a device, a driver or nvidia-smi."""
    here = any(Path(place).exists() for place in ("/dev/nvidia0", "/proc/driver/nvidia"))
    return here or shutil.which("nvidia-smi") is not None


def _versions() -> dict[str, str | None]:
    return {package: _version(package) for package in _PACKAGES}


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _commit() -> str | None:
    """Commit of the source tree, or None outside a checkout."""
    here = Path(__file__).resolve().parents[3]
    if not (here / ".git").exists():  # installed; a surrounding repository is unrelated
        return None
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
