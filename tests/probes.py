"""Environments of a few lines, in pure JAX, with known answers. They follow the Env protocol."""

from typing import NamedTuple

import jax
import jax.numpy as jnp


class TimeStep(NamedTuple):
    image: jax.Array
    reward: jax.Array
    first: jax.Array
    terminal: jax.Array


class State(NamedTuple):
    position: jax.Array
    clock: jax.Array
    limit: jax.Array
    key: jax.Array
    episode: jax.Array


class Probe:
    """A point that moves by its action; its image is a bright column at its position.

    An episode falls after 3 to 9 steps, drawn from the phase's key; the next step resets. The
    reward is `1 - 4 (action[0] - 0.5)^2`, so the best action is 0.5 everywhere, with reward 1.
    """

    discrete = False
    has_host = True

    def __init__(self, action_size=2, image_size=32, falls=True):
        self.action_size, self.image_size, self.falls = action_size, image_size, falls

    def _image(self, position):
        column = jnp.clip((position + 1) / 2 * self.image_size, 0, self.image_size - 1)
        bright = jnp.arange(self.image_size) == column.astype(jnp.int32)
        image = jnp.where(bright[None, :, None], 255, 40).astype(jnp.uint8)
        return jnp.broadcast_to(image, (self.image_size, self.image_size, 3))

    def _start(self, key, episode):
        draw = jax.random.fold_in(key, episode)
        position = jax.random.uniform(draw, minval=-0.5, maxval=0.5)
        limit = jax.random.randint(draw, (), 3, 10)
        return State(position, jnp.int32(0), limit, key, episode)

    def reset(self, slot, key):
        state = self._start(key, jnp.int32(0))
        false = jnp.bool_(False)
        return state, TimeStep(self._image(state.position), jnp.float32(0), ~false, false)

    def step(self, state, action):
        over = self.falls & (state.clock >= state.limit)
        fresh = self._start(state.key, state.episode + 1)
        moved = state._replace(
            position=jnp.clip(state.position + 0.1 * action[0], -1, 1), clock=state.clock + 1
        )
        new = jax.tree.map(lambda a, b: jnp.where(over, a, b), fresh, moved)
        reward = jnp.where(over, 0.0, 1 - 4 * (action[0] - 0.5) ** 2)
        terminal = ~over & self.falls & (new.clock >= new.limit)
        return new, TimeStep(self._image(new.position), reward.astype(jnp.float32), over, terminal)

    def check(self):
        pass

    def close(self):
        pass


class Inside(Probe):
    """A probe that is a part of the program."""

    has_host = False


class Walk(Probe):
    """Five cells in a row, shown as a bright column; a choice steps left, not at all, or right.

    Arriving in the middle cell, or staying there, is worth 1. The best policy goes there and
    stays, so that a state d cells away has the value discount^d / (1 - discount), its own reward
    counted.
    """

    discrete = True
    cells, middle = 5, 2

    def __init__(self, image_size=32):
        super().__init__(action_size=3, image_size=image_size, falls=False)

    def _time_step(self, cell, reward, first):
        image = self._image((2 * cell + 1) / self.cells - 1)
        return TimeStep(image, jnp.float32(reward), jnp.bool_(first), jnp.bool_(False))

    def reset(self, slot, key):
        cell = jax.random.randint(key, (), 0, self.cells)
        return cell, self._time_step(cell, 0.0, True)

    def step(self, state, action):
        cell = jnp.clip(state + jnp.argmax(action) - 1, 0, self.cells - 1)
        return cell, self._time_step(cell, cell == self.middle, False)

    @classmethod
    def cell_of(cls, image):
        """Which cell images show: uint8 [..., size, size, 3] -> int [...]."""
        column = image[..., 0, :, 0].argmax(-1)
        return column * cls.cells // image.shape[-2]


class BrokenProbe(Probe):
    """A probe whose simulators report an error after a given number of phases."""

    def __init__(self, phases, **sizes):
        super().__init__(**sizes)
        self.left = phases

    def check(self):
        self.left -= 1
        if self.left < 0:
            raise RuntimeError("the simulator of probe/point died")
