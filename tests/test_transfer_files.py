"""Parameters in .npz, .safetensors and Orbax checkpoints."""

import pickle

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import transfer
from transfer_trees import LIBRARIES, assert_same_kind, bits, library_tree, like, trees

NAMES = ("source.npz", "source.safetensors", "checkpoint")
TREE = {
    "a": {"w": jnp.arange(6.0).reshape(2, 3), "b": jnp.ones(2, jnp.bfloat16)},
    "n": jnp.array(3),
}


class Alarm:
    """Rings when unpickled."""

    def __reduce__(self):
        return pytest.fail, ("a file executed code",)


@pytest.mark.parametrize("name", NAMES[:2])
@hypothesis.settings(max_examples=25, deadline=None)
@hypothesis.given(tree=trees())
def test_files_give_back_every_bit_of_random_trees(tmp_path_factory, name, tree):
    path = tmp_path_factory.mktemp("files") / name
    transfer.save(path, tree)
    loaded = transfer.load(path)
    assert {p: (x.shape, x.dtype) for p, x in loaded.items()} == {
        p: (x.shape, x.dtype) for p, x in transfer.flatten(tree).items()
    }
    assert bits(loaded) == bits(tree)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("library", LIBRARIES)
def test_a_tree_of_every_library_is_itself_again_after_a_file(tmp_path, library, name):
    tree = library_tree(library)
    transfer.save(tmp_path / name, tree)
    again = transfer.copy(like(tree, 5), transfer.load(tmp_path / name))
    assert_same_kind(again, tree)
    assert bits(again) == bits(tree)


@pytest.mark.parametrize("name", NAMES)
def test_files_keep_dtypes_and_scalars(tmp_path, name):
    tree = TREE | {"c": jnp.ones(2, jnp.complex64), "flag": jnp.array([True, False])}
    transfer.save(tmp_path / name, tree)
    loaded = transfer.load(tmp_path / name)
    assert bits(loaded) == bits(tree)
    assert loaded["a/b"].dtype == jnp.bfloat16 and loaded["n"].shape == ()


@pytest.mark.parametrize("name", NAMES)
def test_patterns_choose_what_is_written_and_what_is_read(tmp_path, name):
    transfer.save(tmp_path / name, TREE, where="a/*")
    assert set(transfer.load(tmp_path / name)) == {"a/w", "a/b"}
    assert set(transfer.load(tmp_path / name, "**", "!a/b")) == {"a/w"}
    with pytest.raises(ValueError, match=r"Pattern 'z/\*' matches no leaf"):
        transfer.load(tmp_path / name, "z/*")


@pytest.mark.parametrize("name", NAMES)
def test_files_hold_8_bit_floating_point_numbers(tmp_path, name):
    tree = {"w": jnp.ones(3, jnp.float8_e4m3fn), "v": jnp.ones(3, jnp.float8_e5m2)}
    transfer.save(tmp_path / name, tree)
    assert bits(transfer.load(tmp_path / name)) == bits(tree)
    assert transfer.load(tmp_path / name)["w"].dtype == jnp.float8_e4m3fn


def test_a_dtype_that_safetensors_has_not_is_named(tmp_path):
    with pytest.raises(ValueError, match="w is int4, which .safetensors cannot"):
        transfer.save(tmp_path / "x.safetensors", {"w": jnp.ones(3, jnp.int4)})
    transfer.save(tmp_path / "x.npz", {"w": jnp.ones(3, jnp.int4)})
    assert transfer.load(tmp_path / "x.npz")["w"].dtype == jnp.int4


def test_other_libraries_read_what_is_written(tmp_path):
    from safetensors.numpy import load_file

    tree = {"file": jnp.ones(2), "a": {"w": jnp.zeros((2, 2))}}
    transfer.save(tmp_path / "x.npz", tree)
    with np.load(tmp_path / "x.npz") as archive:
        assert bits(dict(archive)) == bits(tree)
    transfer.save(tmp_path / "x.safetensors", tree)
    assert bits(load_file(tmp_path / "x.safetensors")) == bits(tree)


def test_what_other_libraries_write_is_read(tmp_path):
    import orbax.checkpoint as ocp
    from safetensors.numpy import save_file

    flat = {"a/w": np.arange(4.0, dtype=np.float32), "b": np.ones((2, 2), np.float32)}
    np.savez(tmp_path / "x.npz", **flat)
    save_file(flat, tmp_path / "x.safetensors")
    with ocp.StandardCheckpointer() as checkpointer:
        nested = {"a": {"w": flat["a/w"]}, "b": flat["b"], "list": [flat["b"], flat["b"]]}
        checkpointer.save(tmp_path / "x", nested)
    assert bits(transfer.load(tmp_path / "x.npz")) == bits(flat)
    assert bits(transfer.load(tmp_path / "x.safetensors")) == bits(flat)
    assert bits(transfer.load(tmp_path / "x")) == bits(nested)
    assert set(transfer.load(tmp_path / "x", "list/1")) == {"list/1"}


def test_nothing_that_is_loaded_executes_code(tmp_path):
    np.savez(tmp_path / "objects.npz", w=np.array([Alarm()], dtype=object))
    with pytest.raises(ValueError, match="holds Python objects, which are never loaded"):
        transfer.load(tmp_path / "objects.npz")
    for name in ("pickle.npz", "pickle.safetensors"):
        (tmp_path / name).write_bytes(pickle.dumps(Alarm()))
        with pytest.raises(ValueError, match=name):
            transfer.load(tmp_path / name)


def test_a_damaged_file_is_named(tmp_path):
    for name in NAMES[:2]:
        transfer.save(tmp_path / name, TREE)
        content = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(content[: len(content) // 2])
        with pytest.raises(ValueError, match=name):
            transfer.load(tmp_path / name)
    with pytest.raises(FileNotFoundError, match="nowhere"):
        transfer.load(tmp_path / "nowhere")


def test_a_folder_that_is_no_checkpoint_points_to_the_one_inside(tmp_path):
    transfer.save(tmp_path / "run" / "state", TREE)
    with pytest.raises(ValueError, match=r"no Orbax checkpoint; there is one in .*state"):
        transfer.load(tmp_path / "run")


def test_files_are_replaced_whole_and_checkpoints_never(tmp_path, monkeypatch):
    path = tmp_path / "x.npz"
    transfer.save(path, TREE)
    monkeypatch.setattr(np.lib.format, "write_array", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        transfer.save(path, {"w": jnp.ones(1)})
    assert bits(transfer.load(path)) == bits(TREE) and list(tmp_path.iterdir()) == [path]
    monkeypatch.undo()
    transfer.save(path, {"w": jnp.ones(1)})
    assert set(transfer.load(path)) == {"w"}
    transfer.save(tmp_path / "checkpoint", TREE)
    with pytest.raises(FileExistsError, match="checkpoint exists"):
        transfer.save(tmp_path / "checkpoint", TREE)


@pytest.mark.parametrize(
    ("name", "tree", "message"),
    [
        ("x.npz", {"key": jax.random.key(0)}, "key is a typed PRNG key"),
        ("x.npz", jnp.ones(2), "a bare array has no name"),
        ("x.npz", {}, "no array to write"),
        ("x.npz", {"__dtypes__": jnp.ones(1)}, "'__dtypes__' is taken"),
        ("x", {"a": jnp.ones((0, 2))}, "no empty arrays; leave out a"),
        ("x", {"a": jnp.ones(1), "a/b": jnp.ones(1)}, "one leaf lies below another"),
    ],
)
def test_what_a_format_cannot_hold_is_refused(tmp_path, name, tree, message):
    with pytest.raises(ValueError, match=f"(?i){message}"):
        transfer.save(tmp_path / name, tree)
    assert not (tmp_path / name).exists()
