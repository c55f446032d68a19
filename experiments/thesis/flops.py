"""Arithmetic operations of a program, counted in its trace: nothing is compiled, nothing runs."""

import math
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np


def count(function: Callable, *arguments: Any) -> float:
    """Operations of one call: two for each multiplication and addition of a product of matrices or
    a convolution, one for each number that anything else makes. Loops count every turn; zeros that
    a convolution puts between or around pixels count nothing.

    Args:
      function: what JAX can trace.
      arguments: arrays, or `jax.ShapeDtypeStruct` in their place.
    """
    return of_jaxpr(jax.make_jaxpr(function)(*arguments).jaxpr)


def of_jaxpr(jaxpr: Any) -> float:
    """Operations of a trace; see `count`."""
    return sum(_of_equation(equation) for equation in jaxpr.eqns)


def _of_equation(equation) -> float:
    name, parameters = equation.primitive.name, equation.params
    made = sum(math.prod(variable.aval.shape) for variable in equation.outvars)
    if name == "dot_general":
        (contracted, _), _ = parameters["dimension_numbers"]
        shape = equation.invars[0].aval.shape
        return 2.0 * made * math.prod(shape[axis] for axis in contracted)
    if name == "conv_general_dilated":
        return 2.0 * _products_of_convolution(equation)
    inner = [of_jaxpr(jaxpr) for jaxpr in _jaxprs(parameters)]
    if not inner:
        return float(made)
    if name == "scan":
        return parameters["length"] * sum(inner)
    return max(inner) if name == "cond" else sum(inner)


def _products_of_convolution(equation) -> float:
    """Multiplications of pixels by weights, those with zeros of padding or dilation left out."""
    image, kernel = (variable.aval.shape for variable in equation.invars)
    made = equation.outvars[0].aval.shape
    parameters = equation.params
    images, kernels, results = parameters["dimension_numbers"]
    found = made[results[0]] * made[results[1]] * kernel[kernels[1]]
    for axis, (before, _) in enumerate(parameters["padding"]):
        place = parameters["window_strides"][axis] * np.arange(made[results[2 + axis]])[:, None]
        place = place + parameters["rhs_dilation"][axis] * np.arange(kernel[kernels[2 + axis]])
        pixel, beside = np.divmod(place - before, parameters["lhs_dilation"][axis])
        found *= int(np.sum((beside == 0) & (pixel >= 0) & (pixel < image[images[2 + axis]])))
    return float(found)


def _jaxprs(parameters: dict[str, Any]) -> Iterator[Any]:
    """The programs among an operation's parameters."""
    for value in parameters.values():
        for one in value if isinstance(value, tuple | list) else (value,):
            inner = getattr(one, "jaxpr", one)
            if hasattr(inner, "eqns"):
                yield inner
