"""How much memory does this process hold, and how much did it at most? MiB, as Linux tells.

`resource.getrusage` does not say: what the process that started this one held then counts there, too, since
Linux keeps that through `exec`.

**Raises:** `OSError` where there is no /proc.
"""

from pathlib import Path


STATUS = Path("/proc/self/status")


def held() -> float:
    """Resident memory now."""
    return _told("VmRSS")


def peak() -> float:
    """The greatest resident memory so far."""
    return _told("VmHWM")


def forget_peak() -> None:
    """Begin anew: from here on, `peak` is the greatest from here on."""
    Path("/proc/self/clear_refs").write_text("5", encoding="utf-8")


def _told(name: str) -> float:
    lines = STATUS.read_text(encoding="utf-8").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(name)) / 1024
