"""Runs of populations, their evaluation and reports, and the command line.

From Python: `train`, `transfer`, `evaluate` and `load`, see `experiments.api`.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from experiments.api import evaluate as evaluate
    from experiments.api import load as load
    from experiments.api import train as train
    from experiments.api import transfer as transfer

__all__ = ["evaluate", "load", "train", "transfer"]


def __getattr__(name: str) -> Any:
    # Imported when asked for: the command line starts without JAX.
    if name in __all__:
        from experiments import api

        return getattr(api, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
