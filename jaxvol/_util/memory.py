"""Does an allocation fit into memory? Running out would end the process. And how is memory given back?"""

import ctypes
import os
from pathlib import Path

import jax


def require_room(wanted: int, of: str) -> None:
    """Raises `ValueError` if the device has less than the bytes `wanted` by these arguments (`of`)."""
    if wanted > (room := memory_of_device()):
        asked, held = wanted / 2**30, room / 2**30
        raise ValueError(f"{of}: asks for {asked:.3g} GiB of memory, and the device has {held:.3g} GiB.")


def memory_of_device() -> int:
    """Bytes that the default device may use: its own limit, or that of the machine or container."""
    device = getattr(jax.config, "jax_default_device", None) or jax.local_devices()[0]
    reported = (device.memory_stats() or {}).get("bytes_limit") if isinstance(device, jax.Device) else None
    if reported:
        return reported
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    container = Path("/sys/fs/cgroup/memory.max")
    limit = container.read_text().strip() if container.is_file() else "max"
    return machine if limit == "max" else min(machine, int(limit))


def memory_available() -> int:
    """Bytes of the default device's memory that nobody uses now; all of them where that is unknown."""
    device = getattr(jax.config, "jax_default_device", None) or jax.local_devices()[0]
    reported = (device.memory_stats() or {}) if isinstance(device, jax.Device) else {}
    if reported.get("bytes_limit"):
        return reported["bytes_limit"] - reported.get("bytes_in_use", 0)
    host = Path("/proc/meminfo")
    lines = host.read_text().splitlines() if host.is_file() else []
    free = [1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable")]
    return min([memory_of_device(), *free])


def give_back() -> None:
    """Gives memory that was freed back to the system, where the C library is one that keeps it (glibc)."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if trim is not None:
        trim(0)
