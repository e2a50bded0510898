"""Would that fit into memory? Asked before it is taken, since what does not fit ends the process."""

import os
from pathlib import Path

import jax


def require_room(wanted: int, of: str) -> None:
    """**Raises** `ValueError` if so many bytes are more than the device has. `of`: which arguments ask for
    them, and what to do."""
    if wanted > (room := memory_of_device()):
        raise ValueError(f"{of}: asks for {_spelled(wanted)} of memory, and the device has {_spelled(room)}.")


def memory_of_device() -> int:
    """Bytes that the default device may use: what it says itself, or else what the machine, or a container on
    it, has."""
    device = getattr(jax.config, "jax_default_device", None) or jax.local_devices()[0]
    told = (device.memory_stats() or {}).get("bytes_limit") if isinstance(device, jax.Device) else None
    if told:
        return told
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    container = Path("/sys/fs/cgroup/memory.max")
    limit = container.read_text().strip() if container.is_file() else "max"
    return machine if limit == "max" else min(machine, int(limit))


def _spelled(count: int) -> str:
    return f"{count / 2**30:.3g} GiB"
