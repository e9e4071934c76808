"""The machine that measurements depend on."""

import platform
from pathlib import Path
from typing import Any

import jax


def machine() -> dict[str, Any]:
    """Processor, first XLA device, number of XLA devices and JAX's version, by name."""
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [line.split(":")[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")]
        cpu = f"{len(names)} x {names[0]}" if names else cpu
    device = jax.devices()[0]
    kind = f"{device.platform}: {device.device_kind}"
    return {"cpu": cpu, "device": kind, "devices": len(jax.devices()), "jax": jax.__version__}
