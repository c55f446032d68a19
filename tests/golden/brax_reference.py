"""Where Brax's generalized engine has links, and where a step moves them, for tests/test_brax.py.

Brax takes seconds to trace and compile for each task, so its numbers are stored, beside a mark of
what they depend on: the version of Brax, the model and the joints. Where any of these is another,
the tests compute them themselves. To write `brax.npz` anew:

    python tests/golden/brax_reference.py

n states, Q joint positions, D joint velocities, A action, L links.
"""

import hashlib
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path
from unittest import mock

import jax
import numpy as np

STORED = Path(__file__).parent / "brax.npz"


def inputs_of(system) -> tuple[np.ndarray, ...]:
    """Positions [n, Q], velocities [n, D] and controls [n, A] drawn at random, float32.

    Some touch the floor or a joint's end. A root's quaternion is not of length 1.
    """
    random = np.random.default_rng(0)
    q = np.asarray(system.init_q) + 0.5 * random.normal(size=(16, system.q_size()))
    qd = 3 * random.normal(size=(16, system.qd_size()))
    controls = random.uniform(-1, 1, (16, system.act_size()))
    return tuple(np.asarray(x, np.float32) for x in (q, qd, controls))


def mark_of(system) -> str:
    """What the numbers depend on, as a hash."""
    leaves = jax.tree.leaves((system, inputs_of(system)))
    numbers = b"".join(np.asarray(leaf).tobytes() for leaf in leaves)
    return hashlib.sha256(version("brax").encode() + numbers).hexdigest()


def computed(system) -> dict[str, np.ndarray]:
    """Brax's own numbers for `inputs_of(system)`, leaves [n, ...].

    Brax makes a state with the exact inverse of its mass matrix, as all steps here have it.
    """
    from brax.generalized import pipeline

    @jax.jit
    @jax.vmap
    def brax(q, qd, controls):
        state = pipeline.init(system, q, qd)
        # What a step makes ready for the next one is not looked at, and is most of it.
        skipped = (
            (pipeline.kinematics, "forward", lambda *_: (state.x, state.xd)),
            (pipeline.dynamics, "transform_com", lambda _, moved: moved),
            (pipeline.mass, "matrix_inv", lambda _, moved, __: moved),
            (pipeline.constraint, "jacobian", lambda _, moved: moved),
        )
        with ExitStack() as stack:
            for module, name, instead in skipped:
                stack.enter_context(mock.patch.object(module, name, instead))
            after = pipeline.step(system, state, controls)
        return {
            "positions": state.x.pos,
            "quaternions": state.x.rot,
            "centre": state.root_com[:1],
            "moments": state.cinr.transform.pos,
            "inertia": state.cinr.i,
            "turns": state.cdof.ang,
            "moves": state.cdof.vel,
            "link_turns": state.cd.ang,
            "link_moves": state.cd.vel,
            "turns_rate": state.cdofd.ang,
            "moves_rate": state.cdofd.vel,
            "held": (state.con_diag > 0).sum(),
            "q": after.q,
            "qd": after.qd,
        }

    return jax.device_get(brax(*inputs_of(system)))


def reference(title: str, system) -> dict[str, np.ndarray]:
    """The numbers of a task: those that are stored, or new ones if they are of something else."""
    with np.load(STORED) as stored:
        if stored[f"{title}/mark"] != mark_of(system):
            return computed(system)
        names = [name for name in stored if name.startswith(f"{title}/")]
        return {name.split("/")[1]: stored[name] for name in names if not name.endswith("/mark")}


if __name__ == "__main__":
    import envs
    from envs.brax_physics import physics_of

    arrays = {}
    names = [name for name in envs.task_names() if name.startswith("brax/")]
    for title in [envs.spec(name).title for name in names]:
        model = physics_of(title, "generalized").env.sys
        numbers = {"mark": np.array(mark_of(model)), **computed(model)}
        arrays |= {f"{title}/{name}": x for name, x in numbers.items()}
    np.savez_compressed(STORED, **arrays)
