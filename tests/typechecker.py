"""Run-time type checker: beartype, configured to accept int for float, and NumPy's flags for bool."""

import functools

import jaxtyping
import numpy as np
from beartype import BeartypeConf, BeartypeHintOverrides, beartype


FLAGS = BeartypeHintOverrides({bool: bool | np.bool_})
check = beartype(conf=BeartypeConf(is_pep484_tower=True, hint_overrides=FLAGS))


def adapt_decorator():
    """Change `jaxtyping.jaxtyped`, the decorator of jaxtyping's import hook, in two ways. Functions inside
    others stay as they are: they are made anew in each call of the outer one, and decorating them takes up to
    a third of the time of tests that mostly trace. And where an argument is not of its annotated type, the
    function's own error comes first, if it raises one, since that is what users see."""
    decorate = jaxtyping.jaxtyped

    def jaxtyped(*, typechecker):
        def jaxtyped_or_not(function):
            name = getattr(function, "__qualname__", "")
            if "<locals>" in name:
                return function
            if isinstance(function, type) and hasattr(vars(function).get("__init__"), "__wrapped__"):
                return function  # decorated as a method
            checked = decorate(function, typechecker=typechecker)
            if isinstance(function, type) or not callable(function):
                return checked
            refused = f"checking the parameters of {function.__module__}.{name}."

            @functools.wraps(function)
            def call(*args, **kwargs):
                try:
                    return checked(*args, **kwargs)
                except jaxtyping.TypeCheckError as error:
                    if refused in str(error):
                        function(*args, **kwargs)
                    raise

            return call

        return jaxtyped_or_not

    jaxtyping.jaxtyped = jaxtyped
