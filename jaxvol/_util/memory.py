"""Checks that allocations fit into memory, since running out ends the process; and return of freed memory."""

import ctypes
import os
from pathlib import Path

import jax


def require_room(size: int, subject: str) -> None:
    """Raise a `ValueError`, beginning with `subject`, if the device has less memory than `size` bytes."""
    if size > (room := memory_of_device()):
        needs, has = size / 2**30, room / 2**30
        raise ValueError(f"{subject}: asks for {needs:.3g} GiB of memory, and the device has {has:.3g} GiB.")


def memory_of_device() -> int:
    """Bytes that the default device may use: its own limit, or the limit of the machine or container."""
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
    """Return freed memory to the system, if the C library keeps it (glibc)."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if trim is not None:
        trim(0)
