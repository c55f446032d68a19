"""What must not reach the replay: rewards and actions that are no finite numbers."""

from collections.abc import Sequence

import numpy as np

from dreamer_jax.records import Records


class RecordsError(RuntimeError):
    """An environment or a policy gave what cannot be learned from."""


def check_records(records: Records, tasks: Sequence[str], healthy: np.ndarray) -> None:
    """Checks the records of one phase.

    Args:
      records: NumPy leaves [P, K, T + 1, ...].
      tasks: names of the K tasks.
      healthy: bool [P]; nothing is expected of members that are frozen.

    Raises:
      RecordsError: a number is not finite; names member, task and tick.
    """
    for what in ("reward", "action"):
        values = getattr(records, what)
        finite = np.isfinite(values) | ~healthy.reshape(-1, *[1] * (values.ndim - 1))
        if not finite.all():
            member, task, tick, *_ = np.argwhere(~finite)[0].tolist()
            value = np.atleast_1d(values[member, task, tick])
            raise RecordsError(
                f"the {what} of {tasks[task]} (member {member}) at tick {tick} of the phase is "
                f"{value[~np.isfinite(value)][0]}, expected a finite number: nothing of this phase "
                "is kept. It comes of the "
                + ("environment" if what == "reward" else "policy")
                + ", and will come again with the same seed and settings"
            )
