import subprocess
import sys

import pytest


@pytest.mark.parametrize("order", [("softfin.quantities", "jax"), ("jax", "softfin.quantities")])
def test_arrays_of_both_kinds_are_readings_whichever_is_imported_first(order):
    code = (
        "import importlib, numpy as np\n"
        f"for name in {order}: importlib.import_module(name)\n"
        "import jax, jax.numpy as jnp\n"
        "from jaxtyping import Float\n"
        "from softfin.quantities import AnyArray\n"
        "kind = Float[AnyArray, '2']\n"
        "print([isinstance(x, kind) for x in (np.zeros(2, np.float32), jnp.zeros(2), jnp.zeros(3), [0.0, 0.0])])\n"
        "print(jax.eval_shape(lambda x: x * isinstance(x, kind), jnp.zeros(2)).shape)"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.split("\n")[:2] == ["[True, True, False, False]", "(2,)"]
