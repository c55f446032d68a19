"""Checkpoints: restored bit for bit, or an older one with a warning, or a clear error."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
import warnings
from collections import OrderedDict
from types import SimpleNamespace
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
import orbax.checkpoint as ocp
import pytest

from dreamer_jax import stored_tree
from dreamer_jax.checkpoint import Checkpointer, CorruptCheckpointError, load_tree
from dreamer_jax.integrity import write_checksums


class Counters(NamedTuple):
    updates: jax.Array
    healthy: jax.Array


@flax.struct.dataclass
class RunState:
    params: dict
    optimiser: optax.OptState
    counters: Counters
    key: jax.Array
    rest: tuple


def run_state(seed=0):
    """A state with everything that is hard to store in it."""
    keys = jax.random.split(jax.random.key(seed), 3)
    normal = np.random.default_rng(seed).normal
    params = {
        "encoder": {"conv_0": {"kernel": jnp.array(normal(size=(4, 4, 3, 8)), jnp.float32)}},
        "actor": {"out": {"kernel": jnp.array(normal(size=(5, 2)), jnp.bfloat16)}},
    }
    optimiser = optax.chain(optax.clip_by_global_norm(100.0), optax.adam(1e-3))
    moments = jax.tree.map(lambda x: x + jnp.asarray(seed, x.dtype), optimiser.init(params))
    return RunState(
        params=params,
        optimiser=moments,
        counters=Counters(jnp.int32(seed + 7), jnp.array([True, False])),
        key=keys,
        rest=(
            jnp.zeros((0, 3), jnp.bfloat16),
            jnp.array([jnp.nan, -0.0, jnp.inf, 1e-42], jnp.float32),
            None,
            jax.random.key(seed, impl="rbg"),
            jnp.arange(5, dtype=jnp.uint8),
        ),
    )


def assert_identical(actual, expected):
    """Same structure, shapes, dtypes and bits."""
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    for got, wanted in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        assert got.dtype == wanted.dtype and got.shape == wanted.shape
        if jnp.issubdtype(wanted.dtype, jax.dtypes.prng_key):
            got, wanted = jax.random.key_data(got), jax.random.key_data(wanted)
        assert np.asarray(got).tobytes() == np.asarray(wanted).tobytes()


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A folder with checkpoints of steps 1 and 2, to be copied by those who change it."""
    checkpointer = Checkpointer(tmp_path_factory.mktemp("saved"))
    for step in (1, 2):
        checkpointer.save(step, run_state(step), {"phase": step})
    return checkpointer.directory


@pytest.fixture
def folder(saved, tmp_path):
    return shutil.copytree(saved, tmp_path / "checkpoints")


# --- round trips ----------------------------------------------------------------------------------


@pytest.mark.parametrize("template", [run_state, lambda: jax.eval_shape(run_state)])
def test_a_run_is_restored_bit_for_bit(saved, template):
    state, metadata, step = Checkpointer(saved).restore(template())
    assert_identical(state, run_state(2))
    assert (metadata, step) == ({"phase": 2}, 2)


def test_an_earlier_step_can_be_asked_for(saved):
    state, metadata, step = Checkpointer(saved).restore(run_state(), step=1)
    assert_identical(state, run_state(1))
    assert (metadata, step) == ({"phase": 1}, 1)


def test_a_jitted_update_is_not_traced_again_after_restoring(saved):
    traces = []

    @jax.jit
    def update(state):
        traces.append(1)
        return state.replace(counters=state.counters._replace(updates=state.counters.updates + 1))

    state = run_state(2)
    expected = update(state)
    restored = update(Checkpointer(saved).restore(state)[0])
    assert_identical(restored, expected)
    assert len(traces) == 1


def test_arrays_return_to_the_devices_they_were_committed_to(tmp_path):
    device = jax.devices()[-1]
    state = {"committed": jax.device_put(jnp.ones(3), device), "free": jnp.ones(3)}
    checkpointer = Checkpointer(tmp_path)
    checkpointer.save(0, state, {})
    restored, _, _ = checkpointer.restore(state)
    assert restored["committed"].committed and restored["committed"].devices() == {device}
    assert not restored["free"].committed


def test_metadata_may_hold_numpy_values_and_nothing_that_json_lacks(tmp_path):
    checkpointer = Checkpointer(tmp_path)
    metadata = {
        "lengths": np.arange(4).reshape(2, 2),
        "progress": {"phase": np.int64(3), "share": 0.1},
        "step": "of the user's own",
    }
    checkpointer.save(5, {"x": jnp.ones(2)}, metadata)
    assert (
        checkpointer.metadata()
        == checkpointer.metadata(5)
        == {
            "lengths": [[0, 1], [2, 3]],
            "progress": {"phase": 3, "share": 0.1},
            "step": "of the user's own",
        }
    )
    with pytest.raises(ValueError, match="JSON"):
        checkpointer.save(6, {"x": jnp.ones(2)}, {"loss": float("nan")})
    assert checkpointer.steps() == [5] and len(list(tmp_path.iterdir())) == 1


def test_the_arrays_can_be_read_with_orbax_alone(saved):
    path = Checkpointer(saved).path(2) / "state"
    tree = ocp.PyTreeCheckpointer().restore(path)
    kernel = run_state(2).params["encoder"]["conv_0"]["kernel"]
    np.testing.assert_array_equal(tree["params"]["encoder"]["conv_0"]["kernel"], kernel)


@pytest.mark.parametrize("state", [{}, {"empty": jnp.zeros((0, 3)), "none": None}])
def test_a_state_without_any_number_is_restored_too(tmp_path, state):
    checkpointer = Checkpointer(tmp_path)
    checkpointer.save(0, state, {})
    assert_identical(checkpointer.restore(state)[0], state)


# --- which are kept -------------------------------------------------------------------------------


def test_the_newest_are_kept_and_the_newest_is_the_latest(tmp_path):
    checkpointer = Checkpointer(tmp_path / "new" / "folder", keep=2)
    assert checkpointer.latest() is None and checkpointer.steps() == []
    for step in (3, 20, 100):
        checkpointer.save(step, {"x": jnp.int32(step)}, {})
    assert checkpointer.steps() == [20, 100] and checkpointer.latest() == 100
    assert len(list(checkpointer.directory.iterdir())) == 2


def test_saving_an_earlier_step_replaces_the_continuation_it_left(tmp_path):
    checkpointer = Checkpointer(tmp_path, keep=3)
    for step in (1, 2, 3):
        checkpointer.save(step, {"x": jnp.int32(step)}, {})
    checkpointer.save(2, {"x": jnp.int32(-2)}, {})
    assert checkpointer.steps() == [1, 2]
    assert checkpointer.restore({"x": jnp.int32(0)})[0]["x"] == -2


def test_what_a_killed_process_left_is_not_a_checkpoint_and_goes_with_the_next_save(tmp_path):
    checkpointer = Checkpointer(tmp_path)
    checkpointer.save(1, {"x": jnp.ones(2)}, {})
    for name in ("step_000000000002.tmp", "step_000000000000.old.tmp"):
        (tmp_path / name / "state").mkdir(parents=True)
    assert checkpointer.steps() == [1]
    checkpointer.save(2, {"x": jnp.ones(2)}, {})
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "step_000000000001",
        "step_000000000002",
    ]


def test_a_missing_checkpoint_is_reported_with_those_that_exist(tmp_path, saved):
    with pytest.raises(FileNotFoundError, match=r"of step 7 .*steps \[1, 2\]"):
        Checkpointer(saved).restore(run_state(), step=7)
    with pytest.raises(FileNotFoundError, match="no checkpoint in"):
        Checkpointer(tmp_path).restore(run_state())
    with pytest.raises(FileNotFoundError, match="no checkpoint in"):
        Checkpointer(tmp_path).metadata()


# --- templates that do not fit --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda s: s.replace(counters=s.counters._replace(healthy=jnp.zeros(3, bool))),
            r"counters/healthy: saved bool \[2\], expected bool \[3\]",
        ),
        (
            lambda s: s.replace(params=jax.tree.map(lambda x: x.astype(jnp.float16), s.params)),
            r"params/actor/out/kernel: saved bfloat16 \[5, 2\], expected float16 \[5, 2\]",
        ),
        (
            lambda s: s.replace(key=jax.random.key_data(s.key)),
            r"key: saved key<fry> \[3\], expected uint32 \[3, 2\]",
        ),
        (
            lambda s: s.replace(params={**s.params, "value": jnp.ones(4)}),
            r"params/value: saved nothing, expected float32 \[4\]",
        ),
        (
            lambda s: s.replace(params={"encoder": s.params["encoder"]}),
            r"params/actor/out/kernel: saved bfloat16 \[5, 2\], expected nothing",
        ),
    ],
)
def test_a_template_that_does_not_fit_is_refused_and_both_sides_are_named(saved, change, message):
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # no falling back: the checkpoint is sound
        with pytest.raises(ValueError, match=message) as raised:
            Checkpointer(saved).restore(change(run_state()))
    assert "step_000000000002" in str(raised.value)


def test_many_differences_are_counted_not_listed(saved):
    with pytest.raises(ValueError, match=r"and \d+ more"):
        Checkpointer(saved).restore({"x": jnp.ones(3)})


# --- damage ---------------------------------------------------------------------------------------


def data_file(checkpoint):
    """The file with the arrays: the largest."""
    return max((checkpoint / "state").rglob("*"), key=lambda p: p.stat().st_size * p.is_file())


def flip_bits(checkpoint):
    # The bytes of one array, wherever it is stored: what no format's own check would see.
    needle = np.asarray(run_state(2).params["encoder"]["conv_0"]["kernel"]).tobytes()[:64]
    for path in (checkpoint / "state").rglob("*"):
        if path.is_file() and needle in (content := path.read_bytes()):
            path.write_bytes(content.replace(needle, needle[:40] + b"\x55" + needle[41:]))
            return
    raise AssertionError("the array was not found in any file")


DAMAGE = {
    "bits flipped": flip_bits,
    "arrays cut short": lambda c: os.truncate(data_file(c), 100),
    "arrays gone": lambda c: shutil.rmtree(c / "state"),
    "table gone": lambda c: (c / "leaves.json").unlink(),
    "table cut short": lambda c: os.truncate(c / "leaves.json", 50),
    "metadata emptied": lambda c: os.truncate(c / "metadata.json", 0),
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_a_damaged_newest_checkpoint_is_named_and_the_one_before_is_restored(folder, damage):
    checkpointer = Checkpointer(folder)
    damage(checkpointer.path(2))
    with pytest.warns(UserWarning, match="step_000000000002 .*going back .* step 1"):
        state, metadata, step = checkpointer.restore(run_state())
    assert_identical(state, run_state(1))
    assert (metadata, step) == ({"phase": 1}, 1)

    # The run goes on from there and saves the step that was damaged.
    checkpointer.save(2, run_state(5), {"phase": 2})
    state, _, step = checkpointer.restore(run_state())
    assert_identical(state, run_state(5))
    assert step == 2 and checkpointer.steps() == [1, 2]


def test_a_damaged_checkpoint_that_was_asked_for_is_an_error(folder):
    checkpointer = Checkpointer(folder)
    DAMAGE["arrays gone"](checkpointer.path(2))
    with pytest.raises(CorruptCheckpointError, match="step_000000000002 .*delete what is damaged"):
        checkpointer.restore(run_state(), step=2)


def test_with_nothing_left_every_damaged_checkpoint_is_named(folder):
    checkpointer = Checkpointer(folder)
    for step in (1, 2):
        DAMAGE["metadata emptied"](checkpointer.path(step))
    with (
        pytest.warns(UserWarning),
        pytest.raises(CorruptCheckpointError, match="step_000000000002 .*step_000000000001 "),
    ):
        checkpointer.restore(run_state())


def full_disk(*_, **__):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


class FullOrbax:
    """What Orbax raises on a full disk: TensorStore's text, in an error of no special kind."""

    save = staticmethod(
        lambda *_, **__: (_ for _ in ()).throw(
            ValueError("RESOURCE_EXHAUSTED: Failed to write [os_error_code='28']")
        )
    )
    __enter__ = lambda self: self  # noqa: E731
    __exit__ = lambda self, *_: None  # noqa: E731


def little_room(_):
    return SimpleNamespace(total=10**9, free=1000)


@pytest.mark.parametrize(
    ("name", "failure"),
    [
        ("write_json_atomically", full_disk),
        ("_orbax", FullOrbax),
        ("shutil", SimpleNamespace(disk_usage=little_room)),
    ],
)
def test_a_full_disk_leaves_the_earlier_checkpoints_and_says_so(folder, monkeypatch, name, failure):
    monkeypatch.setattr(stored_tree, name, failure)
    checkpointer = Checkpointer(folder)
    with pytest.raises(OSError, match="No space left .* MiB free .* are intact") as raised:
        checkpointer.save(3, run_state(3), {})
    assert raised.value.errno == errno.ENOSPC and "step_000000000003" in str(raised.value)
    monkeypatch.undo()
    assert len(list(folder.iterdir())) == 2
    assert_identical(checkpointer.restore(run_state())[0], run_state(2))


def test_a_disk_without_room_is_told_before_anything_is_written(folder, monkeypatch):
    monkeypatch.setattr(stored_tree, "shutil", SimpleNamespace(disk_usage=little_room))
    monkeypatch.setattr(stored_tree, "_orbax", lambda: pytest.fail("Orbax was called"))
    with pytest.raises(OSError, match="No space left"):
        Checkpointer(folder).save(3, run_state(3), {})


# --- kill -9 --------------------------------------------------------------------------------------

SAVE_FOR_EVER = """
    import os, shutil, signal, sys
    import numpy as np
    from dreamer_jax.checkpoint import Checkpointer

    where = sys.argv[2]

    def kill(*args, **kwargs):
        os.kill(os.getpid(), signal.SIGKILL)

    checkpointer = Checkpointer(sys.argv[1])
    for step in range(1, 50):
        if step == 4 and where != "any moment":
            owner, name = {"before it is named": (os, "replace"),
                           "while removing": (shutil, "rmtree")}[where]
            # os.replace names JSON files too: kill only where the folder is renamed.
            original = getattr(owner, name)
            def replacement(*args, **kwargs):
                if name != "replace" or "json" not in str(args[0]):
                    kill()
                return original(*args, **kwargs)
            setattr(owner, name, replacement)
        checkpointer.save(step, {"x": np.full((1000, 100), step, np.float32)}, {"step": step})
        print(step, flush=True)
"""


@pytest.mark.parametrize("where", ["any moment", "before it is named", "while removing"])
def test_a_process_killed_while_saving_leaves_a_folder_that_can_be_restored(tmp_path, where):
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(SAVE_FOR_EVER), str(tmp_path), where],
        stdout=subprocess.PIPE,
        text=True,
    )
    saved = 0
    for line in process.stdout:
        saved = int(line)
        if where == "any moment" and saved == 3:
            time.sleep(np.random.default_rng().uniform(0, 0.3))
            process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL

    checkpointer = Checkpointer(tmp_path)
    state, metadata, step = checkpointer.restore({"x": jnp.zeros((1000, 100))})
    assert saved <= step <= saved + 1
    assert metadata == {"step": step} and (state["x"] == step).all()
    checkpointer.save(step + 1, state, {})
    assert checkpointer.steps() == [step, step + 1] and len(list(tmp_path.iterdir())) == 2


# --- without a template ---------------------------------------------------------------------------


def test_a_tree_is_loaded_without_a_template_as_nested_dicts_of_numpy(saved):
    tree = load_tree(saved)
    state = run_state(2)
    assert set(tree) == {"params", "optimiser", "counters", "key", "rest"}
    kernel = tree["params"]["actor"]["out"]["kernel"]
    assert isinstance(kernel, np.ndarray) and kernel.dtype == jnp.bfloat16
    assert_identical(tree["params"], jax.tree.map(np.asarray, state.params))
    assert tree["counters"]["updates"] == 9
    np.testing.assert_array_equal(tree["key"], jax.random.key_data(state.key))
    assert tree["rest"]["0"].shape == (0, 3)


def test_a_part_of_a_tree_is_loaded_from_one_checkpoint(saved):
    encoder = load_tree(Checkpointer(saved).path(1), "params/encoder")
    assert_identical(encoder, jax.tree.map(np.asarray, run_state(1).params["encoder"]))


def test_a_part_that_is_not_there_is_an_error_naming_what_is(saved):
    with pytest.raises(KeyError, match=r"no 'params/critic'.*at params .*\['actor', 'encoder'\]"):
        load_tree(saved, "params/critic")
    with pytest.raises(KeyError, match=r"no 'weights/encoder'.*at the top .*'counters', 'key'"):
        load_tree(saved, "weights/encoder")


def test_loading_goes_back_from_a_damaged_checkpoint_with_a_warning(folder):
    flip_bits(Checkpointer(folder).path(2))
    with pytest.warns(UserWarning, match="step_000000000002"):
        assert load_tree(folder)["counters"]["updates"] == 8


def test_loading_from_nothing_is_an_error(tmp_path):
    for directory in (tmp_path, tmp_path / "absent", tmp_path / "step_000000000001"):
        with pytest.raises(FileNotFoundError, match="no checkpoint"):
            load_tree(directory)


def test_another_format_is_an_error_not_damage(folder):
    table = Checkpointer(folder).path(2) / "leaves.json"
    table.write_text(json.dumps({**json.loads(table.read_text()), "format": 99}))
    write_checksums(table.parent)
    with pytest.raises(ValueError, match="format 99, this version reads 1"):
        load_tree(folder)


def test_leaves_whose_paths_collide_are_refused(tmp_path):
    with pytest.raises(ValueError, match="two leaves .*'0'"):
        Checkpointer(tmp_path).save(1, OrderedDict({0: jnp.ones(2), "0": jnp.ones(3)}), {})
