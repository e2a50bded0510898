"""The list of faults fits the code, so that `python -m tests.faults` can run."""

import inspect
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
            text = (HERE / file).read_text(encoding="utf-8")
            assert f"def {name.partition('[')[0]}" in text, f"{fault.name}: {test}"


def test_a_fault_is_replaced_wherever_it_was_imported(monkeypatch):
    import jaxvol
    from jaxvol import metrics

    from .faults import Fault

    monkeypatch.setattr(metrics, "rmse", metrics.rmse)  # put back afterwards, here and where it is public
    fault = Fault("none", "metrics:rmse", lambda rmse: lambda *images: 2 * rmse(*images), ())
    original = metrics.rmse
    try:
        fault.inject()
        assert metrics.rmse(np.ones((2, 2)), np.zeros((2, 2))) == 2
        assert inspect.getattr_static(jaxvol.metrics, "rmse") is not original
    finally:
        Fault("undo", "metrics:rmse", lambda _: original, ()).inject()
