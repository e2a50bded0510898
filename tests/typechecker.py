"""Run-time type checker: beartype, configured to accept int for float."""

import jaxtyping
from beartype import BeartypeConf, beartype


check = beartype(conf=BeartypeConf(is_pep484_tower=True))


def leave_inner_functions():
    """Make jaxtyping's import hook, whose decorator is `jaxtyping.jaxtyped`, leave functions inside others as
    they are: they are made anew in each call of the outer one, and to decorate them each time takes up to a
    third of the time of tests that mostly trace."""
    decorate = jaxtyping.jaxtyped

    def jaxtyped(*, typechecker):
        def jaxtyped_or_not(function):
            inner = "<locals>" in getattr(function, "__qualname__", "")
            return function if inner else decorate(function, typechecker=typechecker)

        return jaxtyped_or_not

    jaxtyping.jaxtyped = jaxtyped
