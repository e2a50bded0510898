"""How often does the host wait for the device during a program on a GPU?

XLA's GPU backend waits at each look at the condition of a loop whose number of turns is not known when it is
compiled (one more than its turns), and at each branch. This counts both: the program is evaluated as JAX
traced it, on any device, with a counter carried along.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.extend.core import Jaxpr, Literal


class RoundTrips(NamedTuple):
    """Looks at the conditions of loops, and branches."""

    looks: Any
    branches: Any

    @property
    def number(self) -> int:
        return int(self.looks) + int(self.branches)


INNER = ("jaxpr", "call_jaxpr", "fun_jaxpr", "call")
"""Where primitives that only call a program hold it."""


def counted(function: Callable[..., Any], *arguments: Any) -> tuple[Any, RoundTrips]:
    """The function's arrays, and the round trips that it takes to compute them."""
    arrays, rest = eqx.partition(arguments, eqx.is_array)
    static = []

    def of_arrays(arrays: Any) -> Any:
        found, other = eqx.partition(function(*eqx.combine(arrays, rest)), eqx.is_array)
        static.append(other)
        return found

    program, shape = jax.make_jaxpr(of_arrays, return_shape=True)(arrays)

    def run(leaves: list[Any]) -> tuple[Any, RoundTrips]:
        none = RoundTrips(jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32))
        return _evaluated(program.jaxpr, program.consts, leaves, none)

    leaves, count = jax.jit(run)(jax.tree.leaves(arrays))
    return eqx.combine(jax.tree.unflatten(jax.tree.structure(shape), leaves), static[0]), count


def _evaluated(
    program: Jaxpr, constants: Any, arguments: Any, count: RoundTrips
) -> tuple[list[Any], RoundTrips]:
    known = dict(zip((*program.constvars, *program.invars), (*constants, *arguments), strict=True))

    def read(atom: Any) -> Any:
        return atom.val if isinstance(atom, Literal) else known[atom]

    for step in program.eqns:
        given, params, kind = [read(atom) for atom in step.invars], step.params, step.primitive.name
        inner = next((params[name] for name in INNER if hasattr(params.get(name), "eqns")), None)
        if kind == "while":
            found, count = _while(params, given, count)
        elif kind == "cond":
            found, count = _cond(params, given, count)
        elif kind == "scan":
            found, count = _scan(params, given, count)
        elif inner is not None:
            found, count = _called(inner, given, count)
        else:
            found = step.primitive.bind(*given, **params)
            found = found if step.primitive.multiple_results else [found]
        known.update(zip(step.outvars, found, strict=True))
    return [read(atom) for atom in program.outvars], count


def _called(program: Any, arguments: Any, count: RoundTrips) -> tuple[list[Any], RoundTrips]:
    open_, constants = (program.jaxpr, program.consts) if hasattr(program, "consts") else (program, ())
    return _evaluated(open_, constants, arguments, count)


def _while(params: Any, given: list[Any], count: RoundTrips) -> tuple[list[Any], RoundTrips]:
    of_cond, of_body = params["cond_nconsts"], params["body_nconsts"]
    cond, body = given[:of_cond], given[of_cond : of_cond + of_body]

    def goes_on(carry: Any) -> Any:  # for each element, where a batch of loops was made one
        return _called(params["cond_jaxpr"], [*cond, *carry], count)[0][0]

    def look(state: Any) -> Any:
        return jnp.any(goes_on(state[0]))

    def turn(state: Any) -> Any:
        carry, count = state
        found, count = _called(params["body_jaxpr"], [*body, *carry], count._replace(looks=count.looks + 1))
        goes = goes_on(carry)
        return [_where(goes, new, old) for new, old in zip(found, carry, strict=True)], count

    after, count = jax.lax.while_loop(look, turn, (given[of_cond + of_body :], count))
    return after, count._replace(looks=count.looks + 1)  # the look that ends it


def _where(goes: Any, new: Any, old: Any) -> Any:
    """`new`, where a loop goes on; its further axes are not those of the batch."""
    return jnp.where(goes.reshape(goes.shape + (1,) * (new.ndim - goes.ndim)), new, old)


def _cond(params: Any, given: list[Any], count: RoundTrips) -> tuple[list[Any], RoundTrips]:
    index, *arguments = given
    count = count._replace(branches=count.branches + 1)
    branches = [lambda *a, branch=branch: _called(branch, a[1:], a[0]) for branch in params["branches"]]
    return jax.lax.switch(index, branches, count, *arguments)


def _scan(params: Any, given: list[Any], count: RoundTrips) -> tuple[list[Any], RoundTrips]:
    if "ft_in" in params:  # from jax 0.11 on
        fixed, carried, _ = (len(part) for part in params["ft_in"].unpack())
    else:
        fixed, carried = params["num_consts"], params["num_carry"]
    constants, carry, every = given[:fixed], given[fixed : fixed + carried], given[fixed + carried :]

    def one(state: Any, each: Any) -> tuple[Any, Any]:
        carry, count = state
        found, count = _called(params["jaxpr"], [*constants, *carry, *each], count)
        return (found[:carried], count), found[carried:]

    options = {name: params[name] for name in ("length", "reverse", "unroll")}
    (carry, count), stacked = jax.lax.scan(one, (carry, count), every, **options)
    return [*carry, *stacked], count
