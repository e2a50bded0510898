"""Would that fit into memory? Asked before it is taken, since what does not fit ends the process."""

import os

import jax


def require_room(wanted: int, of: str) -> None:
    """**Raises** `ValueError` if so many bytes are more than the device has. `of`: which arguments ask for
    them, and what to do."""
    if wanted > (room := memory_of_device()):
        raise ValueError(f"{of}: asks for {_spelled(wanted)} of memory, and the device has {_spelled(room)}.")


def memory_of_device() -> int:
    """Bytes that the default device may use: what it says itself, or else the machine's memory."""
    told = (jax.local_devices()[0].memory_stats() or {}).get("bytes_limit")
    return told or os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def _spelled(count: int) -> str:
    return f"{count / 2**30:.3g} GiB"
