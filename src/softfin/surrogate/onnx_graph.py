"""A traced JAX function as a graph of ONNX: each primitive of its jaxpr becomes an operator of
opset 17.

What does not depend on the arguments, such as weights that are transposed, is computed now and
becomes a constant. So formulas stand once, in JAX. Only what surrogates use is here; any other
primitive is refused by name.
"""

import importlib
import importlib.metadata
import math
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal

from softfin.core.errors import RunError
from softfin.storage.onnx_file import OPSET

OPERATORS = "spox.opset.ai.onnx.v17"
"""Module of the operators, which spox puts together to a graph; it comes with ndonnx."""

NAMES = {
    "add": "add",
    "sub": "sub",
    "mul": "mul",
    "div": "div",
    "pow": "pow",
    "neg": "neg",
    "abs": "abs",
    "sign": "sign",
    "exp": "exp",
    "log": "log",
    "sqrt": "sqrt",
    "sin": "sin",
    "cos": "cos",
    "tanh": "tanh",
    "logistic": "sigmoid",
    "lt": "less",
    "le": "less_or_equal",
    "gt": "greater",
    "ge": "greater_or_equal",
    "eq": "equal",
    "stop_gradient": "identity",
    "copy": "identity",
    "copy_p": "identity",
}
"""Primitives that are one operator of the same operands."""

Value = Any
"""A NumPy array where it is known now, else a variable of the graph."""


class GraphBuilder:
    """Translates jaxprs, equation by equation."""

    def __init__(self) -> None:
        self.op = importlib.import_module(OPERATORS)

    def run(self, jaxpr: Any, consts: Any, arguments: Any) -> list[Value]:
        """Return the outputs of a jaxpr."""
        values: dict[Any, Value] = dict(zip(jaxpr.constvars, consts, strict=True))
        values |= dict(zip(jaxpr.invars, arguments, strict=True))

        def read(atom: Any) -> Value:
            literal: Any = atom if isinstance(atom, Literal) else None
            return values[atom] if literal is None else np.asarray(literal.val, literal.aval.dtype)

        for equation in jaxpr.eqns:
            found = self._equation(equation, [read(atom) for atom in equation.invars])
            values |= dict(zip(equation.outvars, found, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def variable(self, value: Value) -> Any:
        """A variable of the graph; of a known value a constant."""
        return self.op.const(np.asarray(value)) if _is_known(value) else value

    def _equation(self, equation: Any, values: list[Value]) -> list[Value]:
        name = equation.primitive.name
        params = equation.params
        inner = params.get("jaxpr", params.get("call_jaxpr"))
        if name == "scan":
            return self._scan(equation, values)
        if inner is not None:
            closed = hasattr(inner, "consts")
            return self.run(
                inner.jaxpr if closed else inner, inner.consts if closed else (), values
            )
        if all(map(_is_known, values)):
            out = equation.primitive.bind(*values, **params)
            return [
                np.asarray(each) for each in (out if equation.primitive.multiple_results else [out])
            ]
        if name in NAMES:
            return [getattr(self.op, NAMES[name])(*map(self.variable, values))]
        translate: Callable[..., Value] | None = getattr(self, f"_{name}", None)
        if translate is None:
            raise RunError(
                f"ONNX: JAX {importlib.metadata.version('jax')} computes this surrogate with "
                f"{name!r}, which softfin does not translate; use another version of JAX, or tell "
                "softfin's authors"
            )
        found = translate(equation, *values)
        return list(found) if isinstance(found, tuple) else [found]

    def _scan(self, equation: Any, values: list[Value]) -> list[Value]:
        """Write out every iteration: surrogates step by one tick.

        Versions of JAX say in different ways how many values are carried: they are those of which
        no series comes out.
        """
        params = equation.params
        body = equation.params["jaxpr"]
        carries = sum(
            out.aval.ndim == each.ndim
            for out, each in zip(equation.outvars, body.out_avals, strict=True)
        )
        before = sum(
            given.aval.ndim == each.ndim
            for given, each in zip(equation.invars, body.in_avals, strict=True)
        )
        fixed = values[: before - carries]
        carry = values[before - carries : before]
        series = values[before:]
        order = range(params["length"])
        each: list[list[Value]] = [[] for _ in order]
        for index in reversed(order) if params["reverse"] else order:
            now = [self._row(values, index) for values in series]
            found = self.run(body.jaxpr, body.consts, [*fixed, *carry, *now])
            carry = found[:carries]
            each[index] = found[carries:]
        return [*carry, *(self._stacked(rows, 0) for rows in zip(*each, strict=True))]

    def _row(self, value: Value, index: int) -> Value:
        if _is_known(value):
            return value[index]
        return self.op.gather(value, self.op.const(np.int64(index)), axis=0)

    def _stacked(self, values: Any, axis: int) -> Value:
        if all(map(_is_known, values)):
            return np.stack(values, axis)
        at = self._sizes([axis])
        return self.op.concat(
            [self.op.unsqueeze(self.variable(value), at) for value in values], axis=axis
        )

    def _sizes(self, numbers: Any) -> Any:
        return self.op.const(np.array(numbers, np.int64))

    def _reshaped(self, equation: Any, value: Any) -> Any:
        return self.op.reshape(value, self._sizes(equation.outvars[0].aval.shape))

    def _reshape(self, equation: Any, value: Any) -> Any:
        return self._reshaped(equation, value)

    def _squeeze(self, equation: Any, value: Any) -> Any:
        return self._reshaped(equation, value)

    def _broadcast_in_dim(self, equation: Any, value: Any) -> Any:
        shape = equation.params["shape"]
        places = equation.params["broadcast_dimensions"]
        sizes = [1] * len(shape)
        for place, size in zip(places, equation.invars[0].aval.shape, strict=True):
            sizes[place] = size
        value = self.op.reshape(value, self._sizes(sizes))
        return value if tuple(sizes) == tuple(shape) else self.op.expand(value, self._sizes(shape))

    def _transpose(self, equation: Any, value: Any) -> Any:
        return self.op.transpose(value, perm=equation.params["permutation"])

    def _concatenate(self, equation: Any, *values: Value) -> Any:
        return self.op.concat([*map(self.variable, values)], axis=equation.params["dimension"])

    def _stack(self, equation: Any, *values: Value) -> Any:
        return self._stacked(values, equation.params["axis"])

    def _slice(self, equation: Any, value: Any) -> Any:
        params = equation.params
        starts = params["start_indices"]
        ends = params["limit_indices"]
        steps = params["strides"] or [1] * len(starts)
        return self.op.slice(value, *map(self._sizes, (starts, ends, range(len(starts)), steps)))

    def _dynamic_slice(self, equation: Any, value: Any, *starts: Value) -> Any:
        """Cut out a part whose place is known now."""
        if not all(map(_is_known, starts)):
            raise RunError("ONNX: a slice whose place depends on the state is not translated")
        sizes = equation.params["slice_sizes"]
        whole = equation.invars[0].aval.shape
        # As JAX does, a slice is moved to lie within.
        begin = [
            min(max(int(start), 0), n - size)
            for start, size, n in zip(starts, sizes, whole, strict=True)
        ]
        end = [start + size for start, size in zip(begin, sizes, strict=True)]
        return self.op.slice(value, *map(self._sizes, (begin, end, range(len(begin)))))

    def _split(self, equation: Any, value: Any) -> tuple[Any, ...]:
        sizes = equation.params["sizes"]
        axis = equation.params["axis"]
        return tuple(self.op.split(value, self._sizes(sizes), outputs_count=len(sizes), axis=axis))

    def _tile(self, equation: Any, value: Any) -> Any:
        return self.op.tile(value, self._sizes(equation.params["reps"]))

    def _gather(self, equation: Any, value: Any, indices: Value) -> Any:
        """Take whole rows along one axis, at places that are known now."""
        shape = equation.invars[0].aval.shape
        numbers = equation.params["dimension_numbers"]
        (axis,) = numbers.start_index_map
        sizes = tuple(1 if place == axis else size for place, size in enumerate(shape))
        batch = equation.outvars[0].aval.ndim - len(shape) + 1
        rows = tuple(range(axis)) + tuple(range(axis + batch, axis + batch + len(shape) - axis - 1))
        simple = numbers.collapsed_slice_dims == (axis,) and numbers.offset_dims == rows
        if not (_is_known(indices) and simple and equation.params["slice_sizes"] == sizes):
            raise RunError("ONNX: only whole rows at known places are translated")
        return self.op.gather(
            value, self._sizes(np.clip(indices[..., 0], 0, shape[axis] - 1)), axis=axis
        )

    def _dot_general(self, equation: Any, one: Value, other: Value) -> Any:
        """Bring the operands into matrices ``(batch, rows, sum)`` and ``(batch, sum, columns)``,
        and multiply."""
        (left, right), (left_batch, right_batch) = equation.params["dimension_numbers"]
        shapes = [atom.aval.shape for atom in equation.invars]
        rows = [place for place in range(len(shapes[0])) if place not in (*left, *left_batch)]
        columns = [place for place in range(len(shapes[1])) if place not in (*right, *right_batch)]
        batch = math.prod(shapes[0][place] for place in left_batch)
        summed = math.prod(shapes[0][place] for place in left)
        first = self._arranged(one, (*left_batch, *rows, *left), (batch, -1, summed))
        second = self._arranged(other, (*right_batch, *right, *columns), (batch, summed, -1))
        return self._reshaped(equation, self.op.matmul(self.variable(first), self.variable(second)))

    def _arranged(self, value: Value, order: tuple[int, ...], shape: tuple[int, ...]) -> Value:
        if _is_known(value):
            return np.transpose(value, order).reshape(shape)
        value = value if list(order) == sorted(order) else self.op.transpose(value, perm=order)
        return self.op.reshape(value, self._sizes(shape))

    def _reduce_sum(self, equation: Any, value: Any) -> Any:
        return self.op.reduce_sum(value, self._sizes(equation.params["axes"]), keepdims=0)

    def _max(self, _: Any, *values: Value) -> Any:
        return self.op.max([*map(self.variable, values)])

    def _min(self, _: Any, *values: Value) -> Any:
        return self.op.min([*map(self.variable, values)])

    def _integer_pow(self, equation: Any, value: Any) -> Any:
        power = equation.params["y"]
        if power == 2:
            return self.op.mul(value, value)
        return self.op.pow(value, self.op.const(np.float32(power)))

    def _square(self, _: Any, value: Any) -> Any:
        return self.op.mul(value, value)

    def _select_n(self, _: Any, which: Any, no: Value, yes: Value) -> Any:
        return self.op.where(self.variable(which), self.variable(yes), self.variable(no))

    def _convert_element_type(self, equation: Any, value: Any) -> Any:
        return self.op.cast(value, to=np.dtype(equation.params["new_dtype"]).type)


def _is_known(value: Value) -> bool:
    return isinstance(value, np.ndarray | np.generic | jax.Array)


def build_graph(
    function: Callable[..., Mapping[str, Any]], inputs: Mapping[str, tuple[int, ...]]
) -> Any:
    """Build the ONNX model of a function of float32 arrays by name, given their shapes; its results
    have names, too."""
    spox = importlib.import_module("spox")
    builder = GraphBuilder()
    examples = {name: jnp.zeros(shape, jnp.float32) for name, shape in inputs.items()}
    names: list[str] = []

    def traced(values: dict[str, Any]) -> dict[str, Any]:
        results = dict(function(**values))
        names.extend(results)
        return results

    closed = jax.make_jaxpr(traced)(examples)
    arguments = {
        name: spox.argument(spox.Tensor(np.float32, shape)) for name, shape in inputs.items()
    }
    # JAX flattens dictionaries in the order of their names.
    found = builder.run(
        closed.jaxpr, closed.consts, [arguments[name] for name in sorted(arguments)]
    )
    results = dict(zip(sorted(names), map(builder.variable, found), strict=True))
    model = spox.build(arguments, {name: results[name] for name in names})
    # spox names the oldest opset that has these operators.
    model.opset_import[0].version = OPSET
    return model
