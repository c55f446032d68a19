"""Every example in a docstring of the transfer library is true."""

import doctest
import importlib
import pkgutil

import jax
import jax.numpy as jnp
import optax
import pytest

import transfer

MODULES = [
    importlib.import_module(f"transfer.{module.name}")
    for module in pkgutil.iter_modules(transfer.__path__)
]
CONTEXT = {"jax": jax, "jnp": jnp, "optax": optax, "transfer": transfer}


@pytest.mark.parametrize("module", MODULES, ids=lambda module: module.__name__)
def test_examples_in_docstrings_are_true(module):
    names = {name: getattr(module, name) for name in vars(module)}
    result = doctest.testmod(
        module, extraglobs=CONTEXT | names, optionflags=doctest.NORMALIZE_WHITESPACE
    )
    assert result.failed == 0


@pytest.mark.parametrize("name", transfer.OPERATIONS)
def test_every_operation_has_an_example(name):
    assert ">>>" in transfer.OPERATIONS[name].__doc__
