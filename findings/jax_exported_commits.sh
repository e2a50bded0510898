#!/usr/bin/env bash
# A function that went through `jax.export` returns arrays that are committed to a device, though it was given arrays
# that are not, and the function itself returns none that are: JAX then refuses to combine them with arrays that are
# committed to another device. Called while another primitive is lowered, rather than traced, it commits nothing.
# Seen with jax 0.10.2 and flatbuffers 25.9.23, on a CPU:
#   the function:                     committed False
#   exported:                         committed True
#   exported, called in a lowering:   committed False
# Runs without jaxvol; fails if it changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install -q jax==0.10.2 flatbuffers==25.9.23
JAX_PLATFORMS=cpu "$folder/env/bin/python" - <<'PYTHON'
import jax
import jax.numpy as jnp
from jax import export
from jax.extend.core import Primitive
from jax.interpreters import mlir

x = jnp.arange(4.0)
plain = jax.jit(lambda x: x + 1)
exported = export.deserialize(export.export(plain)(jax.typeof(x)).serialize())
call = Primitive("call")
call.def_abstract_eval(lambda _: exported.out_avals[0])
mlir.register_lowering(call, mlir.lower_fun(exported.call, multiple_results=False))
functions = {
    "the function": plain,
    "exported": jax.jit(exported.call),
    "exported, called in a lowering": jax.jit(call.bind),
}
found = {name: function(x).committed for name, function in functions.items()}
for name, committed in found.items():
    print(f"{name + ':':33} committed {committed}")
assert not x.committed
assert list(found.values()) == [False, True, False], found
PYTHON
