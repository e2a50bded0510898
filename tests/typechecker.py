"""Run-time type checker: beartype, configured to accept int for float."""

import jaxtyping
from beartype import BeartypeConf, beartype


check = beartype(conf=BeartypeConf(is_pep484_tower=True))


class InnerFunctions:
    """Whether functions inside others are checked, too.

    They are made anew in each call of the outer function. To decorate them again each time takes up to a
    third of the time of tests that mostly trace, so that only the slow tests do."""

    checked = True


def leave_inner_functions():
    """Make jaxtyping's import hook, whose decorator is `jaxtyping.jaxtyped`, ask `InnerFunctions`."""
    decorate = jaxtyping.jaxtyped

    def jaxtyped(*, typechecker):
        def jaxtyped_or_not(function):
            if "<locals>" in getattr(function, "__qualname__", "") and not InnerFunctions.checked:
                return function
            return decorate(function, typechecker=typechecker)

        return jaxtyped_or_not

    jaxtyping.jaxtyped = jaxtyped
