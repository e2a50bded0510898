"""`python -m tests.faults`: see the package."""

import argparse
import re
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from os import environ
from pathlib import Path

from . import __doc__ as about, all_faults


ROOT = Path(__file__).parent.parent.parent
TIMEOUT = 600
"""Seconds after which tests count as having missed a fault."""

STALE = re.compile(r"TypeError: .*<lambda>\(\) (takes|missing|got)")


def run(tests: list[str], folder: str, *options: str) -> tuple[int, str]:
    """Exit status of pytest, and what it printed. Runs share compiled programs, in a folder."""
    command = [sys.executable, "-m", "pytest", "-n", "0", "-q", "-x", "--tb=line", "-p", "no:cacheprovider"]
    try:
        ran = subprocess.run(
            [*command, *options, *(f"tests/{test}" for test in tests)],
            cwd=ROOT,
            env={**environ, "JAX_COMPILATION_CACHE_DIR": folder},
            capture_output=True,
            text=True,
            timeout=TIMEOUT,
        )
    except subprocess.TimeoutExpired:
        return -1, "the tests did not end"
    return ran.returncode, ran.stdout[-2000:] + ran.stderr[-2000:]


def main() -> int:
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", metavar="TEXT", help="faults whose names contain this")
    parser.add_argument("--list", action="store_true", help="list the faults, and run nothing")
    parser.add_argument("-j", type=int, default=2, metavar="N", help="how many run at a time")
    given = parser.parse_args()
    faults = {name: fault for name, fault in all_faults().items() if given.only in name}
    if given.list:
        print("\n".join(f"{name}  ({fault.where})" for name, fault in faults.items()))
        return 0
    begun, missed = time.monotonic(), []
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(given.j) as pool:
        tests = sorted({test for fault in faults.values() for test in fault.tests})
        parts = [tests[i :: given.j] for i in range(given.j)]
        for status, printed in pool.map(lambda part: run(part, folder) if part else (0, ""), parts):
            if status:
                print(printed, "\nwithout any fault, the tests fail")
                return 1

        def caught(name: str) -> tuple[str, int, str, float]:
            since = time.monotonic()
            status, printed = run(list(faults[name].tests), folder, "--fault", name)
            return name, status, printed, time.monotonic() - since

        for name, status, printed, seconds in pool.map(caught, faults):
            # 1: tests failed; all else is no answer, nor is a fault whose arguments do not fit any more
            seen = status == 1 and not STALE.search(printed)
            print(f"{'caught' if seen else 'MISSED'} {seconds:5.0f} s  {name}", flush=True)
            if not seen:
                missed.append(name)
                print(printed)
    print(f"{len(faults) - len(missed)} of {len(faults)} faults caught in {time.monotonic() - begun:.0f} s")
    return 1 if missed or not faults else 0


if __name__ == "__main__":
    sys.exit(main())
