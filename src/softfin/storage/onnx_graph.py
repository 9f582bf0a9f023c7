"""Converts a JAX function to an ONNX graph: each primitive of its jaxpr becomes operators of opset
17.

Controllers and surrogates are exported from the formulas that softfin itself runs, so that no
formula exists twice. Values that do not depend on the inputs, such as transposed weights, become
constants. Unsupported primitives are rejected by name. Requires ``softfin[onnx]``.
"""

import importlib.metadata
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, SupportsIndex, TypeAlias, cast

import jax
import jax.numpy as jnp
import numpy as np
import spox
import spox.opset.ai.onnx.v17 as op
from jax.extend.core import Jaxpr, JaxprEqn, Literal, Var

from softfin.core.errors import RunError
from softfin.storage.onnx_file import NEXT, OPSET

Value: TypeAlias = np.ndarray | np.generic | jax.Array | spox.Var
"""Array if the value is known while the graph is built; otherwise a graph variable."""

Results: TypeAlias = Value | list[Value]

Atom: TypeAlias = Var | Literal
"""Operand of an equation: a variable of the jaxpr, or a constant."""


def build_graph(
    function: Callable[..., Mapping[str, jax.Array]], inputs: Mapping[str, np.ndarray]
) -> Any:
    """Build the ONNX model of a function of named arrays that returns named arrays.

    Args:
        function: Called with the `inputs` as keyword arguments.
        inputs: An example of each input, for its shape and dtype. The output ``next_NAME`` gets
            the dtype of the input NAME.

    Raises:
        RunError: the function uses a primitive that cannot be translated.
    """
    names: list[str] = []

    def traced(values: dict[str, jax.Array]) -> dict[str, jax.Array]:
        results = dict(function(**values))
        names.extend(results)
        return results

    examples = {name: jnp.asarray(value) for name, value in inputs.items()}
    closed = jax.make_jaxpr(traced)(examples)
    arguments = {
        name: spox.argument(spox.Tensor(value.dtype, value.shape)) for name, value in inputs.items()
    }
    # JAX flattens dictionaries in the order of their keys. Inputs are cast to JAX's own dtypes,
    # because its integers have 32 bits by default.
    given = [_cast(arguments[name], examples[name].dtype) for name in sorted(arguments)]
    found = dict(zip(sorted(names), _translate(closed.jaxpr, closed.consts, given), strict=True))
    outputs = {}
    for name in names:
        like = inputs.get(name.removeprefix(NEXT))
        outputs[name] = _variable(found[name])
        if name.startswith(NEXT) and like is not None:
            outputs[name] = _cast(outputs[name], like.dtype)
    model = spox.build(arguments, outputs)
    # spox declares the oldest opset that has these operators; softfin always declares the same one.
    model.opset_import[0].version = OPSET
    return model


def _translate(jaxpr: Jaxpr, consts: Sequence[Value], arguments: Sequence[Value]) -> list[Value]:
    """Translate the equations one by one; return the outputs of the jaxpr."""
    values: dict[Var, Value] = dict(zip(jaxpr.constvars, consts, strict=True))
    values |= dict(zip(jaxpr.invars, arguments, strict=True))

    def read(atom: Atom) -> Value:
        if isinstance(atom, Literal):
            return np.asarray(atom.val, dtype=_dtype(atom))
        return values[atom]

    for equation in jaxpr.eqns:
        found = _translate_equation(equation, [read(atom) for atom in equation.invars])
        results = found if isinstance(found, list) else [found]
        values |= dict(zip(equation.outvars, results, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _translate_equation(equation: JaxprEqn, values: list[Value]) -> Results:
    name = equation.primitive.name
    params = equation.params
    if name == "scan":
        return _unroll_scan(equation, values)
    # Calls to other functions, such as jit and custom derivatives, are translated in place.
    inner = params.get("jaxpr", params.get("call_jaxpr"))
    if inner is not None:
        if hasattr(inner, "consts"):
            return _translate(inner.jaxpr, inner.consts, values)
        return _translate(inner, (), values)
    if all(map(_is_known, values)):
        # The result is independent of the inputs, such as a transposed weight, so compute it now as
        # a constant.
        bind: Callable[..., jax.Array | Sequence[jax.Array]] = equation.primitive.bind
        computed = bind(*values, **params)
        results = [computed] if isinstance(computed, jax.Array) else computed
        return list(map(np.asarray, results))
    if name in SAME_OPERANDS:
        return SAME_OPERANDS[name](*map(_variable, values))
    if name in TRANSLATORS_OF_VALUES:
        return TRANSLATORS_OF_VALUES[name](equation, *values)
    if name not in TRANSLATORS:
        raise RunError(
            f"ONNX: JAX {importlib.metadata.version('jax')} uses the primitive {name!r}, which "
            "softfin cannot export; use another version of JAX, or report this to softfin's authors"
        )
    return TRANSLATORS[name](equation, *map(_variable, values))


def _unroll_scan(equation: JaxprEqn, values: list[Value]) -> list[Value]:
    """Unroll all iterations: one step of a controller or surrogate has few.

    Versions of JAX store the number of carried values differently, so they are recognised by their
    shape: they lack the leading axis of iterations.
    """
    params = equation.params
    body = params["jaxpr"]
    num_carried = _count_unscanned(equation.outvars, body.out_avals)
    num_unscanned = _count_unscanned(equation.invars, body.in_avals)
    constants = values[: num_unscanned - num_carried]
    carried = values[num_unscanned - num_carried : num_unscanned]
    scanned = values[num_unscanned:]
    order = range(params["length"])
    rows = {}
    for index in reversed(order) if params["reverse"] else order:
        now = [_row(value, index) for value in scanned]
        found = _translate(body.jaxpr, body.consts, [*constants, *carried, *now])
        carried = found[:num_carried]
        rows[index] = found[num_carried:]
    in_order = [rows[index] for index in order]
    return [*carried, *(_stack(each, 0) for each in zip(*in_order, strict=True))]


def _count_unscanned(atoms: Sequence[Atom], in_body: Sequence[jax.core.ShapedArray]) -> int:
    return sum(_shape(atom) == inner.shape for atom, inner in zip(atoms, in_body, strict=True))


def _is_known(value: Value) -> bool:
    return not isinstance(value, spox.Var)


def _variable(value: Value) -> spox.Var:
    return value if isinstance(value, spox.Var) else op.const(np.asarray(value))


def _integers(numbers: Sequence[SupportsIndex] | np.ndarray) -> spox.Var:
    return op.const(np.asarray(numbers, np.int64))


def _cast(value: Value, dtype: np.dtype | type[np.generic]) -> spox.Var:
    return op.cast(_variable(value), to=np.dtype(dtype).type)


def _shape(atom: Atom) -> tuple[int, ...]:
    shape: tuple[int, ...] = cast(jax.core.ShapedArray, atom.aval).shape
    return shape


def _dtype(atom: Atom) -> np.dtype:
    dtype: np.dtype = cast(jax.core.ShapedArray, atom.aval).dtype
    return dtype


def _row(value: Value, index: int) -> Value:
    if isinstance(value, spox.Var):
        return op.gather(value, op.const(np.int64(index)), axis=0)
    row: np.ndarray = np.asarray(value)[index]
    return row


def _stack(values: Sequence[Value], axis: int) -> Value:
    if all(map(_is_known, values)):
        return np.stack(list(map(np.asarray, values)), axis)
    rows = [op.unsqueeze(_variable(value), _integers([axis])) for value in values]
    return op.concat(rows, axis=axis)


def _broadcast_in_dim(equation: JaxprEqn, value: spox.Var) -> spox.Var:
    # First reshape, with ones for the new axes, then expand them.
    shape = equation.params["shape"]
    sizes = np.ones(len(shape), np.int64)
    sizes[list(equation.params["broadcast_dimensions"])] = _shape(equation.invars[0])
    value = op.reshape(value, op.const(sizes))
    return value if tuple(sizes) == shape else op.expand(value, _integers(shape))


def _slice(equation: JaxprEqn, value: spox.Var) -> spox.Var:
    params = equation.params
    starts = params["start_indices"]
    axes = range(len(starts))
    steps = params["strides"] or [1] * len(starts)
    return op.slice(value, *map(_integers, (starts, params["limit_indices"], axes, steps)))


def _dynamic_slice(equation: JaxprEqn, value: spox.Var, *starts: spox.Var) -> spox.Var:
    """Take a slice at computed starts; as in JAX, the starts are clamped so that the slice lies
    inside."""
    sizes = np.asarray(equation.params["slice_sizes"], np.int64)
    last_starts = _shape(equation.invars[0]) - sizes
    rows = [op.reshape(_cast(start, np.int64), _integers([1])) for start in starts]
    begin = op.min([op.max([op.concat(rows, axis=0), _integers([0])]), op.const(last_starts)])
    end = op.add(begin, op.const(sizes))
    return op.slice(value, begin, end, _integers(range(len(sizes))))


def _split(equation: JaxprEqn, value: spox.Var) -> Results:
    sizes = equation.params["sizes"]
    axis = equation.params["axis"]
    return list(op.split(value, _integers(sizes), outputs_count=len(sizes), axis=axis))


def _argmin(equation: JaxprEqn, value: spox.Var) -> spox.Var:
    (axis,) = equation.params["axes"]
    return _cast(op.arg_min(value, axis=axis, keepdims=0), equation.params["index_dtype"])


def _integer_pow(equation: JaxprEqn, value: spox.Var) -> spox.Var:
    power = equation.params["y"]
    return op.mul(value, value) if power == 2 else op.pow(value, op.const(np.float32(power)))


def _gather(equation: JaxprEqn, value: Value, indices: Value) -> spox.Var:
    """Take entire rows along one axis, at indices that are known while the graph is built."""
    shape = _shape(equation.invars[0])
    numbers = equation.params["dimension_numbers"]
    (axis,) = numbers.start_index_map
    # Each index selects one row of the operand; in the result, the row's other axes surround the
    # axes of the indices.
    sizes = (*shape[:axis], 1, *shape[axis + 1 :])
    rank = len(_shape(equation.outvars[0]))
    row_axes = (*range(axis), *range(rank - len(shape) + 1 + axis, rank))
    takes_rows = (
        numbers.collapsed_slice_dims == (axis,)
        and numbers.offset_dims == row_axes
        and equation.params["slice_sizes"] == sizes
    )
    if isinstance(indices, spox.Var) or not takes_rows:
        raise RunError("ONNX: softfin can only export a gather of entire rows at fixed indices")
    # Clamp indices that are out of bounds, as JAX does; ONNX's Gather rejects them.
    places = np.clip(np.asarray(indices)[..., 0], 0, shape[axis] - 1)
    return op.gather(_variable(value), _integers(places), axis=axis)


def _dot_general(equation: JaxprEqn, left: Value, right: Value) -> spox.Var:
    """Multiply matrices ``(batch, rows, sum)`` and ``(batch, sum, columns)``."""
    # Any contraction becomes a batch of matrix products: move the axes to (batch, rows, sum) and
    # (batch, sum, columns), merge each group into one axis, multiply, and split them again.
    (left_sum, right_sum), (left_batch, right_batch) = equation.params["dimension_numbers"]
    left_shape, right_shape = map(_shape, equation.invars)
    rows = [axis for axis in range(len(left_shape)) if axis not in (*left_sum, *left_batch)]
    columns = [axis for axis in range(len(right_shape)) if axis not in (*right_sum, *right_batch)]
    num_batches = math.prod(left_shape[axis] for axis in left_batch)
    num_summed = math.prod(left_shape[axis] for axis in left_sum)
    first = _arrange(left, (*left_batch, *rows, *left_sum), (num_batches, -1, num_summed))
    second = _arrange(right, (*right_batch, *right_sum, *columns), (num_batches, num_summed, -1))
    return _reshape(equation, op.matmul(first, second))


def _arrange(value: Value, axes: tuple[int, ...], shape: tuple[int, ...]) -> spox.Var:
    if not isinstance(value, spox.Var):
        # Known values, such as weights, are transposed now instead of on every run.
        return op.const(np.transpose(np.asarray(value), axes).reshape(shape))
    if list(axes) != sorted(axes):
        value = op.transpose(value, perm=axes)
    return op.reshape(value, _integers(shape))


def _reshape(equation: JaxprEqn, value: spox.Var) -> spox.Var:
    return op.reshape(value, _integers(_shape(equation.outvars[0])))


SAME_OPERANDS: Mapping[str, Callable[..., spox.Var]] = {
    "abs": op.abs,
    "add": op.add,
    "and": op.and_,
    "atanh": op.atanh,
    "copy": op.identity,
    "copy_p": op.identity,
    "cos": op.cos,
    "div": op.div,
    "eq": op.equal,
    "exp": op.exp,
    "ge": op.greater_or_equal,
    "gt": op.greater,
    "le": op.less_or_equal,
    "log": op.log,
    "logistic": op.sigmoid,
    "lt": op.less,
    "max": lambda *values: op.max(values),
    "min": lambda *values: op.min(values),
    "mul": op.mul,
    "ne": lambda one, other: op.not_(op.equal(one, other)),
    "neg": op.neg,
    "pow": op.pow,
    # A remainder has the sign of the dividend, as in C.
    "rem": lambda one, other: op.mod(one, other, fmod=1),
    "sign": op.sign,
    "sin": op.sin,
    "sqrt": op.sqrt,
    "square": lambda value: op.mul(value, value),
    "stop_gradient": op.identity,
    "sub": op.sub,
    "tanh": op.tanh,
}
"""Operators for primitives that need no parameters."""

TRANSLATORS: Mapping[str, Callable[..., Results]] = {
    "argmin": _argmin,
    "broadcast_in_dim": _broadcast_in_dim,
    "concatenate": lambda equation, *values: op.concat(values, axis=equation.params["dimension"]),
    "convert_element_type": lambda equation, value: _cast(value, equation.params["new_dtype"]),
    "dynamic_slice": _dynamic_slice,
    "integer_pow": _integer_pow,
    "reduce_sum": lambda equation, value: op.reduce_sum(
        value, _integers(equation.params["axes"]), keepdims=0
    ),
    "reshape": _reshape,
    "select_n": lambda _, condition, if_false, if_true: op.where(condition, if_true, if_false),
    "slice": _slice,
    "split": _split,
    "squeeze": _reshape,
    "stack": lambda equation, *values: _stack(values, equation.params["axis"]),
    "tile": lambda equation, value: op.tile(value, _integers(equation.params["reps"])),
    "transpose": lambda equation, value: op.transpose(value, perm=equation.params["permutation"]),
}
"""Translators that get the equation and its operands as graph variables."""

TRANSLATORS_OF_VALUES: Mapping[str, Callable[..., spox.Var]] = {
    "dot_general": _dot_general,
    "gather": _gather,
}
"""Translators that get operands as arrays if they are known while the graph is built."""
