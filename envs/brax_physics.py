"""Dynamics of the six Brax tasks as pure functions.

Models and dynamics are those of the package `brax`, as are the rewards of locomotion; the two
pendula are the swing-ups of the thesis (equations 24 and 25).

A action, L links, Q joint positions.
"""

from __future__ import annotations

import contextlib
import functools
import io
import warnings
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from envs.base import TaskSpec
from envs.brax_models import camera, model_xml, not_installed, painted_xml
from envs.scene import Scene, scene_of

try:
    # Brax says on import that `warp` is missing, which nothing here needs.
    with contextlib.redirect_stdout(io.StringIO()):
        import mujoco
        from brax.envs import get_environment
        from brax.envs.base import PipelineEnv, State
        from brax.io import mjcf
except ModuleNotFoundError as error:
    raise not_installed(error.name) from error

# Left to itself, MuJoCo writes its warnings to a file in the current folder.
mujoco.set_mju_user_warning(warnings.warn)

_BRAX_NAMES = {
    "Ant": "ant",
    "HalfCheetah": "halfcheetah",
    "Hopper": "hopper",
    "Walker2D": "walker2d",
}

# Physics steps in an environment step, of the backends that integrate rigid bodies as MuJoCo does
# ("generalized" and "mjx") and of those that need shorter steps ("spring" and "positional").
_PHYSICS_STEPS = {
    "Ant": (2, 4),
    "HalfCheetah": (2, 6),
    "Hopper": (8, 8),
    "Walker2D": (8, 8),
    "InvertedPendulum": (4, 4),
    "InvertedDoublePendulum": (8, 8),
}
_SHORT_STEPS = ("spring", "positional")

# Newtons with which an action of 1 pushes the cart: of the pendulum what its model's motor has, of
# the double pendulum what PyBullet's has, for its model's 500 would drive it into the ends of the
# rail faster than "generalized" and "mjx" can follow.
_PUSH = {"InvertedPendulum": 300.0, "InvertedDoublePendulum": 200.0}


@contextlib.contextmanager
def quiet():
    """Keeps what Brax has to say of its age, and of MuJoCo's, to itself."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


class _Swingup(PipelineEnv):
    """A pendulum on a cart, of one pole or two, that starts hanging and never ends."""

    def __init__(self, title: str, backend: str, n_frames: int):
        system = mjcf.loads(model_xml(title))
        # PyBullet's time step. Physics steps of the models' own 10 and 20 ms gain energy when the
        # cart meets an end of the rail, until nothing is finite.
        system = system.tree_replace({"opt.timestep": TaskSpec.step_seconds / n_frames})
        self._push = _PUSH[title] / system.actuator.gear
        super().__init__(system, backend=backend, n_frames=n_frames)

    def reset(self, rng: jax.Array) -> State:
        """Still, hanging but for an angle of each joint in U(-0.1, 0.1)."""
        hinges = self.sys.q_size() - 1
        angles = jax.random.uniform(rng, (hinges,), minval=-0.1, maxval=0.1).at[0].add(jnp.pi)
        positions = self.sys.init_q.at[1:].set(angles)
        physics = self.pipeline_init(positions, jnp.zeros(self.sys.qd_size()))
        return State(physics, None, jnp.float32(0), jnp.float32(0))

    def step(self, state: State, action: jax.Array) -> State:
        """Push the cart with `action` of the greatest force; reward: the sum of the cosines of the
        joint's positions, the second relative to the first pole."""
        physics = self.pipeline_step(state.pipeline_state, action * self._push)
        return state.replace(pipeline_state=physics, reward=jnp.cos(physics.q[1:]).sum())


def brax_state(state: Any) -> State:
    """The engine's state as one of Brax's environments."""
    return State(state, None, jnp.float32(0), jnp.float32(0), {}, {})


class Physics:
    """One task's dynamics as pure functions of Brax's state.

    Attributes:
      action_size: |A|.
      positions: Q.
      seconds: simulated time of one `step`.
      env: Brax's environment.

    Args:
      title: one of the six names of the thesis, such as "Walker2D".
      backend: Brax's engine: "generalized", "spring", "positional" or "mjx".
    """

    def __init__(self, title: str, backend: str):
        steps = _PHYSICS_STEPS[title][backend in _SHORT_STEPS]
        with quiet():
            if title in _BRAX_NAMES:
                env = get_environment(_BRAX_NAMES[title], backend=backend, n_frames=steps)
            else:
                env = _Swingup(title, backend, steps)
        self.env = env
        self.backend = backend
        self._free = env.sys.link_types[0] == "f"
        self.action_size = env.action_size
        self.positions = env.sys.q_size()
        self.seconds = float(env.dt)

    def start(self, key: jax.Array) -> Any:
        """The state in which an episode starts."""
        with quiet():
            return self.env.reset(key).pipeline_state

    def step(self, state: Any, action: jax.Array) -> tuple[Any, jax.Array, jax.Array]:
        """Advance by one environment step with `action` (float32 [|A|], clipped to [-1, 1]).

        Returns:
          The state, the reward and whether the episode ended. A state in which the engine
          has diverged ends it too, without reward, and is replaced by the one before.
        """
        with quiet():
            after = self.env.step(brax_state(state), jnp.clip(action, -1.0, 1.0))
        return self.judged(state, after)

    def judged(self, before: Any, after: State) -> tuple[Any, jax.Array, jax.Array]:
        """What `step` returns, of the state before and of what Brax's environment makes of it."""
        new, reward = after.pipeline_state, jnp.float32(after.reward)
        finite = jnp.isfinite(jnp.concatenate([new.q, new.qd, reward[None]])).all()
        new = jax.tree.map(lambda a, b: jnp.where(finite, a, b), new, before)
        return new, jnp.where(finite, reward, 0.0), ~finite | (after.done > 0.5)

    def hold(self, state: Any, action: jax.Array, repeat: int):
        """`repeat` steps with one action, fewer if the episode ends; rewards are summed."""

        def one(carry, _):
            state, total, over = carry
            new, reward, terminal = self.step(state, action)
            new = jax.tree.map(lambda a, b: jnp.where(over, a, b), state, new)
            return (new, total + jnp.where(over, 0.0, reward), over | terminal), None

        return jax.lax.scan(one, (state, jnp.float32(0), jnp.bool_(False)), None, repeat)[0]

    def poses(self, state: Any) -> tuple[jax.Array, jax.Array]:
        """Where the links are: positions float32 [L, 3] and quaternions float32 [L, 4]."""
        places = state.x.pos
        if self._free:
            # Brax starts the Ant with a quaternion that is not of length 1, by which it scales all
            # that hangs on the torso until the first step.
            torso, scale = places[:1], jnp.square(state.q[3:7]).sum()
            places = torso + (places - torso) / scale
        return places, state.x.rot


@functools.cache
def physics_of(title: str, backend: str) -> Physics:
    """One `Physics` for all who ask for it: models take a while to load."""
    return Physics(title, backend)


@functools.cache
def task_scene(title: str) -> Scene:
    """What `envs.ray_casting` draws of a task, nearly as MuJoCo does."""
    with quiet():
        model = mujoco.MjModel.from_xml_string(mjcf.fuse_bodies(painted_xml(title)))
    scene = scene_of(model)
    # MuJoCo lights a floor at points that are 40 m apart, and so sees no edge of the pendula's
    # cone of light. A wide lamp further up comes out alike.
    lights = [
        replace(light, position=(0.0, 0.0, 8.0), cutoff=180.0, exponent=0.0)
        if light.kind == "spot"
        else light
        for light in scene.lights
    ]
    return replace(scene, camera=camera(title), lights=tuple(lights))
