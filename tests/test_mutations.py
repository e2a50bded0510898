"""The list of faults matches the code, so that `python -m tests.mutations` can be run."""

import ast
import subprocess
import sys

import pytest

from .mutations import MUTATIONS, ROOT


def test_every_fault_is_a_change_of_the_code_as_it_is():
    names = [mutation.name for mutation in MUTATIONS]
    assert len(set(names)) == len(names) >= 20
    for mutation in MUTATIONS:
        changed = mutation.applied(ROOT)
        before = (ROOT / "jaxvol" / mutation.file).read_text(encoding="utf-8")
        assert ast.dump(ast.parse(changed)) != ast.dump(ast.parse(before)), mutation.name


def test_a_text_that_is_not_there_any_more_is_told():
    with pytest.raises(ValueError, match=r"march\.py must contain this text once; it occurs 0 times"):
        MUTATIONS[0]._replace(file="march.py", old="no such line").applied(ROOT)


@pytest.mark.slow
def test_every_test_that_is_named_exists_and_is_fast():
    named = {test for mutation in MUTATIONS for test in mutation.tests}
    command = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-n", "0"]
    result = subprocess.run(
        [*command, *(f"tests/{test}" for test in sorted(named))],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stdout[-3000:] + result.stderr[-3000:]
    collected = result.stdout
    for test in named:
        assert f"tests/{test}" in collected, f"{test} is slow or does not exist"
