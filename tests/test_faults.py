"""The list of faults fits the code, so that `python -m tests.faults` can run."""

import ast
from pathlib import Path

import numpy as np

from .faults import all_faults


HERE = Path(__file__).parent


def test_what_faults_replace_and_the_tests_that_must_see_it_are_there():
    for fault in all_faults().values():
        _, _, original = fault.found()
        faulty = fault.make(original)
        assert faulty is not original, fault.name
        assert callable(faulty) == callable(original) or isinstance(original, property), fault.name
        for test in fault.tests:
            file, _, name = test.partition("::")
            tree = ast.parse((HERE / file).read_text(encoding="utf-8"))
            found = {each.name: each for each in tree.body if isinstance(each, ast.FunctionDef)}
            marks = [ast.unparse(each) for each in found[name.partition("[")[0]].decorator_list]
            assert "pytest.mark.slow" not in marks, f"{fault.name}: {test}"


def test_a_fault_is_replaced_wherever_it_was_imported():
    from jaxvol import metrics
    from jaxvol.app.viewer import tiles

    from .faults import Fault

    fault = Fault("none", "metrics:rmse", lambda rmse: lambda *images: 2 * rmse(*images), ())
    original = metrics.rmse
    try:
        fault.inject()
        assert metrics.rmse(np.ones((2, 2)), np.zeros((2, 2))) == 2
        assert tiles.rmse is metrics.rmse is not original
    finally:
        Fault("undo", "metrics:rmse", lambda _: original, ()).inject()
    assert tiles.rmse is original
